"""A refit carried to its end: under the noise of what it leaves, along curved valleys, in steps short enough."""

import numpy as np

from ...mechanics.effects.base import AbstractForceEffect, Term
from ..noise.whitening import Chain
from ..screening.linearization import rows_of
from .change_points import from_other_moments
from .context import Bench, chain_of
from .element_sums import at_fewer_thresholds, from_other_thresholds
from .gauss_newton import Refit, refit, with_states

RENEWALS = 6
"""How often the chain of a refit is renewed."""

ROUGH = 0.3
"""Decrement, in units of the noise variance, at which a first refit is good enough to compare."""

MOST_STEPS = 16
"""Steps per sample up to which a force is followed."""

TOLERABLE = 0.1
"""Error of the steps, relative to the noise, that is never left."""


def pursued(bench: Bench, fit: Refit) -> Refit:
    """A first refit carried to its end, whatever is noise at the forces told apart."""
    fit = along_the_valley(bench, with_new_chains(bench, fit))
    for begun_again in (from_other_thresholds, from_other_moments):
        other = begun_again(bench, fit, max_steps=25, tolerance=ROUGH)
        fit = fit if other is fit else with_new_chains(bench, other)
    fit = at_fewer_thresholds(bench, fit, max_steps=25, tolerance=ROUGH)
    return settled(bench, fit, chain_of(bench, fit))


def with_new_chains(bench: Bench, fit: Refit) -> Refit:
    """Refits under the chain of what is left, as long as less and less of it passes for noise at the forces."""
    chain = chain_of(bench, fit)
    for _ in range(RENEWALS):
        again = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=10)
        if again is None:
            return fit
        fit, ratio, chain = again, chain.ratio, chain_of(bench, again)
        if not chain.ratio < ratio / 2:
            return fit
    return fit


def settled(bench: Bench, fit: Refit, chain: Chain) -> Refit:
    """A refit with first states that suit its free run, which a chain with noise at the forces does not determine."""
    return fit if chain.ratio == 0.0 else with_states(bench.simulator, fit, bench.data)


def along_the_valley(bench: Bench, fit: Refit) -> Refit:
    """A refit that did not come to an end, carried on: the scale of its last term's shape is set to others, all else
    refitted, as long as that pays. A curved valley is too narrow to follow in straight steps."""
    places = [
        j
        for j, p in enumerate(fit.candidate.terms[-1].effect.parameters)
        if p.counts and p.lower == 0 and not p.amplitude
    ]
    if fit.converged or len(places) != 1:
        return fit
    chain, j = chain_of(bench, fit), places[0]
    options = {"held": bench.held, "max_steps": 8, "shapes_after": 4, "tolerance": ROUGH}
    here = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=1)
    if here is None:
        return fit
    for factor in (1.5, 1 / 1.5):
        for _ in range(4):
            values = np.array(here.candidate.terms[-1].values, dtype=float)
            values[j] *= factor
            term = here.candidate.terms[-1]
            moved = here.candidate.with_terms((*here.candidate.terms[:-1], Term(term.effect, term.place, values)))
            trial = refit(bench.simulator, moved, bench.data, chain, **options)
            if trial is None or not trial.cost < here.cost:
                break
            here = trial
    return here


def sharpened(bench: Bench, fit: Refit) -> Refit:
    """A refit in shorter steps of its added forces, where the error of the steps could be told from noise and mending
    it pays.

    The simulator keeps the shorter steps.
    """
    steps, before = bench.simulator.substeps, chain_of(bench, fit)
    trial, error = in_short_steps(bench, fit)
    if trial is fit or error > TOLERABLE or chain_of(bench, trial).cost < before.cost - 2.0:
        return trial
    bench.simulator.substeps = steps
    return fit


def in_short_steps(bench: Bench, fit: Refit) -> tuple[Refit, float]:
    """A refit in steps so short that their error cannot be told from noise, itself where it is so already, and the
    error of its own steps; the simulator takes the shorter steps from then on."""
    simulator, steps = bench.simulator, bench.simulator.substeps
    error = integration_error(bench, fit)
    rows = rows_of(bench.data[0])
    if error**2 * rows < 1.0 or steps >= MOST_STEPS:
        return fit, error
    simulator.substeps = min(MOST_STEPS, steps * 2 ** int(np.ceil(np.log2(2 * error * np.sqrt(rows)))))
    return at_the_same_steps(bench, fit), error


def at_the_same_steps(bench: Bench, fit: Refit) -> Refit:
    """A refit again, in the steps that the simulator takes by now."""
    chain = chain_of(bench, fit)
    again = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=10)
    return fit if again is None else settled(bench, again, chain)


def integration_error(bench: Bench, fit: Refit) -> float:
    """How far the free run on the first record moves with steps half as long, relative to what the fit leaves: root
    mean square over the outputs."""
    if not any(isinstance(term.effect, AbstractForceEffect) for term in fit.candidate.terms):
        return 0.0
    data, simulator, steps = bench.data[0], bench.simulator, bench.simulator.substeps
    simulator.substeps = 2 * steps
    finer = simulator.run(fit.candidate, data)
    simulator.substeps = steps
    change = np.where(data.kept, data.y - fit.residual[0] - finer, 0.0)
    level = np.maximum(np.sum(fit.residual[0] ** 2, axis=0), 1e-300)
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0) / level)))
