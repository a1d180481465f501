"""Laws that the force equation finds where the free run of the linear model is too far off to tell any.

Scores are of first order about the linear model, and a strong effect takes its free run out of step with the record:
what is left then passes for noise, or for anything. The force equation asks for no motion but the measured one. What
it finds, or would add first, begins with its M, D, K and its sizes, and is refitted by the free run and judged as any
other law. Where the free run does not follow the record, it is refitted to windows first, each with a first state of
its own.

**Reference:** multiple shooting: Bock, Numerical treatment of inverse problems in chemical reaction kinetics (1981).
"""

import dataclasses
import itertools

import numpy as np

from ...mechanics.effects.base import Term
from ...numerics.side_by_side import side_by_side
from .. import settings
from ..equation_error.search import Trial
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import refit
from ..estimation.multistart import Attempt, by_contact, compared
from ..model.candidate import Candidate, Setup
from ..model.simulator import natural_frequencies_hz
from ..noise.whitening import NoiseModel, white_noise_model
from ..screening.linearization import Stage
from ..screening.score_test import Screening
from ..screening.shortlist import begun_at
from .windows import WINDOWS, long_enough, squares_left

STEPS = 25
"""Of the first refit, which has to bring the free run into step."""

MAX_PROPOSALS = 2
"""Laws that it would add first and that are refitted until the free run follows one."""


def force_equation_finds(context: SearchContext) -> bool:
    """Whether the force equation may be asked, and finds something."""
    return bool(_proposed(context))


def _proposed(context: SearchContext) -> list[Trial]:
    """What the force equation finds first and what it does not tell from that, or what it would add first."""
    if context.proposed is not None:
        kept: list[Trial] = []
        for trial in context.proposed():
            effect, place = trial.name
            # Of laws that differ in their name alone, one.
            alike = {one.name[0] for one in kept if one.name[1] == place} & settings.CONTACT
            if not alike or effect not in settings.CONTACT:
                kept.append(trial)
        return kept[:MAX_PROPOSALS]
    search = None if context.forces is None else context.forces()
    if search is None or not search.taken:
        return []
    return [search.taken[0].trial, *search.taken[0].rivals]


def from_forces(context: SearchContext, stage: Stage, screening: Screening) -> list[Attempt]:
    """What the force equation finds first, and what it does not tell from it, refitted by the free run, best first; of
    what it would add first, the first that the free run follows. None where it is not asked, finds nothing, or the free
    run is no nearer with it.

    **Arguments:** `context`; `stage`: without any law; `screening`: of that stage.
    """
    if stage.candidate.terms or not force_equation_finds(context):
        return []
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
        begin = _begun(context, stage.candidate, trial)
        if context.proposed is not None:
            near = squares_left(context, begin, noise_model) < squares_left(context, stage.candidate, noise_model)
            if context.out_of_step or not near:
                begin = _over_windows(context, begin, trial, noise_model)
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
        begun = begun_at(score, np.asarray(begin.terms[-1].values, float))
        return by_contact(context, Attempt(begun, end, noise_model_of(context, end)), stage)

    proposed = _proposed(context)
    if context.proposed is not None:
        # What the free run follows is enough: rivals are refitted from there.
        return compared(context, stage, [*itertools.islice(filter(None, map(refitted, proposed)), 1)])
    attempts = side_by_side(refitted, proposed)
    return compared(context, stage, [attempt for attempt in attempts if attempt is not None])


def _over_windows(context: SearchContext, candidate: Candidate, trial: Trial, noise_model: NoiseModel) -> Candidate:
    """The candidate refitted to windows of the first record together, each with a first state of its own, where these
    are long enough, and the run over the whole record is nearer with it."""
    data, series = context.data[0], trial.equation.series[0]
    size, numbers = data.samples // WINDOWS, len(candidate.entries) + len(candidate.x0[0])
    hz = natural_frequencies_hz(context.simulator.plant(candidate))
    begins = [k * size for k in range(WINDOWS) if np.all(np.any(data.kept[k * size : (k + 1) * size], axis=0))]
    if not begins or not long_enough(hz, data, size, numbers):
        return candidate
    parts = [data.part(begin, size, padded=True) for begin in begins]
    states = tuple(np.concatenate([series.q[begin], series.v[begin]]) for begin in begins)
    begun = dataclasses.replace(candidate, x0=states)
    fit = refit(context.simulator, begun, parts, noise_model, held=context.held, max_steps=STEPS, tolerance=ROUGH)
    if fit is None:
        return candidate
    first = fit.candidate.x0[0] if begins[0] == 0 else candidate.x0[0]
    found = dataclasses.replace(fit.candidate, x0=(first, *candidate.x0[1:]))
    return min((found, candidate), key=lambda one: squares_left(context, one, noise_model))


def _begun(context: SearchContext, candidate: Candidate, trial: Trial) -> Candidate:
    """A candidate with what the force equation finds: what does not move as it was, in units of its own mass."""
    setup, term, held = context.simulator.setup, trial.term, context.simulator.setup.held
    scale = _scale(setup, candidate, trial.fit.matrices[0]) if setup.per_mass else 1.0
    entries = scale * setup.entries_of(*trial.fit.matrices)
    if held.any():
        entries = np.where(held, candidate.entries, entries)
    amplitudes = np.array([p.amplitude for p in term.effect.parameters])
    values = np.where(amplitudes, scale, 1.0) * np.asarray(term.values, float)
    return candidate.with_entries(entries).with_terms((Term(term.effect, term.place, term.effect.bounded(values)),))


def _scale(setup: Setup, candidate: Candidate, mass: np.ndarray) -> float:
    """Masses of a candidate relative to others, by the first that is held; by all of them where none is."""
    known, other = np.diag(np.asarray(setup.matrices(candidate.entries)[0])), np.diag(mass)
    none = np.zeros_like(mass)
    for k in range(len(mass) if setup.held.any() else 0):
        one = none.copy()
        one[k, k] = 1.0
        if np.all(setup.held[setup.entries_of(one, none, none) != 0.0]):
            return float(known[k] / other[k])
    return float(np.sum(known) / np.sum(other))
