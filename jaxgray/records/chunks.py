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
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path: {path} does not exist; give the path of a file.")
    readers = {".npy": _npy, ".parquet": _parquet, ".h5": _hdf5, ".hdf5": _hdf5}
    if path.suffix.lower() not in readers:
        raise ValueError(f"path: {path.name} cannot be read in chunks; convert it to {', '.join(readers)}.")
    return readers[path.suffix.lower()](path, tuple(columns), chunk_samples)


def _known(path: Path, name: str, names) -> str:
    if name not in names:
        raise ValueError(f"column {name!r} is not in {path.name}; it has {', '.join(list(names)[:20])}.")
    return name


def _npy(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    shape, kind = _npy_shape(path)
    names = kind.names or tuple(f"data[{k}]" for k in range(shape[1] if len(shape) == 2 else 1))
    places = [names.index(_known(path, name, names)) for name in columns]
    for first in range(0, shape[0], size):
        # Mapped anew for every chunk: pages of a lasting map would pile up in memory.
        part = np.load(path, mmap_mode="r")[first : first + size]
        if kind.names:
            yield np.stack([np.array(part[name], dtype=float) for name in columns], axis=1)
        else:
            yield np.array(part.reshape(len(part), -1)[:, places], dtype=float)


def _npy_shape(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    try:
        mapped = np.load(path, mmap_mode="r")
    except (OSError, ValueError):
        raise ValueError(f"{path.name} is no NPY file that can be mapped; save one array of numbers.") from None
    return mapped.shape, mapped.dtype


def _parquet(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    try:
        import pyarrow.parquet
    except ImportError:
        raise ImportError(f"{path.name} needs pyarrow: pip install 'jaxgray[parquet]'.") from None
    with pyarrow.parquet.ParquetFile(path) as file:
        for name in columns:
            _known(path, name, file.schema_arrow.names)
        for batch in file.iter_batches(batch_size=size, columns=list(columns)):
            yield np.stack([batch.column(name).to_numpy(zero_copy_only=False) for name in columns], axis=1).astype(
                float
            )


def _hdf5(path: Path, columns: tuple[str, ...], size: int) -> Iterator[np.ndarray]:
    try:
        import h5py
    except ImportError:
        raise ImportError(f"{path.name} needs h5py: pip install 'jaxgray[hdf5]'.") from None
    with h5py.File(path, "r") as file:
        names = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        wanted = []
        for column in columns:
            name, bracket, place = column.partition("[")
            data = file[_known(path, name, names)]
            wanted.append((data, int(place.rstrip("]")) if bracket else None))
        for first in range(0, len(wanted[0][0]), size):
            rows = slice(first, first + size)
            yield np.stack(
                [np.asarray(d[rows] if k is None else d[rows, k], dtype=float).reshape(-1) for d, k in wanted], axis=1
            )
