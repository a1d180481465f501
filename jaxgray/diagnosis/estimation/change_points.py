"""When something changed at once: how a refit finds the moment of a jump."""

import numpy as np

from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, AbstractOutputEffect, Scales, Term, onset_of
from ..model.candidate import Candidate
from ..model.simulator import natural_frequencies_hz
from ..noise.whitening import NoiseModel, counted
from .context import SearchContext, noise_model_of
from .gauss_newton import Refit
from .normal_equations import weighted
from .profile_scan import from_other_values, products_of, something_left

FINER = 8
"""Moments looked at for every one that a law is begun with."""

SURE = 1.0
"""Difference in N ln cost from which another moment is the better one: each is refitted to its end."""

CLOSER = 8
"""Those of them around which it is looked at more closely."""

FINEST = 24
"""Moments that are looked at around each."""

NEAR = 12
"""Most moments to either side of its own from which a change is refitted."""

LOCAL = 12.0
"""Standard errors by the curvature within which the likelihood is looked at most closely."""

THREE = 3.0
"""Standard errors at which an interval is compared with that of a likelihood without kinks."""


def softened(term: Term, scales: Scales) -> list[Term]:
    """The terms to refit one after the other: a sudden change first smeared over the distance between the times that
    were tried, since only the samples inside its edge can tell where it belongs."""
    if not term.effect.onset or len(scales.times) < 2:
        return [term]
    _, at = onset_of(term.effect)
    widths = [2 * (scales.times[1] - scales.times[0])]
    # The time is looked for within the width before: by a fixed factor, so that long records take a few steps more.
    while widths[-1] > 8 * scales.sampling_time:
        widths.append(widths[-1] / 4)
    result = []
    for width in (*widths, scales.sampling_time):
        values = np.array(term.values, float)
        values[at] = width
        result.append(Term(term.effect, term.place, values))
    return result


def width_of(term: Term) -> float:
    """Over how long [s] the jump of a term is smeared, 0 where there is none."""
    return float(term.values[onset_of(term.effect)[1]]) if term.effect.onset else 0.0


def dated(context: SearchContext, candidate: Candidate, noise_model: NoiseModel, span: float) -> Candidate:
    """A candidate with the jump of its last term at the moment that leaves the least of the first record.

    While nothing moves, no gradient leads there. Only jumps of the outputs, whose free run costs next to nothing; other
    candidates come back as they are.

    **Arguments:** `context`; `candidate`; `noise_model` by which the residual is whitened; `span` [s]: how far from
    where it is the moment is looked for, in steps of half of the term's width or a sample.

    **Returns:** a `Candidate`; nothing but the moment differs.
    """
    term = candidate.terms[-1]
    if not isinstance(term.effect, AbstractOutputEffect) or not term.effect.onset:
        return candidate
    data, at = context.data[0], onset_of(term.effect)[0]
    step = max(width_of(term) / 2, data.sampling_time)
    count = int(span / step)
    end = data.samples * data.sampling_time
    times = np.clip(float(term.values[at]) + step * np.arange(-count, count + 1), 0.0, end)
    found = []
    for time in times:
        values = np.array(term.values, float)
        values[at] = time
        found.append(candidate.with_terms((*candidate.terms[:-1], Term(term.effect, term.place, values))))
    left = [np.where(data.kept, data.y - context.simulator.run(one, data), 0.0) for one in found]
    costs = np.sum(weighted(noise_model, np.stack(left, axis=2), data.kept) ** 2, axis=0)
    return found[int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))]


def from_other_change_points(context: SearchContext, fit: Refit, *, max_steps: int, tolerance: float) -> Refit:
    """A refit whose last term is a force that begins at once, or a better one from another moment.

    What rings after the step draws a refit to the nearest moment at which it rings alike.

    **Arguments:** `context`; `fit`: carried to its end, returned as it is where its law has no such moment;
    `max_steps`, `tolerance`: of the refits.
    """
    effect = fit.candidate.terms[-1].effect
    at = _change_point_of(effect)
    if at is None:
        return fit

    def chosen(fit: Refit, noise_model: NoiseModel) -> list[np.ndarray]:
        tried, shares, weights = _looked(context, fit.candidate, noise_model, at)
        k = int(np.argmax(shares))
        return [effect.bounded(effect.combine(tried[k], weights[k]))] if np.isfinite(shares[k]) else []

    return from_other_values(context, fit, chosen, max_steps=max_steps, tolerance=tolerance, worth=SURE)


def from_near_change_points(context: SearchContext, fit: Refit, *, max_steps: int, tolerance: float) -> Refit:
    """A refit whose last term is a force that begins at once, or a better one from a moment near to its own.

    Where little is damped, M, D, K that go with one moment score the moments around it wrongly, and the likelihood has
    a hill for every period of every mode: where more than noise is left, all else is refitted at moments half of the
    shortest period apart, over the longest one to both sides.

    **Arguments:** as of `from_other_change_points`.
    """
    effect = fit.candidate.terms[-1].effect
    at = _change_point_of(effect)
    if at is None or not something_left(noise_model_of(context, fit)):
        return fit
    data = context.data[0]
    hz = natural_frequencies_hz(context.simulator.plant(fit.candidate))
    hz = hz[hz > 0]
    if not len(hz):
        return fit
    spacing = max(0.5 / hz[-1], 2 * data.sampling_time)
    count = int(np.clip(np.ceil(1 / hz[0] / spacing), 1, NEAR))
    shifts = spacing * np.concatenate([np.arange(-count, 0), np.arange(1, count + 1)])

    def chosen(fit: Refit, noise_model: NoiseModel) -> list[np.ndarray]:
        values = np.tile(np.array(fit.candidate.terms[-1].values, float), (len(shifts), 1))
        values[:, at] += shifts
        inside = (values[:, at] > 0) & (values[:, at] < data.samples * data.sampling_time)
        return list(values[inside])

    return from_other_values(context, fit, chosen, max_steps=max_steps, tolerance=tolerance)


def change_point_errors(context: SearchContext, fit: Refit, index: int, errors: dict[int, float]) -> dict[int, float]:
    """Standard error of the moment at which the force of a term begins, by its position; empty for other terms.

    The likelihood has a kink at every sample and a hill for every period of what rings: its curvature says little, so
    that a third of the farthest distance at which it is what it is three standard errors from the best stands for one.

    **Arguments:** `context`; `fit`; `index` of the term; `errors`: standard errors by the curvature alone, by position.

    **Reference:** Siegmund, Int. Stat. Rev. 56 (1988) 31-48.
    """
    terms = fit.candidate.terms
    at = _change_point_of(terms[index].effect)
    local = errors.get(at, 0.0)
    if at is None or not local > 0:
        return {}
    last = fit.candidate.with_terms((*terms[:index], *terms[index + 1 :], terms[index]))
    here, noise_model = float(terms[index].values[at]), noise_model_of(context, fit)
    near = here + LOCAL * local * np.linspace(-1, 1, 2 * FINEST)
    found = [_looked(context, last, noise_model, at), _scored(context, last, noise_model, at, lambda _: near)]
    times = np.concatenate([tried[:, at] for tried, *_ in found])
    left = np.log1p(-np.maximum(np.concatenate([shares for _, shares, _ in found]), 0.0))
    rows = int(counted(context.data[0].kept).sum())
    alike = rows * (left - left.min()) < THREE**2
    return {at: max(local, float(np.max(np.abs(times[alike] - here))) / THREE)}


def _change_point_of(effect: AbstractEffect) -> int | None:
    """Position of the moment at which a force begins; None for other laws."""
    return onset_of(effect)[0] if isinstance(effect, AbstractForceEffect) and effect.onset else None


def _looked(
    context: SearchContext, candidate: Candidate, noise_model: NoiseModel, at: int
) -> tuple[np.ndarray, np.ndarray, list]:
    """As `_scored`, all over the record, and more closely where most is explained."""
    tried, shares, _ = _scored(context, candidate, noise_model, at, lambda t: np.linspace(t[0], t[-1], len(t) * FINER))
    best, spacing = tried[np.argsort(-shares)[:CLOSER], at], tried[1, at] - tried[0, at]
    around = best[:, None] + spacing * np.linspace(-0.5, 0.5, FINEST)
    return _scored(context, candidate, noise_model, at, lambda _: around.ravel())


def _scored(context: SearchContext, candidate: Candidate, noise_model: NoiseModel, at: int, moments):
    """Values of the last term at many moments, what each explains, and the weights of its basis."""

    def rows(begun: np.ndarray) -> np.ndarray:
        times = moments(begun[:, at])
        values = np.tile(np.array(candidate.terms[-1].values, dtype=float), (len(times), 1))
        values[:, at] = np.clip(times, 0.0, context.data[0].samples * context.data[0].sampling_time)
        return values

    products, tried = products_of(context, candidate, noise_model, rows)
    columns = np.arange(len(products.X)).reshape(len(tried), -1)
    gains, weights = np.full(len(tried), -np.inf), [None] * len(tried)
    for k, own in enumerate(columns):
        dense = products.among(own)
        if np.all(dense.visible(np.arange(len(own)))) and np.all(products.finite[own]):
            gains[k], weights[k] = dense.taken(np.arange(len(own)))
    return tried, gains, weights
