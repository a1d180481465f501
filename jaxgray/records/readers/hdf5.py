"""HDF5, and MATLAB files of version 7.3, which are HDF5."""

import functools
import mmap
from collections.abc import Callable
from math import prod
from pathlib import Path

import numpy as np

from jaxgray.records.readers.containers import KINDS, Stored, table_of_arrays, table_of_stored
from jaxgray.records.readers.limits import Refused, check_size, reading
from jaxgray.records.readers.matlab import mat_arrays
from jaxgray.records.readers.table import Table

COMPRESSIONS = {1: "deflate", 4: "szip", 32000: "lzf"}
OTHER_FILTERS = {2: "shuffle", 3: "fletcher32"}
"""Filters of HDF5; one compression alone cannot expand without bound, one upon the other can."""

HEAP = b"GCOL\1"
"""Beginning of a global heap."""

LONGEST_UNIT = 200
"""Bytes of the attribute of a dataset."""


def read_mat(path: Path) -> Table:
    """A MATLAB file, up to version 7 or of version 7.3; fields of a structure `data` are `data.u`.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no such file.
    """
    with reading(path, "MATLAB file"):
        arrays = mat_arrays(path)
    if arrays is None:
        # Version 7.3 is HDF5 with the axes the other way round.
        return read_hdf5(path, transposed=True)
    return table_of_arrays(path.name, arrays)


def read_hdf5(path: Path, *, transposed: bool = False) -> Table:
    """An HDF5 file; a dataset in a group is `group/u`, its attribute `units` or `unit` is taken.

    Links are not followed, and datasets whose numbers lie in other files are refused.

    **Arguments:**

    - `path`: the file.
    - `transposed`: whether 2-D arrays have the samples last, as MATLAB writes them; default False.

    **Returns:** a `Table`.

    **Raises:** `ImportError` without h5py, `ValueError` where the file is no HDF5.
    """
    arrays, what = {}, "HDF5 file"

    def read(name: str) -> np.ndarray:
        with hdf5_file(path) as file, reading(path, what):
            values = readable(path, file[name])[()]
        return values.T if transposed else values

    with hdf5_file(path) as file, reading(path, what):
        sound = functools.cache(functools.partial(_heaps_end, file, path))
        for name, node in data_sets(file).items():
            if not name.startswith("#") and node.dtype.kind in KINDS and node.shape is not None:
                shown = name.replace("/", ".") if transposed else name
                shape = node.shape[::-1] if transposed else node.shape
                arrays[shown] = Stored(shape, node.dtype, functools.partial(read, name), _unit(node, sound))
    return table_of_stored(path.name, arrays)


def hdf5_file(path: Path):
    """An HDF5 file, open for reading.

    **Raises:** `ImportError` without h5py, `ValueError` where the file is no HDF5.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError(f"{path.name} needs h5py: pip install 'jaxgray[hdf5]'.") from None

    with reading(path, "HDF5 file"):
        return h5py.File(path, "r")


def data_sets(file) -> dict:
    """The datasets of an HDF5 file by name; links to other places and files are not followed."""
    import h5py

    found = {}

    def visit(name, node):
        if isinstance(node, h5py.Dataset):
            found[name] = node

    file.visititems(visit)
    return found


def readable(path: Path, node, rows: int | None = None):
    """A dataset of an HDF5 file, once it is known that it can be read without harm.

    **Arguments:** `path` of the file; `node`: the dataset; `rows`: how many are read at once, default all.

    **Raises:** `Refused` where its numbers lie in another file, or could be more than the file has room for.
    """
    name = node.name.lstrip("/")
    if node.external or node.is_virtual:
        raise Refused(f"{name!r} of {path.name} lies in other files; copy its numbers into this one.")
    pipeline = node.id.get_create_plist()
    codes = [pipeline.get_filter(k)[0] for k in range(pipeline.get_nfilters())]
    packed = [code for code in codes if code not in OTHER_FILTERS]
    if len(packed) > 1 or not set(packed) <= set(COMPRESSIONS):
        known = ", ".join(COMPRESSIONS.values())
        raise Refused(f"{name!r} of {path.name} has the filters {codes}; compress it by one of {known}, or not at all.")
    size = prod(node.shape) * node.dtype.itemsize
    if rows is not None and node.shape:
        size = size * min(rows, node.shape[0]) // max(1, node.shape[0])
    check_size(path.name, name, size, path.stat().st_size)
    return node


def _unit(node, sound: Callable[[], bool]) -> str:
    import h5py

    for name in ("units", "unit"):
        if name in node.attrs:
            attribute = node.attrs.get_id(name)
            # Other objects of variable length than texts make the library crash where they are damaged.
            text = h5py.check_string_dtype(attribute.dtype) is not None
            fits = text and attribute.shape == () and attribute.dtype.itemsize <= LONGEST_UNIT
            # Texts of variable length are kept as objects, and lie in a heap of the file.
            if fits and (attribute.dtype.kind != "O" or sound()):
                unit = node.attrs[name]
                return unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return ""


def _heaps_end(file, path: Path) -> bool:
    """Whether all global heaps of a file can be walked to their end: in a damaged one the library never comes there.

    **Reference:** HDF5 File Format Specification 3.0, section III.E, Disk Format: Level 1E - Global Heap.
    """
    _, size = file.id.get_create_plist().get_sizes()
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        place = content.find(HEAP)
        while place >= 0:
            if not _heap_ends(content, place, size):
                return False
            place = content.find(HEAP, place + 1)
    return True


def _heap_ends(content, start: int, size: int) -> bool:
    def length(place: int) -> int:
        return int.from_bytes(content[place : place + size], "little")

    head = 8 + size
    end = start + length(start + 8)
    # After the heap's own head, which is filled up to eight bytes, objects with heads of their own.
    place = start + head + -head % 8
    while place + head <= min(end, len(content)):
        index, stored = int.from_bytes(content[place : place + 2], "little"), length(place + 8)
        # What is free is the last, and its size counts its head.
        step = head + -head % 8 + stored + -stored % 8 if index else stored
        if not head <= step <= end - place:
            return False
        place += step
    return True
