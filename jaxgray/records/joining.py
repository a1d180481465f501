"""Several records of one system: whether they belong together, and putting pieces end to end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxgray.records.record import Record
from jaxgray.records.stamped import grid_of

# Clocks of one logger differ by some parts per million between files.
SAMPLING_TIME_TOLERANCE = 1e-4


def records_of(given: Record | Sequence[Record], name: str) -> list[Record]:
    """The records of an argument.

    **Arguments:** `given`: a record or several; `name` of the argument.

    **Raises:** `ValueError` where it holds none, or something else.
    """
    if isinstance(given, (list, tuple)) and given:
        return [record_of(one, name, "a Record or a list of them, at least one") for one in given]
    return [record_of(given, name, "a Record or a list of them, at least one")]


def record_of(given: Record, name: str, wanted: str = "a Record") -> Record:
    """An argument that must be a record; `ValueError` where it is something else."""
    if isinstance(given, Record):
        return given
    came = repr(given) if isinstance(given, (str, int, float, list, tuple)) else f"a {type(given).__name__}"
    raise ValueError(f"{name} must be {wanted}; here is {came}. Read a file with read_record.")


def check_compatible(records: Sequence[Record]) -> None:
    """Check that records can be treated as several experiments on one system.

    **Arguments:**

    - `records`: at least one. Names, measured quantities, hold, scheduling channel and sampling time (to
        1e-4) must agree with the first, and units where both have them; every output must be measured somewhere in
        every record.

    **Raises:** `ValueError` naming what differs.
    """
    if not records:
        raise ValueError("records is empty; give at least one record.")
    first = records[0]
    for k, other in enumerate(records[1:], start=1):
        for what in ("input_names", "output_names", "measured", "hold", "scheduling_name"):
            _demand(getattr(first, what) == getattr(other, what), k, what, first, other)
        for what in ("input_units", "output_units"):
            pairs = zip(getattr(first, what), getattr(other, what))
            _demand(all(a == b or not a or not b for a, b in pairs), k, what, first, other)
        apart = abs(other.sampling_time - first.sampling_time)
        _demand(apart <= SAMPLING_TIME_TOLERANCE * first.sampling_time, k, "sampling_time", first, other)
    for k, record in enumerate(records):
        for name, column in zip(record.output_names, record.y.T):
            if np.all(np.isnan(column)):
                raise ValueError(
                    f"records[{k}] has no measured sample of {name!r} ({record.samples} samples, all missing); leave "
                    "that record or that output out."
                )


def _demand(holds: bool, k: int, what: str, first: Record, other: Record) -> None:
    if not holds:
        raise ValueError(
            f"records[{k}] has {what} {getattr(other, what)!r} and records[0] has "
            f"{getattr(first, what)!r}; they must agree: rename, select or resample."
        )


def concatenate(records: Sequence[Record]) -> Record:
    """Contiguous pieces of one record, put end to end.

    **Arguments:**

    - `records`: in order, each starting where the one before ends (to a tenth of a sample). Experiments that
        are not contiguous stay a list: joining them would invent a jump of the state.

    **Returns:** one `Record`.

    **Raises:** `ValueError` where the pieces do not belong together or are not contiguous.
    """
    records = list(records)
    check_compatible(records)
    first = records[0]
    end = first.start_time + first.duration
    for k, piece in enumerate(records[1:], start=1):
        if abs(piece.start_time - end) > 0.1 * first.sampling_time:
            raise ValueError(
                f"records[{k}] starts at {piece.start_time:.9g} s and the one before ends at {end:.9g} s; "
                "give contiguous pieces, or keep the records as a list."
            )
        end = piece.start_time + piece.duration
    scheduling = None
    if first.scheduling is not None:
        scheduling = np.concatenate([piece.scheduling for piece in records])
    return replace(
        first,
        u=np.concatenate([piece.u for piece in records]),
        y=np.concatenate([piece.y for piece in records]),
        scheduling=scheduling,
    )


def on_one_grid(records: Sequence[Record], tolerance: float = 0.0) -> list[Record]:
    """Records with rows at times of their own on grids of one sampling time: that of the uniform ones among the
    records, or the shortest.

    **Arguments:**

    - `records`: of one system.
    - `tolerance`: relative difference in sampling time that is left; default none.

    **Returns:** the records, those that are uniform as they are.
    """
    uniform = [record.sampling_time for record in records if not record.has_own_times]
    step = uniform[0] if uniform else min((record.sampling_time for record in records), default=0.0)
    return [
        with_step(record, step)
        if record.has_own_times and abs(record.sampling_time - step) > tolerance * step
        else record
        for record in records
    ]


def with_step(record: Record, step: float) -> Record:
    """A record of rows at times of their own on a grid of another step [s]."""
    rows = record.stamps
    y = np.where(rows.place >= 0, rows.y, np.nan)
    kept = (rows.place >= 0).any(axis=1)
    at = grid_of(rows.time[kept], rows.input_time, rows.u, y[kept], rows.hold, step, rows.clock[kept])
    return replace(record, u=at.u, y=at.y, sampling_time=at.step, start_time=at.start, stamps=at.stamps)
