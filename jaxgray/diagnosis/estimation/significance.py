"""How sure a parameter is: evidence, size in standard errors, bounds."""

import numpy as np
from jaxtyping import Float

from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects.base import Term
from ..model.candidate import Data
from ..model.own_laws import ParameterError
from ..model.parameter_vector import Layout
from ..noise.whitening import NoiseModel, counted
from .gauss_newton import Refit
from .normal_equations import LARGEST, weighted

NUDGE = 1e-6
"""Relative change by which a parameter is moved to see whether a bound is in the way."""


def evidence(
    e: Float[np.ndarray, "samples outputs"],
    J: Float[np.ndarray, "samples outputs parameters"],
    data: Data,
    noise_model: NoiseModel,
) -> tuple[float, int]:
    """Sum of squares of a residual under a noise model, re-optimised to first order along J (infinite where these are
    all but overflowing), and how many samples count."""
    white = weighted(noise_model, np.concatenate([J, e[:, :, None]], axis=2), data.kept)
    count = int(counted(data.kept).sum())
    if not np.max(np.abs(white)) <= LARGEST:
        return np.inf, count
    J, e = white[:, :-1], white[:, -1]
    g = J.T @ e
    return float(e @ e - g @ pseudo_inverse(J.T @ J) @ g), count


def significance(fit: Refit, layout: Layout, term: int) -> float:
    """How far the amplitudes of one term are from nothing, in standard errors: the largest |β|/se, or all of them
    together where laws with several share what they explain (Wald's statistic as a normal one, Wilson & Hilferty).

    One amplitude that nothing determines, whatever M, D, K are, is none.
    """
    at, values = [], []
    for position, (k, j) in enumerate(layout.terms):
        if k == term and fit.candidate.terms[k].effect.parameters[j].amplitude:
            at.append(layout.first + position)
            values.append(float(fit.candidate.terms[k].values[j]))
    if not any(p.amplitude and p.counts for p in fit.candidate.terms[term].effect.parameters):
        return np.inf
    known = np.diag(fit.covariance)[at] > 0
    # Of several amplitudes, as elements of a sum, a direction may be open and their sum known all the same.
    if not known.any() or (len(at) == 1 and fit.undetermined_alone[at[0]]):
        return 0.0
    at, values = np.array(at)[known], np.array(values)[known]
    covariance = fit.covariance[np.ix_(at, at)]
    errors = np.sqrt(np.diag(covariance))
    scaled = values / errors
    best = float(np.max(np.abs(scaled)))
    if len(at) == 1:
        return best
    wald = float(scaled @ pseudo_inverse(covariance / np.outer(errors, errors)) @ scaled)
    part = 2 / (9 * len(at))
    return max(best, float((np.cbrt(max(wald, 0.0) / len(at)) - 1 + part) / np.sqrt(part)))


def at_bound(fit: Refit, term: int, given: tuple[Term, ...] = ()) -> str | None:
    """The parameter of a term that lies at a physical bound, None where none does; `given`: laws of the user's model.

    What a simpler law at the same place has taken upon itself is no bound of the wider one: their sum is inside. Nor is
    it one where a law that was given is found not to be there.
    """
    own = fit.candidate.terms[term]
    effect, values = own.effect, np.array(own.values, dtype=float)
    if isinstance(effect, ParameterError) and effect.owner.parameters[effect.at[1]].amplitude:
        return None
    others = (*given, *fit.candidate.terms)
    inside = [t.effect for t in others if t.place == own.place and t.effect.id in effect.contains]
    taken = {parameter.name for simpler in inside for parameter in simpler.parameters}
    for k, parameter in enumerate(effect.parameters):
        if not parameter.counts or not (np.isfinite(parameter.lower) or np.isfinite(parameter.upper)):
            continue
        if parameter.name in taken:
            continue
        for change in (-NUDGE, NUDGE):
            beyond = values.copy()
            beyond[k] += change * max(abs(values[k]), 1e-300)
            held = effect.bounded(beyond)[k]
            if abs(held - beyond[k]) >= 0.5 * abs(beyond[k] - values[k]) > 0:
                return parameter.name
    return None
