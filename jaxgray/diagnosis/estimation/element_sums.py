"""Sums of elements with a threshold each, restarted from other thresholds.

Between two turning points of the record the cost hardly depends on a threshold, and elements make up for one another: a
refit ends near the thresholds from which it started. Given M, D, K the elements are linear in their sizes, so the best
few of many thresholds are chosen by least squares, and refitted from there.

Where a record needs fewer elements, they can replace one another in many ways, and none is determined: the size of each
may be zero, and its threshold is then meaningless. Elements at one threshold are one.
"""

import itertools

import numpy as np
import scipy.special

from ...mechanics.effects.base import AbstractEffect, Term
from .. import settings
from ..noise.whitening import NoiseModel
from .context import SearchContext, noise_model_of
from .gauss_newton import Refit, refit
from .profile_scan import from_other_values, products_of, something_left
from .significance import at_bound

LEVELS = 24
"""Thresholds that are looked at."""

BEYOND = 1.5
"""They reach so far beyond those that the law is begun with."""

NEAR = np.array([0.85, 0.93, 0.97, 1.0, 1.03, 1.07, 1.15])
"""Ratios to the thresholds of the refit that are looked at besides."""

APART = (1.1, 1.3)
"""Sets that are refitted: the best, and the best with a threshold so far from all of that."""

ONE = 1e-3
"""Relative difference up to which thresholds are the same."""


def elements_of(effect: AbstractEffect) -> list[tuple[int, int]]:
    """Positions of size and threshold of every element, where a law is a sum of several of a kind; else none."""
    sizes = [j for j, p in enumerate(effect.parameters) if p.amplitude]
    thresholds = [j for j, p in enumerate(effect.parameters) if p.counts and not p.amplitude and p.lower == 0]
    names = {effect.parameters[j].name for j in thresholds}
    if len(thresholds) < 2 or len(names) > 1 or len(sizes) != len(thresholds):
        return []
    return list(zip(sizes, thresholds))


def one_threshold(levels: list[float]) -> bool:
    """Whether thresholds are the same."""
    return bool(np.ptp(levels) <= ONE * max(levels))


def at_one_threshold(levels) -> list[list[int]]:
    """Positions of thresholds, those that are the same together."""
    groups: list[list[int]] = []
    for k, level in enumerate(levels):
        same = [group for group in groups if one_threshold([levels[group[0]], level])]
        if same:
            same[0].append(k)
        else:
            groups.append([k])
    return groups


def from_other_thresholds(context: SearchContext, fit: Refit, *, max_steps: int, tolerance: float) -> Refit:
    """A refit whose last term is a sum of elements, or a better one from other thresholds.

    **Arguments:** `context`; `fit`: carried to its end, returned as it is where its law is no such sum or leaves
    nothing but white noise; `max_steps`, `tolerance`: of the refits.
    """
    elements = elements_of(fit.candidate.terms[-1].effect)
    if not elements or not something_left(noise_model_of(context, fit)):
        return fit

    def chosen(fit: Refit, noise_model: NoiseModel) -> list[np.ndarray]:
        return _chosen(context, fit, noise_model, elements)

    return from_other_values(context, fit, chosen, max_steps=max_steps, tolerance=tolerance)


def at_fewer_thresholds(context: SearchContext, fit: Refit, *, max_steps: int, tolerance: float) -> Refit:
    """A refit whose last term is a sum of elements, with as few different thresholds as explain the record as well
    (likelihood ratio).

    **Arguments:** `context`; `fit`: carried to its end, returned as it is where its law is no such sum, where all of
    its thresholds pay, or where it leaves more than white noise; `max_steps`, `tolerance`: of the refits.
    """
    term = fit.candidate.terms[-1]
    elements = elements_of(term.effect)
    noise_model = noise_model_of(context, fit) if elements else None
    # What else is missing could pass for noise that hides a threshold. At a bound an element is out already.
    if noise_model is None or something_left(noise_model):
        return fit
    if at_bound(fit, len(fit.candidate.terms) - 1, context.simulator.setup.own) is not None:
        return fit
    options = {"held": context.held, "max_steps": max_steps, "tolerance": tolerance}
    whole = refit(context.simulator, fit.candidate, context.data, noise_model, **options)
    for distinct in range(1, len(elements)) if whole is not None else ():
        most = scipy.special.chdtri(2 * (len(elements) - distinct), settings.SIGNIFICANCE)
        for values in _chosen(context, fit, noise_model, elements, distinct)[:1]:
            terms = (*fit.candidate.terms[:-1], Term(term.effect, term.place, values))
            few = refit(context.simulator, fit.candidate.with_terms(terms), context.data, noise_model, **options)
            if few is None or not few.count * np.log(few.cost / whole.cost) < most:
                continue
            few = _at_one(context, few, noise_model, elements[distinct - 1 :])
            if few is not None and few.count * np.log(few.cost / whole.cost) < most:
                return few
    return fit


def _at_one(
    context: SearchContext, fit: Refit, noise_model: NoiseModel, elements: list[tuple[int, int]]
) -> Refit | None:
    """A refit with some thresholds that noise drew apart at their mean again, or as it is where they are the same; None
    where that cannot be simulated."""
    term = fit.candidate.terms[-1]
    values = np.array(term.values, dtype=float)
    sizes, levels = (list(x) for x in zip(*elements))
    if one_threshold(values[levels]):
        return fit
    values[levels], values[sizes] = np.mean(values[levels]), np.mean(values[sizes])
    candidate = fit.candidate.with_terms((*fit.candidate.terms[:-1], Term(term.effect, term.place, values)))
    # Short enough for them to stay together.
    return refit(
        context.simulator, candidate, context.data, noise_model, held=context.held, max_steps=1, shapes_after=1
    )


def _chosen(
    context: SearchContext,
    fit: Refit,
    noise_model: NoiseModel,
    elements: list[tuple[int, int]],
    distinct: int | None = None,
) -> list[np.ndarray]:
    """Values of the last term for the sets of thresholds that explain most, best first; so many of them `distinct`
    (default all), the last of these shared by the rest of the elements in equal parts."""
    term, count = fit.candidate.terms[-1], len(elements)

    def rows(begun: np.ndarray) -> np.ndarray:
        begun = begun[:, [threshold for _, threshold in elements]]
        levels = np.geomspace(begun.min() / BEYOND, begun.max() * BEYOND, -(-LEVELS // count) * count)
        # Beside those that it has as well: where the input takes few levels, minima lie close together.
        levels = np.append(levels, np.outer(NEAR, [float(term.values[j]) for _, j in elements]))
        values = np.tile(np.array(term.values, dtype=float), (len(levels) // count, 1))
        for (size, threshold), level in zip(elements, levels.reshape(-1, count).T):
            values[:, size], values[:, threshold] = 1.0, level
        return values

    products, tried = products_of(context, fit.candidate, noise_model, rows)
    levels = tried[:, [threshold for _, threshold in elements]].ravel()
    everything = products.among(np.arange(len(levels)))
    seen = np.flatnonzero(everything.visible(np.arange(len(levels))) & products.finite)
    distinct = count if distinct is None else distinct
    shared = count - distinct + 1
    sets = np.array(list(itertools.combinations(seen, distinct)))
    if not len(sets):
        return []
    targets = everything.target[sets]
    inverse = np.linalg.pinv(everything.matrix[sets[:, :, None], sets[:, None, :]], rcond=1e-10, hermitian=True)
    weights = np.einsum("kij,kj->ki", inverse, targets)
    best: list[np.ndarray] = []
    apart = list(APART)
    for k in np.argsort(-np.sum(weights * targets, axis=1)):
        values = np.array(term.values, dtype=float)
        parts = [*weights[k][:-1], *[weights[k][-1] / shared] * shared]
        columns = [*sets[k][:-1], *[sets[k][-1]] * shared]
        for (size, threshold), weight, column in zip(elements, parts, columns):
            values[size], values[threshold] = weight, levels[column]
        if np.array_equal(term.effect.bounded(values), values) and (
            not best or _distance(values, best[0], elements) > apart[0]
        ):
            apart = apart[1:] if best else apart
            best.append(values)
        if not apart:
            break
    return best


def _distance(values: np.ndarray, other: np.ndarray, elements: list[tuple[int, int]]) -> float:
    """Ratio of the threshold that is farthest from all of another set to the nearest of that set."""
    one, two = (np.log([x[threshold] for _, threshold in elements]) for x in (values, other))
    return float(np.exp(np.max(np.min(np.abs(one[:, None] - two[None, :]), axis=1))))
