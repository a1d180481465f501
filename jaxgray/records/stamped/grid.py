"""A uniform grid beside rows at times of their own."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import isotonic_regression

from .stamps import NOT_SAMPLED, Stamps

WANDERING = 1.0
"""Distance from a uniform grid, in its steps, up to which rows are those of a clock that wanders."""

FINER = (1.0, 0.9, 0.7, 0.5)
"""Step of the grid for rows that follow no clock, in their mean step; the first is taken by which they lie near their
places, or the last."""

NEAR = 0.6
"""Root mean square distance of rows from their places, in steps, that is near: 0.2 rad of a period of twenty
steps, by which the slopes there are worth four percent less."""

MOST_EMPTY = 20
"""Places of a grid per row of the output that is sampled most, at most."""


@dataclass(frozen=True)
class Grid:
    """The uniform grid of a record, and its channels there: `start` [s], `step` [s], `u`, `y`, `hold` of the inputs
    between its samples, and the `stamps` with their places."""

    start: float
    step: float
    u: Float[np.ndarray, "samples inputs"]
    y: Float[np.ndarray, "samples outputs"]
    hold: str
    stamps: Stamps


def grid_of(
    time: Float[np.ndarray, " rows"],
    input_time: Float[np.ndarray, " events"],
    u: Float[np.ndarray, "events inputs"],
    y: Float[np.ndarray, "rows outputs"],
    hold: str,
    step: float | None = None,
    clock: Int[np.ndarray, " rows"] | None = None,
) -> Grid:
    """A uniform grid for rows at times of their own.

    Rows of a clock that wanders lie on the grid of the clock, one by one in their order. For others the grid is as much
    finer than their mean step as it takes; every sample of an output takes a place of its own near its time, by
    isotonic regression. Held inputs have their means over the steps of the grid, others their values; outputs are as
    they were sampled, NaN in places without a sample.

    **Arguments:** `time` of the rows and `input_time` [s], increasing; `u`, finite; `y`, NaN where a row has no sample;
    `hold`: "zero" or "linear"; `step` of the grid [s], default by the rows; `clock` of every row, 0 for that of the
    inputs, by default all.

    **Raises:** `ValueError` where an output has fewer than four samples, or the rows leave too long a gap.
    """
    sampled = np.isfinite(y)
    counts = sampled.sum(axis=0)
    if np.any(counts < 4):
        k = int(np.argmin(counts))
        raise ValueError(f"output {k} has {counts[k]} samples with a time; give at least 4.")
    densest = time[sampled[:, int(np.argmax(counts))]]
    start, step = _clock(densest) if step is None else (float(densest[0]) - step, step)
    wanted = (time - start) / step
    samples = int(np.ceil(np.max(wanted[sampled.any(axis=1)]))) + 2
    if samples > MOST_EMPTY * len(densest):
        raise ValueError(
            f"the rows leave gaps too long for their {len(densest)} times ({densest[-1] - densest[0]:.6g} s at "
            f"{step:.6g} s a step); cut the record there and give several."
        )
    place = np.full(y.shape, NOT_SAMPLED)
    for k in range(y.shape[1]):
        rows = np.flatnonzero(sampled[:, k])
        place[rows, k] = _places(wanted[rows])
    # It begins where something was sampled.
    first = int(place[place >= 0].min())
    start, wanted = start + first * step, wanted - first
    place = np.where(place >= 0, place - first, NOT_SAMPLED)
    samples = int(place.max()) + 1
    at = start + step * np.arange(samples)
    jitter = float(np.max(np.abs(wanted[:, None] - place)[place >= 0]))
    clock = np.zeros(len(time), int) if clock is None else clock
    stamps = Stamps(input_time, u, time, y, place, clock, hold, jitter)
    return Grid(start, step, inputs_on(at, step, input_time, u, hold), _outputs(y, place, samples), hold, stamps)


def _clock(time: np.ndarray) -> tuple[float, float]:
    """Start and step of the grid for the times of the densest output."""
    rows = np.arange(len(time))
    usual = float(np.median(np.diff(time)))
    for counts in (rows, np.concatenate([[0], np.cumsum(np.maximum(np.rint(np.diff(time) / usual), 1))])):
        step, start = np.polyfit(counts, time, 1)
        if np.max(np.abs(time - start - step * counts)) <= WANDERING * step:
            return float(start), float(step)
    mean = float((time[-1] - time[0]) / (len(time) - 1))
    for share in FINER:
        step = share * mean
        # One step more at the start, where rows may come late.
        wanted = 1 + (time - time[0]) / step
        if np.sqrt(np.mean((wanted - _places(wanted)) ** 2)) <= NEAR:
            break
    return float(time[0]) - step, step


def _places(wanted: np.ndarray) -> np.ndarray:
    """Increasing whole numbers near increasing ones."""
    rows = np.arange(len(wanted))
    near = np.rint(isotonic_regression(wanted - rows).x).astype(int) + rows
    return np.maximum(near, rows)


def inputs_on(
    at: Float[np.ndarray, " samples"],
    step: float,
    time: Float[np.ndarray, " events"],
    u: Float[np.ndarray, "events inputs"],
    hold: str,
) -> Float[np.ndarray, "samples inputs"]:
    """Inputs given from times on, on a grid: held ones by their means over its steps, others by their values."""
    if hold == "linear":
        return np.stack([np.interp(at, time, column) for column in u.T], axis=1)
    held = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(np.diff(time)[:, None] * u[:-1], axis=0)])
    edges = np.append(at, at[-1] + step)
    # The last value, and the first, hold on beyond their rows.
    far = np.concatenate([[min(time[0], edges[0]) - step], time, [max(time[-1], edges[-1]) + step]])
    whole = np.concatenate([held[:1] - (time[0] - far[0]) * u[:1], held, held[-1:] + (far[-1] - time[-1]) * u[-1:]])
    return np.stack([np.diff(np.interp(edges, far, column)) / step for column in whole.T], axis=1)


def _outputs(y: np.ndarray, place: np.ndarray, samples: int) -> np.ndarray:
    found = np.full((samples, y.shape[1]), np.nan)
    for k, column in enumerate(y.T):
        rows = place[:, k] >= 0
        found[place[rows, k], k] = column[rows]
    return found
