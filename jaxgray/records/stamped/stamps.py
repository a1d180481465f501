"""Rows as they were sampled, each at a time of its own."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

NOT_SAMPLED = -1
"""Place on the grid of what a row does not hold."""

BEGIN, START = -2, -1
"""What stands for a row at the beginning of a run, and at the start of the grid."""


@dataclass(frozen=True, eq=False, repr=False)
class Stamps:
    """What a record was made of: rows at times of their own, and where their outputs lie on its uniform grid.

    `time` of every row [s], increasing; `u`: inputs from there on, held ("zero") or on straight lines to the next row
    ("linear"), as `hold` says; `y`: outputs, NaN where a row has none; `place` of every output on the grid of the
    record, `NOT_SAMPLED` where there is none; `jitter`: largest distance from the grid in its steps; `counted`: whether
    the rows count, and not the channels on the grid.
    """

    time: Float[np.ndarray, " rows"]
    u: Float[np.ndarray, "rows inputs"]
    y: Float[np.ndarray, "rows outputs"]
    place: Int[np.ndarray, "rows outputs"]
    hold: str
    jitter: float
    counted: bool = True

    def between(self, first: int, last: int) -> "Stamps":
        """Outputs at the samples first ≤ k < last of the grid alone."""
        inside = (self.place >= first) & (self.place < last)
        return dataclasses.replace(self, place=np.where(inside, self.place - first, NOT_SAMPLED))

    def sampled(self, samples: int) -> Bool[np.ndarray, "samples outputs"]:
        """Where on a grid of so many samples something was sampled."""
        there = np.zeros((samples, self.y.shape[1]), bool)
        for k, place in enumerate(self.place.T):
            there[place[place >= 0], k] = True
        return there

    def select(self, inputs: list[int], outputs: list[int]) -> "Stamps":
        """Some of the channels, by position."""
        return dataclasses.replace(self, u=self.u[:, inputs], y=self.y[:, outputs], place=self.place[:, outputs])

    def less(self, u: Float[np.ndarray, " inputs"], y: Float[np.ndarray, " outputs"]) -> "Stamps":
        """With constants taken off the channels."""
        return dataclasses.replace(self, u=self.u - u, y=self.y - y)

    def since(self, start: float) -> "Events":
        """What happens from a start on, or from the first row on that lies on the grid, where that is earlier."""
        placed = (self.place >= 0).any(axis=1)
        first = int(np.argmax(placed))
        begin = min(start, float(self.time[first]))
        after = int(np.searchsorted(self.time, begin, side="left"))
        rows = np.arange(after, len(self.time))
        time = np.concatenate([[begin, start], self.time[rows]])
        u = np.concatenate([self._input(begin)[None], self._input(start)[None], self.u[rows]])
        # The start itself comes before a row at the same time.
        order = np.argsort(time, kind="stable")
        row = np.concatenate([[BEGIN, START], rows])[order]
        return Events(time[order] - begin, u[order], row)

    def _input(self, time: float) -> Float[np.ndarray, " inputs"]:
        """Inputs at a time."""
        if self.hold == "linear":
            return np.array([np.interp(time, self.time, column) for column in self.u.T])
        return self.u[max(int(np.searchsorted(self.time, time, side="right")) - 1, 0)]


@dataclass(frozen=True)
class Events:
    """Inputs from a beginning on: `time` since then [s]; `u` from there on; `row` of the stamps, `START` for that of
    the grid and `BEGIN` for the beginning."""

    time: Float[np.ndarray, " events"]
    u: Float[np.ndarray, "events inputs"]
    row: Int[np.ndarray, " events"]
