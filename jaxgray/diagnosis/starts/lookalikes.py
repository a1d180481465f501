"""Look-alikes of the best law of a round that were not among those tried, refitted from where its refit ended."""

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import Attempt, by_contact, criterion_of, dominated
from ..findings import NOT_SIMULATED, Rejected
from ..screening.linearization import Stage
from ..screening.score_test import Score, Screening
from ..screening.shortlist import same_start


def untried_look_alikes(
    ids: frozenset[str], screening: Screening, closer: Screening, tried: set[tuple[str, str]]
) -> list[list[Score]]:
    """Candidates of the given laws, each at the place where it explains most, with the shapes to start from.

    Of the laws that differ in their name alone, one is tried at a place; `tried`: laws and places of the round so far.
    """
    listed, known = [], set(tried)
    for effect_id in sorted(ids):
        scores: list[Score] = []
        for table in (closer.scores, screening.scores, screening.white):
            best = next((score for score in table if score.shape.effect.id == effect_id), None)
            if best is None or best.delta_bic < settings.MIN_DELTA_BIC:
                continue
            if not scores or (scores[0].shape.place.name == best.shape.place.name and not same_start(best, scores[0])):
                scores.append(best)
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


def refit_look_alikes(
    context: SearchContext, stage: Stage, best: Attempt, listed: list[list[Score]], rejected: list[Rejected]
) -> list[Attempt]:
    """Refits of laws that stand in the place of the best one, those that do not end far behind it.

    **Arguments:** `context`; `stage`: without the best one; `best`; `listed`: scores of every law to hear; `rejected`:
    takes those that end far behind.
    """
    ends = side_by_side(lambda scores: _refit_look_alike(context, stage, best, scores), listed)
    rejected += [end for end in ends if isinstance(end, Rejected)]
    return [end for end in ends if isinstance(end, Attempt)]


def refit_at_other_places(
    context: SearchContext, stage: Stage, best: Attempt, listed: list[list[Score]]
) -> list[Attempt]:
    """The law of the best one where its refit ends better at another place, that place carried to its end; none where
    none does. Arguments as of `refit_look_alikes`."""
    most, abandon = _reached(context, best)
    ends = side_by_side(lambda scores: _from_best(context, best, scores, abandon), listed)
    ends = [end for end in ends if end is not None and criterion_of(context, *end) < most]
    if not ends:
        return []
    return [_at_end(context, stage, *min(ends, key=lambda end: criterion_of(context, *end)))]


def _refit_look_alike(context: SearchContext, stage: Stage, best: Attempt, scores: list[Score]) -> Attempt | Rejected:
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
    return _at_end(context, stage, *found)


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
    known = dict(zip((p.name for p in last.effect.parameters), last.values))
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


def _at_end(context: SearchContext, stage: Stage, score: Score, fit: Refit) -> Attempt:
    context.progress.stage(f"refining {score.shape.effect.id} at {score.shape.place.name}")
    end = refit_to_convergence(context, fit)
    return by_contact(context, Attempt(score, end, noise_model_of(context, end)), stage)
