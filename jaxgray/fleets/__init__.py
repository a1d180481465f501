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
long         one record that is larger than a machine
"""

from .long.compressed import compress_on_workers
from .long.refinement import refine_on_workers
from .run import Fleet, fleet
from .runner import Lost

__all__ = ["Fleet", "Lost", "compress_on_workers", "fleet", "refine_on_workers"]
