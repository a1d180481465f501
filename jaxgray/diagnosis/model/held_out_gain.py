"""Gain from one model to the next on free runs: is there one for sure, and how large would it be on other records?

The first is asked of the record at hand: a bootstrap over many short pieces of it. The second is asked of records with
other inputs of the same kind. Pieces longer than the motion remembers stand for them, and a lightly damped motion
remembers long: short pieces would make the interval three times too narrow. What differs between records, but not
within one, shows in the difference of this gain to the gain on the data of the fit.
"""

import numpy as np
import scipy.special
from jaxtyping import Float, Int

from ...numerics.responses.filters import white_part
from .. import settings
from ..findings import Gain
from .free_run import FreeRun, on_the_same

SHORT = 40
"""Pieces that the bootstrap draws from."""

RESAMPLES = 2000
"""Of the bootstrap: enough for the bound of the twentieth candidate that is judged on the same data."""

INTERVAL = 0.025, 0.975
"""Quantiles of the bootstrap at the ends of a 95 % interval."""

LONG = (4, 5, 6, 8, 12)
"""Pieces of the jackknife; the number with the largest spread counts."""


def gain_of(
    before: list[FreeRun],
    after: list[FreeRun],
    baseline: list[FreeRun],
    floor: Float[np.ndarray, " outputs"],
    names: tuple[str, ...],
    *,
    held_out: bool,
    rng: np.random.Generator,
    seen: tuple[list[FreeRun], list[FreeRun], list[FreeRun]] | None = None,
    trials: int = 1,
    once: bool = False,
) -> Gain:
    """Gain from one model to the next, with its intervals.

    **Arguments:** `before`, `after`, `baseline`: free runs on the same records; `floor`: noise floor per output;
    `names` of outputs; `held_out`; `rng`; `seen`: the same three on the data of the fit, for gains on
    held-out data; `trials`: candidates judged on these data so far, this one included: the k-th must be sure with a
    k-th part of the risk of the first; `once`: of what happened once and is not in every part of the record, so that
    the interval is that of the bootstrap.

    **Returns:** a `Gain`.

    **Reference:** Künsch, *The jackknife and the bootstrap for general stationary observations* (1989).
    """
    runs = on_the_same(before, after, baseline)
    short = _Pieces(runs, floor, max(SHORT // len(before), 8))
    draws = short.percent(rng.integers(0, len(short), (RESAMPLES, len(short))))
    everything = np.arange(len(short))
    pairs = {name: (float(b), float(a)) for name, b, a in zip(names, *short.rmse(everything)[:2])}
    percent = float(short.percent(everything))
    between = np.zeros(2)
    if held_out and seen is not None:
        fitted = _Pieces(on_the_same(*seen), floor, 1)
        between = np.abs(fitted.kept(np.arange(len(fitted))) - short.kept(everything))
    interval = tuple(np.quantile(draws, INTERVAL).tolist()) if once else _interval(runs, floor, between)
    return Gain(pairs, percent, interval, float(np.quantile(draws, settings.HELD_OUT_RISK / trials)), held_out)


class _Pieces:
    """Sums of squares of three sets of runs over pieces of the records, `each` a record."""

    def __init__(self, runs: tuple[list[FreeRun], ...], floor: np.ndarray, each: int):
        self.floor = floor
        self.counts = np.concatenate([[run.kept[k].sum(axis=0) for k in _cut(run, each)] for run in runs[0]])
        self.sums = [
            np.concatenate(
                [[np.sum(np.where(r.kept[k], r.e[k], 0.0) ** 2, axis=0) for k in _cut(r, each)] for r in one]
            )
            for one in runs
        ]

    def __len__(self):
        return len(self.counts)

    def rmse(self, index: Int[np.ndarray, "... drawn"]) -> list[Float[np.ndarray, "... outputs"]]:
        """Root mean square error per output of every set of runs, over some pieces."""
        total = np.maximum(self.counts[index].sum(axis=-2), 1)
        return [np.sqrt(sums[index].sum(axis=-2) / total) for sums in self.sums]

    def overall(self, index: Int[np.ndarray, "... drawn"]) -> list[Float[np.ndarray, "..."]]:
        """Errors of all outputs in units of the floor, of every set of runs, over some pieces."""
        return [np.maximum(np.sqrt(np.mean((rmse / self.floor) ** 2, axis=-1)), 1e-300) for rmse in self.rmse(index)]

    def percent(self, index: Int[np.ndarray, "... drawn"]) -> Float[np.ndarray, "..."]:
        """Gain over some pieces."""
        before, after, baseline = self.overall(index)
        return 100 * (before - after) / baseline

    def left(self, index: Int[np.ndarray, "... drawn"]) -> Float[np.ndarray, "..."]:
        """Logarithm of the share of the error that is left, over some pieces."""
        return self.kept(index)[..., 0]

    def kept(self, index: Int[np.ndarray, "... drawn"]) -> Float[np.ndarray, "... 2"]:
        """That, and the logarithm of the error that is left itself, in units of the floor."""
        before, after, _ = self.overall(index)
        return np.stack([np.log(np.maximum(after / before, 1e-12)), np.log(after)], axis=-1)


def _cut(run: FreeRun, each: int) -> list[np.ndarray]:
    return np.array_split(np.flatnonzero(run.kept.any(axis=1)), each)


def _interval(runs, floor, between: Float[np.ndarray, " 2"]) -> tuple[float, float]:
    """95 % interval of the gain: of the logarithm of the error that is left, by the jackknife over long pieces, and its
    difference `between` records in squares; towards a loss no further than the worst piece, or the fit, shows, nor than
    what may be left is above its white part: less than that no model leaves, so that none loses more."""
    spreads = []
    for wanted in LONG:
        pieces = _Pieces(runs, floor, max(1, -(-wanted // len(runs[0]))))
        everything = np.arange(len(pieces))
        kept = np.array([pieces.kept(np.delete(everything, k)) for k in everything])
        spreads.append(np.sqrt((len(kept) - 1) * np.var(kept, axis=0)))
    reach = np.hypot(float(scipy.special.stdtrit(LONG[0] - 1, 0.975)) * np.max(spreads, axis=0), between)
    whole, (before, _, baseline) = pieces.kept(everything), pieces.overall(everything)
    # Where nearly all of the error lies in one piece, the gain without that piece is small, but it is no loss.
    worst = max(float(np.max(pieces.left(everything[:, None]))), whole[0] + between[0])
    # Fast errors of one model seem white as well.
    white = np.minimum(_white(runs[0]), _white(runs[1])) / floor
    above = max(whole[1] - float(np.log(max(np.sqrt(np.mean(white**2)), 1e-300))), 0.0)
    ends = min(whole[0] + reach[0], worst, max(above, whole[0]) + reach[1]), whole[0] - reach[0]
    return tuple(float(100 * before / baseline * (1 - np.exp(end))) for end in ends)


def _white(runs: list[FreeRun]) -> Float[np.ndarray, " outputs"]:
    """Root mean square of the white part of what runs leave, per output."""
    counts = np.array([run.kept.sum(axis=0) for run in runs])
    white = np.array([white_part(run.e, run.kept) for run in runs])
    return np.sqrt(np.sum(counts * white, axis=0) / np.maximum(counts.sum(axis=0), 1))
