"""Rows of a file at times of their own: whether their times matter, inputs between their samples, several files."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from ..clock import read_clock, seconds_per
from ..readers.memory import TIME_NAMES
from ..readers.table import Table

RESOLUTION = 0.51
"""Distance of times from a uniform clock, in units of their last digit, that rounding makes."""


def error_if_uniform(time: Float[np.ndarray, " rows"], y: Float[np.ndarray, "rows outputs"]) -> float:
    """Error that a uniform clock in the place of the rows' times makes of the outputs, in standard deviations of their
    noise: the largest root mean square of an output; infinite where there is no such clock, 0 where the times were
    rounded and may be uniform. Times that do not increase are left to the clock.

    **Arguments:** `time` [s]; `y`, NaN where missing.
    """
    if not np.all(np.isfinite(time)) or len(time) < 3 or np.any(np.diff(time) <= 0):
        return 0.0
    try:
        clock = read_clock(time)
    except ValueError:
        return np.inf
    off = time - clock.start_time - clock.sampling_time * clock.index
    if np.ptp(off) <= 2 * RESOLUTION * _last_digit(time):
        return 0.0
    off -= off.mean()
    worst = 0.0
    for column in y.T:
        known = np.isfinite(column)
        if known.sum() < 5:
            continue
        t, x = time[known], column[known]
        # Second differences of white noise have six times its variance, those of anything slow next to none.
        noise = np.sqrt(np.mean(np.diff(x, n=2) ** 2) / 6)
        # The noise has slopes too, of half its variance over central differences.
        slope = np.mean(np.gradient(x, t) ** 2) - noise**2 / (2 * clock.sampling_time**2)
        error = np.sqrt(max(slope, 0.0)) * np.std(off[known])
        worst = max(worst, error / noise if noise > 0 else np.inf if error > 0 else 0.0)
    return worst


def _last_digit(time: np.ndarray) -> float:
    """The decimal unit of which all times are whole multiples [s]; 0 where they have too many digits."""
    for digits in range(10):
        unit = 10.0**-digits
        if np.max(np.abs(time / unit - np.rint(time / unit))) < 1e-3:
            return unit
    return 0.0


def held(
    time: Float[np.ndarray, " rows"], u: Float[np.ndarray, "rows inputs"], hold: str
) -> Float[np.ndarray, "rows inputs"]:
    """Inputs at every row: in empty cells the value before, or with a linear hold that on a straight line; NaN before
    the first.

    **Arguments:** `time` [s]; `u`, NaN where empty; `hold`: "zero" or "linear".
    """
    found = np.array(u)
    for column in found.T:
        known = np.flatnonzero(np.isfinite(column))
        if known.size == 0:
            continue
        if hold == "linear":
            column[:] = np.interp(time, time[known], column[known])
        else:
            last = np.searchsorted(known, np.arange(len(column)), side="right") - 1
            column[:] = np.where(last >= 0, column[known[np.maximum(last, 0)]], np.nan)
        column[: known[0]] = np.nan
    return found


def joined(
    table: Table, time: str | None, also: Sequence[str], first_input: str, opened: Callable[[str, None, None], Table]
) -> tuple[Table, Int[np.ndarray, " rows"]]:
    """One table of the rows of several files with time columns of their own, in the order of their times; cells are
    empty where a file has none; its time column is "t", in s. And the clock of every row: 0 for that of the file with
    the first input, or the number of another file.

    **Arguments:** `table`: of the first file; `time`: its time column, default t or time; `also`: "FILE:column,…";
    `first_input`: name of a column; `opened`: reads a file.

    **Raises:** `ValueError` where something is not found, or a name is in two files.
    """
    parts = [(table, time, None)]
    for one in also:
        path, _, names = str(one).rpartition(":")
        wanted = [name.strip() for name in names.split(",") if name.strip()]
        if not path or not wanted:
            raise ValueError(f"also is {one!r}; give a file and its columns, such as camera.csv:x,y.")
        parts.append((opened(path, None, None), None, wanted))
    columns, units, every = {}, {}, []
    for number, (part, name, wanted) in enumerate(parts):
        clock = _time_column(part, name)
        every.append(_increasing(part, clock))
        for name in [n for k, n in enumerate(part.names) if k != clock] if wanted is None else wanted:
            if name in columns:
                raise ValueError(f"also: a column {name!r} is in two files; rename one.")
            k = part.find("also", name)
            columns[name], units[name] = (number, k), part.unit(k)
    times = np.concatenate(every)
    owner = np.repeat(np.arange(len(parts)), [len(one) for one in every])
    order = np.argsort(times, kind="stable")

    def column(position: int) -> np.ndarray:
        if position == 0:
            return times[order]
        number, k = list(columns.values())[position - 1]
        values = np.full(len(times), np.nan)
        values[owner == number] = parts[number][0].numbers(k)
        return values[order]

    reference = columns[first_input][0] if first_input in columns else 0
    numbers = np.where(owner == reference, 0, np.where(owner < reference, owner + 1, owner))[order]
    return Table(table.source, ("t", *columns), column, units=units), numbers


def _increasing(table: Table, position: int) -> np.ndarray:
    """The times of a file in s.

    **Raises:** `ValueError` where one is missing, not later than the one before, or a date, of which there is no common
    zero.
    """
    name = table.names[position]
    if np.asarray(table.column(position)).dtype.kind == "M":
        raise ValueError(f"also: time column {name!r} of {table.source} holds dates; give seconds on one clock.")
    time = table.numbers(position) * seconds_per(table.unit(position), name)
    wrong = np.flatnonzero(~np.isfinite(time))
    if wrong.size:
        raise ValueError(f"time is missing at {table.row(wrong[0])} of {table.source}; give every row a time.")
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        k = back[0]
        raise ValueError(
            f"time column {name!r} of {table.source}: time does not increase at {table.row(k + 1)} ({time[k]:.9g} s, "
            f"then {time[k + 1]:.9g} s); sort the rows and remove duplicates."
        )
    return time


def _time_column(table: Table, time: str | None) -> int:
    if time is not None:
        return table.find("time", time)
    found = [k for k, name in enumerate(table.names) if name.lower() in TIME_NAMES]
    if len(found) != 1:
        raise ValueError(f"also: {table.source} has {len(found)} columns called t or time; it needs one.")
    return found[0]
