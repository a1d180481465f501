"""Laws that the force equation finds where the free run of the linear model is too far off to tell any.

Scores are of first order about the linear model, and a strong effect takes its free run out of step with the record:
what is left then passes for noise, or for anything. The force equation asks for no motion but the measured one. What it
finds begins with its M, D, K and its sizes, and is refitted by the free run and judged as any other law.
"""

import numpy as np

from ...numerics.side_by_side import side_by_side
from ..estimation.context import Bench, chain_of
from ..estimation.continuation import ROUGH, pursued
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt, by_contact, compared
from ..noise.whitening import white_chain
from ..screening.linearization import Stage
from ..screening.score_test import Screening
from ..screening.shortlist import begun_at

STEPS = 25
"""Of the first refit, which has to bring the free run into step."""

NEARER = 0.5
"""Share of the sum of squares of the linear model's free run that a law may leave to be of interest."""


def heard(bench: Bench) -> bool:
    """Whether the force equation may be asked, and finds something."""
    search = None if bench.forces is None else bench.forces()
    return search is not None and bool(search.taken)


def from_forces(bench: Bench, stage: Stage, screening: Screening) -> list[Attempt]:
    """What the force equation finds first, and what it does not tell from it, refitted by the free run, best first;
    none where it is not asked, finds nothing, or the free run is no nearer with it.

    **Arguments:** `bench`; `stage`: without any law; `screening`: of that stage.
    """
    if stage.candidate.terms or not heard(bench):
        return []
    search = bench.forces()
    chain = white_chain(stage.e, bench.data[0].kept, stage.system)
    left = float(np.sum(np.where(bench.data[0].kept, stage.e, 0.0) ** 2))

    def refitted(trial) -> Attempt | None:
        effect, place = trial.name
        here = (
            s for s in (*screening.first, *screening.scores) if (s.shape.effect.id, s.shape.place.name) == trial.name
        )
        score = next(here, None)
        if score is None:
            return None
        bench.progress.stage(f"refitting {effect} at {place}")
        begin = stage.candidate.with_terms((trial.term,))
        begin = begin.with_entries(bench.simulator.setup.entries_of(*trial.fit.matrices))
        options = {"held": bench.held, "tolerance": ROUGH}
        fit = refit(bench.simulator, begin, bench.data, chain, max_steps=0, **options)
        if fit is None:
            return None
        # Out of step as it still is, what is left passes for noise at the forces, and less and less of it does.
        fit = refit(bench.simulator, begin, bench.data, chain_of(bench, fit), max_steps=STEPS, **options)
        if fit is None or not float(np.sum(fit.residual[0] ** 2)) < NEARER * left:
            return None
        bench.progress.stage(f"pursuing {effect} at {place}")
        end = pursued(bench, fit)
        begun = begun_at(score, np.asarray(trial.term.values, float))
        return by_contact(bench, Attempt(begun, end, chain_of(bench, end)), stage)

    first = search.taken[0]
    attempts = side_by_side(refitted, [first.trial, *first.rivals])
    return compared(bench, stage, [attempt for attempt in attempts if attempt is not None])
