"""Laws that the force equation finds where the free run of the linear model is too far off to tell any.

Scores are of first order about the linear model, and a strong effect takes its free run out of step with the record:
what is left then passes for noise, or for anything. The force equation asks for no motion but the measured one. What it
finds begins with its M, D, K and its sizes, and is refitted by the free run and judged as any other law.
"""

import numpy as np

from ...numerics.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt, by_contact, compared
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage
from ..screening.score_test import Screening
from ..screening.shortlist import begun_at

STEPS = 25
"""Of the first refit, which has to bring the free run into step."""


def force_equation_finds(context: SearchContext) -> bool:
    """Whether the force equation may be asked, and finds something."""
    search = None if context.forces is None else context.forces()
    return search is not None and bool(search.taken)


def from_forces(context: SearchContext, stage: Stage, screening: Screening) -> list[Attempt]:
    """What the force equation finds first, and what it does not tell from it, refitted by the free run, best first;
    none where it is not asked, finds nothing, or the free run is no nearer with it.

    **Arguments:** `context`; `stage`: without any law; `screening`: of that stage.
    """
    if stage.candidate.terms or not force_equation_finds(context):
        return []
    search = context.forces()
    noise_model = white_noise_model(stage.e, context.data[0].kept, stage.system)
    left = float(np.sum(np.where(context.data[0].kept, stage.e, 0.0) ** 2))

    def refitted(trial) -> Attempt | None:
        effect, place = trial.name
        here = (
            s for s in (*screening.white, *screening.scores) if (s.shape.effect.id, s.shape.place.name) == trial.name
        )
        score = next(here, None)
        if score is None:
            return None
        context.progress.stage(f"refitting {effect} at {place}")
        begin = stage.candidate.with_terms((trial.term,))
        begin = begin.with_entries(context.simulator.setup.entries_of(*trial.fit.matrices))
        options = {"held": context.held, "tolerance": ROUGH}
        fit = refit(context.simulator, begin, context.data, noise_model, max_steps=0, **options)
        if fit is None:
            return None
        # Out of step as it still is, what is left passes for noise at the forces, and less and less of it does.
        fit = refit(context.simulator, begin, context.data, noise_model_of(context, fit), max_steps=STEPS, **options)
        if fit is None or not float(np.sum(fit.residual[0] ** 2)) < settings.MAX_START_POWER * left:
            return None
        context.progress.stage(f"pursuing {effect} at {place}")
        end = refit_to_convergence(context, fit)
        begun = begun_at(score, np.asarray(trial.term.values, float))
        return by_contact(context, Attempt(begun, end, noise_model_of(context, end)), stage)

    first = search.taken[0]
    attempts = side_by_side(refitted, [first.trial, *first.rivals])
    return compared(context, stage, [attempt for attempt in attempts if attempt is not None])
