"""Named columns of numbers, as every reader hands them over."""

import difflib
import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxgray.records.channels import LARGEST_VALUE
from jaxgray.records.readers.limits import LONGEST_NAME

_SHOWN = 20

_COMPARED = 1000
"""Names among which a near one is sought."""


def split_unit(header: str) -> tuple[str, str]:
    """Name and unit of a header such as `force [N]` or `force (N)`.

    **Arguments:**

    - `header`: the text above the column.

    **Returns:** name and unit, the latter empty where there is none.
    """
    header = header.strip()
    for opening, closing in ("[]", "()"):
        name, bracket, rest = header.rpartition(opening)
        unit = rest[:-1].strip()
        # A whole number in brackets counts, `u[0]`, and is no unit.
        if bracket and name.strip() and rest.endswith(closing) and rest.count(closing) == 1 and not unit.isdecimal():
            return name.strip(), unit
    return header, ""


@dataclass(frozen=True)
class Table:
    """Columns by header, read one at a time because most files hold more than a record needs.

    **Arguments:**

    - `source`: the file's name, for messages.
    - `headers`: the headers as written, in order.
    - `column`: gives the numbers of the column at a position, NaN for an empty cell.
    - `units`: units known from elsewhere, by header.
    - `scalars`: single numbers in the file, by name.
    """

    source: str
    headers: tuple[str, ...]
    column: Callable[[int], np.ndarray]
    row_numbers: np.ndarray | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    scalars: Mapping[str, float] = field(default_factory=dict)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The headers without their units."""
        return tuple(split_unit(header)[0] for header in self.headers)

    def row(self, sample) -> str:
        """How to call the row of a sample in a message."""
        return f"sample {sample}" if self.row_numbers is None else f"line {self.row_numbers[sample]}"

    def find(self, argument: str, wanted: str) -> int:
        """Position of the one column of that name, unit left out or written as in the header."""
        if wanted in self.headers and self.headers.count(wanted) == 1:
            return self.headers.index(wanted)
        names = self.names
        found = [k for k, name in enumerate(names) if name == wanted or self.headers[k] == wanted]
        if len(found) == 1:
            return found[0]
        if found:
            raise ValueError(
                f"{argument}: {self.source} has {len(found)} columns called {wanted!r}; give each a name of its own."
            )
        raise ValueError(f"{argument}: {self.source} has no column {wanted!r}{self._nearest(wanted)}")

    def _nearest(self, wanted: str) -> str:
        names = list(dict.fromkeys(name[:LONGEST_NAME] for name in self.names[:_COMPARED] if name))
        members = [name for name in names if re.fullmatch(re.escape(wanted) + r"\[\d+\]", name)]
        if members:
            return f"; it has several columns, say {', '.join(members[:_SHOWN])}."
        by_lower = {name.lower(): name for name in reversed(names)}
        near = difflib.get_close_matches(wanted.lower(), list(by_lower), n=1)
        hint = f"; did you mean {by_lower[near[0]]!r}?" if near else "."
        shown = ", ".join(names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")
        return f"{hint} It has: {shown or 'no column of numbers'}."

    def unit(self, position: int) -> str:
        """Unit of the column at a position, empty where none is known."""
        header = self.headers[position]
        return self.units.get(header, "") or split_unit(header)[1]

    def numbers(self, position: int) -> Float[np.ndarray, " samples"]:
        """The column at a position, checked to be one-dimensional numbers."""
        values = np.asarray(self.column(position))
        name = self.names[position][:LONGEST_NAME]
        if values.dtype.kind in "mM":
            try:
                since = values - values[:1] if values.dtype.kind == "M" else values
                values = since / np.timedelta64(1, "s")
            except TypeError:
                raise ValueError(
                    f"column {name!r} of {self.source} holds {values.dtype}, which are no seconds; give times in s."
                ) from None
        if values.dtype.kind == "O" or values.dtype.kind in "US":
            values = _from_objects(self, name, values)
        if values.dtype.kind not in "fiub":
            raise ValueError(f"column {name!r} of {self.source} holds {values.dtype}; give real numbers.")
        # What is out of range becomes infinite, which is refused below; damaged bytes may be no number at all.
        with np.errstate(over="ignore", invalid="ignore"):
            values = values.astype(np.float64)
        # One NaN for all: arithmetic warns of some that damaged bytes make.
        values[np.isnan(values)] = np.nan
        infinite = np.flatnonzero(np.isinf(values))
        if infinite.size:
            raise ValueError(
                f"column {name!r} of {self.source} is infinite at {self.row(infinite[0])}; correct or empty the cell."
            )
        largest = np.nanmax(np.abs(values), initial=0.0)
        if largest > LARGEST_VALUE:
            raise ValueError(
                f"column {name!r} of {self.source} reaches {largest:.3g}, beyond {LARGEST_VALUE:g}; check "
                "the file or rescale the channel."
            )
        return values


def _from_objects(table: Table, name: str, values: np.ndarray) -> np.ndarray:
    result = np.empty(values.shape)
    for k, value in enumerate(values):
        try:
            result[k] = np.nan if value is None else float(value)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"column {name!r} of {table.source} holds the text {str(value)[:40]!r} at {table.row(k)}; give numbers."
            ) from None
    return result
