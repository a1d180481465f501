"""What newer findings make of the older: laws that are part of a wider one, and terms that are needless now.

The newest may be the needless one: where the others were not yet at their best values, a refit together with any law
brings them there, and that law gets the credit.
"""

import dataclasses
import itertools

import numpy as np

from ...mechanics.effects.base import AbstractForceEffect, Term
from ...numerics.matrices.bounded import bounded
from .. import settings
from ..estimation.context import SearchContext, noise_model_of, stage_of_candidate
from ..estimation.gauss_newton import Refit, refit, with_states
from ..estimation.multistart import moving, shape_penalty
from ..estimation.significance import evidence, significance
from ..findings import NEEDLESS_NOW, Reason, Refusal, Rejected
from ..model.candidate import Candidate
from ..model.parameter_vector import Layout
from ..screening.features import Shape
from ..starts.force_matching import imitating
from .confusable import resemble
from .state import SearchState, held_out_run


def prune(context: SearchContext, state: SearchState) -> None:
    """Make one law of the newest and of what it contains or resembles, and drop the terms that the newer ones have made
    needless."""
    _unite(context, state)
    _unite_alike(context, state)
    while len(state.accepted) > 1 and _dropped(context, state):
        pass


def _unite(context: SearchContext, state: SearchState) -> None:
    """Let the newest law stand alone, in the place of a simpler one that it contains and that was accepted where it
    acts: beside it, what both name is shared between them at will."""
    terms = state.fit.candidate.terms
    wide, accepted = terms[-1], state.accepted[-1]
    inside = [t.effect.id in wide.effect.contains and t.place == wide.place for t in terms[:-1]]
    if not any(inside):
        return
    k = inside.index(True)
    whole = (*terms[:k], _sum_of(wide, terms[k]), *terms[k + 1 : -1])
    found = _instead(context, state, state.fit.candidate.with_terms(whole))
    if found is None:
        return
    fit, ratio, rows = found
    gone = state.accepted[k]
    change = ratio - gone.attempt.score.shape.free * np.log(rows)
    if change >= settings.MIN_DELTA_BIC:
        return
    why = f"contained in {wide.effect.id}, which explains as much alone"
    state.rejected.append(Rejected.of(gone.attempt.name, change, Refusal(Reason.NEEDLESS, why)))
    # What stood for either of them was refitted beside other terms; it is compared with their sum at the end.
    known = {r.name: r for r in (*gone.rivals, *accepted.rivals) if r.name != accepted.attempt.name}
    rivals = tuple(dataclasses.replace(r, criterion=np.inf) for r in known.values())
    worth = accepted.attempt.delta_bic + gone.attempt.delta_bic - change
    attempt = dataclasses.replace(accepted.attempt, fit=gone.attempt.fit, delta_bic=float(worth))
    state.accepted.pop()
    state.accepted[k] = dataclasses.replace(accepted, attempt=attempt, rivals=rivals, runs=gone.runs)
    _take(context, state, fit)
    if k == len(state.accepted) - 1:
        _credit(state, 0.0)


def _unite_alike(context: SearchContext, state: SearchState) -> None:
    """Let one law stand for two that resemble each other where both act: two springs that harden may have stood for a
    third while another law was missing. Begun where it imitates both."""
    terms = state.fit.candidate.terms
    for i, j in itertools.combinations(range(len(terms)), 2):
        one, two = terms[i], terms[j]
        forces = isinstance(one.effect, AbstractForceEffect) and isinstance(two.effect, AbstractForceEffect)
        alike = forces and one.place == two.place and resemble(one.effect, two.effect)
        if alike and _one_for_both(context, state, i, j):
            return


def _one_for_both(context: SearchContext, state: SearchState, i: int, j: int) -> bool:
    """Put one law in the place of the i-th and the j-th where it explains as much; whether one does."""
    terms, (gone, kept) = state.fit.candidate.terms, (state.accepted[i], state.accepted[j])
    scales, place, found = kept.attempt.score.shape.scales, terms[j].place, []
    taken = {t.effect.id for k, t in enumerate(terms) if k not in (i, j) and t.place == place}
    for law in (law for law in context.catalogue if resemble(law, terms[j].effect) and law.id not in taken):
        own = (terms[k].values for k in (i, j) if terms[k].effect.id == law.id)
        values = [np.asarray(one, dtype=float) for one in (*law.shapes(scales), *own)]
        shapes = [Shape(law, place, one, tuple(law.basis(one)), scales, len(values)) for one in values]
        context.progress.stage(f"refitting {law.id} at {place.name}")
        for start in imitating(context, state.fit.candidate, (i, j), shapes):
            made = _instead(context, state, start.candidate)
            if made is not None and law.unresolved(np.array(made[0].candidate.terms[j - 1].values), scales) is None:
                fewer = gone.attempt.score.shape.free + kept.attempt.score.shape.free - shapes[0].free
                found.append((made[1] - fewer * np.log(made[2]), shapes[0], made[0]))
    found = sorted(found, key=lambda one: one[0])
    if not found or found[0][0] >= settings.MIN_DELTA_BIC:
        return False
    change, shape, fit = found[0]
    name = shape.effect.id, place.name
    why = Refusal(Reason.NEEDLESS, f"part of {shape.effect.id}, which explains as much as both")
    state.rejected = [one for one in state.rejected if (one.effect, one.location) != name]
    was = [one.attempt.name for one in (gone, kept) if one.attempt.name != name]
    state.rejected += [Rejected.of(one, change, why) for one in was]
    worth = float(gone.attempt.delta_bic + kept.attempt.delta_bic - change)

    def attempt(shape, **more):
        score = dataclasses.replace(kept.attempt.score, shape=shape)
        penalty = shape_penalty(context, score)
        return dataclasses.replace(kept.attempt, score=score, penalty=penalty, delta_bic=worth, **more)

    # What explains as much in their place is compared with it at the end.
    near = {one.effect.id: (one, fit) for change, one, fit in reversed(found) if change < settings.MIN_DELTA_BIC}
    rivals = [attempt(one, fit=fit, criterion=np.inf) for law, (one, fit) in near.items() if law != name[0]]
    del state.accepted[i]
    state.accepted[j - 1] = dataclasses.replace(kept, attempt=attempt(shape), rivals=tuple(rivals), others=())
    _take(context, state, fit)
    if j == len(terms) - 1:
        _credit(state, 0.0)
    return True


def _sum_of(wide: Term, simple: Term) -> Term:
    """The wider law with the part of the simpler one as well, or nearly: where a refit of it alone begins."""
    values = np.array(wide.values, dtype=float)
    sizes = [p.amplitude for p in wide.effect.parameters]
    known = simple.effect.named_values(simple.values)
    part = wide.effect.widened(np.where(sizes, 0.0, values), known)
    return Term(wide.effect, wide.place, wide.effect.bounded(np.where(sizes, values + part, values)))


def _dropped(context: SearchContext, state: SearchState) -> bool:
    """Drop one accepted term that explains nothing beside the others; whether there was one."""
    layout = Layout(context.simulator.setup, state.fit.candidate)
    for k in range(len(state.accepted)):
        if significance(state.fit, layout, k) >= settings.MIN_STANDARD_ERRORS:
            continue
        terms = tuple(t for j, t in enumerate(state.fit.candidate.terms) if j != k)
        found = _instead(context, state, state.fit.candidate.with_terms(terms))
        if found is None:
            continue
        gone = state.accepted[k].attempt
        fit, ratio, rows = found
        change = ratio - gone.score.shape.free * np.log(rows)
        if change < settings.MIN_DELTA_BIC:
            state.accepted.pop(k)
            state.rejected.append(Rejected.of(gone.name, change, NEEDLESS_NOW))
            _take(context, state, fit)
            if k == len(state.accepted):
                _credit(state, gone.delta_bic - change)
            return True
    return False


def _credit(state: SearchState, delta_bic: float) -> None:
    """Give the last finding its better values, and what they are worth."""
    last = state.accepted[-1]
    attempt = dataclasses.replace(last.attempt, fit=state.fit, delta_bic=last.attempt.delta_bic + delta_bic)
    state.accepted[-1] = dataclasses.replace(last, attempt=attempt)


def _instead(context: SearchContext, state: SearchState, candidate: Candidate) -> tuple[Refit, float, int] | None:
    """A candidate with less in it, refitted, and by how much the likelihood ratio speaks for the present model, over
    so many samples; None where it cannot be simulated, on held-out data neither."""
    noise_model = noise_model_of(context, state.fit)
    fit = refit(context.simulator, candidate, context.data, noise_model, held=context.held)
    if fit is None:
        return None
    with_it, rows = evidence(*moving(context, state.fit), context.data[0], noise_model)
    without_it, _ = evidence(*moving(context, fit), context.data[0], noise_model)
    held_out = (held_out_run(context, fit.candidate, d).e for d in context.validation)
    if not bounded(np.array([with_it, without_it]), *held_out):
        return None
    return fit, float(rows * np.log(without_it / with_it)), rows


def _take(context: SearchContext, state: SearchState, fit: Refit) -> None:
    """Go on from another refit."""
    fit = with_states(context.simulator, fit, context.data)
    state.fit, state.stage = fit, stage_of_candidate(context, fit.candidate)
    state.runs = [held_out_run(context, fit.candidate, d) for d in context.validation]
    state.accepted[-1] = dataclasses.replace(state.accepted[-1], runs=state.runs)
