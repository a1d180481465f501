"""A refit carried to its end: under the noise of what it leaves, along curved valleys, in steps short enough."""

import dataclasses

import numpy as np

from ...mechanics.effects.base import AbstractForceEffect, Term, onset_of
from ...numerics.matrices.bounded import bounded
from .. import settings
from ..model.candidate import Candidate, Data
from ..model.reversals import decided_residual
from ..model.simulator import Simulator, Steps
from ..noise.whitening import NoiseModel
from ..screening.linearization import rows_of
from .change_points import from_near_change_points, from_other_change_points, width_of
from .context import SearchContext, noise_model_of
from .element_sums import at_fewer_thresholds, from_other_thresholds
from .gauss_newton import Refit, refit, with_states

RENEWALS = 6
"""How often the noise model of a refit is renewed."""

ROUGH = 0.3
"""Decrement, in units of the noise variance, at which a first refit is good enough to compare."""

MOST_STEPS = 32
"""Steps per sample, of all runs together, up to which a force is followed."""

SMOOTH = 3.0
"""By how much steps half as long must take the error down for it to go with their square, which takes it to a quarter:
then it is extrapolated."""

EDGE_STEPS = 4
"""Steps per sample from which the beginning of a force is followed within one of them, not within a sample."""

RESTARTS = (from_other_thresholds, 25), (from_other_change_points, 25), (from_near_change_points, 8)
"""How a refit that may have ended in a local optimum is restarted, and the most steps of every such refit."""


def refit_to_convergence(context: SearchContext, fit: Refit) -> Refit:
    """A first refit carried to its end, whatever is noise at the forces told apart."""
    fit = along_the_valley(context, with_new_noise_models(context, fit))
    for restarted, steps in RESTARTS:
        other = restarted(context, fit, max_steps=steps, tolerance=ROUGH)
        fit = fit if other is fit else with_new_noise_models(context, other)
    fit = at_fewer_thresholds(context, fit, max_steps=25, tolerance=ROUGH)
    return settled(context, fit, noise_model_of(context, fit))


def with_new_noise_models(context: SearchContext, fit: Refit) -> Refit:
    """Refits under the noise model of what is left, as long as less and less of it passes for noise at the forces."""
    noise_model = noise_model_of(context, fit)
    for _ in range(RENEWALS):
        again = refit(context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=10)
        if again is None:
            return fit
        fit, ratio, noise_model = again, noise_model.ratio, noise_model_of(context, again)
        if not noise_model.ratio < ratio / 2:
            return fit
    return fit


def settled(context: SearchContext, fit: Refit, noise_model: NoiseModel) -> Refit:
    """A refit with first states that suit its free run, which a noise model with noise at the forces does not
    determine."""
    return fit if noise_model.ratio == 0.0 else with_states(context.simulator, fit, context.data)


def along_the_valley(context: SearchContext, fit: Refit) -> Refit:
    """A refit that did not come to an end, carried on: the scale of its last term's shape is set to others, all else
    refitted, as long as that pays. A curved valley is too narrow to follow in straight steps."""
    places = [
        j
        for j, p in enumerate(fit.candidate.terms[-1].effect.parameters)
        if p.counts and p.lower == 0 and not p.amplitude
    ]
    if fit.converged or len(places) != 1:
        return fit
    noise_model, j = noise_model_of(context, fit), places[0]
    options = {"held": context.held, "max_steps": 8, "shapes_after": 4, "tolerance": ROUGH}
    here = refit(context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=1)
    if here is None:
        return fit
    for factor in (1.5, 1 / 1.5):
        for _ in range(4):
            values = np.array(here.candidate.terms[-1].values, dtype=float)
            values[j] *= factor
            term = here.candidate.terms[-1]
            moved = here.candidate.with_terms((*here.candidate.terms[:-1], Term(term.effect, term.place, values)))
            trial = refit(context.simulator, moved, context.data, noise_model, **options)
            if trial is None or not trial.cost < here.cost:
                break
            here = trial
    return here


def sharpened(context: SearchContext, fit: Refit) -> Refit:
    """A refit in shorter steps of its added forces, where the error of the steps could be told from noise and mending
    it pays.

    The simulator keeps the shorter steps.
    """
    fit = with_sharp_edge(context, fit)
    steps, before = context.simulator.steps, noise_model_of(context, fit)
    trial, error = in_short_steps(context, fit)
    if trial is fit or error > settings.MAX_STEP_ERROR or noise_model_of(context, trial).cost < before.cost - 2.0:
        return trial
    context.simulator.steps = steps
    return fit


def with_sharp_edge(context: SearchContext, fit: Refit) -> Refit:
    """A refit whose last term is a force that begins at once, its beginning within a quarter of a sample where that
    pays: what is little damped rings on after it, and tells a step from one that is smeared over a sample.

    The simulator keeps the steps that follow it.
    """
    steps, sharp = context.simulator.steps, _sharp(context, fit.candidate)
    if sharp is fit.candidate:
        return fit
    context.simulator.steps = Steps(max(steps.count, EDGE_STEPS))
    trial = at_the_same_steps(context, dataclasses.replace(fit, candidate=sharp))
    if noise_model_of(context, trial).cost < noise_model_of(context, fit).cost - settings.MIN_DELTA_BIC:
        return trial
    context.simulator.steps = steps
    return fit


def _sharp(context: SearchContext, candidate: Candidate) -> Candidate:
    """The candidate with the edge of its last term, a force that begins at once, as steep as `EDGE_STEPS` follow."""
    if not candidate.terms:
        return candidate
    term, width = candidate.terms[-1], context.data[0].sampling_time / EDGE_STEPS
    if not term.effect.onset or not isinstance(term.effect, AbstractForceEffect) or width_of(term) <= width:
        return candidate
    values = np.array(term.values, dtype=float)
    values[onset_of(term.effect)[1]] = width
    return candidate.with_terms((*candidate.terms[:-1], Term(term.effect, term.place, values)))


def in_short_steps(context: SearchContext, fit: Refit) -> tuple[Refit, float]:
    """A refit in steps so short that their error cannot be told from noise, itself where it is so already, and the
    error of its own steps; the simulator takes the shorter steps from then on."""
    steps, rows = context.simulator.steps, rows_of(context.data[0])
    error = integration_error(context, fit)
    if error**2 * rows < 1.0 or steps.halved.cost > MOST_STEPS:
        return fit, error
    context.simulator.steps = min(_short_enough(context, fit), key=lambda one: (one[1], one[0].cost))[0]
    return at_the_same_steps(context, fit), error


def _short_enough(context: SearchContext, fit: Refit) -> list[tuple[Steps, bool]]:
    """Steps whose error cannot be told from noise, plain ones and, where the error goes with their square, ones that
    are extrapolated; neither longer than those that the simulator takes, nor more than `MOST_STEPS`; and whether their
    error is still too large."""
    steps, tolerable = context.simulator.steps, 0.5 / np.sqrt(rows_of(context.data[0]))

    def enough(here, error, order):
        while error > tolerable and here.halved.cost <= MOST_STEPS:
            here, error = here.halved, error / 2**order
        return here, error > tolerable

    count = steps.count
    made = [_residual(context.simulator.in_steps(Steps(k * count)), fit, context.data[0]) for k in (1, 2, 4)]
    if not bounded(*made):
        return [(Steps(count), True)]
    # Residuals are zero where nothing was measured, or where it says nothing.
    coarse, middle, fine = np.where(np.all([one != 0 for one in made], axis=0), made, 0.0)
    first, second = _relative(middle - coarse, fit), _relative(fine - middle, fit)
    if not first > SMOOTH * second:
        return [enough(Steps(count), first, 1)]
    # Extrapolated from 2 and 4 less from 1 and 2: the error of the latter, of which an eighth is left in the former.
    left = _relative(fine + (fine - middle) / 3 - middle - (middle - coarse) / 3, fit)
    return [enough(Steps(count), first, 2), enough(Steps(max(count, 2), True), left * (8 if count > 1 else 1), 3)]


def at_the_same_steps(context: SearchContext, fit: Refit) -> Refit:
    """A refit again, in the steps that the simulator takes by now."""
    noise_model = noise_model_of(context, fit)
    steps = context.simulator.steps
    follows = steps.count >= EDGE_STEPS and not steps.extrapolated
    candidate = _sharp(context, fit.candidate) if follows else fit.candidate
    again = refit(context.simulator, candidate, context.data, noise_model, held=context.held, max_steps=10)
    return fit if again is None else settled(context, again, noise_model)


def integration_error(context: SearchContext, fit: Refit) -> float:
    """How far the free run on the first record moves with steps half as long, relative to what the fit leaves: root
    mean square over the outputs."""
    if not any(
        isinstance(term.effect, AbstractForceEffect) for term in context.simulator.completed(fit.candidate).terms
    ):
        return 0.0
    simulator = context.simulator
    finer = _residual(simulator.in_steps(simulator.steps.halved), fit, context.data[0])
    # Residuals are zero where nothing was measured, or where it says nothing.
    return _relative(np.where(finer != 0, finer - fit.residual[0], 0.0), fit)


def _residual(simulator: Simulator, fit: Refit, data: Data) -> np.ndarray:
    return decided_residual(simulator, fit.candidate, data, simulator.run(fit.candidate, data))[0]


def _relative(change: np.ndarray, fit: Refit) -> float:
    """A change of the residual relative to what a fit leaves: root mean square over the outputs."""
    change = np.where(fit.residual[0] != 0, change, 0.0)
    level = np.maximum(np.sum(fit.residual[0] ** 2, axis=0), 1e-300)
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0) / level)))
