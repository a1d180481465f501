"""Columns of a file in chunks, for records longer than memory."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxgray.records.readers.containers import mapped
from jaxgray.records.readers.hdf5 import data_sets, hdf5_file, readable
from jaxgray.records.readers.limits import Refused, check_file, reading
from jaxgray.records.readers.parquet import parquet_file, parquet_numbers, row_groups

CHUNK_SAMPLES = 2**16
PARQUET, HDF5 = "Parquet file", "HDF5 file"


def read_chunks(
    path, columns: Sequence[str], *, chunk_samples: int = CHUNK_SAMPLES
) -> Iterator[Float[np.ndarray, "samples columns"]]:
    """Some columns of a NPY, Parquet or HDF5 file, one chunk of rows after the other.

    Names are those of `read_record`: fields of a structured NPY or `data[0]`, `data[1]`, … of a matrix; columns of a
    Parquet file; data sets of an HDF5 file, `u[0]` for a column of one.

    **Arguments:**

    - `path`: the file.
    - `columns`: names.
    - `chunk_samples`: rows per chunk; default 65 536. The last chunk is shorter.

    **Returns:** an iterator over arrays; never more than one chunk is held.

    **Raises:** `ValueError` for another kind of file or an unknown column, `ImportError` naming the extra to install.
    """
    path = _file(path)
    return READERS[path.suffix.lower()](path, tuple(columns), chunk_samples)


def count_rows(path, columns: Sequence[str]) -> int:
    """Rows of a NPY, Parquet or HDF5 file, without reading them.

    **Arguments:** `path`; `columns`: names, of which the first is counted in a HDF5 file.

    **Raises:** as `read_chunks`.
    """
    path = _file(path)
    kind = path.suffix.lower()
    if kind == ".npy":
        return _npy_shape(path)[0][0]
    if kind == ".parquet":
        with parquet_file(path) as file:
            return file.metadata.num_rows
    with hdf5_file(path) as file, reading(path, HDF5):
        name, nodes = columns[0].partition("[")[0], data_sets(file)
        return len(nodes[_known(path, name, nodes)])


def read_rows(path, columns: Sequence[str], first: int, count: int) -> Float[np.ndarray, "samples columns"]:
    """Some rows of a NPY, Parquet or HDF5 file; of a Parquet file only the row groups that hold them are read.

    **Arguments:** `path`; `columns`: names, as for `read_chunks`; `first`: row; `count`: how many at most.

    **Raises:** as `read_chunks`.
    """
    path, columns = _file(path), tuple(columns)
    kind = path.suffix.lower()
    if kind == ".npy":
        places, named = _npy_places(path, columns)
        part = mapped(path)[first : first + count]
        return _npy_part(part, columns, places, named)
    if kind == ".parquet":
        return _parquet_rows(path, columns, first, count)
    with hdf5_file(path) as file, reading(path, HDF5):
        return _hdf5_part(_hdf5_columns(path, file, columns, count), slice(first, first + count))


def _file(path) -> Path:
    path = Path(path)
    check_file(path)
    if path.suffix.lower() not in READERS:
        raise ValueError(f"path: {path.name} cannot be read in chunks; convert it to {', '.join(READERS)}.")
    return path


def _known(path: Path, name: str, names) -> str:
    if name not in names:
        raise Refused(f"column {name!r} is not in {path.name}; it has {', '.join(list(names)[:20])}.")
    return name


def _npy(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    places, named = _npy_places(path, columns)
    for first in range(0, _npy_shape(path)[0][0], size):
        # Mapped anew for every chunk: pages of a lasting map would pile up in memory.
        yield _npy_part(mapped(path)[first : first + size], columns, places, named)


def _npy_places(path: Path, columns: tuple[str, ...]) -> tuple[list[int], bool]:
    """Places of the columns, and whether these are fields."""
    shape, kind = _npy_shape(path)
    names = kind.names or tuple(f"data[{k}]" for k in range(shape[1] if len(shape) == 2 else 1))
    return [names.index(_known(path, name, names)) for name in columns], bool(kind.names)


def _npy_part(part: np.ndarray, columns: tuple[str, ...], places: list[int], named: bool) -> np.ndarray:
    if named:
        return np.stack([np.array(part[name], dtype=float) for name in columns], axis=1)
    return np.array(part.reshape(len(part), -1)[:, places], dtype=float)


def _npy_shape(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    array = mapped(path)
    if array.ndim == 0:
        raise ValueError(f"{path.name} holds a single number; save one array with the samples first.")
    return array.shape, array.dtype


def _parquet_part(part, columns: tuple[str, ...]) -> np.ndarray:
    return np.stack([parquet_numbers(part.column(name)) for name in columns], axis=1).astype(float)


def _parquet(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    with _parquet_columns(path, columns) as file, reading(path, PARQUET):
        for batch in file.iter_batches(batch_size=size, columns=list(columns)):
            yield _parquet_part(batch, columns)


def _parquet_columns(path: Path, columns: tuple[str, ...]):
    with parquet_file(path) as file:
        for name in columns:
            _known(path, name, file.schema_arrow.names)
    return parquet_file(path, columns)


def _parquet_rows(path: Path, columns: tuple[str, ...], first: int, count: int) -> np.ndarray:
    with _parquet_columns(path, columns) as file, reading(path, PARQUET):
        sizes = [rows for rows, _ in row_groups(path)]
        ends = np.cumsum(sizes)
        wanted = [k for k, end in enumerate(ends) if end > first and end - sizes[k] < first + count]
        if not wanted:
            return np.zeros((0, len(columns)))
        left = first - int(ends[wanted[0]] - sizes[wanted[0]])
        parts = []
        for batch in file.iter_batches(CHUNK_SAMPLES, row_groups=wanted, columns=list(columns)):
            if left < batch.num_rows and count > 0:
                parts.append(_parquet_part(batch.slice(max(0, left), count), columns))
                count -= len(parts[-1])
            left -= batch.num_rows
        return np.concatenate(parts) if parts else np.zeros((0, len(columns)))


def _hdf5_columns(path: Path, file, columns: tuple[str, ...], rows: int) -> list:
    """Data set and column of each name; so many rows are read at once."""
    nodes, wanted = data_sets(file), []
    for column in columns:
        name, bracket, place = column.partition("[")
        node = readable(path, nodes[_known(path, name, nodes)], rows)
        wanted.append((node, int(place.rstrip("]")) if bracket else None))
    return wanted


def _hdf5_part(wanted: list, rows: slice) -> np.ndarray:
    parts = [np.asarray(d[rows] if k is None else d[rows, k], dtype=float).reshape(-1) for d, k in wanted]
    return np.stack(parts, axis=1)


def _hdf5(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    with hdf5_file(path) as file, reading(path, HDF5):
        wanted = _hdf5_columns(path, file, columns, size)
        for first in range(0, len(wanted[0][0]), size):
            yield _hdf5_part(wanted, slice(first, first + size))


READERS = {".npy": _npy, ".parquet": _parquet, ".h5": _hdf5, ".hdf5": _hdf5}
"""By the ending of the file."""
