"""Which numbers of a user's model are wrong: begun from the model that the record itself gives.

A frequency that is a little wrong puts a free run out of phase, and no small change of the wrong entry seems to help.
Near the identified model θ̂ the cost is a parabola, cost(θ) = cost(θ̂) + (θ − θ̂)ᵀH(θ − θ̂); along one entry e of the
user's model θ its lowest point is δ = eᵀH(θ̂ − θ)/(eᵀHe), and lower by δ²eᵀHe.
"""

import dataclasses

import numpy as np

from ...identification import identify
from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects import MODEL_ERRORS
from ...mechanics.effects.base import AbstractEffect
from ...mechanics.runs.extended import Plant, changed_plant
from ...mechanics.runs.simulate import initial_state
from ...mechanics.systems.drives import Force
from ...numerics.matrices.bounded import bounded
from ...numerics.outcomes import ComputationError
from ...records import Record
from .. import settings
from ..estimation.context import Identified, SearchContext
from ..estimation.continuation import in_short_steps
from ..estimation.gauss_newton import refit
from ..estimation.normal_equations import Equations
from ..model.baseline import Baseline
from ..model.candidate import Candidate, Data
from ..model.parameter_vector import Layout
from ..model.simulator import Simulator
from ..noise.whitening import white_noise_model
from ..screening.linearization import Stage, sampled_plant, stage_of
from ..screening.score_test import Score, Screening

COUNT = 3
"""Entries of a round that are begun so."""

STEPS = 20
"""Of the refit of all entries beside the laws that were found."""


def identified(simulator: Simulator, records: list[Record], data: list[Data], options: dict) -> Identified | None:
    """The model that the records themselves give, with the inputs and laws of another one; None where there is none.

    **Arguments:** `simulator` of that model; `records`, and as `data`; `options` of `identify`.
    """
    drive = simulator.setup.drive
    places = {"input_map": np.asarray(drive.input_map)} if isinstance(drive, Force) else {}
    try:
        found = identify(records, **(options | places))
    except (ComputationError, ValueError):
        return None
    entries = simulator.setup.entries_of(found.mass, found.damping, found.stiffness)
    x0 = tuple(initial_state(found.model, r.u, r.y, r.sampling_time, hold=r.hold)[0] for r in records)
    candidate = Candidate(entries, x0)
    e = np.where(data[0].kept, data[0].y - simulator.run(candidate, data[0]), 0.0)
    if not bounded(e):
        return None
    if simulator.setup.own:
        # The linear model had taken the laws upon itself.
        system = sampled_plant(simulator.plant(candidate), data[0], simulator.setup.outputs)
        white, free = white_noise_model(e, data[0].kept, system), np.zeros(len(entries), bool)
        fit = refit(simulator, candidate, data, white, held=free, max_steps=STEPS)
        if fit is None:
            return None
        candidate, e = fit.candidate, fit.residual[0]
    return _informed(simulator, data, candidate, e)


def with_first_states(context: SearchContext, baseline: Baseline) -> Baseline:
    """A baseline with laws, its first states those that bring its free runs nearest to the records, in steps as short
    as every candidate takes. The same one without laws."""
    if not baseline.setup.own:
        return baseline
    stage = stage_of(context.simulator, baseline.start, context.data[0])
    white = white_noise_model(stage.e, context.data[0].kept, stage.system)
    fit = refit(context.simulator, baseline.start, context.data, white, held=context.held)
    if fit is None:
        return baseline
    return dataclasses.replace(baseline, start=in_short_steps(context, fit)[0].candidate)


def _informed(simulator: Simulator, data: list[Data], candidate: Candidate, e: np.ndarray) -> Identified | None:
    """What the records say of the entries of a candidate that leaves `e` of the first; None where it overflows."""
    noise_model = white_noise_model(
        e, data[0].kept, sampled_plant(simulator.plant(candidate), data[0], simulator.setup.outputs)
    )
    made = Equations(simulator, data, noise_model, Layout(simulator.setup, candidate))(candidate)
    if made is None:
        return None
    H, n = made[0], len(candidate.entries)
    across = H[:n, n:] @ pseudo_inverse(H[n:, n:])
    return Identified(candidate.entries, candidate.x0, H[:n, :n] - across @ H[n:, :n])


def beside_laws(context: SearchContext, stage: Stage) -> SearchContext:
    """A context whose identified model has the laws of a stage as well, all entries refitted beside them: laws hide
    what is wrong of the entries. The same context where there is no law, or no refit."""
    laws = tuple(term for term in stage.candidate.terms if not _is_entry(term.effect))
    if context.identified is None or not laws:
        return context
    begin = Candidate(context.identified.entries, context.identified.x0, laws)
    noise_model = white_noise_model(stage.e, context.data[0].kept, stage.system)
    free = np.zeros(len(begin.entries), bool)
    fit = refit(context.simulator, begin, context.data, noise_model, held=free, max_steps=STEPS)
    found = None if fit is None else _informed(context.simulator, context.data, fit.candidate, fit.residual[0])
    return context if found is None else dataclasses.replace(context, identified=found)


def _is_entry(effect: AbstractEffect) -> bool:
    return effect.id in {error.id for error in MODEL_ERRORS}


def wrong_entries(
    context: SearchContext, stage: Stage, screening: Screening, *, least: float | None = None
) -> list[Score]:
    """Scores of the entries that the identified model says are wrong, with the sizes to begin from, best first; those
    alone that would lower the sum of squares by at least so much, in units of the noise variance (default
    `MIN_DELTA_BIC`)."""
    least = settings.MIN_DELTA_BIC if least is None else least
    found = context.identified
    if found is None:
        return []
    setup, corrections = context.simulator.setup, [t for t in stage.candidate.terms if _is_entry(t.effect)]
    # As given and corrected, without what laws make of them.
    plant = Plant(*setup.matrices(stage.candidate.entries), setup.drive, setup.measured)
    plant = changed_plant(plant, tuple(corrections))
    matrices = tuple(np.asarray(X) for X in (plant.mass, plant.damping, plant.stiffness))
    here = setup.entries_of(*matrices)
    ranked = []
    for score in screening.best_by_place().values():
        effect, place = score.shape.effect, score.shape.place
        if not _is_entry(effect):
            continue
        first, second = np.eye(setup.dofs)[place.first], np.zeros(setup.dofs)
        if place.second >= 0:
            second[place.second] = 1.0
        moved = effect.matrices(np.ones(1), *matrices, first, second)
        along = setup.entries_of(*moved) - here
        curvature = float(along @ found.information @ along)
        if curvature > 0:
            size = float(along @ found.information @ (found.entries - here)) / curvature
            ranked.append((size**2 * curvature, dataclasses.replace(score, weights=np.array([size]))))
    ranked.sort(key=lambda pair: -pair[0])
    return [score for worth, score in ranked[:COUNT] if worth > least]
