"""The search on a part of a record; every reported number is refitted on all of it.

Evidence grows with the samples, and so does the time of every trial: of long records a part is searched first and,
where it shows nothing, one four times as long, up to the whole. What belongs to the clock of a record, such as a step
of stiffness, is looked for in the whole.

A body that nothing holds is searched as if its sensor had no offset. Where more than noise is left, it is searched once
more with the offset of the linear fit: a force along the position tells where the sensor has its zero.

A strong effect takes the free run of the linear model out of phase with the record, and scores about it then name
anything: there the trials of the force equation count, whatever the gate says.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...mechanics.effects.base import AbstractEffect, Term
from ...mechanics.runs.simulate import initial_state
from ...numerics.matrices.bounded import bounded
from ...numerics.responses.filters import white_part
from .. import settings
from ..estimation.context import SearchContext, noise_model_of, stage_of_candidate
from ..estimation.continuation import ROUGH, settled
from ..estimation.gauss_newton import Refit, refit
from ..model.baseline import Baseline
from ..model.candidate import Candidate, Data
from ..model.simulator import Simulator
from ..noise.floor import more_than_noise
from ..noise.whitening import white_noise_model
from ..screening.linearization import screen_simulated
from ..starts.first_states import without_free_offset
from .forward import extend, select_forward
from .state import SearchState, held_out_run
from .swap import call_by_contact

PART = 8192
"""Samples of each record that the search begins with."""

LONG = 2.0
"""Length of a record, relative to the part, from which the search works on a part."""

LONGER = 4
"""By how much longer the next part is where one shows nothing."""

STEPS = 10
"""Of each refit on the whole record."""


@dataclass(frozen=True)
class Searched:
    """What the search worked on: its `context`, how far it got there (`state`), and which part that was, None for the
    whole."""

    context: SearchContext
    state: SearchState
    where: str | None


def search(
    context: SearchContext,
    baseline: Baseline,
    max_effects: int,
    *,
    errors: tuple[AbstractEffect, ...] = (),
) -> tuple[SearchState, "Searched"]:
    """Extend the baseline until nothing more is found, on a part first where records are long.

    **Arguments:** `context`; `baseline`; `max_effects`; `errors`: as for `select_forward`, where numbers of a given
    model may be wrong: the whole record is then searched.

    **Returns:** how far the search got, on the whole records; what it worked on.
    """
    start, size = without_free_offset(context, baseline.start), PART
    while not errors and context.data[0].samples > LONG * size:
        part, begun, where = _part(context, baseline, size)
        state = select_forward(part, begun, max_effects)
        if state.accepted:
            whole = _carried_over(context, start, state)
            if whole is not None:
                _tied_to_clock(context, whole, max_effects)
                return whole, Searched(part, state, where)
        if state.unexplained:
            break
        size *= LONGER
    if context.first_trials is not None and context.trials_at_once:
        missed = missed_share(context.simulator, start, context.data[0])
        context = dataclasses.replace(context, out_of_phase=missed >= settings.OUT_OF_PHASE)
    options = {"errors": errors, "max_errors": len(start.entries)}
    state = select_forward(context, start, max_effects, **options)
    if start is not baseline.start and more_than_noise(state.stage.e, context.data[0]):
        other = select_forward(context, baseline.start, max_effects, **options)
        mended = any(accepted.stage == "model" for accepted in other.accepted)
        if mended and not (other.unexplained or more_than_noise(other.stage.e, context.data[0])):
            state = other
    return state, Searched(context, state, None)


def missed_share(simulator: Simulator, candidate: Candidate, data: Data) -> float:
    """The largest share of the variance of an output that the free run of a candidate leaves, white noise not counted;
    outputs that do not move are left out. Infinite where the run overflows."""
    kept = data.kept[: data.samples]
    y = np.where(kept, data.y[: data.samples], 0.0)
    e = np.where(kept, y - simulator.run(candidate, data)[: data.samples], 0.0)
    if not bounded(e):
        return float("inf")
    count = np.maximum(kept.sum(axis=0), 1)

    def variance(x):
        return np.sum(np.where(kept, x - x.sum(axis=0) / count, 0.0) ** 2, axis=0) / count

    size = variance(y)
    left = np.maximum(variance(e) - white_part(e, kept), 0.0)
    moving = size > 1e-12 * max(float(size.max()), 1e-300)
    return float(np.max(left[moving] / size[moving], initial=0.0))


def _part(context: SearchContext, baseline: Baseline, size: int) -> tuple[SearchContext, Candidate, str]:
    """The context with the liveliest part of every record, the baseline with its first states there, and which part."""
    part, begins = _cut(context, size)
    model = baseline.model
    states = []
    for d in part.data:
        u, y = d.u[: d.samples], np.where(d.kept, d.y, np.nan)[: d.samples]
        states.append(initial_state(model, u, y, d.sampling_time, hold=d.hold)[0])
    begin, end = begins[0], min(begins[0] + size, context.data[0].samples)
    where = f"The search worked on samples {begin + 1} to {end} of {context.data[0].samples}"
    begun = without_free_offset(part, Candidate(baseline.start.entries, tuple(states)))
    return part, begun, where


def _cut(context: SearchContext, size: int) -> tuple[SearchContext, list[int]]:
    """The context with the liveliest part of every record and the laws that belong to no clock, and where the parts of
    the records of the fit begin."""
    lasting = tuple(effect for effect in context.catalogue if not effect.tied_to_clock)
    begins = [_liveliest(d, size) for d in context.data]
    data = [d.part(begin, size) for d, begin in zip(context.data, begins)]
    held = [d.part(_liveliest(d, size), size) for d in context.validation]
    # Both are about the whole records, the other models with their first states.
    known = {"first_trials": None, "others": None}
    return dataclasses.replace(context, data=data, validation=held, catalogue=lasting, **known), begins


def _liveliest(data: Data, size: int) -> int:
    """Where the part of a record begins whose outputs, each in units of its own size, move most."""
    if data.samples <= size:
        return 0
    kept = data.kept[: data.samples]
    y = np.where(kept, data.y[: data.samples], 0.0)
    y = np.where(kept, y - y.sum(axis=0) / np.maximum(kept.sum(axis=0), 1), 0.0)
    power = np.sum(y**2 / np.maximum(np.mean(y**2, axis=0), 1e-300), axis=1)
    total = np.concatenate([[0.0], np.cumsum(power)])
    begins = np.arange(0, data.samples - size + 1, max(size // 4, 1))
    return int(begins[np.argmax(total[begins + size] - total[begins])])


def _carried_over(context: SearchContext, start: Candidate, part: SearchState) -> SearchState | None:
    """What was found on a part, refitted on the whole records one finding after the other; None where one of the refits
    cannot be simulated."""
    first = stage_of_candidate(context, start)
    whole = SearchState(first, first)
    whole.baseline_runs = whole.runs = [held_out_run(context, start, d) for d in context.validation]
    whole.rejected, whole.tried, whole.unexplained = part.rejected, part.tried, part.unexplained
    whole.screening, whole.first, whole.ruled_out = part.screening, part.first, part.ruled_out
    for k, accepted in enumerate(part.accepted):
        context.progress.unlimited.stage(f"refitting {accepted.attempt.name[0]} on the whole record")
        last = k == len(part.accepted) - 1
        found, terms = accepted.attempt.fit, part.fit.candidate.terms[: k + 1]
        if last or [_law(term) for term in found.candidate.terms] != [_law(term) for term in terms]:
            found = part.fit
        terms = found.candidate.terms[: k + 1]
        fit = _refitted(context, Candidate(found.candidate.entries, start.x0, terms), first)
        if fit is None:
            return None
        runs = [held_out_run(context, fit.candidate, d) for d in context.validation]
        attempt = dataclasses.replace(accepted.attempt, fit=fit)
        whole.accepted.append(dataclasses.replace(accepted, attempt=attempt, runs=runs))
        whole.fit, whole.runs = fit, runs
    whole.stage = stage_of_candidate(context, whole.fit.candidate)
    call_by_contact(context, whole)
    return whole


def _law(term: Term) -> tuple[str, str]:
    return term.effect.id, term.place.name


def _refitted(context: SearchContext, candidate: Candidate, first) -> Refit | None:
    """Under white noise first, which brings the first states into place, then under that of what is left."""
    white = white_noise_model(first.e, context.data[0].kept, first.system)
    options = {"held": context.held, "max_steps": STEPS, "tolerance": ROUGH}
    fit = refit(context.simulator, candidate, context.data, white, **options)
    if fit is None:
        return None
    noise_model = noise_model_of(context, fit)
    again = refit(context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=STEPS)
    return fit if again is None else settled(context, again, noise_model)


def _tied_to_clock(context: SearchContext, state: SearchState, max_effects: int) -> None:
    """Look in the whole records for what belongs to the clock of one, which no part of it shows; not where the part is
    unexplained, for which anything may stand in."""
    tied = tuple(effect for effect in context.catalogue if effect.tied_to_clock)
    most, known = max_effects - len(state.accepted), len(state.accepted)
    if not tied or most <= 0 or state.unexplained:
        return
    context.progress.unlimited.stage("looking for what belongs to the clock of the record")
    seen = screen_simulated(state.stage, context.data[0], tied, context.names, surrogates=0)
    best = seen.best_by_effect()
    # In so many samples the least misfit is significant: it must also be of some size.
    share = {name: 1 - np.exp(-score.ratio / seen.rows) for name, score in best.items()}
    sized = tuple(effect for effect in tied if share.get(effect.id, 0.0) >= settings.MIN_RESIDUAL_SHARE)
    if not sized:
        return
    screening = state.screening
    extend(dataclasses.replace(context, catalogue=sized), state, most, sized)
    if len(state.accepted) == known:
        state.unexplained, state.screening = False, screening
