"""Parquet: columns of numbers, or of texts of numbers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxgray.records.readers.limits import Refused, check_size, reading
from jaxgray.records.readers.table import Table

WHAT = "Parquet file"
STEP = 2**16
"""Rows taken at a time, so that a file that says too little of itself is found out before it fills the memory."""
BROTLI = 4
"""Code of a compression that expands without bound."""
DEEPEST = 8
"""Structures in structures of a footer."""


def read_parquet(path: Path) -> Table:
    """A Parquet file.

    **Arguments:**

    - `path`: the file.

    **Returns:** a `Table`.

    **Raises:** `ImportError` without pyarrow, `ValueError` where the file is no Parquet.
    """
    with parquet_file(path) as file:
        names = tuple(file.schema_arrow.names)
    return Table(path.name, names, lambda position: _column(path, names[position]))


def parquet_file(path: Path, columns: Sequence[str] = ()):
    """A Parquet file, open for reading; `columns`: those to be read, which are checked.

    **Raises:** `ImportError` without pyarrow, `ValueError` where the file is no Parquet or a column holds no numbers.
    """
    try:
        import pyarrow.parquet
    except ImportError:
        raise ImportError(f"{path.name} needs pyarrow: pip install 'jaxgray[parquet]'.") from None

    with reading(path, WHAT):
        # Before the library: what it says of the footer itself, it says by ending the process where that is damaged.
        if any(BROTLI in codecs for _, codecs in row_groups(path)):
            raise Refused(f"{path.name} is compressed by brotli, which expands without bound; use another compression.")
        # Texts stay numbers of a dictionary, so that one that is repeated takes its room once.
        file = pyarrow.parquet.ParquetFile(path, pre_buffer=False, read_dictionary=list(columns))
        kinds = {name: file.schema_arrow.field(name).type for name in columns}
    for name, kind in kinds.items():
        if not _of_numbers(kind):
            raise ValueError(f"column {name!r} of {path.name} holds {kind}; give real numbers.")
    return file


def row_groups(path: Path) -> list[tuple[int, set[int]]]:
    """Number of rows and codes of compressions of every row group, as the footer of the file says.

    **Reference:** Apache Parquet, `parquet.thrift`: FileMetaData 4, RowGroup 1 and 3, ColumnChunk 3, ColumnMetaData 4.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        file.seek(max(0, size - 8))
        end = file.read()
        length = int.from_bytes(end[:4], "little")
        if end[4:] != b"PAR1" or length + 12 > size:
            raise ValueError("it does not end as such a file does")
        file.seek(size - 8 - length)
        footer = _Footer(file.read(length)).structure()
    groups = []
    for group in footer.get(4, []):
        chunks = [chunk.get(3, {}) for chunk in group.get(1, [])]
        groups.append((int(group.get(3, 0)), {chunk.get(4) for chunk in chunks}))
    return groups


class _Footer:
    """Reads the compact protocol of Apache Thrift: structures as dictionaries by the numbers of their fields."""

    def __init__(self, data: bytes):
        self.data, self.place = data, 0

    def byte(self) -> int:
        self.place += 1
        return self.data[self.place - 1]

    def number(self) -> int:
        """Seven bits a byte, the last without the eighth."""
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value
            if shift > 63:
                raise ValueError("a number of its footer has no end")

    def signed(self) -> int:
        value = self.number()
        return (value >> 1) ^ -(value & 1)

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise ValueError("its footer is cut off")

    def structure(self, depth: int = 0) -> dict:
        if depth > DEEPEST:
            raise ValueError("its footer is nested too deep")
        fields, last = {}, 0
        while head := self.byte():
            last = last + (head >> 4) if head >> 4 else self.signed()
            fields[last] = self.value(head & 15, depth, False)
        return fields

    def value(self, kind: int, depth: int, in_list: bool):
        if kind in (1, 2):
            return self.byte() if in_list else kind == 1
        if kind == 3:
            return self.byte()
        if kind in (4, 5, 6):
            return self.signed()
        if kind == 7:
            return self.skip(8)
        if kind == 8:
            return self.skip(self.number())
        if kind in (9, 10):
            head = self.byte()
            count = self.number() if head >> 4 == 15 else head >> 4
            if count > len(self.data) - self.place:
                raise ValueError(f"its footer has a list of {count} elements")
            return [self.value(head & 15, depth + 1, True) for _ in range(count)]
        if kind == 12:
            return self.structure(depth + 1)
        raise ValueError(f"its footer has a field of type {kind}")


def _of_numbers(kind) -> bool:
    """Whether values of an Arrow type can be numbers: also texts of numbers, and what is missing everywhere."""
    from pyarrow import types

    if types.is_dictionary(kind):
        kind = kind.value_type
    text = types.is_string(kind) or types.is_large_string(kind)
    return text or types.is_primitive(kind) or types.is_decimal(kind) or types.is_null(kind)


def _column(path: Path, name: str) -> np.ndarray:
    with parquet_file(path, [name]) as file, reading(path, WHAT):
        parts, rows = [], 0
        for batch in file.iter_batches(STEP, columns=[name], use_threads=False):
            rows += batch.num_rows
            check_size(path.name, name, 8 * rows, path.stat().st_size)
            parts.append(parquet_numbers(batch.column(name)))
    return np.concatenate(parts) if parts else np.empty(0)


def parquet_numbers(column) -> np.ndarray:
    """A column of a batch of Arrow as an array; texts become objects."""
    if not hasattr(column, "dictionary"):
        return column.to_numpy(zero_copy_only=False)
    words = np.array([*column.dictionary.to_pylist(), None], dtype=object)
    return words[column.indices.fill_null(len(words) - 1).to_numpy(zero_copy_only=False)]
