"""Forward selection by free runs: screen, refit, test, accept, and screen again."""

import contextlib
import dataclasses

import numpy as np

from ...mechanics.effects.base import AbstractEffect, Term
from ...numerics.programs.runtime import relieve
from ...numerics.progress import BudgetSpent
from .. import settings
from ..acceptance import at_its_bound, unproven, unsound
from ..estimation.context import SearchContext, stage_of_candidate
from ..estimation.multistart import Attempt, compared, shape_penalty, unresolved
from ..estimation.significance import at_bound
from ..findings import Move, Reason, Refusal, Rejected
from ..model.candidate import Candidate
from ..model.held_out_gain import gain_of
from ..screening.flexible_force import FlexibleForce
from ..screening.linearization import screen_simulated
from ..screening.score_test import Score
from ..starts.equation_error import force_equation_finds
from ..starts.residual_modes import hidden_modes
from ..starts.user_model import beside_laws, wrong_entries
from .acceptance import Evidence, floor_of, tested
from .backward import prune
from .confusable import alike, commonest_first, look_alikes, needless, resemble
from .proposals import (
    by_forces,
    closer_screening,
    given_up,
    refitted,
    strong,
    without_failed,
)
from .provisional import accept_provisionally, may_be_provisional, refit_for_free_run, revert_provisional
from .restart import for_the_free_run, likelier
from .state import MOST_COMPARED, Accepted, SearchState, held_out_run, runs_seen
from .swap import conclude, swap

BRANCHES = 2
"""Rounds in which another law is taken, at most, where a search leaves something unexplained."""


def select_forward(
    context: SearchContext,
    start: Candidate,
    max_effects: int,
    *,
    errors: tuple[AbstractEffect, ...] = (),
    max_errors: int = 0,
) -> SearchState:
    """Extend a model until nothing more is found.

    **Arguments:** `context`; `start`: the model to begin with; `max_effects`; `errors`: effects to look for alone
    first, at most `max_errors` of them (wrong numbers of a model that was given).

    **Returns:** a `SearchState`.
    """
    first = stage_of_candidate(context, start)
    state = SearchState(first, first)
    state.baseline_runs = [held_out_run(context, start, d) for d in context.validation]
    state.runs = state.baseline_runs
    if errors:
        extend(dataclasses.replace(context, catalogue=errors), state, max_errors, errors)
    searched = (*context.catalogue, FlexibleForce())
    extend(context, state, max_effects, searched)
    if not errors:
        state = _along_branches(context, state, max_effects, searched)
    conclude(context, state)
    return state


def _along_branches(
    context: SearchContext, state: SearchState, most: int, searched: tuple[AbstractEffect, ...]
) -> SearchState:
    """The state, or that of a search that took another law in one of the rounds, where this one leaves something
    unexplained and the other is likelier and no farther from held-out data: what explained most in a round may have
    stood in for two laws, its values led astray by the one that was missing."""
    there = [one.attempt for one in state.accepted]

    def other(attempt: Attempt) -> bool:
        laws = ((attempt.score.shape.effect, one.score.shape.effect) for one in there)
        return all(attempt.name != one.name for one in there) and not any(resemble(*pair) for pair in laws)

    branches = [(*one, others) for one in state.branches if (others := [*filter(other, one[1])])]
    clear = [branch for branch in branches if branch[2][0].delta_bic > settings.CLEAR_DELTA_BIC]
    state.branches = ()
    for begun, ranked, others in sorted(clear, key=lambda branch: -branch[2][0].delta_bic)[:BRANCHES]:
        if not state.unexplained or len(begun.accepted) > most - 2:
            continue
        new, rest = begun.copied(), [one for one in ranked if not other(one)]
        # As many were judged in that round already.
        new.trials += 1 + next((k for k, one in enumerate(ranked) if one is rest[0]), 0) if rest else 0
        new.branches = ()
        with contextlib.suppress(BudgetSpent):
            if _accepted(context, new, others + rest, Move.BEGUN_WITH, most=len(others)):
                _rounds(context, new, most - len(new.accepted), searched)
        revert_provisional(new)
        if new.fit is not None and likelier(context, new, state):
            state = dataclasses.replace(new, branches=())
    return state


def extend(context: SearchContext, state: SearchState, most: int, searched: tuple[AbstractEffect, ...]) -> None:
    """Rounds of looking and accepting, until nothing more is found, `most` effects were, or the time is over; findings
    that are still provisional then go."""
    with contextlib.suppress(BudgetSpent):
        _rounds(context, state, most, searched)
    revert_provisional(state)


def _rounds(context: SearchContext, state: SearchState, most: int, searched: tuple[AbstractEffect, ...]) -> None:
    turn, free = 0, settings.MAX_FREE_ROUNDS
    while (used := _round(beside_laws(context, state.stage), state, most - turn, searched)) is not None:
        turn, free = (turn, free - 1) if used == 0 and free else (turn + 1, free)


def _round(context: SearchContext, state: SearchState, left: int, searched: tuple[AbstractEffect, ...]) -> int | None:
    """One round, where so many effects may still be added: how many it took, 0 where it but ruled something out; None
    where nothing more is found."""
    relieve()
    known, told_from = len(state.accepted), state.ruled_out
    state.stage = dataclasses.replace(state.stage, ruled_out=state.ruled_out)
    context.progress.unlimited.stage("looking for effects" if known == 0 else f"looking further ({known} found)")
    screening = screen_simulated(state.stage, context.data[0], searched, context.names, rng=context.rng)
    state.screening = screening
    state.first = screening if state.first is None else state.first
    state.unexplained = screening.fires
    if context.out_of_phase and not state.stage.candidate.terms and force_equation_finds(context):
        state.unexplained = True
        first = by_forces(context, state.stage, screening) if left > 0 else []
        return 1 if _accepted(context, state, first, Move.FORCE_EQUATION) else None
    quiet = not (_tried_by_forces(context, state, left) or screening.fires or strong(screening))
    # A run out of phase shows no entry to first order, and all that it leaves passes for noise at the forces.
    if quiet and not wrong_entries(context, state.stage, screening, least=settings.CLEAR_DELTA_BIC):
        found = left > 0 and (
            _accepted(context, state, hidden_modes(context, state.stage, screening), Move.HIDDEN_MODE)
            or _accepted(context, state, by_forces(context, state.stage, screening), Move.FORCE_EQUATION)
        )
        return 1 if found else None
    if left <= 0:
        return None
    # Until they are taken or refuted, there are candidates.
    state.unexplained = True
    closer = closer_screening(context, state.stage, screening)
    before = len(state.rejected)
    ranked = refitted(context, state, screening, closer)
    begun = state.copied()
    if _accepted(context, state, ranked):
        state.branches = (*state.branches, (begun, tuple(ranked)))
        return 1
    if state.ruled_out != told_from:
        return 0
    if given_up(state.rejected[before:], ranked):
        # Far behind laws that do not hold, and looked for under what these leave.
        others = without_failed(context, state, searched, screening, ranked)
        second = [] if others is None else refitted(context, state, *others)
        if _accepted(context, state, second, Move.SECOND_SCREENING):
            return 1
        ranked = compared(context, state.stage, ranked + second) if second else ranked
    tried = frozenset(attempt.name for attempt in ranked)
    if _accepted(context, state, hidden_modes(context, state.stage, screening, tried), Move.HIDDEN_MODE):
        return 1
    refuted = screening.fires and _refuted(context, state, ranked, searched)
    state.unexplained = screening.fires and not refuted
    # A provisional finding needs another round, in which a second one may confirm it.
    return 1 if not refuted and left > 1 and _provisional(context, state, ranked) else None


def _tried_by_forces(context: SearchContext, state: SearchState, left: int) -> bool:
    """Whether the force equation has trials of a first law, and the free run is out of phase: then all that is left may
    pass for noise."""
    first = left > 0 and context.trials_at_once and context.out_of_phase and not state.stage.candidate.terms
    return first and context.first_trials is not None and bool(context.first_trials())


def _refuted(
    context: SearchContext, state: SearchState, ranked: list[Attempt], searched: tuple[AbstractEffect, ...]
) -> bool:
    """Whether the gate was wrong: it sees effects to first order, and none of those refitted holds.

    It must have opened to next to nothing, or barely, or stay shut under the noise that the best refit leaves: where it
    took noise at the forces for white, every effect seemed to explain some of it.
    """
    best = state.screening.scores[0]
    if 1 - np.exp(-best.ratio / state.screening.rows) < settings.MIN_RESIDUAL_SHARE:
        return True
    if not ranked or any(attempt.delta_bic >= settings.MIN_DELTA_BIC for attempt in ranked):
        return False
    if best.delta_bic < 2 * state.screening.threshold:
        return True
    noise_model = ranked[0].noise_model
    again = screen_simulated(
        state.stage, context.data[0], searched, context.names, noise_model=noise_model, rng=context.rng
    )
    if again.fires or again.noise_model.ratio == 0.0:
        return False
    state.screening = again
    return True


def _accepted(
    context: SearchContext,
    state: SearchState,
    ranked: list[Attempt],
    move: Move = Move.SCORE_TEST,
    *,
    most: int | None = None,
) -> bool:
    """Accept the best candidate that holds, among the first `most`; whether one did."""
    floor, unsure, ahead = floor_of(context, sorted(ranked, key=lambda one: one.criterion)), [], []
    judged = len(ranked) if most is None else most
    ranked = commonest_first(ranked[:judged], context.catalogue) + ranked[judged:]
    for k, attempt in enumerate(ranked[:judged]):
        context.progress.stage(f"judging {attempt.name[0]} at {attempt.name[1]}")
        why, gain, runs = tested(context, state, attempt, floor)
        if why is not None and why.reason is Reason.WORSE:
            # Under noise at the forces a refit follows the record step by step: perhaps a free run can follow it, too.
            free = refit_for_free_run(context, state, attempt)
            again, more, after = tested(context, state, free, floor)
            if again is None:
                attempt, why, gain, runs = free, again, more, after
        if why is None:
            rivals, others, refused = _class_of(context, attempt, unsure + ranked[k + 1 :])
            # What was refused for its error alone, and explains as much or more, may be it all the same.
            names = {rival.name for rival in rivals}
            state.rejected = [one for one in state.rejected if (one.effect, one.location) not in names] + refused
            # Refits first: of several starts of one law the first counts.
            others = (*ahead, *others, *_compared_later(context, state, attempt))
            _take(context, state, Accepted(attempt, rivals, gain, runs, move, others))
            return True
        state.rejected.append(Rejected.of(attempt.name, attempt.delta_bic, why, gain))
        unsure += [attempt] if why.reason is Reason.UNCERTAIN else []
        # Its gain may be sure where another law is there, too.
        ahead += [attempt] if why.reason is Reason.NO_SURE_GAIN else []
    return False


def _take(context: SearchContext, state: SearchState, accepted: Accepted) -> None:
    """Go on with a finding that holds, and with the provisional ones that it confirms."""
    state.accepted.append(accepted)
    state.fit, state.runs = accepted.attempt.fit, accepted.runs
    state.stage = stage_of_candidate(context, state.fit.candidate)
    state.unexplained, state.provisional, state.trials = False, None, 0
    names = {one.attempt.name for one in state.accepted}
    state.rejected = [one for one in state.rejected if (one.effect, one.location) not in names]
    prune(context, state)
    if len(state.accepted) == len(names):
        swap(context, state)
    for_the_free_run(context, state)


def _provisional(context: SearchContext, state: SearchState, ranked: list[Attempt]) -> bool:
    """Whether to go on with the best candidate that nothing but its gain speaks against: it holds refitted for the free
    run, or is accepted provisionally."""
    if not may_be_provisional(state, ranked):
        return False
    floor = floor_of(context, ranked)
    for k, attempt in enumerate(ranked):
        if attempt.delta_bic > settings.CLEAR_DELTA_BIC and unsound(Evidence(context, state, attempt, floor)) is None:
            rivals, free = _class_of(context, attempt, ranked[k + 1 :])[0], refit_for_free_run(context, state, attempt)
            why, gain, runs = tested(context, state, free, floor)
            if why is None:
                _take(context, state, Accepted(free, rivals, gain, runs, Move.WITH_ANOTHER))
            else:
                accept_provisionally(context, state, attempt, free, rivals, floor)
            return True
    return False


def _class_of(
    context: SearchContext, attempt: Attempt, others: list[Attempt]
) -> tuple[tuple[Attempt, ...], tuple[Attempt, ...], list[Rejected]]:
    """What the record hardly tells from an attempt, among those that were refitted with it, what else might explain as
    much beside other laws, and why neither is accepted."""
    rivals, near, refused, given = [], [], [], context.simulator.setup.own
    for other in others:
        behind = other.criterion - attempt.criterion
        if behind <= -alike(attempt, other):
            continue
        if behind >= alike(attempt, other):
            near += [other] if behind < settings.MAX_CRITERION_GAP and _may_swap(context, attempt, other) else []
            words = f"explained better by {' at '.join(attempt.name)} (by {behind:.0f})"
            why = Refusal(Reason.EXPLAINED_BETTER, words)
        elif needless(other, attempt):
            words = f"the same as {attempt.name[0]} with a parameter that explains nothing"
            why = Refusal(Reason.NEEDLESS, words)
        elif (bound := at_bound(other.fit, len(other.fit.candidate.terms) - 1, given)) is not None:
            why = at_its_bound(bound)
        elif (other_law := unresolved(other.fit, other.score)) is not None:
            why = Refusal(Reason.OTHER_LAW, other_law)
        else:
            rivals.append(other)
            continue
        refused.append(Rejected.of(other.name, other.delta_bic, why))
    return tuple(rivals[:MOST_COMPARED]), tuple(near[:MOST_COMPARED]), refused


def _compared_later(context: SearchContext, state: SearchState, attempt: Attempt) -> list[Attempt]:
    """What may take the place of an attempt once other laws are there: what it may turn out to be, simpler laws that it
    contains, with its own values, what explained more to first order, and what is easily taken for it. Begun where the
    score test has it."""
    found, term = [], attempt.fit.candidate.terms[-1]
    known, own = state.screening.best_by_place(), term.effect.named_values(term.values)
    names = [(law, term.place.name) for law in (*term.effect.becomes, *term.effect.contains)]
    most = known[attempt.name].delta_bic if attempt.name in known else np.inf
    ahead = [(name, score.shape.effect) for name, score in known.items() if score.delta_bic > most]
    names += [name for name, law in ahead if name[0] != FlexibleForce.id and attempt.name[0] not in law.contains]
    names += _look_alikes_there(context, known, attempt)
    # Of one law under two names one at a place, where the attempt is none of them.
    own_law, laws = _law_there(term.effect, term.place.name), {}
    for name in (name for name in names if name in known):
        laws.setdefault(_law_there(known[name].shape.effect, name[1]), name)
    for name in (name for law, name in laws.items() if law != own_law):
        one = known[name].shape.term(known[name].weights)
        if name[0] in term.effect.contains:
            values = [own.get(p.name, value) for p, value in zip(one.effect.parameters, one.values)]
            one = Term(one.effect, one.place, one.effect.bounded(np.array(values, dtype=float)))
        candidate = attempt.fit.candidate.with_terms((*attempt.fit.candidate.terms[:-1], one))
        fit, score = dataclasses.replace(attempt.fit, candidate=candidate), known[name]
        worth = {"penalty": shape_penalty(context, score), "delta_bic": score.delta_bic}
        found.append(dataclasses.replace(attempt, score=score, fit=fit, **worth))
    return found[:MOST_COMPARED]


def _law_there(effect: AbstractEffect, place: str) -> tuple:
    return effect.by_contact or effect.id, place


def _look_alikes_there(
    context: SearchContext, known: dict[tuple[str, str], Score], attempt: Attempt
) -> list[tuple[str, str]]:
    """Laws that are easily taken for an attempt's, each where it explains most to first order, best first: where others
    were missing, one of them may have ended far behind."""
    laws, best = look_alikes(attempt.score.shape.effect, context.catalogue), {}
    clear = (one for one in known.items() if one[0][0] in laws and one[1].delta_bic > settings.CLEAR_DELTA_BIC)
    for name, _ in sorted(clear, key=lambda one: -one[1].delta_bic):
        best.setdefault(name[0], name)
    return list(best.values())


def _may_swap(context: SearchContext, attempt: Attempt, other: Attempt) -> bool:
    """Whether another law is one of its own, no more of the same; less of it may be enough beside later laws."""
    wider = attempt.name[0] in other.score.shape.effect.contains
    bound = at_bound(other.fit, len(other.fit.candidate.terms) - 1, context.simulator.setup.own)
    return not wider and bound is None and unresolved(other.fit, other.score) is None


def recount(context: SearchContext, state: SearchState, floor: np.ndarray) -> None:
    """Gains that add up: of every finding over what the findings before it leave, in units of one noise floor. One that
    has no sure gain before a later one is there shares the gain of both with it."""
    before, left, waiting = state.baseline_runs, state.start.e, []
    last = max((k for k, accepted in enumerate(state.accepted) if accepted.gain.held_out), default=-1)
    for k, accepted in enumerate(state.accepted):
        now = accepted.attempt.fit.residual[0]
        if accepted.gain.held_out:
            waiting.append(k)
            seen, runs = runs_seen(context, left, now, state.start.e), (before, accepted.runs, state.baseline_runs)
            gain = gain_of(*runs, floor, context.names[1], held_out=True, rng=context.rng, seen=seen)
            if k < last and unproven(gain) is not None:
                continue
            for at, part in zip(waiting, gain.parts(len(waiting))):
                state.accepted[at] = dataclasses.replace(state.accepted[at], gain=part)
            before, waiting = accepted.runs, []
        if not waiting:
            before, left = accepted.runs, now
