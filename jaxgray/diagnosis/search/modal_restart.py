"""The model that was found, refitted once more from another linear model, where the first was poor.

What is hidden may bend the best M, D, K so far (a sensor that lags, a sweep) that a refit with the right effect ends in
another minimum. The record's own modes are hardly touched by it.
"""

import dataclasses

import numpy as np

from ...identification import Identification
from ...identification.modal_start import modal_start
from ...identification.preparation import prepare
from ...identification.start import nearest_physical
from ...mechanics.simulate import initial_state
from ...numerics.outcomes import ComputationError
from ...records import Record
from ..estimation.context import Bench, chain_of
from ..estimation.gauss_newton import Refit, refit
from ..model.candidate import Candidate
from ..model.held_out_gain import gain_of
from ..noise.floor import residual_rms
from ..noise.whitening import white_chain
from .state import Growth, held_out_run, runs_seen, stage_of_candidate

POOR = 80.0
"""Fit [%] of the linear model on the estimation record below which another beginning is tried."""

BETTER = 0.95
"""Residual, relative to that of the first refit, below which the second is taken."""

STEPS = 40


def from_other_modes(bench: Bench, growth: Growth, identification: Identification, records: list[Record]) -> None:
    """Refit a model with one effect from the record's own modes, and keep it where it leaves less.

    **Arguments:** `bench`; `growth`: changed in place; `identification`: where it began; `records`.
    """
    if len(growth.accepted) != 1 or min(identification.fit_percent["estimation"].values()) > POOR:
        return
    scaling = identification.scaling
    try:
        start = modal_start([prepare(r, scaling) for r in records], identification.setting)
    except ComputationError:
        return
    bench.progress.stage("refitting from other modes")
    matrices = scaling.matrices_out(*nearest_physical(start.matrices))
    model = identification.model.with_matrices(*matrices)
    states = tuple(initial_state(model, r.u, r.y, r.sampling_time, hold=r.hold)[0] for r in records)
    moved = Candidate(bench.simulator.setup.entries_of(*matrices), states).with_terms(growth.fit.candidate.terms)
    fit = _refitted(bench, growth, moved)
    if fit is None or not _left(bench, fit) < np.log(BETTER) + _left(bench, growth.fit):
        return
    growth.fit, growth.stage = fit, stage_of_candidate(bench, fit.candidate)
    last = growth.accepted[0]
    held_out, data = last.gain.held_out, bench.data[0]
    runs = seen = runs_seen(bench, growth.start.e, fit.residual[0], growth.start.e)
    if held_out:
        growth.runs = [held_out_run(bench, fit.candidate, d) for d in bench.validation]
        runs = growth.baseline_runs, growth.runs, growth.baseline_runs
    floor = residual_rms(fit.residual[0], data) if bench.floor is None else bench.floor
    gain = gain_of(*runs, floor, bench.names[1], held_out=held_out, rng=bench.rng, seen=seen)
    attempt = dataclasses.replace(last.attempt, fit=fit)
    growth.accepted[0] = dataclasses.replace(last, attempt=attempt, gain=gain, runs=growth.runs)


def _refitted(bench: Bench, growth: Growth, candidate: Candidate) -> Refit | None:
    """To the end: under white noise first, so that what is still far off does not pass for noise at the forces."""
    chain = white_chain(growth.stage.e, bench.data[0].kept, growth.stage.system)
    fit = refit(bench.simulator, candidate, bench.data, chain, held=bench.held, max_steps=STEPS)
    if fit is None:
        return None
    return refit(bench.simulator, fit.candidate, bench.data, chain_of(bench, fit), held=bench.held, max_steps=STEPS)


def _left(bench: Bench, fit: Refit) -> float:
    """Mean logarithm of the residual over outputs and records."""
    return float(np.mean([np.log(residual_rms(e, d)) for e, d in zip(fit.residual, bench.data)]))
