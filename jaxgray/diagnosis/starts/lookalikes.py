"""Look-alikes of the best law of a round that were not among those tried, refitted from where its refit ended."""

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.side_by_side import side_by_side
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

    Of the laws that differ in their name alone, one is heard at a place; `tried`: laws and places of the round so far.
    """
    listed, contacts = [], {place for law, place in tried if law in settings.CONTACT}
    for effect_id in sorted(ids):
        scores: list[Score] = []
        for table in (closer.scores, screening.scores, screening.white):
            best = next((score for score in table if score.shape.effect.id == effect_id), None)
            if best is None or best.delta_bic < settings.MIN_DELTA_BIC:
                continue
            if not scores or (scores[0].shape.place.name == best.shape.place.name and not same_start(best, scores[0])):
                scores.append(best)
        if not scores or (effect_id in settings.CONTACT and scores[0].shape.place.name in contacts):
            continue
        if effect_id in settings.CONTACT:
            contacts.add(scores[0].shape.place.name)
        listed.append(scores[:2])
    return listed


def contained_laws(best: Attempt, screening: Screening, closer: Screening) -> list[list[Score]]:
    """The laws that the best one contains, at its place, with the shapes to start from."""
    tables = [table.best_by_place() for table in (closer, screening)]
    names = [(effect, best.name[1]) for effect in best.score.shape.effect.contains]
    listed = [[table[name] for table in tables if name in table][:1] for name in names]
    return [scores for scores in listed if scores]


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


def _refit_look_alike(context: SearchContext, stage: Stage, best: Attempt, scores: list[Score]) -> Attempt | Rejected:
    """The refit of a law from where the best one's refit ended, or why there is none: parameters of the same name begin
    with the same values; under the name that its contact gives it."""
    name = scores[0].shape.effect.id, scores[0].shape.place.name
    context.progress.stage(f"refitting {name[0]} at {name[1]}")
    noise_model, fit = best.noise_model, best.fit
    last = fit.candidate.terms[-1]
    known = dict(zip((p.name for p in last.effect.parameters), last.values))
    # Under the noise model, and with the samples counted, that the other is compared under.
    again = refit(
        context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=3, tolerance=ROUGH
    )
    most = criterion_of(context, best.score, fit if again is None else again) + settings.MAX_CRITERION_GAP
    found: tuple[Score, Refit] | None = None
    for score in scores:
        shape = score.shape.term(score.weights)
        alike = np.array([known.get(p.name, value) for p, value in zip(shape.effect.parameters, shape.values)], float)
        for values in (alike, np.array(shape.values, float)):
            term = Term(shape.effect, shape.place, shape.effect.bounded(values))
            begin = fit.candidate.with_terms((*fit.candidate.terms[:-1], term))
            trial = refit(
                context.simulator, begin, context.data, noise_model, held=context.held, max_steps=10, tolerance=ROUGH
            )
            if trial is not None and (
                found is None or criterion_of(context, score, trial) < criterion_of(context, *found)
            ):
                found = score, trial
            if np.array_equal(alike, shape.values):
                break
    if found is None:
        return Rejected.of(name, scores[0].delta_bic, NOT_SIMULATED)
    behind = criterion_of(context, *found) - most + settings.MAX_CRITERION_GAP
    if behind > settings.MAX_CRITERION_GAP:
        return Rejected.of(name, scores[0].delta_bic, dominated(behind))
    context.progress.stage(f"pursuing {name[0]} at {name[1]}")
    end = refit_to_convergence(context, found[1])
    return by_contact(context, Attempt(found[0], end, noise_model_of(context, end)), stage)
