"""Findings on credit: the first of two that gain something only together.

Where another effect is still missing, its traces pass for noise at the forces, or for colour at the outputs. Under such
noise a refit follows the record step by step, and what it finds, right as it may be, brings no free run nearer. It is
lent its place until a later finding redeems it, by a sure gain of both over the model before them, or it is withdrawn.
"""

import dataclasses

import numpy as np

from ..estimation.context import Bench
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt
from ..estimation.profile_scan import something_left
from ..findings import Move
from ..model.held_out_gain import gain_of
from ..noise.whitening import white_chain
from ..settings import CLEAR
from .state import Accepted, Credit, Growth, held_out_run, is_local, runs_seen, stage_of_candidate

LOANS = 2
"""Findings that may be lent their place at a time."""

STEPS = 20
"""Of the refit for the free run."""


def lendable(growth: Growth, ranked: list[Attempt]) -> bool:
    """Whether a finding may be lent its place: something is clearly there, under noise that another effect may be."""
    lent = 0 if growth.credit is None else len(growth.accepted) - growth.credit.sure
    if not ranked or lent >= LOANS or not ranked[0].delta_bic > CLEAR:
        return False
    return something_left(ranked[0].chain)


def by_free_run(bench: Bench, growth: Growth, attempt: Attempt) -> Attempt:
    """An attempt refitted for the free run alone, from the model without it and from where it is."""
    sure, data = growth.sure, bench.data[0]
    begin = sure.candidate if growth.credit is None else growth.accepted[-1].attempt.fit.candidate
    chain = white_chain(sure.e, data.kept, sure.system)
    term = attempt.fit.candidate.terms[-1]
    fit = None
    for start in (begin.with_terms((*begin.terms, term)), attempt.fit.candidate):
        abandon = np.inf if fit is None else fit.cost
        found = refit(bench.simulator, start, bench.data, chain, held=bench.held, max_steps=STEPS, abandon=abandon)
        if found is not None and (fit is None or found.cost < fit.cost):
            fit = found
    return attempt if fit is None else dataclasses.replace(attempt, fit=fit)


def lend(bench: Bench, growth: Growth, attempt: Attempt, free: Attempt, rivals: tuple[Attempt, ...], floor) -> None:
    """Go on with a finding that has no sure gain yet; `free` is it refitted for the free run, which its gain is of."""
    before, old = growth.runs, growth.stage.e
    if growth.credit is None:
        sure = len(growth.accepted)
        growth.credit = Credit(growth.stage, growth.fit, growth.screening, growth.unexplained, sure)
    else:
        before, old = growth.accepted[-1].runs, growth.accepted[-1].attempt.fit.residual[0]
    held_out = not is_local(bench, attempt.score.shape.effect) and bool(bench.validation)
    runs = [held_out_run(bench, free.fit.candidate, d) for d in bench.validation] if held_out else before
    seen = runs_seen(bench, old, free.fit.residual[0], growth.start.e)
    pairs = (before, runs, growth.baseline_runs) if held_out else seen
    gain = gain_of(*pairs, floor, bench.names[1], held_out=held_out, rng=bench.rng, seen=seen)
    growth.accepted.append(Accepted(free, rivals, gain, runs, Move.WITH_ANOTHER))
    growth.fit, growth.stage = attempt.fit, stage_of_candidate(bench, attempt.fit.candidate)


def withdraw(growth: Growth) -> None:
    """Take back what was lent and never redeemed."""
    credit, growth.credit = growth.credit, None
    if credit is None:
        return
    del growth.accepted[credit.sure :]
    growth.stage, growth.fit = credit.stage, credit.fit
    growth.screening, growth.unexplained = credit.screening, credit.unexplained
