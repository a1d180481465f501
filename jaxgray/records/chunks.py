"""Columns of a file in chunks, for records longer than memory."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

CHUNK_SAMPLES = 2**16


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
        with _parquet_file(path) as file:
            return file.metadata.num_rows
    with _hdf5_file(path) as file:
        name = columns[0].partition("[")[0]
        return len(file[_known(path, name, _data_sets(file))])


def read_rows(path, columns: Sequence[str], first: int, count: int) -> Float[np.ndarray, "samples columns"]:
    """Some rows of a NPY, Parquet or HDF5 file; of a Parquet file only the row groups that hold them are read.

    **Arguments:** `path`; `columns`: names, as for `read_chunks`; `first`: row; `count`: how many at most.

    **Raises:** as `read_chunks`.
    """
    path, columns = _file(path), tuple(columns)
    kind = path.suffix.lower()
    if kind == ".npy":
        places, named = _npy_places(path, columns)
        part = np.load(path, mmap_mode="r")[first : first + count]
        return _npy_part(part, columns, places, named)
    if kind == ".parquet":
        return _parquet_rows(path, columns, first, count)
    with _hdf5_file(path) as file:
        return _hdf5_part(_hdf5_columns(path, file, columns), slice(first, first + count))


def _file(path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path: {path} does not exist; give the path of a file.")
    if path.suffix.lower() not in READERS:
        raise ValueError(f"path: {path.name} cannot be read in chunks; convert it to {', '.join(READERS)}.")
    return path


def _known(path: Path, name: str, names) -> str:
    if name not in names:
        raise ValueError(f"column {name!r} is not in {path.name}; it has {', '.join(list(names)[:20])}.")
    return name


def _npy(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    places, named = _npy_places(path, columns)
    for first in range(0, _npy_shape(path)[0][0], size):
        # Mapped anew for every chunk: pages of a lasting map would pile up in memory.
        yield _npy_part(np.load(path, mmap_mode="r")[first : first + size], columns, places, named)


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
    try:
        mapped = np.load(path, mmap_mode="r")
    except (OSError, ValueError):
        raise ValueError(f"{path.name} is no NPY file that can be mapped; save one array of numbers.") from None
    return mapped.shape, mapped.dtype


def _parquet_file(path: Path):
    try:
        import pyarrow.parquet
    except ImportError:
        raise ImportError(f"{path.name} needs pyarrow: pip install 'jaxgray[parquet]'.") from None
    return pyarrow.parquet.ParquetFile(path)


def _parquet_part(part, columns: tuple[str, ...]) -> np.ndarray:
    return np.stack([part.column(name).to_numpy(zero_copy_only=False) for name in columns], axis=1).astype(float)


def _parquet(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    with _parquet_file(path) as file:
        for name in columns:
            _known(path, name, file.schema_arrow.names)
        for batch in file.iter_batches(batch_size=size, columns=list(columns)):
            yield _parquet_part(batch, columns)


def _parquet_rows(path: Path, columns: tuple[str, ...], first: int, count: int) -> np.ndarray:
    with _parquet_file(path) as file:
        for name in columns:
            _known(path, name, file.schema_arrow.names)
        sizes = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
        ends = np.cumsum(sizes)
        wanted = [k for k, end in enumerate(ends) if end > first and end - sizes[k] < first + count]
        if not wanted:
            return np.zeros((0, len(columns)))
        before = int(ends[wanted[0]] - sizes[wanted[0]])
        table = file.read_row_groups(wanted, columns=list(columns)).slice(first - before, count)
        return np.stack([table.column(name).to_numpy() for name in columns], axis=1).astype(float)


def _hdf5_file(path: Path):
    try:
        import h5py
    except ImportError:
        raise ImportError(f"{path.name} needs h5py: pip install 'jaxgray[hdf5]'.") from None
    return h5py.File(path, "r")


def _data_sets(file) -> list[str]:
    import h5py

    names: list[str] = []
    file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
    return names


def _hdf5_columns(path: Path, file, columns: tuple[str, ...]) -> list:
    """Data set and column of each name."""
    names, wanted = _data_sets(file), []
    for column in columns:
        name, bracket, place = column.partition("[")
        wanted.append((file[_known(path, name, names)], int(place.rstrip("]")) if bracket else None))
    return wanted


def _hdf5_part(wanted: list, rows: slice) -> np.ndarray:
    parts = [np.asarray(d[rows] if k is None else d[rows, k], dtype=float).reshape(-1) for d, k in wanted]
    return np.stack(parts, axis=1)


def _hdf5(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    with _hdf5_file(path) as file:
        wanted = _hdf5_columns(path, file, columns)
        for first in range(0, len(wanted[0][0]), size):
            yield _hdf5_part(wanted, slice(first, first + size))


READERS = {".npy": _npy, ".parquet": _parquet, ".h5": _hdf5, ".hdf5": _hdf5}
"""By the ending of the file."""
