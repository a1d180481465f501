"""The loop: look, name, refit, accept or reject, look again."""

import dataclasses

import numpy as np

from ...mechanics.effects.base import AbstractEffect
from ...numerics.runtime import relieve
from ...numerics.side_by_side import side_by_side
from ..acceptance import at_its_bound, unsound
from ..estimation.context import Bench, chain_of
from ..estimation.multistart import Attempt, attempts_of, compared, unresolved
from ..estimation.significance import at_bound
from ..findings import Move, Reason, Refusal, Rejected
from ..model.candidate import Candidate, Data
from ..model.held_out_gain import gain_of
from ..noise.whitening import estimate_chain, white_chain
from ..screening.flexible_force import FlexibleForce
from ..screening.linearization import Stage, look, look_closer
from ..screening.score_test import Screening
from ..screening.shortlist import adds_mode, listed_with, shortlist
from ..settings import ACCEPTED, CLEAR, EXPLAINED
from ..starts.equation_error import from_forces, heard
from ..starts.force_matching import left_behind
from ..starts.lookalikes import instead_of, unheard
from ..starts.residual_modes import hidden_modes
from ..starts.user_model import beside_laws, wrong_entries
from .acceptance import Evidence, floor_of, judged
from .backward import prune
from .confusable import alike, look_alikes, needless, simplified
from .final_swap import rejudge
from .provisional import by_free_run, lend, lendable, withdraw
from .state import Accepted, Growth, held_out_run, is_local, runs_seen, stage_of_candidate

SLIGHT = 0.02
"""Share of what is left that the best effect must explain for "unexplained" to be said when no refit holds."""

COMPARABLE = 0.3
"""Motion of held-out data relative to that of the fit from which they can refute coloured noise."""

HALVED = 50.0
"""Gain [%] on held-out data that refutes coloured noise where these move less."""

SPARED = 3
"""Rounds that but rule something out, and do not count."""

BEHIND = 50.0
"""ΔBIC by measured motion from which an effect may hide behind noise at the forces."""


def grow(
    bench: Bench, start: Candidate, max_effects: int, *, errors: tuple[AbstractEffect, ...] = (), max_errors: int = 0
) -> Growth:
    """Extend a model until nothing more is found.

    **Arguments:** `bench`; `start`: the model to begin with; `max_effects`; `errors`: effects to look for alone first,
    at most `max_errors` of them (wrong numbers of a model that was given).

    **Returns:** a `Growth`.
    """
    first = stage_of_candidate(bench, start)
    growth = Growth(first, first)
    growth.baseline_runs = [held_out_run(bench, start, d) for d in bench.validation]
    growth.runs = growth.baseline_runs
    if errors:
        extend(dataclasses.replace(bench, catalogue=errors), growth, max_errors, errors)
    extend(bench, growth, max_effects, (*bench.catalogue, FlexibleForce()))
    rejudge(bench, growth)
    return growth


def extend(bench: Bench, growth: Growth, most: int, searched: tuple[AbstractEffect, ...]) -> None:
    """Rounds of looking and accepting, until nothing more is found or `most` effects were; what was only lent goes."""
    _rounds(bench, growth, most, searched)
    withdraw(growth)


def _rounds(bench: Bench, growth: Growth, most: int, searched: tuple[AbstractEffect, ...]) -> None:
    turn, free = 0, SPARED
    while (used := _round(beside_laws(bench, growth.stage), growth, most - turn, searched)) is not None:
        turn, free = (turn, free - 1) if used == 0 and free else (turn + 1, free)


def _round(bench: Bench, growth: Growth, left: int, searched: tuple[AbstractEffect, ...]) -> int | None:
    """One round, where so many effects may still be added: how many it took, 0 where it but ruled something out; None
    where nothing more is found."""
    relieve()
    known, told_from = len(growth.accepted), growth.ruled_out
    growth.stage = dataclasses.replace(growth.stage, ruled_out=growth.ruled_out)
    bench.progress.stage("looking for effects" if known == 0 else f"looking further ({known} found)")
    screening = look(growth.stage, bench.data[0], searched, bench.names, rng=bench.rng)
    growth.screening = screening
    growth.first = screening if growth.first is None else growth.first
    growth.unexplained = screening.fires
    if bench.out_of_step and not growth.stage.candidate.terms and heard(bench):
        growth.unexplained = True
        first = from_forces(bench, growth.stage, screening) if left > 0 else []
        return 1 if _accepted(bench, growth, first, Move.FORCE_EQUATION) else None
    closer = None
    if not screening.fires and not _strong(screening):
        closer = _behind_the_noise(bench, growth.stage, screening)
        if closer is None and wrong_entries(bench, growth.stage, screening, least=CLEAR):
            # A run that is out of step shows no entry to first order, and all it leaves passes for noise at the forces.
            closer = _closer(bench, growth.stage, screening)
        if closer is None:
            found = left > 0 and (
                _accepted(bench, growth, hidden_modes(bench, growth.stage, screening), Move.HIDDEN_MODE)
                or _accepted(bench, growth, from_forces(bench, growth.stage, screening), Move.FORCE_EQUATION)
            )
            return 1 if found else None
    if left <= 0:
        return None
    closer = _closer(bench, growth.stage, screening) if closer is None else closer
    before = len(growth.rejected)
    ranked = _refitted(bench, growth, screening, closer)
    if _accepted(bench, growth, ranked):
        return 1
    if growth.ruled_out != told_from:
        return 0
    if _given_up(growth.rejected[before:], ranked):
        # Far behind laws that do not hold, and looked for under what these leave.
        others = _without(bench, growth, searched, screening, ranked)
        second = [] if others is None else _refitted(bench, growth, *others)
        if _accepted(bench, growth, second, Move.SECOND_SCREENING):
            return 1
        ranked = compared(bench, growth.stage, ranked + second) if second else ranked
    refitted = frozenset(attempt.name for attempt in ranked)
    if _accepted(bench, growth, hidden_modes(bench, growth.stage, screening, refitted), Move.HIDDEN_MODE):
        return 1
    white = dataclasses.replace(bench, white=True)
    least = 100 * EXPLAINED if _moves(bench) else HALVED
    free = _under_white_noise(white, growth, screening, ranked)
    if _accepted(white, growth, free, Move.WHITE_NOISE, least=least, most=1):
        return 1
    if _accepted(bench, growth, _unsure(growth, ranked, before), Move.KNOWN_SHAPE, given_shape=True):
        return 1
    refuted = screening.fires and _refuted(bench, growth, ranked, searched)
    growth.unexplained = screening.fires and not refuted
    # What is lent its place needs another round to redeem it.
    return 1 if not refuted and left > 1 and _lent(bench, growth, ranked) else None


def _closer(bench: Bench, stage: Stage, screening: Screening) -> Screening:
    """The ranking under the chain of the gate, or under its own where that shows nothing."""
    closer = look_closer(stage, bench.data[0], bench.catalogue, bench.names, screening.chain)
    return closer if closer.shows else look_closer(stage, bench.data[0], bench.catalogue, bench.names)


def _under_white_noise(bench: Bench, growth: Growth, screening: Screening, ranked: list[Attempt]) -> list[Attempt]:
    """Candidates refitted under white noise, best first, none without other data to judge them by; begun as any, and
    where they ended under the noise that was estimated (`ranked`).

    Where a second effect is missing, the noise model that is estimated passes most of the residual for coloured noise,
    and its criterion then asks what the noise is like and not what brings the free run nearer.
    """
    stage, data = growth.stage, bench.data[0]
    if not bench.validation or growth.credit is not None:
        return []
    chain = white_chain(stage.e, data.kept, stage.system)
    simulated = dataclasses.replace(screening, scores=screening.first, chain=chain)
    closer = look_closer(stage, data, bench.catalogue, bench.names, chain, renewed=False)

    def again(attempt: Attempt) -> Attempt:
        bench.progress.stage(f"refitting {attempt.name[0]} at {attempt.name[1]} for the free run")
        return dataclasses.replace(by_free_run(bench, growth, attempt), chain=chain)

    both = compared(bench, stage, _refitted(bench, growth, simulated, closer) + side_by_side(again, ranked))
    # Of two refits of one law the better.
    best = [a for k, a in enumerate(both) if a.name not in {better.name for better in both[:k]}]
    # A mode rings as coloured noise does.
    lasting = [a for a in best if not is_local(bench, a.score.shape.effect) and not adds_mode(a.score.shape.effect)]
    # What coloured noise explains as well is no law: each model with the noise that it is estimated to leave.
    own = dataclasses.replace(bench, white=False)
    coloured = estimate_chain(stage.e, data.kept, stage.system, stage.force).cost

    def evident(attempt: Attempt) -> bool:
        return coloured - chain_of(own, attempt.fit).cost - attempt.penalty >= ACCEPTED

    clear = (a for a in lasting if a.delta_bic > CLEAR and unresolved(a.fit, a.score) is None)
    return [attempt for attempt in clear if evident(attempt)]


def _moves(bench: Bench) -> bool:
    """Whether some held-out data move at every output about as the data of the fit do."""

    def size(data: Data) -> np.ndarray:
        y = np.where(data.kept, data.y, np.nan)[: data.samples]
        return np.nanstd(y, axis=0)

    return any(np.all(size(held) >= COMPARABLE * size(bench.data[0])) for held in bench.validation)


def _without(
    bench: Bench, growth: Growth, searched, screening: Screening, ranked: list[Attempt]
) -> tuple[Screening, Screening] | None:
    """The gate and the ranking without laws that were refitted and do not hold; None where nothing else is seen."""
    failed = {attempt.name[0] for attempt in ranked}
    shapes = (score.shape for score in screening.scores)
    gone = frozenset((s.effect.id, s.place.name) for s in shapes if s.effect.id in failed)
    stage = dataclasses.replace(growth.stage, ruled_out=growth.ruled_out | gone)
    screening = look(stage, bench.data[0], searched, bench.names, rng=bench.rng)
    return (screening, _closer(bench, stage, screening)) if screening.fires else None


def _strong(screening: Screening) -> bool:
    """Whether some candidate takes most of what is left, though the chain could pass it off as noise at the forces."""
    best = screening.first[0] if screening.first else None
    if best is None or best.delta_bic < CLEAR:
        return False
    return 1 - np.exp(-best.ratio / screening.rows) > 0.3


def _behind_the_noise(bench: Bench, stage: Stage, screening: Screening) -> Screening | None:
    """The ranking by measured motion where the gate is silent only because noise at the forces takes all; None where
    that shows nothing either.

    At large amplitudes the simulated motion is too far off for its features to count, and the chain then swallows the
    effect. What is found so must still hold on data that the fit has not seen.
    """
    if screening.chain.ratio == 0.0:
        return None
    closer = look_closer(stage, bench.data[0], bench.catalogue, bench.names)
    return closer if closer.scores and closer.scores[0].delta_bic > BEHIND else None


def _refuted(bench: Bench, growth: Growth, ranked: list[Attempt], searched: tuple[AbstractEffect, ...]) -> bool:
    """Whether the gate was wrong: it sees effects to first order, and none of those refitted holds.

    It must have opened to next to nothing, or barely, or stay shut under the noise that the best refit leaves: where it
    took noise at the forces for white, every effect seemed to explain some of it.
    """
    best = growth.screening.scores[0]
    if 1 - np.exp(-best.ratio / growth.screening.rows) < SLIGHT:
        return True
    if not ranked or any(attempt.delta_bic >= ACCEPTED for attempt in ranked):
        return False
    if best.delta_bic < 2 * growth.screening.threshold:
        return True
    chain = ranked[0].chain
    again = look(growth.stage, bench.data[0], searched, bench.names, chain=chain, rng=bench.rng)
    if again.fires or again.chain.ratio == 0.0:
        return False
    growth.screening = again
    return True


def _given_up(rejected: list[Rejected], ranked: list[Attempt]) -> set[tuple[str, str]]:
    """Laws that were not carried to their end, being far behind another."""
    behind = {(one.effect, one.location) for one in rejected if one.reason is Reason.DOMINATED}
    return behind - {attempt.name for attempt in ranked}


def _refitted(bench: Bench, growth: Growth, screening: Screening, closer: Screening) -> list[Attempt]:
    """The most promising candidates and what is easily taken for the best of them, refitted, best first."""
    stage, before = growth.stage, len(growth.rejected)
    chain = closer.chain if closer.shows else white_chain(stage.e, bench.data[0].kept, stage.system)
    listed = listed_with(shortlist(screening, closer), wrong_entries(bench, stage, screening))
    attempts = attempts_of(bench, stage, listed, chain, growth.rejected)
    ranked = compared(bench, stage, list(attempts.values()))
    if forced := from_forces(bench, stage, screening):
        both = compared(bench, stage, ranked + forced)
        # Of two refits of one law the better.
        ranked = [a for k, a in enumerate(both) if a.name not in {better.name for better in both[:k]}]
    if ranked:
        tried = {a.name for a in ranked} | {(one.effect, one.location) for one in growth.rejected[before:]}
        ids = look_alikes(ranked[0].score.shape.effect, bench.catalogue) - {effect for effect, _ in tried}
        others = unheard(ids, screening, closer, tried)
        late = instead_of(bench, stage, ranked[0], others, growth.rejected)
        behind = _given_up(growth.rejected[before:], ranked)
        late += left_behind(bench, stage, ranked[0], behind, (closer, screening), growth.rejected)
        ranked = compared(bench, stage, ranked + late) if late else ranked
    ranked = simplified(ranked)
    growth.tried |= {attempt.name: attempt.fit for attempt in ranked}
    return ranked


def _unsure(growth: Growth, ranked: list[Attempt], since: int) -> list[Attempt]:
    """Candidates that were refused in this round for the error of their size alone; they are no longer refused."""
    names = {(one.effect, one.location) for one in growth.rejected[since:] if one.reason is Reason.UNCERTAIN}
    growth.rejected[since:] = [one for one in growth.rejected[since:] if one.reason is not Reason.UNCERTAIN]
    return [attempt for attempt in ranked if attempt.name in names]


def _accepted(
    bench: Bench,
    growth: Growth,
    ranked: list[Attempt],
    move: Move = Move.SCORE_TEST,
    *,
    least: float = -np.inf,
    most: int | None = None,
    given_shape: bool = False,
) -> bool:
    """Accept the best candidate that holds and surely gains `least` [%], among the first `most`; whether one did.

    `given_shape`: with the errors that sizes have beside a shape that is known.
    """
    floor, unsure = floor_of(bench, ranked), []
    for k, attempt in enumerate(ranked[:most]):
        bench.progress.stage(f"judging {attempt.name[0]} at {attempt.name[1]}")
        why, gain, runs = judged(bench, growth, attempt, floor, given_shape)
        if why is None and gain.ci99_lower < least:
            words = f"coloured noise could do the same, and no more than {gain.ci99_lower:.0f} % is a sure gain"
            why = Refusal(Reason.NO_SURE_GAIN, words)
        if why is None:
            rivals, refused = _class_of(attempt, unsure + ranked[k + 1 :])
            # What was refused for its error alone, and explains as much or more, may be it all the same.
            names = {rival.name for rival in rivals}
            growth.rejected = [one for one in growth.rejected if (one.effect, one.location) not in names] + refused
            _take(bench, growth, Accepted(attempt, rivals, gain, runs, move))
            return True
        growth.rejected.append(Rejected.of(attempt.name, attempt.delta_bic, why, gain))
        unsure += [attempt] if why.reason is Reason.UNCERTAIN else []
    return False


def _take(bench: Bench, growth: Growth, accepted: Accepted) -> None:
    """Go on with a finding that holds, and with those on credit that it redeems."""
    growth.accepted.append(accepted)
    growth.fit, growth.runs = accepted.attempt.fit, accepted.runs
    growth.stage = stage_of_candidate(bench, growth.fit.candidate)
    growth.unexplained, growth.credit = False, None
    names = {one.attempt.name for one in growth.accepted}
    growth.rejected = [one for one in growth.rejected if (one.effect, one.location) not in names]
    prune(bench, growth)


def _lent(bench: Bench, growth: Growth, ranked: list[Attempt]) -> bool:
    """Whether to go on with the best candidate that nothing but its gain speaks against: it holds refitted for the free
    run, or is lent its place."""
    if not lendable(growth, ranked):
        return False
    floor = floor_of(bench, ranked)
    for k, attempt in enumerate(ranked):
        if attempt.delta_bic > CLEAR and unsound(Evidence(bench, growth, attempt, floor)) is None:
            rivals, free = _class_of(attempt, ranked[k + 1 :])[0], by_free_run(bench, growth, attempt)
            why, gain, runs = judged(bench, growth, free, floor)
            if why is None:
                _take(bench, growth, Accepted(free, rivals, gain, runs, Move.WITH_ANOTHER))
            else:
                lend(bench, growth, attempt, free, rivals, floor)
            return True
    return False


def _class_of(attempt: Attempt, others: list[Attempt]) -> tuple[tuple[Attempt, ...], list[Rejected]]:
    """What the record hardly tells from an attempt, among those that were refitted with it, and why not the rest."""
    rivals, refused = [], []
    for other in others:
        behind = other.criterion - attempt.criterion
        if behind <= -alike(attempt, other):
            continue
        if behind >= alike(attempt, other):
            words = f"explained better by {' at '.join(attempt.name)} (by {behind:.0f})"
            why = Refusal(Reason.EXPLAINED_BETTER, words)
        elif needless(other, attempt):
            words = f"the same as {attempt.name[0]} with a parameter that explains nothing"
            why = Refusal(Reason.NEEDLESS, words)
        elif (bound := at_bound(other.fit, len(other.fit.candidate.terms) - 1)) is not None:
            why = at_its_bound(bound)
        elif (other_law := unresolved(other.fit, other.score)) is not None:
            why = Refusal(Reason.OTHER_LAW, other_law)
        else:
            rivals.append(other)
            continue
        refused.append(Rejected.of(other.name, other.delta_bic, why))
    return tuple(rivals[:3]), refused


def recount(bench: Bench, growth: Growth, floor: np.ndarray) -> None:
    """Gains that add up: of every finding over what the findings before it leave, in units of one noise floor."""
    before, left = growth.baseline_runs, growth.start.e
    for k, accepted in enumerate(growth.accepted):
        now = accepted.attempt.fit.residual[0]
        if accepted.gain.held_out:
            seen, runs = runs_seen(bench, left, now, growth.start.e), (before, accepted.runs, growth.baseline_runs)
            gain = gain_of(*runs, floor, bench.names[1], held_out=True, rng=bench.rng, seen=seen)
            growth.accepted[k] = dataclasses.replace(accepted, gain=gain)
            before = accepted.runs
        left = now
