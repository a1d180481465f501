"""HDF5, and MATLAB files of version 7.3, which are HDF5."""

import functools
import mmap
from collections.abc import Callable, Iterator
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

UNITS = "units", "unit"
"""Names of the attribute that says a unit."""

VARIABLE_LENGTH = 9
"""Class of a datatype of variable length."""

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
        sound = functools.cache(functools.partial(_texts_are_there, file, path))
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

    for name in UNITS:
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


def _texts_are_there(file, path: Path) -> bool:
    """Whether the units of variable length in a file can be read without harm: its global heaps can be walked to their
    end, to which the library never comes in a damaged one, and every such unit is an object of them and no longer than
    it, since the library asks for as much memory as its length says.

    **Reference:** HDF5 File Format Specification 3.0, sections III.E, Disk Format: Level 1E - Global Heap, and
    IV.A.2.m, The Attribute Message.
    """
    _, size = file.id.get_create_plist().get_sizes()
    nodes = data_sets(file).values()
    units = [node.attrs.get_id(name).dtype for node in nodes for name in UNITS if name in node.attrs]
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        texts: dict[bytes, int] = {}
        for place in _places(content, HEAP):
            found = _heap(content, place, size)
            if found is None:
                return False
            # Addresses count from behind a block of the user, which MATLAB puts in front.
            own = (place - file.userblock_size).to_bytes(size, "little", signed=True)
            texts |= {own + index: length for index, length in found.items()}
        names = [name.encode() for name in UNITS]
        fit = [_text_fits(content, at, name, texts, size) for name in names for at in _places(content, name + b"\0")]
    fit = [one for one in fit if one is not None]
    return all(fit) and len(fit) >= sum(dtype.kind == "O" for dtype in units)


def _places(content, text: bytes) -> Iterator[int]:
    place = content.find(text)
    while place >= 0:
        yield place
        place = content.find(text, place + 1)


def _text_fits(content, place: int, name: bytes, texts: dict[bytes, int], size: int) -> bool | None:
    """Whether the attribute of this name is a text of variable length that a heap has; None where it is none."""

    def number(at: int, length: int) -> int:
        return int.from_bytes(content[at : at + length], "little")

    for head, version, filled in ((8, 1, 8), (8, 2, 1), (9, 3, 1)):
        begin = place - head
        if begin < 0 or content[begin] != version or number(begin + 2, 2) != len(name) + 1:
            continue
        own, kind, space = (-(-number(begin + at, 2) // filled) * filled for at in (2, 4, 6))
        if place + own >= len(content) or content[place + own] & 0x0F != VARIABLE_LENGTH:
            return None
        at = place + own + kind + space
        length = number(at, 4)
        return length <= texts.get(content[at + 4 : at + 4 + size + 4], 0)
    return None


def _heap(content, start: int, size: int) -> dict[bytes, int] | None:
    """Objects of a global heap, by their number, and how long they are; None where it cannot be walked to its end."""

    def length(place: int) -> int:
        return int.from_bytes(content[place : place + size], "little")

    head, found = 8 + size, {}
    end = start + length(start + 8)
    if end > len(content):
        # The library asks for as much memory as a heap says that it has.
        return None
    # After the heap's own head, which is filled up to eight bytes, objects with heads of their own.
    place = start + head + -head % 8
    while place + head <= end:
        index, stored = int.from_bytes(content[place : place + 2], "little"), length(place + 8)
        # What is free is the last, and its size counts its head.
        step = head + -head % 8 + stored + -stored % 8 if index else stored
        if not head <= step <= end - place:
            return None
        found[index.to_bytes(4, "little")] = stored
        place += step
    return found
