"""Laws that a record hardly tells apart: which stand for one another, and which is another with something needless."""

import numpy as np
import scipy.special

from ..estimation.multistart import Attempt
from ..settings import ALIKE, STANDING_ALIKE

STANDING = (
    frozenset(("input_delay", "actuator_lag", "intersample_hold", "sensor_delay", "sensor_lag")),
    frozenset(("constant_force", "sensor_offset")),
    frozenset(("stiffness_step", "mass_step")),
    frozenset(("cubic_stiffness", "end_stop", "dead_zone_stiffness", "sine_stiffness")),
    frozenset(("bouc_wen_hysteresis", "maxwell_slip_hysteresis", "dahl_friction")),
    frozenset(("bilinear_stiffness", "quadratic_stiffness")),
)
"""Laws that are easily alike: one of them is ruled out only by more, and never unheard."""

LEVEL = 0.01
"""Probability at which chance alone makes further parameters of a law pay."""

CLEARLY = float(np.sqrt(scipy.special.chdtri(1, LEVEL)))
"""The same in standard errors of one parameter."""

STANDING_LEVEL = 0.1
"""The same for laws that stand for one another: a parameter that may well be there leaves both of them."""

SPECIAL = {("bouc_wen_hysteresis", "dahl_friction")}
"""Laws that contain another under other names: Dahl's friction is A = Fc/x_d, beta = 1/x_d, gamma = 0."""


def standing_for(effect_id: str) -> frozenset[str]:
    """Ids of the laws that are easily taken for one."""
    return frozenset().union(*(group for group in STANDING if effect_id in group)) - {effect_id}


def alike(best: Attempt, other: Attempt) -> float:
    """Difference of BIC within which two attempts count as one class."""
    return STANDING_ALIKE if other.name[0] in standing_for(best.name[0]) else ALIKE


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
    special = (large.effect.id, small.effect.id) in SPECIAL
    if rival.name[1] != best.name[1] or not (special or small.effect.id in large.effect.contains):
        return False
    terms, known = rival.fit.candidate.terms, {p.name for p in small.effect.parameters}
    at = next(k for k, t in enumerate(terms) if (t.effect.id, t.place.name) == rival.name)
    term, own = terms[at], [j for j, p in enumerate(terms[at].effect.parameters) if p.counts]
    later = sum(p.counts for t in terms[at + 1 :] for p in t.effect.parameters)
    end = len(rival.fit.covariance) - later
    errors = np.sqrt(np.maximum(np.diag(rival.fit.covariance)[end - len(own) : end], 0.0))
    further = [(float(term.values[j]), e) for j, e in zip(own, errors) if term.effect.parameters[j].name not in known]
    if not special and further and all(abs(value) < CLEARLY * error for value, error in further):
        return True
    ratio = best.criterion - best.penalty - (rival.criterion - rival.penalty)
    level = STANDING_LEVEL if special else LEVEL
    return ratio < scipy.special.chdtri(max(large.free - small.free, 1), level)
