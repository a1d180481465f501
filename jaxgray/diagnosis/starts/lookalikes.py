"""Look-alikes of the best law of a round that were not among those tried, refitted from where its refit ended, and that
law at other places, from there and from the model without it."""

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import Attempt, by_contact, criterion_of, dominated, first_fit, unresolved
from ..findings import NOT_SIMULATED, Rejected
from ..screening.linearization import Stage
from ..screening.score_test import Score, Screening, best_by_place
from ..screening.shortlist import same_start


def untried_look_alikes(
    ids: frozenset[str], best: Attempt, screening: Screening, closer: Screening, tried: set[tuple[str, str]]
) -> list[list[Score]]:
    """Candidates of the given laws, each at the place where it explains most, or at that of the best one where it
    explains nothing to first order, with the shapes to start from.

    Of the laws that differ in their name alone, one is tried at a place; `tried`: laws and places of the round so far.
    """
    listed, known = [], set(tried)
    tables = closer.scores, screening.scores, screening.white
    for effect_id in sorted(ids):
        found = [next((score for score in table if score.shape.effect.id == effect_id), None) for table in tables]
        found = [score for score in found if score is not None and score.delta_bic >= settings.MIN_DELTA_BIC]
        found = found or [best_by_place(table).get((effect_id, best.name[1])) for table in tables]
        scores: list[Score] = []
        for score in filter(None, found):
            same = not scores or scores[0].shape.place.name == score.shape.place.name
            if same and not any(same_start(score, other) for other in scores):
                scores.append(score)
        place = scores[0].shape.place.name if scores else ""
        if not scores or any((name, place) in known for name in scores[0].shape.effect.by_contact):
            continue
        known.add((effect_id, place))
        listed.append(scores[:2])
    return listed


def contained_laws(best: Attempt, screening: Screening, closer: Screening) -> list[list[Score]]:
    """The laws that the best one contains, at its place, with the shapes to start from."""
    tables = [table.best_by_place() for table in (closer, screening)]
    names = [(effect, best.name[1]) for effect in best.score.shape.effect.contains]
    listed = [[table[name] for table in tables if name in table][:1] for name in names]
    return [scores for scores in listed if scores]


def at_other_places(
    best: Attempt, screening: Screening, closer: Screening, tried: set[tuple[str, str]]
) -> list[list[Score]]:
    """The law of the best one at its other places, unless `tried`: where a law has taken much of the motion to itself,
    scores of first order, which are about the model without it, hardly tell its places apart."""
    effect, found = best.score.shape.effect, {}
    for table in (closer, screening):
        for name, score in table.best_by_place().items():
            if name[0] == effect.id and name not in tried:
                found.setdefault(name, [score])
    return list(found.values())


def as_likely_places(best: Attempt, screening: Screening, closer: Screening) -> list[Score]:
    """Scores of the law of the best one where another place explains about as much as its own, to first order: at these
    and at its own."""
    effect, found = best.score.shape.effect, {}
    for table in (closer, screening):
        here = table.best_by_place()
        own = here.get(best.name)
        for name, score in here.items():
            near = own and score.delta_bic > max(own.delta_bic - settings.MAX_CRITERION_GAP, settings.MIN_DELTA_BIC)
            if name[0] == effect.id and near:
                found.setdefault(name, score)
    return list(found.values()) if len(found) > 1 else []


def refit_look_alikes(
    context: SearchContext, best: Attempt, listed: list[list[Score]], rejected: list[Rejected]
) -> list[Attempt]:
    """Refits of laws that stand in the place of the best one, those that do not end far behind it.

    **Arguments:** `context`; `best`; `listed`: scores of every law to refit; `rejected`: takes those that end far
    behind.
    """
    ends = side_by_side(lambda scores: _refit_look_alike(context, best, scores), listed)
    rejected += [end for end in ends if isinstance(end, Rejected)]
    return [end for end in ends if isinstance(end, Attempt)]


def refit_at_other_places(
    context: SearchContext, stage: Stage, best: Attempt, listed: list[list[Score]], near: list[Score]
) -> list[Attempt]:
    """The law of the best one where its refit ends better at another place, or from another start: the place from which
    it ends best carried to its end, from where the best one ended and from the model without it each; none where none
    does. Arguments as of `refit_look_alikes`; `near`: scores to begin with from `stage`, the model without it."""
    most, abandon = _reached(context, best)
    moved = side_by_side(lambda scores: _from_best(context, best, scores, abandon), listed)

    def begun(score):
        fit = first_fit(context, stage, score, best.noise_model, most)
        return None if fit is None or unresolved(fit, score) is not None else (score, fit)

    ends = []
    for found in moved, side_by_side(begun, near):
        found = [end for end in found if end is not None and criterion_of(context, *end) < most]
        ends += [min(found, key=lambda end: criterion_of(context, *end))] if found else []
    return [_at_end(context, *end) for end in ends]


def _refit_look_alike(context: SearchContext, best: Attempt, scores: list[Score]) -> Attempt | Rejected:
    """The refit of a law from where the best one's refit ended, or why there is none; under the name that its contact
    gives it."""
    name = scores[0].shape.effect.id, scores[0].shape.place.name
    context.progress.stage(f"refitting {name[0]} at {name[1]}")
    most, _ = _reached(context, best)
    found = _from_best(context, best, scores)
    if found is None:
        return Rejected.of(name, scores[0].delta_bic, NOT_SIMULATED)
    behind = criterion_of(context, *found) - most
    if behind > settings.MAX_CRITERION_GAP:
        return Rejected.of(name, scores[0].delta_bic, dominated(behind))
    return _at_end(context, *found)


def _reached(context: SearchContext, best: Attempt) -> tuple[float, float]:
    """Criterion and cost of the best one, with the samples counted that others are compared with it under."""
    options = {"held": context.held, "max_steps": 3, "tolerance": ROUGH}
    again = refit(context.simulator, best.fit.candidate, context.data, best.noise_model, **options)
    fit = best.fit if again is None else again
    return criterion_of(context, best.score, fit), fit.cost


def _from_best(
    context: SearchContext, best: Attempt, scores: list[Score], abandon: float = np.inf
) -> tuple[Score, Refit] | None:
    """A first refit from where the best one's ended: parameters of the same name begin with the same values, and with
    those of each score's own shape."""
    last, found = best.fit.candidate.terms[-1], None
    known = last.effect.named_values(last.values)
    options = {"held": context.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
    for score in scores:
        shape = score.shape.term(score.weights)
        alike = np.array([known.get(p.name, value) for p, value in zip(shape.effect.parameters, shape.values)], float)
        for values in (alike, np.array(shape.values, float)):
            term = Term(shape.effect, shape.place, shape.effect.bounded(values))
            begin = best.fit.candidate.with_terms((*best.fit.candidate.terms[:-1], term))
            trial = refit(context.simulator, begin, context.data, best.noise_model, **options)
            if trial is not None and (
                found is None or criterion_of(context, score, trial) < criterion_of(context, *found)
            ):
                found = score, trial
            if np.array_equal(alike, shape.values):
                break
    return found


def _at_end(context: SearchContext, score: Score, fit: Refit) -> Attempt:
    context.progress.stage(f"refining {score.shape.effect.id} at {score.shape.place.name}")
    end = refit_to_convergence(context, fit)
    return by_contact(context, Attempt(score, end, noise_model_of(context, end)))
