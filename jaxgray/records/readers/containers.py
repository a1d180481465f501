"""Arrays by name: npz, npy and mat up to version 7, and what they share with other formats.

A file is asked for the names, types and shapes of its columns; numbers are read once a record needs them, and only
where the file is large enough to hold them.
"""

import functools
import tokenize
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from jaxgray.records.readers.limits import Refused, check_size, reading
from jaxgray.records.readers.table import Table

KINDS = "fiubmM"
"""Kinds of numbers, dates among them."""

ENCRYPTED = 1
"""Flag of a member of a zip file."""

MOST_COLUMNS = 100_000
"""Of a file; more would take longer to name than to read."""


@dataclass(frozen=True)
class Stored:
    """An array that has not been read.

    **Arguments:** `shape`; `dtype`; `read`: gives the array; `unit`: of its numbers, default none.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], np.ndarray]
    unit: str = ""


def read_npz(path: Path) -> Table:
    """A NumPy archive; columns of a 2-D array `u` are `u[0]`, `u[1]`, …, single numbers are scalars.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no archive of numbers.
    """
    return table_of_stored(path.name, npz_members(path))


def npz_members(path: Path, kinds: str = KINDS) -> dict[str, Stored]:
    """The arrays of a NumPy archive by name, not read yet.

    **Arguments:** `path`: the file; `kinds`: of NumPy's types that are wanted, default numbers.

    **Raises:** `ValueError` where the file is no archive.
    """
    arrays, what = {}, "npz archive of numbers"

    def read(member: zipfile.ZipInfo, size: int) -> np.ndarray:
        check_size(path.name, member.filename, size, path.stat().st_size)
        with reading(path, what), zipfile.ZipFile(path) as archive, archive.open(member) as file:
            return np.lib.format.read_array(file, allow_pickle=False)

    with reading(path, what), zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            shape, dtype = _npy_head(archive, member)
            # Python objects would run code on being read; what else is in the file can still be used.
            if dtype.kind in kinds:
                size = prod(shape) * dtype.itemsize
                name = member.filename.removesuffix(".npy")
                arrays[name] = Stored(shape, dtype, functools.partial(read, member, size))
    return arrays


def _npy_head(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of one member of an archive; those of an object for what is no array."""
    none = (), np.dtype(object)
    # What NumPy writes; other compressions expand without bound.
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & ENCRYPTED:
        return none
    with archive.open(member) as file:
        try:
            first = np.lib.format.read_magic(file) == (1, 0)
            header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(file)
        except (ValueError, MemoryError, tokenize.TokenError):
            # The last two are what Python's parser says of brackets within brackets.
            return none
    return shape, dtype


def read_npy(path: Path) -> Table:
    """One NumPy array, mapped into memory, so that only what is used is read.

    Columns of a structured array bear the names of its fields, those of a plain one are `data[0]`, `data[1]`, ….

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the file is no array of numbers.
    """
    array = mapped(path)
    if array.dtype.names is not None:
        return table_of_arrays(path.name, {name: array[name] for name in array.dtype.names})
    return table_of_arrays(path.name, {"data": array})


def mapped(path: Path) -> np.ndarray:
    """The array of a NPY file, mapped into memory.

    **Raises:** `ValueError` where the file is no array of numbers.
    """
    with reading(path, "npy array of numbers"):
        return np.load(path, mmap_mode="r", allow_pickle=False)


def table_of_arrays(source: str, arrays: Mapping[str, object]) -> Table:
    """Columns out of named arrays, samples along the longer axis.

    **Arguments:**

    - `source`: the file's name, for messages.
    - `arrays`: values by name; text and arrays of three or more dimensions are left out.

    **Returns:** a `Table`.
    """
    stored = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        stored[name] = Stored(array.shape, array.dtype, lambda array=array: array)
    return table_of_stored(source, stored)


def table_of_stored(source: str, arrays: Mapping[str, Stored]) -> Table:
    """Columns out of named arrays that are read once they are asked for, samples along the longer axis.

    **Arguments:** `source`: as for `table_of_arrays`; `arrays`: by name, likewise.

    **Returns:** a `Table`.
    """
    columns: dict[str, tuple[str, int | None]] = {}
    scalars, units = {}, {}
    for name, stored in arrays.items():
        if stored.dtype.kind not in KINDS or len(stored.shape) > 2:
            continue
        if prod(stored.shape) == 1 and stored.dtype.kind in "fiub":
            if name == "sampling_time":
                scalars[name] = float(stored.read().reshape(()))
        elif len(stored.shape) == 2 and min(stored.shape) > 1:
            for k in range(min(*stored.shape, MOST_COLUMNS + 1)):
                columns[f"{name}[{k}]"] = name, k
                units[f"{name}[{k}]"] = stored.unit
        elif stored.shape:
            columns[name] = name, None
            units[name] = stored.unit
        if len(columns) > MOST_COLUMNS:
            raise Refused(f"{source} has more than {MOST_COLUMNS} columns; keep the channels of the record alone.")
    places = list(columns.values())

    @functools.cache
    def array(name: str) -> np.ndarray:
        values = arrays[name].read()
        return values if values.ndim < 2 or values.shape[0] >= values.shape[1] else values.T

    def column(position: int) -> np.ndarray:
        name, k = places[position]
        return array(name).reshape(-1) if k is None else array(name)[:, k]

    return Table(source, tuple(columns), column, units=units, scalars=scalars)
