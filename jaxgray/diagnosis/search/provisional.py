"""Provisional findings: the first of two that gain something only together.

Where another effect is still missing, its traces pass for noise at the forces, or for colour at the outputs. Under such
noise a refit follows the record step by step, and what it finds, right as it may be, brings no free run nearer. It
stays in the model provisionally, until both it and a later finding have a sure gain over the model before them, or
the search ends and it is withdrawn.
"""

import dataclasses

import numpy as np

from .. import settings
from ..estimation.context import SearchContext, stage_of_candidate
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt
from ..estimation.profile_scan import something_left
from ..findings import Move
from ..model.held_out_gain import gain_of
from ..noise.whitening import white_noise_model
from .state import Accepted, Provisional, SearchState, held_out_runs, is_local, runs_seen

STEPS = 20
"""Of the refit for the free run."""


def may_be_provisional(state: SearchState, ranked: list[Attempt]) -> bool:
    """Whether a finding may be accepted provisionally: something is clearly there, in noise that may be an effect."""
    count = 0 if state.provisional is None else len(state.accepted) - state.provisional.sure
    if not ranked or count >= settings.MAX_PROVISIONAL or not ranked[0].delta_bic > settings.CLEAR_DELTA_BIC:
        return False
    return something_left(ranked[0].noise_model)


def refit_for_free_run(context: SearchContext, state: SearchState, attempt: Attempt) -> Attempt:
    """An attempt refitted for the free run alone, from the model without it and from where it is."""
    sure, data = state.sure, context.data[0]
    begin = sure.candidate if state.provisional is None else state.accepted[-1].attempt.fit.candidate
    noise_model = white_noise_model(sure.e, data.kept, sure.system)
    term = attempt.fit.candidate.terms[-1]
    fit = None
    for start in (begin.with_terms((*begin.terms, term)), attempt.fit.candidate):
        abandon = np.inf if fit is None else fit.cost
        found = refit(
            context.simulator, start, context.data, noise_model, held=context.held, max_steps=STEPS, abandon=abandon
        )
        if found is not None and (fit is None or found.cost < fit.cost):
            fit = found
    return attempt if fit is None else dataclasses.replace(attempt, fit=fit)


def accept_provisionally(
    context: SearchContext, state: SearchState, attempt: Attempt, free: Attempt, rivals: tuple[Attempt, ...], floor
) -> None:
    """Go on with a finding that has no sure gain yet; `free` is it refitted for the free run, which its gain is of."""
    before, old = state.runs, state.stage.e
    if state.provisional is None:
        sure = len(state.accepted)
        state.provisional = Provisional(state.stage, state.fit, state.screening, state.unexplained, sure)
    else:
        before, old = state.accepted[-1].runs, state.accepted[-1].attempt.fit.residual[0]
    held_out = not is_local(context, attempt.score.shape.effect) and bool(context.validation)
    runs = held_out_runs(context, free.fit.candidate, before)
    seen = runs_seen(context, old, free.fit.residual[0], state.start.e)
    pairs = (before, runs, state.baseline_runs) if held_out else seen
    gain = gain_of(*pairs, floor, context.names[1], held_out=held_out, rng=context.rng, seen=seen)
    state.accepted.append(Accepted(free, rivals, gain, runs, Move.WITH_ANOTHER))
    state.fit, state.stage = attempt.fit, stage_of_candidate(context, attempt.fit.candidate)


def revert_provisional(state: SearchState) -> None:
    """Withdraw provisional findings that no later one has confirmed."""
    provisional, state.provisional = state.provisional, None
    if provisional is None:
        return
    del state.accepted[provisional.sure :]
    state.stage, state.fit = provisional.stage, provisional.fit
    state.screening, state.unexplained = provisional.screening, provisional.unexplained
