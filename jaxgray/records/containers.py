"""Arrays by name: npz, npy, mat, hdf5 and parquet."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from jaxgray.records.table import Table


def read_npz(path: Path) -> Table:
    """A NumPy archive; columns of a 2-D array `u` are `u[0]`, `u[1]`, …, single numbers are scalars.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no archive of numbers.
    """
    arrays = {}
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            for name in archive.files:
                # Python objects would run code on being read; what else is in the file can still be used.
                with suppress(ValueError):
                    arrays[name] = archive[name]
    except Exception as error:  # A damaged file fails in as many ways as the library has steps.
        raise ValueError(f"{path.name} is no npz archive of numbers ({one_line(error)}).") from None
    return table_of_arrays(path.name, arrays)


def read_npy(path: Path) -> Table:
    """One NumPy array, mapped into memory, so that only what is used is read.

    Columns of a structured array bear the names of its fields, those of a plain one are `data[0]`, `data[1]`, ….

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no array of numbers.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # A damaged file fails in as many ways as the library has steps.
        raise ValueError(f"{path.name} is no npy array of numbers ({one_line(error)}).") from None
    if array.dtype.names is not None:
        return table_of_arrays(path.name, {name: array[name] for name in array.dtype.names})
    return table_of_arrays(path.name, {"data": array})


def read_mat(path: Path) -> Table:
    """A MATLAB file, version 5 or 7.3; fields of a structure `data` are `data.u`.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no such file.
    """
    from scipy.io import loadmat

    try:
        found = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        # Version 7.3 is HDF5 with the axes the other way round.
        return read_hdf5(path, transposed=True)
    except Exception as error:  # A damaged file fails in as many ways as the library has steps.
        raise ValueError(f"{path.name} is no MATLAB file ({one_line(error)}).") from None
    arrays = {name: value for name, value in _members(found) if not name.startswith("__")}
    return table_of_arrays(path.name, arrays)


def read_hdf5(path: Path, *, transposed: bool = False) -> Table:
    """An HDF5 file; a dataset in a group is `group/u`, its attribute `units` or `unit` is taken.

    **Arguments:**

    - `path`: the file.
    - `transposed`: whether 2-D arrays have the samples last, as MATLAB writes them; default False.

    **Returns:** a `Table`.

    **Raises:** `ImportError` without h5py, `ValueError` where the file is no HDF5.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError(f"{path.name} needs h5py: pip install 'jaxgray[hdf5]'.") from None

    arrays, units = {}, {}
    try:
        with h5py.File(path, "r") as file:

            def visit(name, node):
                if not isinstance(node, h5py.Dataset) or name.startswith("#"):
                    return
                if node.dtype.kind in "fiub" and node.shape is not None:
                    name = name.replace("/", ".") if transposed else name
                    arrays[name] = node[()].T if transposed else node[()]
                    unit = node.attrs.get("units", node.attrs.get("unit", ""))
                    units[name] = unit.decode() if isinstance(unit, bytes) else str(unit)

            file.visititems(visit)
    except OSError as error:
        raise ValueError(f"{path.name} is no HDF5 file ({one_line(error)}).") from None
    return table_of_arrays(path.name, arrays, units)


def read_parquet(path: Path) -> Table:
    """A Parquet file.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ImportError` without pyarrow, `ValueError` where the file is no Parquet.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ImportError(f"{path.name} needs pyarrow: pip install 'jaxgray[parquet]'.") from None

    try:
        table = pyarrow.parquet.read_table(path, pre_buffer=False)
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"{path.name} is no Parquet file ({one_line(error)}).") from None

    def column(position: int) -> np.ndarray:
        return table.column(position).to_numpy()

    return Table(path.name, tuple(table.column_names), column)


def table_of_arrays(source: str, arrays: Mapping[str, object], units=None) -> Table:
    """Columns out of named arrays, samples along the longer axis.

    **Arguments:**

    - `source`: the file's name, for messages.
    - `arrays`: values by name; text and arrays of three or more dimensions are left out.
    - `units`: units by name; default none.

    **Returns:** a `Table`.
    """
    columns, scalars, known = {}, {}, {}
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "fiubmM" or array.ndim > 2:
            continue
        if array.size == 1 and array.dtype.kind in "fiub":
            scalars[name] = float(array.reshape(()))
            continue
        if array.ndim == 0:
            continue
        unit = (units or {}).get(name, "")
        if array.ndim == 2 and min(array.shape) > 1:
            tall = array if array.shape[0] >= array.shape[1] else array.T
            for k in range(tall.shape[1]):
                columns[f"{name}[{k}]"] = tall[:, k]
                known[f"{name}[{k}]"] = unit
        else:
            columns[name] = array.reshape(-1)
            known[name] = unit
    values = list(columns.values())
    return Table(source, tuple(columns), lambda position: values[position], units=known, scalars=scalars)


def _members(found: Mapping, prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, value in found.items():
        if isinstance(value, dict):
            yield from _members(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def one_line(error: Exception) -> str:
    """What an error of a library says, in a line."""
    return str(error).strip().partition("\n")[0][:120] or type(error).__name__
