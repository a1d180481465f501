"""The model that was found, refitted once more under white noise, and kept where it leaves less: where a law was still
missing, its traces passed for noise at the forces, and under such noise a refit follows the record step by step and
hardly asks where the free run goes. And which of two models is the likelier one."""

import dataclasses

import numpy as np

from .. import settings
from ..estimation.context import SearchContext, noise_model_of, stage_of_candidate
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import moving
from ..estimation.significance import evidence
from ..model.candidate import Candidate
from ..model.free_run import on_the_same, overall, rms_of
from ..model.held_out_gain import gain_of
from ..noise.floor import more_than_noise, residual_rms
from ..noise.whitening import white_noise_model
from .state import SearchState, held_out_runs, runs_seen

STEPS = 40


def for_the_free_run(context: SearchContext, state: SearchState) -> None:
    """Refit the model as it stands under white noise, where it leaves more than noise.

    **Arguments:** `context`; `state`: changed in place, with an effect in it.
    """
    if not more_than_noise(state.fit.residual[0], context.data[0]):
        return
    context.progress.stage("refitting for the free run")
    _keep(context, state, _refitted(context, state, state.fit.candidate))


def _refitted(context: SearchContext, state: SearchState, candidate: Candidate) -> Refit | None:
    """To the end: under white noise first, so that what is still far off does not pass for noise at the forces."""
    noise_model = white_noise_model(state.stage.e, context.data[0].kept, state.stage.system)
    fit = refit(context.simulator, candidate, context.data, noise_model, held=context.held, max_steps=STEPS)
    if fit is None:
        return None
    return refit(
        context.simulator, fit.candidate, context.data, noise_model_of(context, fit), held=context.held, max_steps=STEPS
    )


def _keep(context: SearchContext, state: SearchState, fit: Refit | None) -> None:
    """Go on with another refit of the model where it leaves less."""
    if fit is None or not _left(context, fit) < np.log(settings.RESTART_RESIDUAL) + _left(context, state.fit):
        return
    state.fit, state.stage = fit, stage_of_candidate(context, fit.candidate)
    *others, last = state.accepted
    before, old = (
        (others[-1].runs, others[-1].attempt.fit.residual[0]) if others else (state.baseline_runs, state.start.e)
    )
    held_out, data = last.gain.held_out, context.data[0]
    runs = seen = runs_seen(context, old, fit.residual[0], state.start.e)
    state.runs = held_out_runs(context, fit.candidate, state.runs)
    if held_out:
        runs = before, state.runs, state.baseline_runs
    floor = residual_rms(fit.residual[0], data) if context.floor is None else context.floor
    gain = gain_of(*runs, floor, context.names[1], held_out=held_out, rng=context.rng, seen=seen)
    attempt = dataclasses.replace(last.attempt, fit=fit)
    state.accepted[-1] = dataclasses.replace(last, attempt=attempt, gain=gain, runs=state.runs)


def likelier(context: SearchContext, new: SearchState, old: SearchState) -> bool:
    """Whether one model is clearly likelier than another (BIC under the noise model that makes either likelier), and no
    farther from held-out data."""
    noise_model = min((noise_model_of(context, one.fit) for one in (new, old)), key=lambda one: one.cost)

    def criterion(state: SearchState) -> float:
        cost, rows = evidence(*moving(context, state.fit), context.data[0], noise_model)
        return float(rows * np.log(max(cost, 1e-300))) + sum(one.attempt.penalty for one in state.accepted)

    farther = bool(context.validation) and overall(*map(rms_of, on_the_same(new.runs, old.runs))) > 1.0
    return not farther and criterion(old) - criterion(new) > settings.MIN_DELTA_BIC


def _left(context: SearchContext, fit: Refit) -> float:
    """Mean logarithm of the residual over outputs and records."""
    return float(np.mean([np.log(residual_rms(e, d)) for e, d in zip(fit.residual, context.data)]))
