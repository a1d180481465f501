"""What a round of the search refits: rankings under several noise models, and their candidates, best first."""

import dataclasses

import numpy as np

from .. import settings
from ..estimation.context import SearchContext
from ..estimation.multistart import Attempt, attempts_of, compared
from ..estimation.profile_scan import predictable
from ..findings import Reason, Rejected
from ..model.own_laws import told_apart
from ..noise.floor import more_than_noise
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage, screen_simulated, screen_smoothed
from ..screening.score_test import Screening
from ..screening.shortlist import listed_with, shortlist
from ..starts.equation_error import from_first_trials, from_forces
from ..starts.force_matching import force_matched
from ..starts.lookalikes import (
    as_likely_places,
    at_other_places,
    contained_laws,
    refit_at_other_places,
    refit_look_alikes,
    untried_look_alikes,
)
from ..starts.other_models import from_other_models
from ..starts.user_model import wrong_entries
from ..starts.windows import changes_over_time
from .confusable import look_alikes
from .state import SearchState


def refitted(context: SearchContext, state: SearchState, screening: Screening, closer: Screening) -> list[Attempt]:
    """The most promising candidates and what is easily taken for the best of them, refitted, best first."""
    stage, before = state.stage, len(state.rejected)
    noise_model = closer.noise_model if closer.shows else white_noise_model(stage.e, context.data[0].kept, stage.system)
    listed = listed_with(shortlist(screening, closer), wrong_entries(context, stage, screening))
    known = changes_over_time(context, stage, screening)
    if context.trials_at_once:
        known |= {a.name: (a.score, a.fit) for a in from_first_trials(context, stage, screening)}
    listed = [scores for scores in listed if (scores[0].shape.effect.id, scores[0].shape.place.name) not in known]
    attempts = attempts_of(context, stage, listed, noise_model, state.rejected, known)
    ranked = compared(context, stage, list(attempts.values()))
    forced = from_forces(context, stage, screening)
    if not ranked or more_than_noise(ranked[0].fit.residual[0], context.data[0]):
        forced += [] if context.trials_at_once else from_first_trials(context, stage, screening)
        forced += from_other_models(context, stage)
    if forced:
        ranked = _better_ones(compared(context, stage, ranked + forced))
    if ranked:
        late, tried, behind = _look_alikes_tried(context, state, ranked, (closer, screening), before)
        if predictable(ranked[0].noise_model):
            elsewhere = at_other_places(ranked[0], screening, closer, tried - behind)
            near = as_likely_places(ranked[0], screening, closer)
            late += refit_at_other_places(context, stage, ranked[0], elsewhere, near)
        ranked = _better_ones(compared(context, stage, ranked + late)) if late else ranked
    ranked = narrowed(context, stage, ranked, screening, closer)
    state.tried |= {attempt.name: attempt.fit for attempt in ranked}
    return ranked


def _look_alikes_tried(
    context: SearchContext,
    state: SearchState,
    ranked: list[Attempt],
    screenings: tuple[Screening, Screening],
    before: int,
) -> tuple[list[Attempt], set[tuple[str, str]], set[tuple[str, str]]]:
    """Refits of what is easily taken for the best law, from where it ended or where they push as it does; what was
    tried, and what was given up far behind, of the refusals from the one numbered `before` on."""
    closer, screening = screenings
    tried = {a.name for a in ranked} | {(one.effect, one.location) for one in state.rejected[before:]}
    ids = look_alikes(ranked[0].score.shape.effect, context.catalogue) - {effect for effect, _ in tried}
    others = untried_look_alikes(ids, ranked[0], screening, closer, tried)
    late = refit_look_alikes(context, ranked[0], others, state.rejected)
    behind = given_up(state.rejected[before:], ranked)
    late += force_matched(context, ranked[0], behind, screenings, state.rejected)
    return late, tried, behind


def narrowed(
    context: SearchContext, stage: Stage, ranked: list[Attempt], screening: Screening, closer: Screening
) -> list[Attempt]:
    """The ranking, with simpler laws refitted from the end of a law that contains them: its lead may be only a better
    optimum. Done for the first law in the ranking that contains one which is not ahead of it: the best may not hold."""
    for k, attempt in enumerate(ranked):
        inside, ahead = contained_laws(attempt, screening, closer), {one.name for one in ranked[:k]}
        inside = [one for one in inside if (one[0].shape.effect.id, one[0].shape.place.name) not in ahead]
        if inside and attempt.delta_bic >= settings.MIN_DELTA_BIC:
            again = refit_look_alikes(context, attempt, inside, [])
            return _better_ones(compared(context, stage, ranked + again)) if again else ranked
    return ranked


def by_forces(context: SearchContext, stage: Stage, screening: Screening) -> list[Attempt]:
    """The first law of the force equation and its rivals (`from_forces`), with the simpler laws that they contain. The
    force equation itself knows no law of an input."""
    return narrowed(context, stage, from_forces(context, stage, screening), screening, screening)


def _better_ones(ranked: list[Attempt]) -> list[Attempt]:
    """Of several refits of one law the best, in the order they come in."""
    return [a for k, a in enumerate(ranked) if a.name not in {better.name for better in ranked[:k]}]


def given_up(rejected: list[Rejected], ranked: list[Attempt]) -> set[tuple[str, str]]:
    """Laws that were not carried to their end, being far behind another."""
    behind = {(one.effect, one.location) for one in rejected if one.reason is Reason.DOMINATED}
    return behind - {attempt.name for attempt in ranked}


def closer_screening(context: SearchContext, stage: Stage, screening: Screening) -> Screening:
    """The ranking under the noise model of the gate, or under its own where that shows nothing."""
    closer = screen_smoothed(stage, context.data[0], context.catalogue, context.names, screening.noise_model)
    return closer if closer.shows else screen_smoothed(stage, context.data[0], context.catalogue, context.names)


def strong(screening: Screening) -> bool:
    """Whether some candidate takes most of what is left, though the noise model could pass it off as noise at the
    forces."""
    best = screening.white[0] if screening.white else None
    if best is None or best.delta_bic < settings.CLEAR_DELTA_BIC:
        return False
    return 1 - np.exp(-best.ratio / screening.rows) > settings.LARGE_RESIDUAL_SHARE


def without_failed(
    context: SearchContext, state: SearchState, searched, screening: Screening, ranked: list[Attempt]
) -> tuple[Screening, Screening] | None:
    """The gate and the ranking without laws that were refitted and do not hold; None where nothing else is seen."""
    failed = {told_apart(attempt.name) for attempt in ranked}
    names = ((score.shape.effect.id, score.shape.place.name) for score in screening.scores)
    gone = frozenset(name for name in names if told_apart(name) in failed)
    stage = dataclasses.replace(state.stage, ruled_out=state.ruled_out | gone)
    screening = screen_simulated(stage, context.data[0], searched, context.names, rng=context.rng)
    return (screening, closer_screening(context, stage, screening)) if screening.fires else None
