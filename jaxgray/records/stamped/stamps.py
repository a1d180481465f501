"""Rows as they were sampled, each at a time of its own."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

NOT_SAMPLED = -1
"""Place on the grid of what a row does not hold."""

BEGIN, START, CHANGE = -3, -2, -1
"""What stands for a row at the beginning of a run, at the start of the grid, and where inputs alone change."""


@dataclass(frozen=True, eq=False, repr=False)
class Stamps:
    """What a record was made of: rows at times of their own, and where their outputs lie on its uniform grid.

    `input_time` [s], increasing; `u`: inputs from there on, held ("zero") or on straight lines to the next ("linear"),
    as `hold` says; `time` of every row [s]; `y`: outputs, NaN where a row has none; `place` of every output on the grid
    of the record, `NOT_SAMPLED` where there is none; `clock` of every row: 0 for that of the inputs, or another one's
    number; `jitter`: largest distance from the grid in its steps; `counted`: whether the rows count, and not the
    channels on the grid.
    """

    input_time: Float[np.ndarray, " events"]
    u: Float[np.ndarray, "events inputs"]
    time: Float[np.ndarray, " rows"]
    y: Float[np.ndarray, "rows outputs"]
    place: Int[np.ndarray, "rows outputs"]
    clock: Int[np.ndarray, " rows"]
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

    @property
    def other_clocks(self) -> list[int]:
        """Numbers of clocks of rows that count, but for that of the inputs."""
        return [int(k) for k in np.unique(self.clock[(self.place >= 0).any(axis=1)]) if k]

    def since(self, start: float) -> "Events":
        """What happens from a start on, or from the first row on that lies on the grid, where that is earlier."""
        rows = np.flatnonzero((self.place >= 0).any(axis=1))
        begin = min(start, float(self.time[rows].min()))
        changes = self.input_time[self.input_time > begin]
        time = np.concatenate([[begin], changes, [start], self.time[rows]])
        row = np.concatenate([[BEGIN], np.full(len(changes), CHANGE), [START], rows])
        # Inputs change before a row at the same time.
        order = np.argsort(time, kind="stable")
        return Events(time[order] - begin, self._inputs(time[order]), row[order])

    def _inputs(self, time: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times inputs"]:
        """Inputs at times."""
        if self.hold == "linear":
            return np.stack([np.interp(time, self.input_time, column) for column in self.u.T], axis=1)
        return self.u[np.maximum(np.searchsorted(self.input_time, time, side="right") - 1, 0)]


@dataclass(frozen=True)
class Events:
    """Inputs from a beginning on: `time` since then [s]; `u` from there on; `row` of the stamps, `START` for that of
    the grid, `BEGIN` for the beginning and `CHANGE` for inputs alone."""

    time: Float[np.ndarray, " events"]
    u: Float[np.ndarray, "events inputs"]
    row: Int[np.ndarray, " events"]
