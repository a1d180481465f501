"""Tables that are in memory already: data frames, xarray objects, arrays by name, benchmark records."""

from collections.abc import Mapping

import numpy as np

from jaxgray.records.readers.containers import table_of_arrays
from jaxgray.records.readers.table import Table

TIME_NAMES = ("t", "time")


def table_in_memory(data) -> Table | None:
    """The table of an object that holds columns, known by what it can do.

    **Arguments:**

    - `data`: a data frame (pandas, polars or alike), an xarray `Dataset` or `DataArray`, a dictionary of arrays, or
        a record of the package `nonlinear_benchmarks` (its columns are `u` and `y`).

    **Returns:** a `Table`, None for any other object.
    """
    if hasattr(data, "coords") and hasattr(data, "dims"):
        return table_of_xarray(data)
    if hasattr(data, "columns"):
        return table_of_frame(data)
    if all(hasattr(data, name) for name in ("u", "y", "sampling_time")):
        arrays = {"u": data.u, "y": data.y}
        if data.sampling_time is not None:
            arrays["sampling_time"] = data.sampling_time
        return table_of_arrays(f"the record {getattr(data, 'name', '')}".strip(), arrays)
    if isinstance(data, Mapping):
        return table_of_arrays("the dictionary", data)
    return None


def table_of_frame(frame) -> Table:
    """A data frame (pandas, polars or alike), known by its `columns`.

    A named index is a column too; a nameless one of time stamps is `time`, one of floating numbers `index`.

    **Arguments:**

    - `frame`: the data frame.

    **Returns:** a `Table`.
    """
    labels = list(frame.columns)
    headers = [str(name) for name in labels]
    index = _index_name(getattr(frame, "index", None))
    if index is not None and index not in headers:
        headers.append(index)

    def column(position: int) -> np.ndarray:
        return _plain(frame[labels[position]] if position < len(labels) else frame.index)

    return Table("the data frame", tuple(headers), column)


def _index_name(index) -> str | None:
    kind = getattr(getattr(index, "dtype", None), "kind", None)
    if kind is None or hasattr(index, "levels"):
        return None
    if index.name is not None:
        return str(index.name)
    return {"M": "time", "m": "time", "f": "index"}.get(kind)


def _plain(series) -> np.ndarray:
    """A series as an array; pandas keeps time zones, and integers with gaps, in types of its own."""
    dtype = getattr(series, "dtype", None)
    kind = getattr(dtype, "kind", "")
    if hasattr(dtype, "na_value"):
        if kind == "M":
            return series.to_numpy(dtype="datetime64[ns]")
        if kind and kind in "iufb":
            return series.to_numpy(dtype=np.float64, na_value=np.nan)
    return np.asarray(series)


def table_of_xarray(data) -> Table:
    """An xarray `Dataset` or `DataArray`; units are those of the attribute `units` or `unit`.

    A variable over time and one more dimension gives a column per entry of that dimension: by its labels
    `motion.left`, `motion.right`, or by number `motion[0]`, `motion[1]`. Labels of a nameless array stand alone.

    **Arguments:**

    - `data`: the object.

    **Returns:** a `Table`.
    """
    variables = dict(data.data_vars) if hasattr(data, "data_vars") else {data.name or "": data}
    columns, units, scalars = {}, {}, {}

    def add(name, values, attributes):
        columns[name] = values
        units[name] = str(attributes.get("units", attributes.get("unit", "")))

    for name, variable in (*variables.items(), *data.coords.items()):
        name = str(name)
        if variable.ndim == 0 and variable.dtype.kind in "iuf":
            scalars[name] = float(variable)
        elif variable.ndim == 1 and variable.dtype.kind not in "OUS":
            add(name or "values", variable, variable.attrs)
        elif variable.ndim == 2:
            over = _sample_dimension(variable)
            (across,) = [dimension for dimension in variable.dims if dimension != over]
            labels = np.asarray(variable.coords[across]).tolist() if across in variable.coords else []
            for k in range(variable.sizes[across]):
                if labels and isinstance(labels[k], str):
                    header = f"{name}.{labels[k]}" if name else labels[k]
                else:
                    header = f"{name or 'values'}[{k}]"
                add(header, variable.isel({across: k}), variable.attrs)
    for name, value in data.attrs.items():
        if name == "sampling_time":
            scalars[name] = float(value)
    series = list(columns.values())
    return Table("the dataset", tuple(columns), lambda k: np.asarray(series[k]), units=units, scalars=scalars)


def _sample_dimension(variable) -> str:
    """The dimension called t or time, else the longest."""
    for dimension in variable.dims:
        if str(dimension).lower() in TIME_NAMES:
            return dimension
    for name, coordinate in variable.coords.items():
        if str(name).lower() in TIME_NAMES and coordinate.ndim == 1:
            return coordinate.dims[0]
    return max(variable.dims, key=lambda dimension: variable.sizes[dimension])
