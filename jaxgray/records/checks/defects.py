"""Detectors of sensor defects on one raw channel, without any model.

All of them separate a defect from what a clean signal does by itself: a settled output rests exactly at its
extreme, a periodic one returns exactly to it, and a step is no spike. What tells is how the signal enters and
leaves: a settled signal arrives slowly, a cut one at speed.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

# From this many equal samples on, a repetition is not taken for chance.
LONG_STRETCH = 8


@dataclass(frozen=True)
class Plateaus:
    """Runs of exactly equal values.

    **Arguments:**

    - `first`, `last`: place of the first and the last sample of each run.
    - `value`: the common value.
    """

    first: Int[np.ndarray, " runs"]
    last: Int[np.ndarray, " runs"]
    value: Float[np.ndarray, " runs"]

    @property
    def length(self) -> Int[np.ndarray, " runs"]:
        """Samples in each run."""
        return self.last - self.first + 1


def plateaus(y: Float[np.ndarray, " samples"]) -> Plateaus:
    """All runs of equal values, single samples too; NaN ends a run and is left out.

    **Arguments:**

    - `y`: one channel.

    **Returns:** the `Plateaus` in order.
    """
    edges = np.flatnonzero(np.concatenate(([True], y[1:] != y[:-1], [True])))
    first, last = edges[:-1], edges[1:] - 1
    there = ~np.isnan(y[first])
    return Plateaus(first[there], last[there], y[first[there]])


def fast_noise(y: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of the part of a signal that changes from sample to sample.

    The fourth difference, divided by sqrt(70), lets white noise pass and a signal at a twentieth of the
    sampling rate by a thousandth; its median resists spikes.

    **Arguments:**

    - `y`: one channel.

    **Returns:** in the unit of the channel; 0 for fewer than nine samples.
    """
    difference = np.diff(y, 4)
    difference = difference[~np.isnan(difference)]
    if difference.size < 5:
        return 0.0
    return float(1.4826 * np.median(np.abs(difference)) / np.sqrt(70.0))


def grid_step(y: Float[np.ndarray, " samples"]) -> float | None:
    """The step of the grid on which all values lie.

    **Arguments:**

    - `y`: one channel.

    **Returns:** in the unit of the channel, None where the values lie on no grid.
    """
    return _grid_step(np.asarray(y, dtype=float).tobytes())


@functools.lru_cache(maxsize=16)
def _grid_step(values: bytes) -> float | None:
    # Asked by one detector after the other.
    y = np.frombuffer(values)
    levels = np.unique(y[~np.isnan(y)])
    if len(levels) < 4:
        return None
    # Counts converted to units and printed with some digits scatter a little about the grid; how little is
    # not known, and gaps as small as the scatter are none.
    for scatter in (1e-9, 1e-7, 1e-6, 1e-5):
        gaps = np.diff(levels)
        step = _common_step(gaps[gaps > scatter * (levels[-1] - levels[0])])
        if step is not None:
            return step
    return None


def _common_step(gaps: np.ndarray) -> float | None:
    """The step of which all gaps are multiples, None where there is none."""
    if gaps.size < 3:
        return None
    # A few gaps may be odd ones, as where two ranges of a converter meet; and the smallest may be a multiple
    # of the step itself.
    low, smallest = np.quantile(gaps, 0.02, method="lower"), gaps.min()
    for step in (low, *(smallest / divisor for divisor in (1, 2, 3, 4, 5))):
        near = gaps < 10.5 * step
        step = float(np.sum(gaps[near]) / np.sum(np.rint(gaps[near] / step)))
        # Gaps of thousands of steps cannot tell a grid from none.
        if np.mean(gaps < 100.0 * step) > 0.5 and _on_grid(gaps, step):
            return step
    return None


def _on_grid(gaps: np.ndarray, step: float) -> bool:
    """Whether all but 2 % of the gaps are multiples of a step, within 5 % of it."""
    # Where there is no grid, a few show it.
    few = gaps[:: max(1, gaps.size // 256)]
    off = np.abs(few / step - np.rint(few / step))
    if np.sum(off >= 0.05) > 0.02 * gaps.size + 1:
        return False
    return bool(np.quantile(np.abs(gaps / step - np.rint(gaps / step)), 0.98) < 0.05)


LIKEWISE = 3
"""Samples at the opposite of a limit that make it a limit as well."""


def clipped(y: Float[np.ndarray, " samples"], upper: bool = True) -> Int[np.ndarray, " clipped"]:
    """Samples cut off at the largest value, or at the smallest.

    **Arguments:**

    - `y`: one channel.
    - `upper`: whether the largest value is looked at; default True.

    **Returns:** their places; empty where nothing is cut off.
    """
    at = _cut_off(y, upper)
    if at.size:
        return at
    x = y if upper else -y
    top = np.nanmax(x, initial=-np.inf)
    # A range that ends on one side ends as far on the other.
    mirrored = abs(top + np.nanmin(x, initial=np.inf)) <= 1e-9 * abs(top) and np.sum(x == top) >= LIKEWISE
    return np.flatnonzero(x == top) if mirrored and _cut_off(y, not upper).size else at


def _cut_off(y: Float[np.ndarray, " samples"], upper: bool) -> Int[np.ndarray, " clipped"]:
    """The same by what one side shows alone."""
    nothing = np.empty(0, dtype=int)
    x = y if upper else -y
    there = x[~np.isnan(x)]
    if there.size < 20:
        return nothing
    levels, counts = np.unique(there, return_counts=True)
    # A slow quantised sine spends up to 2.4 times as long at its top level as at the next one.
    if len(levels) < 8 or counts[-1] < max(6, 4 * counts[-4:-1].max()):
        return nothing
    runs = plateaus(x)
    top = np.flatnonzero(runs.value == levels[-1])
    # A periodic signal returns to every one of its values, and not to the extreme alone.
    between = (runs.value > levels[0]) & (runs.value < levels[-1])
    visits = np.unique(runs.value[between], return_counts=True)[1]
    if np.mean(runs.length[top]) < 3.0 and len(top) < 2 * visits.max(initial=0):
        return nothing
    enters, leaves, known = _speeds(x, runs.first[top], runs.last[top])
    usual, step = _usual_move(x), grid_step(y) or 0.0
    if usual == 0.0:
        return nothing
    # Where a sample moves by less than a few levels, speed is seen over several samples only.
    span = int(np.clip(np.ceil(10.0 * step / usual), 1, len(x) // 4))
    if span > 1:
        enters, leaves, known = _speeds(x, runs.first[top], runs.last[top], span)
    fast = (np.minimum(enters, leaves) > 0.1 * usual * span) & (np.minimum(enters, leaves) > 1.5 * step)
    if not known.any() or np.mean(fast[known]) < 0.5:
        return nothing
    return np.flatnonzero(x == levels[-1])


def _usual_move(y: np.ndarray) -> float:
    """RMS of the movement from sample to sample, 0 where no two neighbours are there."""
    moves = np.diff(y)
    moves = moves[~np.isnan(moves)]
    return float(np.sqrt(np.mean(moves**2))) if moves.size else 0.0


def _speeds(x: np.ndarray, first: np.ndarray, last: np.ndarray, span: int = 1):
    """Movement just before and just after runs, over `span` samples, and where both are known.

    With a span of one the larger of the two nearest differences counts: the sample next to the run may lie
    just inside the limit.
    """
    known = (first >= span + 1) & (last < len(x) - span - 1)
    before, after = np.clip(first, span + 1, None), np.clip(last, None, len(x) - span - 2)
    enters, leaves = np.abs(x[before] - x[before - span]), np.abs(x[after + span] - x[after])
    if span == 1:
        enters = np.fmax(enters, np.abs(x[before - 1] - x[before - 2]))
        leaves = np.fmax(leaves, np.abs(x[after + 2] - x[after + 1]))
    known &= ~np.isnan(enters) & ~np.isnan(leaves)
    return enters, leaves, known


def spikes(
    y: Float[np.ndarray, " samples"], sizes: float = 8.0, widths: Sequence[int] = (1, 2, 3)
) -> Int[np.ndarray, " spikes"]:
    """Short excursions, by one to three samples, from the straight line between their neighbours.

    A spike stands out against the usual deviation from that line (median absolute deviation) and against
    every movement of the signal nearby; the latter spares steps, kinks and bursts.

    **Arguments:**

    - `y`: one channel.
    - `sizes`: smallest deviation in robust standard deviations; default 8.
    - `widths`: lengths of the excursions looked for; default 1, 2, 3.

    **Returns:** the places of the samples.
    """
    n, near = len(y), 5
    found = np.zeros(n, dtype=bool)
    # One level of a grid is no spike, nor is what is small against the signal as a whole.
    least = max(1e-2 * np.nanstd(y), 3.5 * (grid_step(y) or 0.0)) if not np.isnan(y).all() else 0.0
    for width in widths:
        if n < width + 2 * near + 2:
            continue
        start = np.arange(near, n - near - width + 1)
        left, right = y[start - 1], y[start + width]
        fraction = (np.arange(1, width + 1) / (width + 1))[:, None]
        deviation = y[start + np.arange(width)[:, None]] - (left + fraction * (right - left))
        one_side = np.abs(deviation.sum(axis=0)) == np.abs(deviation).sum(axis=0)
        size = np.where(one_side, np.abs(deviation).min(axis=0), 0.0)
        usual = 1.4826 * np.nanmedian(np.abs(deviation)) if not np.isnan(deviation).all() else 0.0
        moves = np.abs(np.diff(y))
        nearby = np.abs(right - left)
        for k in range(1, near):
            nearby = np.fmax(nearby, np.fmax(moves[start - 1 - k], moves[start + width - 1 + k]))
        stands_out = (size > max(sizes * usual, least)) & (size > 3.0 * nearby)
        for k in range(width):
            found[start[stands_out] + k] = True
    return np.flatnonzero(found)


def stuck(y: Float[np.ndarray, " samples"]) -> list[tuple[int, int]]:
    """Stretches in which a moving signal repeats its last value, then jumps on.

    **Arguments:**

    - `y`: one channel.

    **Returns:** first and last sample of each stretch, the last value before it being the first.
    """
    moves = np.abs(np.diff(y))
    runs = plateaus(y)
    inside = (runs.length >= 2) & (runs.first >= 6) & (runs.last < len(y) - 6)
    # At the extremes it would be clipping.
    inside &= (runs.value < np.nanmax(y, initial=-np.inf)) & (runs.value > np.nanmin(y, initial=np.inf))
    first, last, length = runs.first[inside], runs.last[inside], runs.length[inside]
    if first.size == 0:
        return []
    usual, step = _usual_move(y), grid_step(y) or 0.0
    least = max(0.1 * usual, 3.0 * step)

    # Long: the signal arrives at speed, and leaves at speed unless it is noise, where chance decides.
    arrives = np.fmax(np.fmax(moves[first - 1], moves[first - 2]), moves[first - 3]) > least
    noisy = fast_noise(y) > least
    # On a coarse grid a held input alone brings equal samples.
    coarse = step > 0.1 * usual
    long = (length >= (4 if coarse else 1) * LONG_STRETCH) & arrives & (noisy | (moves[last] > least))

    # Short: a rounded signal repeats itself by chance, but then it moves by one or two steps as often.
    short = (length < LONG_STRETCH) & _passes(y, first, last, least, step)
    almost = np.flatnonzero((moves > 0.0) & (moves < 2.5 * step))
    almost = almost[(almost >= 6) & (almost < len(y) - 7)]
    by_chance = np.sum(_passes(y, almost, almost + 1, least, step)) if almost.size else 0
    if coarse or np.sum(short) < 3 + by_chance:
        short[:] = False
    chosen = long | short
    return [(int(a), int(b)) for a, b in zip(first[chosen], last[chosen])]


def _passes(y: np.ndarray, first: np.ndarray, last: np.ndarray, least: float, step: float) -> np.ndarray:
    """Whether the signal moves through these stretches: at speed, in one direction, and far enough."""
    moves = np.diff(y)
    into, out = moves[first - 1], moves[last]
    around = np.mean([np.abs(moves[first - 1 - k]) + np.abs(moves[last + k]) for k in range(5)], axis=0) / 2.0
    # A turning point gives two equal samples as well, but turns back.
    return (
        (np.fmin(np.abs(into), np.abs(out)) > least) & (into * out > 0.0) & ((last - first + 1) * around > 10.0 * step)
    )
