"""Delimited text: csv and its relatives."""

import csv
import re
from pathlib import Path

import numpy as np

from jaxgray.records.readers.table import Table, split_unit

DELIMITERS = ("\t", ";", "|", ",")
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})

_COMMA = re.compile(r"^[+-]?\d*,\d+([eE][+-]?\d+)?$")

# A word with its unit, so that `force [N m]` stays together between blanks. Bounded, as every bracket that stays open
# would be sought to the end of the line.
_WORD = re.compile(r"\"[^\"]*\"|[^\s\[(]+(?:\s*(?:\[[^\]]{0,100}\]|\([^)]{0,100}\)))?")


def read_delimited(path: Path, *, delimiter: str | None = None, decimal: str | None = None) -> Table:
    """Text with one header row; lines that start with # or % are comments.

    **Arguments:**

    - `path`: the file, in UTF-8 or Latin-1.
    - `delimiter`: default found among comma, semicolon, tab, bar and blanks.
    - `decimal`: `"."` or `","`; default found, a comma only where it does not delimit.

    **Returns:** a `Table`.

    **Raises:** `ValueError` where the text is no such table.
    """
    if decimal not in (None, ".", ","):
        raise ValueError(f"decimal is {decimal!r}; give '.' or ','.")
    if decimal is not None and decimal == delimiter:
        raise ValueError(f"decimal and delimiter are both {decimal!r}; they must differ.")
    if delimiter is not None and len(delimiter) != 1:
        raise ValueError(f"delimiter is {delimiter!r}; give one character, ' ' for any blanks.")
    lines, numbers, comment = _lines(path)
    if lines[0].lower().startswith("sep=") and len(lines) > 1:
        delimiter = delimiter or lines[0][4:5] or None
        lines, numbers = lines[1:], numbers[1:]
    if delimiter is None:
        delimiter = _sniff(lines[:50])
    try:
        rows = _cells(lines, delimiter)
        named = [cell.strip() for cell in _cells([comment], delimiter)[0]] if comment else []
    except (csv.Error, TypeError, ValueError) as error:
        raise ValueError(f"{path.name} is no delimited text ({error}); say delimiter.") from None
    headers = [cell.strip() for cell in rows[0]]

    if all(_is_number(cell) or cell.lower() in MISSING for cell in headers):
        # `numpy.savetxt` writes the names as a comment.
        headers = named
        if len(headers) != len(rows[0]):
            raise ValueError(
                f"{path.name} starts with numbers ({lines[0].strip()[:40]}); add a header row with the column names."
            )
    else:
        rows, numbers = rows[1:], numbers[1:]
    units = {}
    if len(rows) > 2 and all(cell.strip() and not _is_number(cell) for cell in rows[0]):
        if not any(cell.strip().lower() in MISSING for cell in rows[0]):
            units = {header: cell.strip().strip("[]()") for header, cell in zip(headers, rows[0])}
            rows, numbers = rows[1:], numbers[1:]
    if len(rows) < 2:
        raise ValueError(f"{path.name} has {len(rows)} row(s) of numbers below its header; a record needs at least 2.")
    _check_lengths(path, headers, rows, numbers)
    if decimal is None:
        decimal = "," if delimiter != "," and any("," in line for line in lines[1:]) else "."

    def column(position: int) -> np.ndarray:
        cells = [row[position] for row in rows]
        if decimal == ",":
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            return np.array(cells, dtype=np.float64)
        except ValueError:
            return _column_with_gaps(path, split_unit(headers[position])[0], cells, rows, position, numbers)

    return Table(path.name, tuple(headers), column, np.asarray(numbers), units)


def _lines(path: Path) -> tuple[list[str], list[int], str]:
    """Lines that count, their numbers in the file, and the last comment above them."""
    raw = path.read_bytes()
    if b"\0" in raw[:4096]:
        if raw[:2] not in (b"\xff\xfe", b"\xfe\xff"):
            raise ValueError(f"{path.name} is not text; give csv, or name the file by its format.")
        try:
            text = raw.decode("utf-16")
        except UnicodeDecodeError:
            raise ValueError(f"{path.name} is no whole UTF-16 text; write it anew, in UTF-8.") from None
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
    lines, numbers, comment = [], [], ""
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped[:1] in ("#", "%"):
            comment = comment if lines else stripped.lstrip("#% ")
        elif stripped:
            lines.append(line)
            numbers.append(number)
    if not lines:
        raise ValueError(f"{path.name} is empty; give a file with a header row and at least 2 rows of numbers.")
    return lines, numbers, comment


def _sniff(lines: list[str]) -> str:
    """The delimiter that cuts every line into the same number of cells, at least two."""
    for delimiter in DELIMITERS:
        try:
            counts = {len(row) for row in _cells(lines, delimiter)}
        except csv.Error:
            continue
        if len(counts) == 1 and counts.pop() >= 2:
            return delimiter
    words = {len(row) for row in _cells(lines, " ")}
    if len(words) == 1 and words.pop() >= 2:
        return " "
    # Ragged: the most frequent one in the header, so that the message can name the row.
    return max(DELIMITERS, key=lines[0].count)


def _cells(lines: list[str], delimiter: str) -> list[list[str]]:
    if delimiter.isspace() and delimiter != "\t":
        return [[word.strip('"') for word in _WORD.findall(lines[0])], *(line.split() for line in lines[1:])]
    return list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))


def _check_lengths(path: Path, headers: list[str], rows: list[list[str]], numbers: list[int]) -> None:
    """Every row as long as the header; one empty cell after a trailing delimiter is forgiven."""
    width = len(headers)
    for row, number in zip(rows, numbers):
        extra = row[width:]
        if len(row) < width or any(cell.strip() for cell in extra):
            raise ValueError(
                f"{path.name} has {len(row)} cells at line {number} and {width} in the header; give every "
                "row the same number, or say delimiter and decimal."
            )


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"').replace(",", "."))
    except ValueError:
        return False
    return True


def _column_with_gaps(path, name, cells, rows, position, numbers) -> np.ndarray:
    """The slow way, where some cell is empty or text."""
    values = np.empty(len(cells))
    for k, cell in enumerate(cells):
        cell = cell.strip()
        try:
            values[k] = np.nan if cell.lower() in MISSING else float(cell)
        except ValueError:
            hint = ", or say that the decimal is a comma" if _COMMA.match(cell) else ""
            raise ValueError(
                f"column {name!r} of {path.name} holds the text {rows[k][position].strip()[:40]!r} at line "
                f"{numbers[k]}; give numbers, and leave missing cells empty{hint}."
            ) from None
    return values
