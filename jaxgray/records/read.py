"""From a file to a record."""

import difflib
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxgray.records.channels import as_seconds
from jaxgray.records.clock import Clock, read_clock, seconds_per
from jaxgray.records.readers.containers import read_npy, read_npz
from jaxgray.records.readers.delimited import read_delimited
from jaxgray.records.readers.hdf5 import read_hdf5, read_mat
from jaxgray.records.readers.limits import check_file
from jaxgray.records.readers.memory import TIME_NAMES, table_in_memory
from jaxgray.records.readers.parquet import read_parquet
from jaxgray.records.readers.table import Table
from jaxgray.records.readers.universal import read_universal
from jaxgray.records.record import Record
from jaxgray.records.stamped import error_if_uniform, held, joined

# A new format is one reader and one row.
READERS = {
    ".csv": read_delimited,
    ".tsv": read_delimited,
    ".txt": read_delimited,
    ".dat": read_delimited,
    ".npz": read_npz,
    ".npy": read_npy,
    ".mat": read_mat,
    ".parquet": read_parquet,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".uff": read_universal,
    ".unv": read_universal,
}
JITTER_WARNING = 0.01

NEGLIGIBLE = 0.01
"""Error of the outputs at uniform times, in standard deviations of their noise, up to which a uniform clock serves."""


class RecordWarning(UserWarning):
    """Something in a file that was read all the same, and should be known."""


def read_record(
    path,
    *,
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    time: str | None = None,
    sampling_time: float | None = None,
    hold: str = "zero",
    measured: str | Sequence[str] = "displacement",
    scheduling: str | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    input_units: Sequence[str] | None = None,
    output_units: Sequence[str] | None = None,
    own_times: bool | None = None,
    also: str | Sequence[str] = (),
) -> Record:
    r"""Read a record from csv (tsv, txt, dat), npz, npy, mat, parquet, hdf5 or uff, or take it from a table in memory.

    Headers may carry units, `force [N]` or `force (N)`, which are stripped from the name; time in `ms`, `µs`,
    `min` or `h` becomes seconds. Columns of a 2-D array `u` are `u[0]`, `u[1]`, …. Rows that are missing from
    the time column become missing outputs, with a `RecordWarning`. Where the rows follow no clock, or wander from it by
    more than the noise hides, they keep times of their own (`Record.from_stamps`).

    **Arguments:**

    - `path`: the file; or a data frame, an xarray object, a dictionary of arrays, or a record of the package
        `nonlinear_benchmarks`, of which the columns are `u` and `y`.
    - `inputs`, `outputs`: names of the columns, one or several.
    - `time`: name of the time column; default `t` or `time` in any case, unless `sampling_time` is given.
    - `sampling_time`: time between rows in s, for files without a time column; default `sampling_time` in the
        file, if there is one.
    - `hold`: the input between samples, `"zero"` (default), `"linear"` or `"band-limited"` (behind an anti-alias
        filter; see `Record`).
    - `measured`: `"displacement"` (default), `"velocity"` or `"acceleration"`, one for all or one per output.
    - `scheduling`: name of a column on which the system may depend; default none.
    - `delimiter`, `decimal`: of delimited text; default found in the file.
    - `input_units`, `output_units`: units instead of those in the headers.
    - `own_times`: whether rows keep the times of their column. Empty cells then count as not sampled, and inputs keep
      their last value there (or lie on straight lines, with a linear hold). Default where it matters; False: never.
    - `also`: columns of other files with time columns of their own, "camera.csv:x,y"; their rows join in, at times of
        their own. `inputs` and `outputs` name them like those of the first file.

    **Returns:** a `Record`.

    **Raises:** `ValueError` where file or arguments do not fit, `ImportError` naming the extra to install.

    **Example:**

        >>> import pathlib, jaxgray
        >>> rows = "\n".join(f"{0.01 * k:.2f},{k % 7},{k % 5}" for k in range(20))
        >>> _ = pathlib.Path("record.csv").write_text(f"t [s],F [N],x [m]\n{rows}\n")
        >>> record = jaxgray.read_record("record.csv", inputs="F", outputs="x")
        >>> record.samples, round(record.sampling_time, 6), record.output_units
        (20, 0.01, ('m',))
    """
    inputs, outputs = _name_list("inputs", inputs), _name_list("outputs", outputs)
    table, clock = _open(path, delimiter, decimal), None
    if also:
        if sampling_time is not None or scheduling is not None or own_times is False:
            raise ValueError("also= joins rows at times of their own; leave out sampling_time, scheduling, own_times.")
        table, clock = joined(table, time, (also,) if isinstance(also, str) else also, inputs[0], _open)
        time, own_times = "t", True
    positions = {
        "inputs": [table.find("inputs", name) for name in inputs],
        "outputs": [table.find("outputs", name) for name in outputs],
    }
    if scheduling is not None:
        positions["scheduling"] = [table.find("scheduling", scheduling)]
    clock_column, sampling_time = _find_clock(table, time, sampling_time, positions["inputs"] + positions["outputs"])
    if clock_column is not None and time is not None:
        positions["time"] = [clock_column]
    _no_column_twice(table, positions)

    if own_times and clock_column is None:
        raise ValueError("own_times is True and there is no time column; name it with time.")
    u = _columns(table, "inputs", positions["inputs"], gaps=bool(own_times))
    y = _columns(table, "outputs", positions["outputs"], samples=len(u))
    p = None
    if scheduling is not None:
        p = _columns(table, "scheduling", positions["scheduling"], samples=len(u))[:, 0]
    start_time = 0.0
    more = {
        "input_names": _names(table, positions["inputs"]),
        "output_names": _names(table, positions["outputs"]),
        "input_units": _units(table, positions["inputs"]) if input_units is None else input_units,
        "output_units": _units(table, positions["outputs"]) if output_units is None else output_units,
        "hold": hold,
        "measured": measured,
    }
    if clock_column is not None:
        times, off = _times(table, clock_column, samples=len(u)), 0.0
        if own_times is not False and scheduling is None and sampling_time is None:
            off = error_if_uniform(times, y)
        if own_times or off > NEGLIGIBLE:
            return _at_own_times(table, clock_column, times, u, y, clock, more)
        grid = _read_clock(table, clock_column, sampling_time, times, off)
        if grid.samples > len(u):
            u, y, p = _fill(grid, u, y, p)
        if sampling_time is None:
            sampling_time = grid.sampling_time
        start_time = grid.start_time

    return Record(
        u,
        y,
        sampling_time,
        **more,
        scheduling=p,
        scheduling_name=None if scheduling is None else _names(table, positions["scheduling"])[0],
        start_time=start_time,
    )


def _name_list(argument: str, given) -> tuple[str, ...]:
    names = (given,) if isinstance(given, str) else tuple(given)
    if not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise ValueError(f"{argument} is {given!r}; give the name of one or several columns.")
    return tuple(name.strip() for name in names)


def _open(path, delimiter: str | None, decimal: str | None) -> Table:
    if isinstance(path, Record):
        raise ValueError("path is a Record already; use it as it is, or record.select(inputs=…, outputs=…).")
    if not isinstance(path, (str, os.PathLike)):
        table = table_in_memory(path)
        if table is None:
            raise ValueError(
                f"path is of type {type(path).__name__}; give the path of a file, a data frame, an xarray object or a "
                "dictionary of arrays."
            )
        return table
    path = Path(path)
    check_file(path)
    if path.stat().st_size == 0:
        raise ValueError(f"path: {path} is empty; give a file with a header row and at least 2 rows of numbers.")
    suffix = path.suffix.lower()
    if suffix not in READERS:
        near = difflib.get_close_matches(suffix, READERS, n=1)
        hint = f"; did you mean {near[0]}?" if near else "."
        raise ValueError(f"path: {path.name} has an unknown ending{hint} Known are {', '.join(READERS)}.")
    reader = READERS[suffix]
    try:
        if reader is read_delimited:
            return reader(path, delimiter=delimiter, decimal=decimal)
        return reader(path)
    except PermissionError:
        raise ValueError(f"path: {path} cannot be read; check its permissions.") from None


def _find_clock(table: Table, time: str | None, sampling_time, used: list[int]) -> tuple[int | None, float | None]:
    """Position of the time column, and the sampling time where it is given; at least one of them."""
    if sampling_time is not None:
        sampling_time = as_seconds("sampling_time", sampling_time)
    if time is not None:
        return table.find("time", time), sampling_time
    if sampling_time is not None:
        return None, sampling_time
    found = [k for k, name in enumerate(table.names) if name.lower() in TIME_NAMES and k not in used]
    if len(found) > 1:
        headers = ", ".join(repr(table.headers[k]) for k in found)
        raise ValueError(f"time: {table.source} has several time columns, {headers}; say which with time.")
    if found:
        return found[0], None
    if "sampling_time" in table.scalars:
        return None, table.scalars["sampling_time"]
    raise ValueError(
        f"time: {table.source} has no column called t or time; give time (the name of a column) or "
        "sampling_time (in s)."
    )


def _no_column_twice(table: Table, positions: dict[str, list[int]]) -> None:
    """Scheduling may be a channel that is used already; nothing else may be named twice."""
    seen: dict[int, str] = {}
    for argument in ("inputs", "outputs", "time"):
        for k in positions.get(argument, ()):
            if k in seen:
                where = f"twice in {argument}" if seen[k] == argument else f"in {seen[k]} and in {argument}"
                raise ValueError(f"column {table.names[k]!r} is {where}; give every column one place.")
            seen[k] = argument


def _at_own_times(table: Table, position: int, times: np.ndarray, u: np.ndarray, y: np.ndarray, clock, more) -> Record:
    """A record of rows at the times of their column."""
    clock = np.zeros(len(times), int) if clock is None else clock
    try:
        u = held(times, u, more["hold"])
        known = np.isfinite(u).all(axis=1)
        record = Record.from_stamps(times[known], u[known], y[known], clock=clock[known], **more)
    except ValueError as error:
        raise ValueError(f"time column {table.names[position]!r} of {table.source}: {error}") from None
    warnings.warn(
        f"{table.source}: the rows have times of their own, up to {record.stamps.jitter:.2g} samples off a uniform "
        f"grid of {record.sampling_time:.6g} s, and keep them.",
        RecordWarning,
        stacklevel=3,
    )
    return record


def _columns(
    table: Table, argument: str, positions: list[int], samples: int | None = None, *, gaps: bool = False
) -> np.ndarray:
    columns = [table.numbers(k) for k in positions]
    for k, column in zip(positions, columns):
        _same_length(table, k, column, len(columns[0]) if samples is None else samples)
        empty = np.flatnonzero(np.isnan(column))
        if argument != "outputs" and empty.size and not gaps:
            raise ValueError(
                f"{argument}: column {table.names[k]!r} of {table.source} has {empty.size} missing values, "
                f"the first at {table.row(empty[0])}; only outputs may be missing: fill or cut them."
            )
        if empty.size == len(column):
            raise ValueError(f"{argument}: column {table.names[k]!r} of {table.source} has no value at all.")
    return np.column_stack(columns)


def _same_length(table: Table, position: int, column: np.ndarray, samples: int) -> None:
    if len(column) != samples:
        raise ValueError(
            f"column {table.names[position]!r} of {table.source} has {len(column)} values and the first "
            f"input has {samples}; they must be equally long."
        )


def _times(table: Table, position: int, samples: int) -> np.ndarray:
    """A time column in s."""
    numbers = table.numbers(position) * seconds_per(table.unit(position), table.names[position])
    _same_length(table, position, numbers, samples)
    return numbers


def _read_clock(table: Table, position: int, sampling_time: float | None, numbers: np.ndarray, error: float) -> Clock:
    """The clock of a time column; `error` that it makes of the outputs, in units of their noise."""
    name = table.names[position]
    try:
        clock = read_clock(numbers, sampling_time=sampling_time, row=table.row)
    except ValueError as error:
        raise ValueError(f"time column {name!r} of {table.source}: {error}") from None
    if clock.samples > len(numbers):
        first = clock.missing[0] * clock.sampling_time + clock.start_time
        warnings.warn(
            f"{table.source}: {clock.missing.size} of {clock.samples} samples are missing in the time "
            f"column, the first at {first:.6g} s; outputs are NaN there and inputs hold their last value.",
            RecordWarning,
            stacklevel=3,
        )
    if clock.jitter > JITTER_WARNING:
        warnings.warn(
            f"{table.source}: the time column is up to {100 * clock.jitter:.2g} % of a sampling time off a "
            f"uniform grid of {clock.sampling_time:.6g} s, which is used"
            + (f": an error of {error:.1g} of the outputs' noise." if error else "."),
            RecordWarning,
            stacklevel=3,
        )
    return clock


def _fill(clock: Clock, u: np.ndarray, y: np.ndarray, p: np.ndarray | None):
    """Spread the rows over the grid: outputs NaN where there is none, inputs held."""
    last = np.searchsorted(clock.index, np.arange(clock.samples), side="right") - 1
    filled = np.full((clock.samples, y.shape[1]), np.nan)
    filled[clock.index] = y
    return u[last], filled, None if p is None else p[last]


def _names(table: Table, positions: list[int]) -> tuple[str, ...]:
    """Names without units, or whole headers where only the unit tells two columns apart."""
    return tuple(table.names[k] if table.names.count(table.names[k]) == 1 else table.headers[k] for k in positions)


def _units(table: Table, positions: list[int]) -> tuple[str, ...]:
    return tuple(table.unit(k) for k in positions)
