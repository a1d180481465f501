"""The diagnosis of a user's simulator: numbers first, then laws in its linear plant, then both in the simulator."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import numpy as np

from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, AbstractInputEffect
from ...mechanics.systems.drives import Force
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress
from ...records import Record
from ..acceptance import unproven
from ..equation_error.without_unmeasured_forces import search_forces
from ..estimation.context import SearchContext
from ..estimation.measured_motion import FORCES
from ..findings import NEEDLESS_NOW, NOT_SIMULATED, Rejected
from ..model.candidate import Candidate
from ..noise.floor import independent_floor
from ..result import Diagnosis
from ..search.forward import select_forward
from ..search.state import SearchState, is_local
from .beginning import Beginner, Beginning
from .conclusions import diagnosis_of, gain_between
from .contenders import chosen, needless, offered
from .force_balance import Balanced, balance_diagnosis, search_balance
from .growing_parts import FEWEST
from .runs.calls import Simulator, checked_function, checked_numbers
from .runs.numbers import NumbersSimulator
from .runs.problem import Linear, Problem, Runs, Span, nearer, parts_of, sized
from .runs.tracking import is_white, near_until
from .settling import Settled, refit_of_numbers

NOT_EXPLAINED = "partly", "unexplained"
"""Verdicts that leave something open."""

REPEATED, AGAIN = 1e-9, 8
"""Difference of two runs with the same inputs, relative to the motion, that rounding may make; and the part of a run
that is made again for it, one in so many."""


def diagnose_simulator(
    function: Callable,
    parameters: Mapping[str, float] | None,
    spans: list[tuple[Record, slice | None, slice | None]],
    *,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    separate: bool,
    seed: int,
    workers: int,
    progress: AbstractProgress,
) -> Diagnosis:
    """What a simulator gets wrong: which of its numbers are off, and which laws it lacks.

    **Arguments:** `function`: y = f(u, w, θ), as `calls.Simulation`; `parameters` θ; `spans`: whole records with the
    samples of the fit and those held out, the fit's first; `catalogue`; `max_effects`; `separate`: whether what is held
    out has records of its own; `seed`; `workers`: processes; `progress`.

    **Raises:** `ValueError` for arguments that cannot serve; `ComputationError` where the simulator fails.
    """
    first = spans[0][0]
    if any(kind != "displacement" for kind in first.measured):
        raise ValueError(
            f"measured={first.measured}; with a simulator give displacements, one for every coordinate in which a "
            "force can act."
        )
    checked_function(function, workers)
    given = checked_numbers(parameters)
    with Simulator(function, tuple(given), first.outputs, workers) as simulator:
        problem = Problem(simulator, tuple(Span(*one) for one in spans), np.array(list(given.values())), FORCES)
        rng = np.random.default_rng(seed)

        @functools.cache
        def balanced() -> Diagnosis | None:
            """What the motion as it was measured tells, where runs over whole records do not."""
            if not (isinstance(function, Balanced) and problem.away):
                return None
            own, effects = (function, tuple(given), np.array(list(given.values()))), (catalogue, max_effects)
            try:
                search = search_balance(*own, *problem.parts(), *effects, rng=rng, progress=progress)
                return balance_diagnosis(search)
            except ComputationError as error:
                if error.result == RESULTS.simulator_failed:
                    raise
            return None

        try:
            return _diagnosed(problem, catalogue, max_effects, separate, rng, progress, balanced)
        except ComputationError:
            if (found := balanced()) is None:
                raise
            return found


def _diagnosed(problem: Problem, catalogue, max_effects: int, separate: bool, rng, progress, balanced) -> Diagnosis:
    simulator = problem.simulator
    progress.unlimited.stage("running the simulator")
    start = np.ones(len(problem.units))
    baseline = problem.runs(problem.called(start))
    problem.away = not problem.follow(baseline.y)
    _check_repeatable(problem, baseline)
    # Beyond where a run leaves its record the least change may show: an arm that turns over does so elsewhere.
    end = max(near_until(problem.record, baseline.y[0]), FEWEST)
    units = sized(simulator, baseline.calls[0], baseline.y[0], end)
    start = np.where(problem.units == 0.0, 0.0, 1.0)
    problem.units = units

    def context_of(linear: NumbersSimulator, wholes: Linear) -> SearchContext:
        return _context(problem, linear, wholes, catalogue, separate, rng, progress)

    beginner = Beginner(problem, context_of, rng, progress)
    found = beginner.begin(baseline, start, lambda: _tells(balanced()))
    if found is None:
        return balanced()
    found = beginner.better(found, start) or found
    given = {"context_of": context_of, "baseline": baseline, "start": start, "most": max_effects}
    context, states, settled = _laws(problem, found, **given)
    if not settled and (again := beginner.again(found)) is not None:
        more = _laws(problem, again, **given)
        if more[2]:
            found, (context, states, settled) = again, more
        else:
            problem.plant, problem.idle = found.plant, found.idle
    fitted = found.fitted
    if not settled:
        settled.append(fitted or _as_given(problem, context, found.wholes, baseline, start))
    return diagnosis_of(
        problem, context, states, settled, baseline=baseline, fitted=fitted, followed=found.followed, start=start
    )


def _laws(
    problem: Problem,
    found: Beginning,
    *,
    context_of: Callable,
    baseline: Runs,
    start,
    most: int,
) -> tuple[SearchContext, list[SearchState], list[Settled]]:
    """Laws in the linear plant, one a round, each settled in the simulator: the last context, the state of every round,
    and what was settled."""
    linear, wholes, fitted, begin = found.linear, found.wholes, found.fitted, found.candidate
    explained = fitted is not None and is_white(parts_of(problem, fitted.y)[0])
    if explained:
        # The numbers explain it all: what they were is nothing that a law has to stand for.
        linear, wholes, begin = fitted.linear, fitted.wholes, fitted.candidate
    states: list[SearchState] = []
    settled: list[Settled] = []
    while len(settled) <= most and len(states) <= 2 * most:
        context = context_of(linear, wholes)
        begin = Candidate(start, wholes.states[: len(context.data)]) if begin is None else begin
        state = select_forward(context, begin, min(1, most - len(settled)))
        states.append(state)
        plain = problem.begun(baseline.y)
        before = settled[-1].y if settled else plain if fitted is None else nearer(problem, fitted.y, plain)
        lacking = not is_white(parts_of(problem, before)[0])
        law = offered(context, state, lacking) if len(settled) < most else None
        if law is None:
            break
        try:
            law, now = chosen(problem, context, state, law, wholes, before)
        except ComputationError:
            # What was settled before stays; without any, its numbers alone are judged.
            state.rejected.append(Rejected.of(law.attempt.name, law.attempt.delta_bic, NOT_SIMULATED))
            state.accepted, state.unexplained, state.fit = [], True, None
            break
        local = is_local(context, law.attempt.score.shape.effect)
        gain = gain_between(problem, context, before, now.y, plain, local=local)
        if (why := unproven(gain)) is not None:
            # It holds in the linear plant alone.
            state.rejected.append(Rejected.of(law.attempt.name, law.attempt.delta_bic, why, gain))
            state.accepted, state.unexplained, state.fit = [], True, None
            break
        state.accepted = [law]
        taken = {law.attempt.name, *(rival.name for rival in law.rivals)}
        state.rejected = [one for one in state.rejected if (one.effect, one.location) not in taken]
        settled.append(now)
        _drop_needless(problem, context, states, settled)
        linear, wholes, begin = settled[-1].linear, settled[-1].wholes, settled[-1].candidate
    if explained and not settled:
        # What the linear plant shows beside them is its own.
        states[-1].unexplained = False
    return context, states, settled


def _drop_needless(problem: Problem, context: SearchContext, states: list[SearchState], settled: list[Settled]) -> None:
    """Drop laws of earlier rounds that the newest one has made needless."""
    while True:
        taken = [state for state in states if state.accepted]
        gone = needless(problem, context, [state.accepted[0] for state in taken], settled[-1])
        if gone is None:
            return
        k, worth, settled[-1] = gone
        name = taken[k].accepted[0].attempt.name
        states[-1].rejected.append(Rejected.of(name, worth, NEEDLESS_NOW))
        taken[k].accepted = []
        del settled[k]


def _as_given(problem: Problem, context: SearchContext, wholes: Linear, baseline: Runs, start: np.ndarray) -> Settled:
    """The numbers as they were given, where the simulator does not run with those that the record asks for.

    **Raises:** `ComputationError` where its linear plant does not either.
    """
    begin = Candidate(start, wholes.states[: len(context.data)])
    fit = dataclasses.replace(refit_of_numbers(context, begin), candidate=begin)
    y = problem.begun(baseline.y)
    return Settled(begin, fit, context.simulator, wholes, tuple(context.data), y, still=False)


def _tells(found: Diagnosis | None) -> bool:
    """Whether a diagnosis explains the records."""
    return found is not None and found.verdict not in NOT_EXPLAINED


def _check_repeatable(problem: Problem, runs: Runs) -> None:
    """Raise `ComputationError` where a simulator gives other outputs for the same inputs; find out whether it stops
    early."""
    call, y, simulator = runs.calls[0], runs.y[0], problem.simulator
    part = max(len(y) // AGAIN, min(FEWEST, len(y)))
    again = simulator.tried(call, part)
    if again is not None and np.max(np.abs(again - y[:part])) <= REPEATED * np.std(y):
        return
    # It may need inputs of the whole length, or see ahead.
    simulator.stops = False
    again = simulator.run(call)
    far = float(np.max(np.abs(again - y)))
    if far > REPEATED * float(np.std(runs.y[0])):
        detail = f"it gave outputs that differ by {far:.3g} for the same inputs; no run may depend on another"
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)


def _context(problem, linear, wholes: Linear, catalogue, separate, rng, progress) -> SearchContext:
    """What a search in the linear plant about some runs works with."""
    # Whether a law gains on held-out data is asked of the simulator, where the linear plant answers as it does or not.
    data = problem.fit_data(wholes)
    record = problem.record
    usable = tuple(e for e in catalogue if not isinstance(e, AbstractInputEffect) or np.any(problem.plant.input_map))
    return SearchContext(
        linear,
        data,
        [],
        usable,
        (record.input_names, record.output_names),
        linear.setup.held,
        independent_floor(record)[0],
        separate,
        rng,
        progress,
        forces=_asked_of_forces(problem, wholes, usable, rng, progress),
    )


def _asked_of_forces(problem: Problem, wholes: Linear, catalogue, rng, progress):
    """What gives the search in the force equation of the linear plant, of its first law alone, once however often it
    is called."""
    dofs = problem.record.outputs
    laws = tuple(effect for effect in catalogue if isinstance(effect, AbstractForceEffect) and effect.places != "input")
    fit, held = [], []
    for k, (span, record) in enumerate(zip(problem.spans, wholes.records)):
        inputs = span.record.inputs
        stiffness, _, forces = wholes.series(k)
        # Of the plant that does not vary.
        off = np.where(np.isfinite(record.y), record.y, wholes.motions[k])
        forces = forces - wholes.beside(k, wholes.motions[k]) - stiffness * (off - wholes.motions[k])
        forces = forces + record.u[:, :inputs] @ problem.plant.input_map.T
        pushed = Record(forces, record.y, record.sampling_time, output_names=record.output_names, hold=record.hold)
        for part, group in ((span.fit, fit), (span.held, held)):
            # Nothing is known of what no run was near.
            if part is not None and np.any(np.all(np.isfinite(pushed.y[part]), axis=1)):
                group.append(pushed[part])

    @functools.cache
    def search():
        progress.unlimited.stage("looking in the force equation")
        try:
            return (
                None if not fit else search_forces(fit, held, Force(np.eye(dofs)), laws, 1, rng=rng, progress=progress)
            )
        except ComputationError:
            return None

    return lambda whole: search()
