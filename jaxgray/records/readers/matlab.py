"""MATLAB files up to version 7: arrays of numbers, also in structures; everything else is stepped over.

**Reference:** The MathWorks, *MAT-File Format*, chapters 1 (levels 5) and 2 (level 4).
"""

import zlib
from collections.abc import Iterator
from math import prod
from pathlib import Path

import numpy as np

from jaxgray.records.readers.limits import EXPANSION

VERSION_7_3 = 2

NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Storage of numbers by type of a data element."""
MATRIX, COMPRESSED = 14, 15

STRUCTURE = 2
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""Numbers by class of an array."""
COMPLEX = 0x0800

OLD_NUMBERS = ("f8", "f4", "i4", "i2", "u2", "u1")
"""Storage by the digit P of level 4."""

MOST_DIMENSIONS = 32
"""Of an array; NumPy has a bound of its own."""

DEEPEST = 20
"""Structures in structures that are looked into."""


def mat_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Real arrays of numbers by name, fields of a structure `data` as `data.u`.

    Texts, cells, objects, functions, sparse and complex arrays are left out, and so are arrays of structures.

    **Arguments:** `path`: the file.

    **Returns:** the arrays; None for version 7.3, which is HDF5.

    **Raises:** `ValueError` where the file is damaged or no MATLAB file.
    """
    content = memoryview(path.read_bytes())
    if len(content) < 20:
        raise ValueError("it is too short")
    # Level 4 has no header: its first number is below 5000, and so has a byte of zeros in the first four.
    if 0 in bytes(content[:4]):
        return dict(_level_4(content))
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:128]))
    if order is None:
        raise ValueError("it has no mark of a MATLAB file")
    if int(np.frombuffer(content[124:126], order + "u2")[0]) >> 8 == VERSION_7_3:
        return None
    arrays = {}
    for kind, data in _elements(content[128:], order):
        if kind == COMPRESSED:
            kind, data = next(_elements(_inflated(data), order), (0, data))
        if kind == MATRIX:
            arrays |= _matrix(data, order)
    return arrays


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of the data elements, one after the other; those of up to four bytes stand in their tag."""
    place = 0
    while place + 8 <= len(data):
        first, size = (int(one) for one in np.frombuffer(data[place : place + 8], order + "u4"))
        if first >> 16:
            kind, size, start, step = first & 0xFFFF, first >> 16, place + 4, 8
            if size > 4:
                raise ValueError(f"a short data element has {size} bytes")
        else:
            # Compressed elements alone are not filled up to eight bytes.
            kind, start, step = first, place + 8, 8 + size + (0 if first == COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError(f"a data element has {size} bytes of which {len(data) - start} are there")
        yield kind, data[start : start + size]
        place += step


def _inflated(data: memoryview) -> memoryview:
    engine = zlib.decompressobj()
    try:
        return memoryview(engine.decompress(data, EXPANSION * len(data) + 64))
    except zlib.error as error:
        raise ValueError(str(error)) from None


def _matrix(data: memoryview, order: str, prefix: str = "", name: str = "", depth: int = 0) -> dict[str, np.ndarray]:
    """The arrays of one element: itself, or what its fields hold."""
    if not data:
        return {}
    parts = _elements(data, order)
    try:
        _, flags = next(parts)
        word = int(np.frombuffer(flags[:4], order + "u4")[0]) if len(flags) >= 4 else 0
        kind = word & 0xFF
        # Objects have no shape: what is not wanted is left before it is parsed any further.
        if kind not in CLASSES and kind != STRUCTURE or word & COMPLEX:
            return {}
        shape = _shape(next(parts)[1], order)
        own = _text(next(parts)[1])
        name = prefix + (name or own)
        if kind == STRUCTURE:
            return _fields(parts, order, name, depth) if prod(shape) == 1 and depth < DEEPEST else {}
        storage, numbers = next(parts)
    except StopIteration:
        raise ValueError("an array is cut off") from None
    if storage not in NUMBERS:
        raise ValueError(f"{name!r} is stored as type {storage}")
    stored = np.dtype(order + NUMBERS[storage])
    if len(numbers) != prod(shape) * stored.itemsize:
        raise ValueError(f"{name!r} has {len(numbers)} bytes, not those of shape {shape[:8]}")
    # Data without a name belong to objects.
    values = np.frombuffer(numbers, stored).astype(CLASSES[kind])
    return {name: np.squeeze(values.reshape(shape, order="F"))} if name else {}


def _shape(data: memoryview, order: str) -> tuple[int, ...]:
    sizes = tuple(int(one) for one in np.frombuffer(data[: len(data) // 4 * 4], order + "i4"))
    if not 2 <= len(sizes) <= MOST_DIMENSIONS or min(sizes) < 0:
        raise ValueError(f"an array has the shape {sizes[:8]}")
    return sizes


def _fields(parts: Iterator, order: str, name: str, depth: int) -> dict[str, np.ndarray]:
    _, width = next(parts)
    _, names = next(parts)
    size = int(np.frombuffer(width[:4], order + "i4")[0]) if len(width) >= 4 else 0
    if size < 1:
        raise ValueError(f"the names of the fields of {name!r} have {size} letters")
    arrays = {}
    for k in range(len(names) // size):
        kind, data = next(parts)
        if kind == MATRIX:
            arrays |= _matrix(data, order, f"{name}.", _text(names[k * size : (k + 1) * size]), depth + 1)
    return arrays


def _text(data: memoryview) -> str:
    return bytes(data).partition(b"\0")[0].decode("latin-1")


def _level_4(content: memoryview) -> Iterator[tuple[str, np.ndarray]]:
    place = 0
    while place < len(content):
        head = content[place : place + 20]
        if len(head) < 20:
            raise ValueError("it is cut off")
        order = "<" if 0 <= int(np.frombuffer(head, "<i4")[0]) < 5000 else ">"
        kind, rows, columns, imaginary, letters = (int(one) for one in np.frombuffer(head, order + "i4"))
        machine, rest = divmod(kind, 1000)
        precision, matrix = divmod(rest % 100, 10)
        known = machine == (order == ">") and rest < 100 and precision < len(OLD_NUMBERS)
        if not known or min(rows, columns, letters) < 0:
            raise ValueError("it has no mark of a MATLAB file")
        stored = np.dtype(order + OLD_NUMBERS[precision])
        size = rows * columns * stored.itemsize
        start = place + 20 + letters
        if start + size > len(content):
            raise ValueError(f"an array of shape {(rows, columns)} is cut off")
        if matrix == 0 and not imaginary:
            values = np.frombuffer(content[start : start + size], stored).astype(stored.newbyteorder("="))
            yield _text(content[place + 20 : start]), np.squeeze(values.reshape(rows, columns, order="F"))
        place = start + size * (2 if imaginary else 1)
