"""From a time column to a uniform grid: the sampling time, the gaps and the jitter."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SECONDS = {
    "s": 1.0,
    "sec": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,  # micro sign
    "μs": 1e-6,  # Greek mu
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
}


@dataclass(frozen=True)
class Clock:
    """A uniform grid and where the rows of the file lie on it.

    **Arguments:**

    - `sampling_time`: in s.
    - `start_time`: in s.
    - `index`: place of every row on the grid, starting at 0.
    - `jitter`: max |t_k − t_0 − k h| / h.
    """

    sampling_time: float
    start_time: float
    index: Int[np.ndarray, " rows"]
    jitter: float

    @property
    def samples(self) -> int:
        """Length of the grid."""
        return int(self.index[-1]) + 1

    @property
    def missing(self) -> Int[np.ndarray, " gaps"]:
        """Places of the grid without a row."""
        return np.setdiff1d(np.arange(self.samples), self.index)


def seconds_per(unit: str, name: str) -> float:
    """The length of a time unit.

    **Arguments:**

    - `unit`: as in a header; empty is seconds.
    - `name`: the column, for the message.

    **Returns:** seconds in one unit.

    **Raises:** `ValueError` for an unknown unit.
    """
    try:
        return SECONDS[unit.strip().lower() or "s"]
    except KeyError:
        known = ", ".join(u for u in SECONDS if u != "μs")
        raise ValueError(f"time column {name!r} has the unit {unit!r}; give one of {known}.") from None


def read_clock(
    time: Float[np.ndarray, " rows"],
    *,
    sampling_time: float | None = None,
    row=lambda sample: f"sample {sample}",
    largest_jitter: float = 0.5,
) -> Clock:
    """Fit t_k = t_0 + n_k h with whole n_k; steps of two or more h are missing samples.

    **Arguments:**

    - `time`: time of every row in s.
    - `sampling_time`: h in s where it is known; default found from the steps.
    - `row`: how to call the row of a sample in a message.
    - `largest_jitter`: largest |t_k − t_0 − n_k h| / h; default 0.5.

    **Returns:** a `Clock`.

    **Raises:** `ValueError` where time is missing, does not increase, or is not uniform.
    """
    unknown = np.flatnonzero(~np.isfinite(time))
    if unknown.size:
        raise ValueError(f"time is missing at {row(unknown[0])}; give every row a time, or say sampling_time.")
    step = np.diff(time)
    if step.size == 0:
        raise ValueError("time has 1 value; a record needs at least 2 samples.")
    backward = np.flatnonzero(step <= 0.0)
    if backward.size:
        k = backward[0]
        raise ValueError(
            f"time does not increase at {row(k + 1)} ({time[k]:.9g} s, then {time[k + 1]:.9g} s); sort the "
            "rows and remove duplicates, or say sampling_time."
        )
    middle = float(np.median(step))
    h = middle if sampling_time is None else sampling_time
    if not 0.4 < middle / h < 1.6:
        raise ValueError(_contradiction(h, middle))
    counts = np.clip(np.rint(step / h), 1, 1e9).astype(np.int64)
    clock = _fit(time, counts)
    if np.mean(counts > 1) > 0.05:
        # A coarse time column (whole milliseconds at 700 Hz) shows steps of one and two for a uniform clock.
        even = _fit(time, np.ones_like(counts))
        if sampling_time is None and even.jitter <= largest_jitter:
            clock = even
    if sampling_time is not None and abs(clock.sampling_time - h) > 1e-3 * h:
        raise ValueError(_contradiction(h, clock.sampling_time))
    if clock.samples > 10 * len(time) or not clock.jitter <= largest_jitter:
        off = np.abs(time - time[0] - clock.sampling_time * clock.index)
        raise ValueError(
            f"time is not uniform: {row(int(off.argmax()))} is {clock.jitter:.3g} sampling times off the "
            f"grid of {clock.sampling_time:.6g} s; resample the record to a uniform grid."
        )
    return clock


def _fit(time: np.ndarray, counts: np.ndarray) -> Clock:
    index = np.concatenate(([0], np.cumsum(counts)))
    # Twelve digits: what the decimals of a file can carry, without the rounding of the division.
    h = float(f"{(time[-1] - time[0]) / index[-1]:.12g}")
    jitter = float(np.abs(time - time[0] - h * index).max() / h)
    return Clock(h, float(time[0]), index, jitter)


def _contradiction(given: float, found: float) -> str:
    return f"sampling_time is {given:.9g} s and the time column says {found:.9g} s; leave one of them out."
