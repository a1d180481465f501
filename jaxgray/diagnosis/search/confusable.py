"""Laws that a record hardly tells apart: which stand for one another, and which is another with something needless."""

from collections.abc import Iterable

import numpy as np
import scipy.special

from ...mechanics.effects.base import AbstractEffect
from .. import settings
from ..estimation.multistart import Attempt


def look_alikes(effect: AbstractEffect, catalogue: Iterable[AbstractEffect]) -> frozenset[str]:
    """Ids of the laws of a catalogue that are easily taken for one."""
    return frozenset(other.id for other in catalogue if resemble(effect, other) and other.id != effect.id)


def resemble(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether a record hardly tells two laws apart: one of them is ruled out only by more, and never untried."""
    return bool(one.resembles) and one.resembles == other.resembles


def alike(best: Attempt, other: Attempt) -> float:
    """Difference of BIC within which two attempts count as one class."""
    return (
        settings.MIN_DELTA_BIC
        if resemble(other.score.shape.effect, best.score.shape.effect)
        else settings.CLASS_DELTA_BIC
    )


def commonest_first(ranked: list[Attempt], catalogue: Iterable[AbstractEffect]) -> list[Attempt]:
    """The ranking, with the law first that comes first in the catalogue, among the look-alikes of the best one there
    that explain as much."""
    order = [effect.id for effect in catalogue]
    best = ranked[0] if ranked else None

    def equal(other: Attempt) -> bool:
        behind, (law, of_best) = other.criterion - best.criterion, (a.score.shape.effect for a in (other, best))
        # Friction of a load is one of its motor, that of a joint one of the joint.
        there = other.name[1] == best.name[1] or law.places != of_best.places
        return there and behind < settings.EQUAL_DELTA_BIC and resemble(law, of_best)

    known = [other for other in ranked if other.name[0] in order and (other is best or equal(other))]
    if best is None or best.name[0] not in order:
        return ranked
    first = min(known, key=lambda other: order.index(other.name[0]))
    return [first, *(other for other in ranked if other is not first)]


def needless(rival: Attempt, best: Attempt) -> bool:
    """Whether a rival is the best law at its place with more parameters, which do not pay (likelihood ratio) or, where
    it is hardly ahead, are near those of the best law; both at 1 %, since several laws with more in them are tried.
    Only the ratio speaks, at 10 %, where the names of the parameters differ and the laws stand for one another."""
    small, large = best.score.shape, rival.score.shape
    special = small.effect.id in large.effect.renamed
    if rival.name[1] != best.name[1] or not (special or small.effect.id in large.effect.contains):
        return False
    if not special and best.criterion - rival.criterion < alike(best, rival) and _nothing_more(rival, small.effect):
        return True
    ratio = best.criterion - best.penalty - (rival.criterion - rival.penalty)
    level = settings.LOOK_ALIKE_SIGNIFICANCE if special else settings.SIGNIFICANCE
    return ratio < scipy.special.chdtri(max(large.free - small.free, 1), level)


def _nothing_more(wide: Attempt, simple: AbstractEffect) -> bool:
    """Whether a wider law's further sizes, or where it has none its further parameters, are surely no others than the
    simpler law has them."""
    terms, known = wide.fit.candidate.terms, {p.name for p in simple.parameters}
    at = next(k for k, t in enumerate(terms) if (t.effect.id, t.place.name) == wide.name)
    effect, values = terms[at].effect, np.asarray(terms[at].values, dtype=float)
    free = [j for j, p in enumerate(effect.parameters) if p.counts]
    further = [j for j in free if effect.parameters[j].name not in known]
    further = [j for j in further if effect.parameters[j].amplitude] or further
    later = sum(p.counts for t in terms[at + 1 :] for p in t.effect.parameters)
    end = len(wide.fit.covariance) - later
    covariance = wide.fit.covariance[end - len(free) : end, end - len(free) : end]
    # Where the simpler law has them may hang on what both have.
    nothing = np.where(np.isin(np.arange(len(values)), further), 0.0, values)

    def beyond(values):
        shared = {p.name: float(v) for p, v in zip(effect.parameters, values) if p.name in known}
        return (values - effect.widened(nothing, shared))[further]

    value, steps = beyond(values), np.maximum(1e-6 * np.abs(values), 1e-300)
    slopes = np.stack([(beyond(values + d) - value) / d[j] for j, d in ((j, _only(steps, j)) for j in free)], axis=1)
    errors = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, covariance, slopes), 0.0))
    clearly = float(np.sqrt(scipy.special.chdtri(1, settings.SIGNIFICANCE)))
    return bool(further) and bool(np.all(np.abs(value) < clearly * errors))


def _only(steps: np.ndarray, j: int) -> np.ndarray:
    return np.where(np.arange(len(steps)) == j, steps, 0.0)
