"""Laws that the force equation finds where the free run of the linear model is too far off to tell any.

Scores are of first order about the linear model, and a strong effect takes its free run out of phase with the record:
what is left then passes for noise, or for anything. The force equation asks for no motion but the measured one. What
it finds, or its trial of a first law, begins with its M, D, K and its sizes, and is refitted by the free run and judged
as any other law.
"""

import itertools

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..equation_error.search import Trial
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt, by_contact, compared
from ..model.candidate import Candidate
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage
from ..screening.score_test import Screening
from ..screening.shortlist import begun_at
from .multiple_shooting import over_windows, squares_left

STEPS = 25
"""Of the first refit, which has to bring the free run into phase."""

MAX_TRIALS = 2
"""Trials of the first law that are refitted, in order, until the free run follows one."""


def force_equation_finds(context: SearchContext) -> bool:
    """Whether the force equation may be asked, and finds something."""
    search = None if context.forces is None else context.forces(False)
    return search is not None and bool(search.taken)


def from_first_trials(context: SearchContext, stage: Stage, screening: Screening) -> list[Attempt]:
    """The first law of the force equation that the free run follows once it is refitted; empty where it is not asked,
    or follows none.

    **Arguments:** as of `from_forces`.
    """
    if stage.candidate.terms or context.first_trials is None:
        return []
    known = {(s.shape.effect.id, s.shape.place.name) for s in (*screening.white, *screening.scores)}
    kept: list[Trial] = []
    for trial in context.first_trials():
        # Of laws that differ in their name alone, one.
        alike = {(name, trial.name[1]) for name in trial.term.effect.by_contact}
        if trial.name in known and not any(one.name in alike for one in kept):
            kept.append(trial)
    followed = filter(None, (_refitted(context, stage, screening, trial, True) for trial in kept[:MAX_TRIALS]))
    return list(itertools.islice(followed, 1))


def from_forces(context: SearchContext, stage: Stage, screening: Screening) -> list[Attempt]:
    """What the force equation finds first, and what it does not tell from it, refitted by the free run, best first;
    empty where it is not asked, finds nothing, or the free run is no nearer with it.

    **Arguments:** `context`; `stage`: without any law; `screening`: of that stage.
    """
    if stage.candidate.terms or not force_equation_finds(context):
        return []
    first = context.forces(False).taken[0]
    trials = [first.trial, *first.rivals]
    attempts = side_by_side(lambda trial: _refitted(context, stage, screening, trial, False), trials)
    return compared(context, stage, [attempt for attempt in attempts if attempt is not None])


def _refitted(
    context: SearchContext, stage: Stage, screening: Screening, trial: Trial, windows: bool
) -> Attempt | None:
    """A trial refitted by the free run; None where that does not follow it. `windows`: over windows first where the run
    is out of phase, or no nearer with the trial."""
    effect, place = trial.name
    noise_model = white_noise_model(stage.e, context.data[0].kept, stage.system)
    left = float(np.sum(np.where(context.data[0].kept, stage.e, 0.0) ** 2))
    here = (s for s in (*screening.white, *screening.scores) if (s.shape.effect.id, s.shape.place.name) == trial.name)
    score = next(here, None)
    if score is None:
        return None
    context.progress.stage(f"refitting {effect} at {place}")
    begin = _begun(context, stage.candidate, trial)
    if windows:
        near = squares_left(context, begin, noise_model) < squares_left(context, stage.candidate, noise_model)
        if context.out_of_phase or not near:
            begin = over_windows(context, begin, trial.equation.series[0], noise_model)
    options = {"held": context.held, "tolerance": ROUGH}
    fit = refit(context.simulator, begin, context.data, noise_model, max_steps=0, **options)
    if fit is None:
        return None
    # Out of phase as it still is, what is left passes for noise at the forces, and less and less of it does.
    fit = refit(context.simulator, begin, context.data, noise_model_of(context, fit), max_steps=STEPS, **options)
    if fit is None or not float(np.sum(fit.residual[0] ** 2)) < settings.MAX_START_POWER * left:
        return None
    context.progress.stage(f"refining {effect} at {place}")
    end = refit_to_convergence(context, fit)
    begun = begun_at(score, np.asarray(begin.terms[-1].values, float))
    return by_contact(context, Attempt(begun, end, noise_model_of(context, end)))


def _begun(context: SearchContext, candidate: Candidate, trial: Trial) -> Candidate:
    """The candidate with a trial's matrices and law, in units of its own mass; what is held is as it was."""
    setup, term, held = context.simulator.setup, trial.term, context.simulator.setup.held
    found = setup.entries_of(*trial.fit.matrices)
    scale = _scale(found, candidate.entries, held) if setup.per_mass else 1.0
    entries = np.where(held, candidate.entries, scale * found) if held.any() else scale * found
    amplitudes = np.array([p.amplitude for p in term.effect.parameters])
    values = np.where(amplitudes, scale, 1.0) * np.asarray(term.values, float)
    return candidate.with_entries(entries).with_terms((Term(term.effect, term.place, term.effect.bounded(values)),))


def _scale(found: np.ndarray, entries: np.ndarray, held: np.ndarray) -> float:
    """The factor by which what is found is nearest to entries that are held, and not at zero; 1 where none is."""
    on = held & (entries != 0.0) if held.any() else np.zeros(len(entries), bool)
    scale = float(entries[on] @ found[on]) / max(float(found[on] @ found[on]), np.finfo(float).tiny)
    return scale if scale > 0.0 else 1.0
