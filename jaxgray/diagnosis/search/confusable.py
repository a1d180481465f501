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


def simplified(ranked: list[Attempt]) -> list[Attempt]:
    """The ranking, with the simpler law first where the best is the same with a parameter that explains nothing."""
    for other in ranked[1:]:
        if needless(ranked[0], other):
            return [other, *(one for one in ranked if one is not other)]
    return ranked


def needless(rival: Attempt, best: Attempt) -> bool:
    """Whether a rival is the best law at its place with more parameters, which do not pay (likelihood ratio) or are
    near nothing, both at 1 %, since several laws with more in them are tried. Only the ratio speaks, at 10 %, where the
    names of the parameters differ and the laws stand for one another."""
    small, large = best.score.shape, rival.score.shape
    special = small.effect.id in large.effect.renamed
    if rival.name[1] != best.name[1] or not (special or small.effect.id in large.effect.contains):
        return False
    terms, known = rival.fit.candidate.terms, {p.name for p in small.effect.parameters}
    at = next(k for k, t in enumerate(terms) if (t.effect.id, t.place.name) == rival.name)
    term, own = terms[at], [j for j, p in enumerate(terms[at].effect.parameters) if p.counts]
    later = sum(p.counts for t in terms[at + 1 :] for p in t.effect.parameters)
    end = len(rival.fit.covariance) - later
    errors = np.sqrt(np.maximum(np.diag(rival.fit.covariance)[end - len(own) : end], 0.0))
    further = [(float(term.values[j]), e) for j, e in zip(own, errors) if term.effect.parameters[j].name not in known]
    clearly = float(np.sqrt(scipy.special.chdtri(1, settings.SIGNIFICANCE)))
    if not special and further and all(abs(value) < clearly * error for value, error in further):
        return True
    ratio = best.criterion - best.penalty - (rival.criterion - rival.penalty)
    level = settings.LOOK_ALIKE_SIGNIFICANCE if special else settings.SIGNIFICANCE
    return ratio < scipy.special.chdtri(max(large.free - small.free, 1), level)
