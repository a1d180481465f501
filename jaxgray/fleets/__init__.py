"""Many records on many workers: a store of results, tables and a page of the population, drift of machines over time.

run          the pipeline
tasks        what is asked of every record, and the key of its result
store        the folder that says what has been done
worker       what a worker process does
runner       executors, Dask clients, a local cluster
batch        records of one shape side by side
tables       results as files for pandas, polars, DuckDB and xarray
population   outliers and trends
page         the population as one page
drift        machines over time
"""

from .run import Fleet, fleet
from .runner import Lost

__all__ = ["Fleet", "Lost", "fleet"]
