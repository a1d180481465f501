"""The law that explains most in the simulator itself, among those that are near it in the linear plant."""

import dataclasses

import numpy as np

from ...mechanics.effects.base import AbstractOutputEffect, Term
from ...numerics.outcomes import ComputationError
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import Attempt, unresolved
from ..estimation.significance import at_bound, significance
from ..findings import Gain, Reason
from ..model.candidate import estimated
from ..model.free_run import FreeRun
from ..model.parameter_vector import Layout
from ..noise.effective_samples import independent_share
from ..screening.score_test import Score
from ..search.confusable import alike, resemble
from ..search.state import Accepted, SearchState
from .runs.problem import Linear, Outputs, Problem, parts_of
from .settling import NEARER, WRONG, Settled, foreseen_by, left_by, left_of, settle, settled_further

MOST = 4
"""Laws that are settled in the simulator in one round."""

FAR_BEHIND = 1.1
"""Mean square that a law leaves, relative to another, at which no further run brings it near."""

BEHIND = (Reason.EXPLAINED_BETTER, Reason.DOMINATED, Reason.NO_SURE_GAIN, Reason.UNCERTAIN)
"""Reasons against a law that hold in the linear plant, and may not in the simulator."""

MOST_RIVALS = 3
"""Laws that a finding shares its class with, at most."""


def offered(context: SearchContext, state: SearchState, lacking: bool) -> Accepted | None:
    """The law that a search in the linear plant took, or the best of those that it refused for their gain alone, which
    the simulator has to show; None for none. `lacking`: whether more than noise is left, of which the linear plant may
    show little beside the numbers: then one that it doubts, too."""
    reasons, least = (BEHIND, settings.MIN_DELTA_BIC) if lacking else ((Reason.NO_SURE_GAIN,), settings.CLEAR_DELTA_BIC)
    if state.accepted:
        return state.accepted[-1]
    refused = sorted((one for one in state.rejected if one.reason in reasons), key=lambda one: -one.delta_bic)
    scores = state.first.best_by_place()
    for one in refused:
        name = one.effect, one.location
        fit = state.tried.get(name)
        if fit is None or name not in scores or one.delta_bic < least or _name(fit) != name:
            continue
        attempt = Attempt(scores[name], fit, noise_model_of(context, fit), delta_bic=one.delta_bic)
        return Accepted(attempt, (), Gain({}, 0.0, (0.0, 0.0), 0.0, False), [])
    return None


def chosen(
    problem: Problem, context: SearchContext, state: SearchState, accepted: Accepted, wholes: Linear, before: Outputs
) -> tuple[Accepted, Settled]:
    """A law that a search in the linear plant offers, or another of its round that explains more in the simulator.

    The linear plant answers to noise and to large forces not quite as the simulator does; settled in the simulator,
    laws are compared by its own runs, and with those without the law (`before`).

    **Raises:** `ComputationError` where the simulator runs with none of them.
    """
    settled: dict[tuple[str, str], Settled] = {}
    beyond, best = np.inf, None
    known = state.first.best_by_place() | {one.name: one.score for one in (accepted.attempt, *accepted.rivals)}
    failure = None

    def tried(name: tuple[str, str], begin: tuple[SearchContext, Refit, Linear]) -> None:
        nonlocal beyond, best, failure
        if begin[2] is not wholes:
            # About runs that are near the records, what the linear plant leaves says how near its own runs may come.
            foretold = left_of(foreseen_by(begin[1], begin[0].data))
            if foretold + problem.record.outputs * WRONG > beyond:
                return
        context.progress.unlimited.stage(f"trying {name[0]} at {name[1]} in the simulator")
        try:
            one = settle(problem, *begin, beyond=beyond, nearly=True)
        except ComputationError as error:
            failure = error
            return
        if left_by(problem, one.y) + np.log(FAR_BEHIND) < beyond:
            best, beyond = one, left_by(problem, one.y) + np.log(FAR_BEHIND)
        if name == accepted.attempt.name or _sound(one, known.get(name)):
            settled[name] = one

    contenders = _contenders(state, accepted)
    for name, fit in contenders:
        tried(name, _about(problem, context, fit.candidate.terms[-1], best) or (context, fit, wholes))
    if not settled:
        raise failure
    for name in _ruled_out_elsewhere(state, best, {name for name, _ in contenders}):
        score = known[name]
        begin = _about(problem, context, score.shape.term(score.weights), best)
        if begin is not None:
            tried(name, begin)
    criteria, count = _criteria(problem, settled)
    first = min(criteria, key=criteria.__getitem__)
    if count * left_by(problem, before) - criteria[first] >= settings.MIN_DELTA_BIC:
        settled[first] = settled_further(problem, context, settled[first])
        criteria, count = _criteria(problem, settled)
    without = count * left_by(problem, before)

    def attempt(name: tuple[str, str]) -> Attempt:
        fit, delta = settled[name].fit, without - criteria[name]
        return Attempt(known[name], fit, noise_model_of(context, fit), criteria[name], delta_bic=delta)

    first_of = attempt(first)
    others = [attempt(name) for name in sorted(criteria, key=criteria.__getitem__) if name != first]
    # Runs of a simulator are compared as finely as they settle.
    near = [other for other in others if other.criterion - first_of.criterion < alike(first_of, other) + NEARER * count]
    return dataclasses.replace(accepted, attempt=first_of, rivals=tuple(near[:MOST_RIVALS])), settled[first]


def _about(
    problem: Problem, context: SearchContext, law: Term, best: Settled | None
) -> tuple[SearchContext, Refit, Linear] | None:
    """Context, refit and records for a law in the place of the best one so far: in the linear plant about the runs of
    that one, begun from where it ended; None where these runs are not near the records.

    A plant about other runs may answer so differently that a law which explains as much seems hopeless.
    """
    if best is None or not problem.follow(best.y):
        return None
    ended = best.candidate.terms[-1]
    ends = ended.effect.named_values(ended.values)
    values = [ends.get(p.name, float(value)) for p, value in zip(law.effect.parameters, law.values)]
    term = Term(law.effect, law.place, law.effect.bounded(np.array(values)))
    there = dataclasses.replace(context, simulator=best.linear, data=list(best.data))
    begins = [best.candidate.with_terms((*best.candidate.terms[:-1], one)) for one in (term, law)]
    noise_model = noise_model_of(there, best.fit)
    found = [refit(best.linear, begin, there.data, noise_model, held=context.held) for begin in begins]
    found = [one for one in found if one is not None]
    return (there, min(found, key=lambda one: one.cost), best.wholes) if found else None


def _ruled_out_elsewhere(state: SearchState, best: Settled, tried: set[tuple[str, str]]) -> list[tuple[str, str]]:
    """Look-alikes of the best law that were ruled out in the linear plant, of which one is a law of a sensor and one of
    the motion: that plant is about a single motion, and the two have others behind the same outputs."""
    law, known = best.candidate.terms[-1].effect, state.first.best_by_place()

    def elsewhere(name: tuple[str, str]) -> bool:
        other = known[name].shape.effect
        of_sensor = isinstance(other, AbstractOutputEffect) != isinstance(law, AbstractOutputEffect)
        return of_sensor and resemble(other, law)

    behind = [(one.effect, one.location) for one in state.rejected if one.reason in BEHIND]
    return [name for name in behind if name in known and name not in tried and elsewhere(name)]


def needless(
    problem: Problem, context: SearchContext, accepted: list[Accepted], settled: Settled
) -> tuple[int, float, Settled] | None:
    """Which of the laws that were accepted before the last one explains nothing beside those after it, what it is worth
    by its BIC, and what is settled without it; None where each explains something."""
    layout, terms = Layout(settled.linear.setup, settled.candidate), settled.candidate.terms
    there = dataclasses.replace(context, simulator=settled.linear, data=list(settled.data))
    for k in range(len(accepted) - 1):
        if significance(settled.fit, layout, k) >= settings.MIN_STANDARD_ERRORS and at_bound(settled.fit, k) is None:
            continue
        candidate = settled.candidate.with_terms((*terms[:k], *terms[k + 1 :]))
        fit = refit(settled.linear, candidate, there.data, noise_model_of(there, settled.fit), held=there.held)
        if fit is None:
            continue
        try:
            other = settle(problem, there, fit, settled.wholes)
        except ComputationError:
            continue
        count = _independent(parts_of(problem, settled.y)[0])
        worth = count * (left_by(problem, other.y) - left_by(problem, settled.y))
        worth -= len(estimated(terms[k])) * float(np.log(count))
        if worth < settings.MIN_DELTA_BIC:
            return k, worth, other
    return None


def _sound(settled: Settled, score: Score | None) -> bool:
    """Whether nothing but its gain could speak against a law where it ended."""
    if score is None:
        return False
    last = len(settled.candidate.terms) - 1
    size = significance(settled.fit, Layout(settled.linear.setup, settled.candidate), last)
    if size < settings.MIN_STANDARD_ERRORS_IF_CLEAR or at_bound(settled.fit, last) is not None:
        return False
    return unresolved(settled.fit, score) is None


def _contenders(state: SearchState, accepted: Accepted) -> list[tuple[tuple[str, str], Refit]]:
    """Names and refits of laws of the last round: what was accepted, its rivals, then what leaves least."""
    own = accepted.attempt
    refused = {(one.effect, one.location) for one in state.rejected if one.reason not in BEHIND}
    rivals = {rival.name: rival.fit for rival in accepted.rivals}
    fits = rivals | {name: fit for name, fit in state.tried.items() if name not in refused and name != own.name}
    count = len(own.fit.candidate.terms)
    fits = {name: fit for name, fit in fits.items() if len(fit.candidate.terms) == count and _name(fit) == name}

    def left(name: tuple[str, str]) -> float:
        return float(np.sum(np.log(np.maximum(sum(np.sum(e**2, axis=0) for e in fits[name].residual), 1e-300))))

    ranked = sorted(fits, key=lambda name: (name not in rivals, left(name)))
    return [(own.name, own.fit), *((name, fits[name]) for name in ranked[: MOST - 1])]


def _name(fit: Refit) -> tuple[str, str]:
    last = fit.candidate.terms[-1]
    return last.effect.id, last.place.name


def _criteria(problem: Problem, settled: dict[tuple[str, str], Settled]) -> tuple[dict[tuple[str, str], float], float]:
    """N ln(cost) + k ln N of runs of the simulator, with as many samples as are independent in the best, and N."""
    runs = {name: parts_of(problem, one.y)[0] for name, one in settled.items()}
    left = {name: left_of(made) for name, made in runs.items()}
    best = runs[min(left, key=left.__getitem__)]
    count = _independent(best)
    criteria = {
        name: count * left[name] + len(estimated(one.candidate.terms[-1])) * float(np.log(count))
        for name, one in settled.items()
    }
    return criteria, count


def _independent(runs: list[FreeRun]) -> float:
    """How many samples are independent in what runs leave."""
    share = independent_share(max((run.e[run.kept.all(axis=1)] for run in runs), key=len))
    return share * sum(int(run.kept.all(axis=1).sum()) for run in runs)
