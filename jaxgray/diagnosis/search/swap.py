"""Findings and what was refitted beside them, compared once more in the model with later findings: what explains most
while others are missing need not do so beside them."""

import contextlib
import dataclasses

import numpy as np

from ...numerics.matrices.bounded import bounded
from ...numerics.progress import BudgetSpent
from .. import settings
from ..estimation.context import SearchContext, noise_model_of, stage_of_candidate
from ..estimation.continuation import ROUGH, in_short_steps
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import Attempt, called, called_by_contact, moving, renamed, unresolved
from ..estimation.significance import at_bound, evidence, significance
from ..findings import NOT_SIMULATED, Move, Reason, Refusal, Rejected
from ..model.free_run import on_the_same, overall
from ..model.parameter_vector import Layout
from ..noise.whitening import NoiseModel
from .confusable import alike, needless
from .state import MOST_COMPARED, SearchState, held_out_run, held_out_runs, is_local

STEPS = 20
"""Of each refit of a rival."""

PASSES = 3
"""Times that findings are compared beside laws that took another's place."""


def swap(context: SearchContext, state: SearchState) -> None:
    """Refit every rival of an earlier finding, and what was refitted with it and explained less, in its place in the
    model with all findings. What is far ahead takes the place; what is as good is of its class. The last finding's were
    refitted there, unless it took in a law that it contains, or another one took an earlier place; those before a law
    that took a place are compared beside it once more."""
    if state.fit is None or state.fit is state.compared_in:
        return
    last, swapped, ahead = len(state.accepted) - 1, False, len(state.accepted)
    for _ in range(PASSES):
        changed = 0
        for k, accepted in enumerate(state.accepted[:ahead]):
            new = any(np.isinf(rival.criterion) for rival in accepted.rivals)
            if new or (accepted.compared and (k < last or swapped)):
                _class_again(context, state, k)
                if state.accepted[k].attempt.name != accepted.attempt.name:
                    swapped, changed = True, k
        if not changed:
            break
        ahead = changed
    state.compared_in = state.fit


def conclude(context: SearchContext, state: SearchState) -> None:
    """The last refits of all findings together: `swap`, and steps whose error cannot be told from noise."""
    with contextlib.suppress(BudgetSpent):
        swap(context, state)
    if state.fit is not None:
        # Too small to change a decision, the error of the steps may still move values by more than their error bars.
        fine, _ = in_short_steps(context, state.fit)
        if fine is not state.fit and not _lost(context, state, fine):
            _go_on(context, state, fine)
        call_by_contact(context, state)


def call_by_contact(context: SearchContext, state: SearchState) -> None:
    """Call laws as the motion with all findings has them: beside other laws a gap has another width."""
    for k, accepted in enumerate(state.accepted if state.fit is not None else ()):
        law, before = called_by_contact(context, state.fit.candidate, k), accepted.attempt.name
        now = law.id, before[1]
        if now == before or now in {one.attempt.name for one in state.accepted}:
            continue
        state.fit = renamed(state.fit, before, law)
        state.stage = dataclasses.replace(state.stage, candidate=state.fit.candidate)
        state.rejected = [one for one in state.rejected if (one.effect, one.location) != now]
        rivals = tuple(rival for rival in accepted.rivals if rival.name != now)
        state.accepted[k] = dataclasses.replace(accepted, attempt=called(accepted.attempt, law), rivals=rivals)
        for j, later in enumerate(state.accepted[k + 1 :], k + 1):
            attempt = dataclasses.replace(later.attempt, fit=renamed(later.attempt.fit, before, law))
            state.accepted[j] = dataclasses.replace(later, attempt=attempt)


def _lost(context: SearchContext, state: SearchState, fit: Refit, farthest: float | None = None) -> bool:
    """Whether another refit of all findings leaves `farthest` times as much of the held-out data, by default what is
    much: what the data of the fit hardly determine went astray on the way."""
    farthest = 1 / settings.MUCH_NEARER if farthest is None else farthest
    runs = [held_out_run(context, fit.candidate, d) for d in context.validation]
    pairs = zip(*on_the_same(runs, state.runs))
    return not all(bounded(new.e) and overall(new.rmse, old.rmse) < farthest for new, old in pairs)


def _class_again(context: SearchContext, state: SearchState, k: int) -> None:
    accepted, noise_model = state.accepted[k], noise_model_of(context, state.fit)
    own = accepted.attempt
    here = _worth(context, state.fit, noise_model) + own.penalty
    # The finding itself, in the place that it has now.
    own_place = dataclasses.replace(own, fit=state.fit, criterion=here)
    members, known = [], [rival.name for rival in accepted.rivals]
    most, nothing = _most(context, state.fit, k, noise_model) if accepted.others else (np.inf, np.inf)
    for rival in _distinct(accepted.compared, {one.attempt.name for one in state.accepted}):
        context.progress.stage(f"judging {rival.name[0]} in the place of {own.name[0]}")
        bounds = (np.inf, np.inf) if rival.name in known else (most, nothing)
        fit = _beside(context, state, rival, k, noise_model, *bounds)
        if fit is not None:
            worth = _worth(context, fit, noise_model) + rival.penalty
            members.append(dataclasses.replace(rival, fit=fit, criterion=worth))
        elif rival.name in known:
            state.rejected.append(Rejected.of(rival.name, rival.delta_bic, NOT_SIMULATED))
    # What is as good keeps its place, unless its own size is no longer sure.
    sure = _sound(context, own_place, k)
    farthest = 1 + settings.MIN_RESIDUAL_SHARE if sure else None
    able = [member for member in members if _may_stand(context, state, member, k, farthest)]
    best = min(able, key=lambda member: member.criterion, default=own_place)
    if best is own_place or here - best.criterion < alike(best, own_place) * (1 if sure else -1):
        # A simpler law stands for it where later ones have taken upon themselves what it has beyond that.
        simpler = [member for member in able if needless(own_place, member)]
        best = min(simpler, key=lambda member: member.criterion, default=own_place)
    rivals, others = [], []
    for member in sorted((own_place, *members), key=lambda member: member.criterion):
        behind = member.criterion - best.criterion
        if member is best:
            continue
        unsure = member is own_place and not sure
        stands = member is own_place or member.name in known or any(one is member for one in able)
        if abs(behind) < alike(best, member) and stands and not unsure and not needless(member, best):
            rivals.append(dataclasses.replace(member, criterion=own.criterion + behind))
            continue
        words = f"explained better by {' at '.join(best.name)} once the others are in the model (by {behind:.0f})"
        why = Refusal(Reason.EXPLAINED_BETTER, words)
        if unsure:
            why = Refusal(Reason.UNCERTAIN, "of no sure size once the others are in the model")
        elif needless(member, best):
            words = (
                f"the same as {best.name[0]} with a parameter that explains nothing once the others are in the model"
            )
            why = Refusal(Reason.NEEDLESS, words)
        elif behind < 0:
            words = "beside the others of no sure size, at a bound, or farther from held-out data"
            why = Refusal(Reason.UNCERTAIN, words)
        state.rejected = [one for one in state.rejected if (one.effect, one.location) != member.name]
        state.rejected.append(Rejected.of(member.name, member.delta_bic, why))
        state.tried[member.name] = member.fit
        others += [member] if behind < settings.MAX_CRITERION_GAP else []
    names = {best.name, *(rival.name for rival in rivals)}
    state.rejected = [one for one in state.rejected if (one.effect, one.location) not in names]
    classes = {"rivals": tuple(rivals[:MOST_COMPARED]), "others": tuple(others[:MOST_COMPARED])}
    state.accepted[k] = dataclasses.replace(accepted, **classes)
    if best is not own_place:
        in_its_round = _in_its_round(context, own.fit, best, k)
        runs = held_out_runs(context, in_its_round.candidate, accepted.runs)
        attempt = dataclasses.replace(best, fit=in_its_round, criterion=own.criterion)
        changes = {"attempt": attempt, "runs": runs, "move": Move.IN_ITS_PLACE}
        state.accepted[k] = dataclasses.replace(state.accepted[k], **changes)
        _go_on(context, state, best.fit)


def _distinct(attempts: tuple[Attempt, ...], there: set[tuple[str, str]]) -> list[Attempt]:
    """The first attempt of every name, without those that are there."""
    return list({one.name: one for one in reversed(attempts) if one.name not in there}.values())[::-1]


def _may_stand(context: SearchContext, state: SearchState, member: Attempt, k: int, farthest: float | None) -> bool:
    """Whether a law holds in the place of the k-th term: it has a size, is at no bound and no other law there, is
    judged on the same data, and is not `_lost` on those that are held out."""
    own, given = state.accepted[k].attempt, context.simulator.setup.own
    laws = own.score.shape.effect, member.score.shape.effect
    if is_local(context, laws[0]) != is_local(context, laws[1]) or not _sound(context, member, k):
        return False
    return at_bound(member.fit, k, given) is None and not _lost(context, state, member.fit, farthest)


def _in_its_round(context: SearchContext, before: Refit, best: Attempt, k: int) -> Refit:
    """A law refitted in the place of another one as it was in its round, which its share and its gain are of."""
    terms = before.candidate.terms
    if len(terms) != k + 1:
        return before
    begin = before.candidate.with_terms((*terms[:-1], best.fit.candidate.terms[k]))
    noise_model = noise_model_of(context, before)
    fit = refit(context.simulator, begin, context.data, noise_model, held=context.held, max_steps=STEPS)
    return before if fit is None else fit


def _sound(context: SearchContext, member: Attempt, k: int) -> bool:
    """Whether a law has a size in the place of the k-th term, and is no other law there."""
    size = significance(member.fit, Layout(context.simulator.setup, member.fit.candidate), k)
    return size >= settings.MIN_STANDARD_ERRORS_IF_CLEAR and unresolved(member.fit, member.score) is None


def _go_on(context: SearchContext, state: SearchState, fit: Refit) -> None:
    """Let another refit of all findings stand for the whole model."""
    state.fit, state.stage = fit, stage_of_candidate(context, fit.candidate)
    state.runs = [held_out_run(context, fit.candidate, d) for d in context.validation]
    attempt = dataclasses.replace(state.accepted[-1].attempt, fit=fit)
    state.accepted[-1] = dataclasses.replace(state.accepted[-1], attempt=attempt, runs=state.runs)


def _beside(
    context: SearchContext,
    state: SearchState,
    rival: Attempt,
    k: int,
    noise_model: NoiseModel,
    most: float,
    nothing: float,
) -> Refit | None:
    """A rival in the place of the k-th term, refitted from M, D, K of the model with all findings and from its own:
    laws differ in the stiffness that they take upon themselves. None where its cost remains above `most`; `nothing`:
    that of the other findings as they are, with no law there."""
    term = next(t for t in rival.fit.candidate.terms if (t.effect.id, t.place.name) == rival.name)
    terms = tuple(term if j == k else t for j, t in enumerate(state.fit.candidate.terms))
    held = context.held
    options = {"held": held, "max_steps": STEPS, "tolerance": ROUGH}
    # From its own M, D, K the way may be slow, but it is no wrong one unless it leaves more than the others alone.
    begun = (state.fit.candidate, most), (rival.fit.candidate, nothing)
    # In steps as a search begins with: most rivals are far behind in any.
    coarse = context.simulator.coarse
    fits = [
        refit(coarse, begin.with_terms(terms), context.data, noise_model, abandon=abandon, **options)
        for begin, abandon in begun
    ]
    best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.cost, default=None)
    if best is None or best.cost > most:
        return None
    return refit(context.simulator, best.candidate, context.data, noise_model, held=held, max_steps=STEPS)


def _most(context: SearchContext, fit: Refit, k: int, noise_model: NoiseModel) -> tuple[float, float]:
    """Cost under a noise model, in steps as a search begins with, from which something is far behind a refit; and that
    of its model with the k-th term left out, all else as it is."""
    without = fit.candidate.with_terms(term for j, term in enumerate(fit.candidate.terms) if j != k)
    options = {"held": context.held, "max_steps": 0}
    here, bare = (
        refit(context.simulator.coarse, candidate, context.data, noise_model, **options)
        for candidate in (fit.candidate, without)
    )
    if here is None:
        return np.inf, np.inf
    most = here.cost * np.exp(settings.MAX_CRITERION_GAP / here.count)
    return most, np.inf if bare is None else max(bare.cost, most)


def _worth(context: SearchContext, fit: Refit, noise_model: NoiseModel) -> float:
    cost, rows = evidence(*moving(context, fit), context.data[0], noise_model)
    return float(rows * np.log(max(cost, 1e-300)))
