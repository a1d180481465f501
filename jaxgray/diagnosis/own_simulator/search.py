"""The diagnosis of a user's simulator: numbers first, then laws in its linear plant, then both in the simulator."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, AbstractInputEffect
from ...mechanics.systems.drives import Force
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress, BudgetSpent
from ...records import Record
from .. import settings
from ..acceptance import unproven
from ..equation_error.without_unmeasured_forces import search_forces
from ..estimation.context import SearchContext
from ..estimation.measured_motion import FORCES
from ..findings import NOT_SIMULATED, Rejected
from ..model.candidate import Candidate
from ..model.simulator import steps_of
from ..noise.floor import independent_floor
from ..result import Diagnosis
from ..search.forward import select_forward
from ..search.state import SearchState, is_local
from .conclusions import diagnosis_of, gain_between, is_white
from .contenders import chosen, offered
from .force_balance import Balanced, balance_diagnosis, search_balance
from .growing_parts import Grown, grown
from .runs.calls import Call, Simulator, checked_function, checked_numbers
from .runs.linearized import Linearized, linearized
from .runs.numbers import NumbersSimulator
from .runs.problem import Linear, Problem, Runs, Span, nearer, parts_of, sized
from .runs.tracking import near_until
from .settling import Settled, left_by, refit_of_numbers, settle

MAX_RELINEARIZATIONS, MAX_LEADS = 8, 2
"""Times that a simulator is linearized about a led run to lead it further; and times that it is led anew with other
numbers."""

GROWING = "fitting the simulator's numbers over parts that grow"
"""What is said while the simulator's own runs fit them."""

NOT_EXPLAINED = "partly", "unexplained"
"""Verdicts that leave something open."""

REPEATED = 1e-9
"""Difference of two runs with the same inputs, relative to the motion, that rounding may make."""


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
    units = sized(simulator, baseline.calls[0], baseline.y[0])
    start = np.where(problem.units == 0.0, 0.0, 1.0)
    problem.units = units

    def context_of(linear: NumbersSimulator, wholes: Linear) -> SearchContext:
        return _context(problem, linear, wholes, catalogue, separate, rng, progress)

    begun = _begin(problem, baseline, start, context_of, rng, progress, balanced)
    if isinstance(begun, Diagnosis):
        return begun
    found, followed, begin = begun
    numbers = found.fitted
    if numbers is not None and numbers.still and not found.by_runs and not is_white(parts_of(problem, numbers.y)[0]):
        # Numbers that stand still in the linear plant may not be those of the simulator.
        again = None
        with contextlib.suppress(BudgetSpent):
            progress.stage(GROWING)
            again = _by_own_runs(problem, start, context_of, rng, progress)
        if again is not None and left_by(problem, again[0].fitted.y) <= left_by(problem, numbers.y):
            found, followed, begin = again
        else:
            problem.plant, problem.idle = found.plant, found.idle
    context, states, settled = _laws(
        problem, found, begin, context_of=context_of, baseline=baseline, start=start, most=max_effects
    )
    fitted = found.fitted
    if not settled:
        if fitted is None:
            detail = "it does not run with the numbers that the record asks for"
            raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
        settled.append(fitted)
    return diagnosis_of(
        problem, context, states, settled, baseline=baseline, fitted=fitted, followed=followed, start=start
    )


@dataclass(frozen=True)
class _Beginning:
    """Where laws are looked for: the `plant` about a run, which numbers are `idle` there, the `linear` simulator and
    records for it (`wholes`), numbers alone in the simulator (`fitted`; None where it does not run with them), and
    whether its own runs found them (`by_runs`)."""

    plant: Linearized
    idle: np.ndarray
    linear: NumbersSimulator
    wholes: Linear
    fitted: Settled | None
    by_runs: bool


def _laws(
    problem: Problem,
    found: _Beginning,
    begin: Candidate | None,
    *,
    context_of: Callable,
    baseline: Runs,
    start,
    most: int,
) -> tuple[SearchContext, list[SearchState], list[Settled]]:
    """Laws in the linear plant, one a round, each settled in the simulator: the last context, the state of every round,
    and what was settled."""
    linear, wholes, fitted = found.linear, found.wholes, found.fitted
    explained = fitted is not None and is_white(parts_of(problem, fitted.y)[0])
    if explained:
        # The numbers explain it all: what they were is nothing that a law has to stand for.
        linear, wholes, begin = fitted.linear, fitted.wholes, fitted.candidate
    states: list[SearchState] = []
    settled: list[Settled] = []
    while len(settled) <= most:
        context = context_of(linear, wholes)
        begin = Candidate(start, wholes.states[: len(context.data)]) if begin is None else begin
        state = select_forward(context, begin, min(1, most - len(settled)))
        states.append(state)
        law = offered(context, state) if len(settled) < most else None
        if law is None:
            break
        plain = problem.begun(baseline.y)
        before = settled[-1].y if settled else plain if fitted is None else nearer(problem, fitted.y, plain)
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
        linear, wholes, begin = now.linear, now.wholes, now.candidate
    if explained and not settled:
        # What the linear plant shows beside them is its own.
        states[-1].unexplained = False
    return context, states, settled


def _begin(
    problem: Problem,
    baseline: Runs,
    start: np.ndarray,
    context_of: Callable,
    rng,
    progress,
    balanced: Callable[[], Diagnosis | None],
) -> tuple[_Beginning, Runs, Candidate | None] | Diagnosis:
    """Where laws are looked for, runs that forces lead along the records, and the candidate to begin with, None for the
    numbers as they were given; or what the balance of forces tells, where no force leads them so far.

    **Arguments:** `problem`; `baseline`: runs with the numbers as they were given, as entries `start`; `context_of`:
    the context of a search by a linear simulator and its records; `rng`; `progress`; `balanced`: gives that diagnosis,
    if there is one.

    **Raises:** `ComputationError` where the simulator fails with the numbers as they were given.
    """

    begun = functools.partial(_begun, problem, context_of, progress)
    found = failure = None
    if problem.away and (again := _by_own_runs(problem, start, context_of, rng, progress)) is not None:
        # Forces that lead a run to a record from far away need many more runs than numbers do. Of a motion that is not
        # stable numbers follow whatever the fit sees, exact to many more digits than they are known.
        told = None if problem.follow(again[1].y) else balanced()
        return again if told is None or told.verdict in NOT_EXPLAINED else told
    try:
        followed = _followed(problem, baseline, rng, progress)
        if not problem.follow(followed.y):
            told = balanced()
            if told is not None and told.verdict not in NOT_EXPLAINED:
                return told
        followed = problem.with_forces(followed)
        found = begun(followed, start)
    except ComputationError as error:
        failure = error
    if found is None or not _settled(problem, found.fitted):
        again = None if problem.away else _by_own_runs(problem, start, context_of, rng, progress)
        if again is not None:
            return again
        if found is None:
            raise failure
        problem.plant, problem.idle = found.plant, found.idle
    runs, begin = baseline, None
    for _ in range(MAX_LEADS):
        fitted = found.fitted
        if fitted is None or problem.follow(runs.y) or problem.follow(fitted.y):
            break
        # From far away its numbers come nearer at a time: led with these it answers more as it does along the record.
        further = problem.tried(problem.called(fitted.candidate.entries))
        if further is None or problem.followed_until(further) <= problem.followed_until(runs):
            break
        try:
            led = problem.with_forces(_followed(problem, further, rng, progress))
            again = begun(led, fitted.candidate.entries)
        except ComputationError:
            break
        if again.fitted is None:
            break
        found, followed, runs, begin = again, led, further, fitted.candidate
    fitted = found.fitted
    runs = problem.tried(problem.called(fitted.candidate.entries)) if _moved_far(problem, baseline, fitted) else None
    if runs is not None and problem.follow(runs.y):
        again = _anew(problem, context_of, rng, progress, runs, fitted.candidate.entries)
        if again is not None and left_by(problem, again.fitted.y) <= left_by(problem, fitted.y):
            found, begin = again, fitted.candidate
    problem.plant, problem.idle = found.plant, found.idle
    return found, followed, begin


def _begun(
    problem: Problem, context_of: Callable, progress, about: Runs, entries: np.ndarray, by_runs: Grown | None = None
) -> _Beginning:
    """Where laws are looked for about some runs, with the forces that numbers take there."""
    problem.idle = problem.idle_by(about.by_number)
    linear = problem.linear_simulator(entries, steps_of(problem.linear_model(), problem.record.sampling_time))
    wholes = problem.linear_data(linear, about).near(about.y)
    progress.unlimited.stage("fitting the simulator's numbers")
    context = context_of(linear, wholes)
    candidate = Candidate(entries, wholes.states[: len(context.data)])
    fitted = _numbers_alone(problem, context, candidate, wholes, by_runs)
    return _Beginning(problem.plant, problem.idle, linear, wholes, fitted, by_runs is not None)


def _anew(
    problem: Problem, context_of, rng, progress, runs: Runs, entries: np.ndarray, by_runs: Grown | None = None
) -> _Beginning | None:
    """The same with the plant, and what the numbers take, as they are about these runs; None where that cannot be."""
    with contextlib.suppress(ComputationError):
        with contextlib.suppress(ComputationError):
            problem.plant = linearized(problem.simulator, problem.record, runs.calls[0], runs.y[0], rng)
        if problem.plant is None:
            return None
        again = _begun(problem, context_of, progress, problem.with_forces(runs), entries, by_runs)
        return again if again.fitted is not None else None
    return None


def _by_own_runs(
    problem: Problem, start: np.ndarray, context_of: Callable, rng, progress
) -> tuple[_Beginning, Runs, Candidate] | None:
    """As `_begin`, with numbers that the simulator's own runs found over parts that grow; None where they find none
    that alone explain the data."""
    progress.unlimited.stage(GROWING)
    by_runs = grown(problem, start)
    if by_runs is None:
        return None
    found = _anew(problem, context_of, rng, progress, by_runs.runs, by_runs.entries, by_runs)
    return None if found is None else (found, by_runs.runs, found.fitted.candidate)


def _followed(problem: Problem, baseline: Runs, rng, progress) -> Runs:
    """Runs that forces lead along the records, and the linear plant about the first of them.

    **Raises:** `ComputationError` where the simulator does not answer to forces as a mechanical system does.
    """
    simulator, first = problem.simulator, problem.record

    def led(about: Runs, begin: Runs, end: int | None = None) -> tuple[Runs, Linearized]:
        progress.unlimited.stage("linearizing the simulator")
        problem.plant = linearized(simulator, first, about.calls[0], about.y[0], rng, end)
        progress.unlimited.stage("looking for the force that it lacks")
        return problem.led(begin), problem.plant

    if problem.follow(baseline.y):
        return led(baseline, baseline)[0]
    # Far from the record it may answer otherwise than there, and to small forces by large motions; at rest it does not.
    none = [Call(0.0 * call.u, call.w, call.numbers) for call in baseline.calls]
    ends, failure = [], None
    for about in (baseline, problem.tried(none)):
        try:
            ends += [] if about is None else [led(about, baseline)]
        except ComputationError as error:
            failure = failure or error
    if not ends:
        raise failure
    followed, plant = max(ends, key=lambda end: problem.followed_until(end[0]))
    for _ in range(MAX_RELINEARIZATIONS):
        # As it answers up to where it was led, it is led further.
        before = problem.followed_until(followed)
        try:
            further, about_it = led(followed, followed, near_until(first, followed.y[0]))
        except ComputationError:
            break
        if problem.followed_until(further) <= before:
            if problem.follow(followed.y):
                plant = about_it
            break
        followed, plant = further, about_it
    problem.plant = plant
    return followed


def _moved_far(problem: Problem, baseline: Runs, fitted: Settled | None) -> bool:
    """Whether numbers alone have led a simulator to where it may answer otherwise: from far away, or much nearer
    without standing still."""
    if fitted is None or not problem.follow(fitted.y):
        return False
    if not problem.follow(baseline.y):
        return True
    nearer = left_by(problem, fitted.y) - left_by(problem, baseline.y)
    return not fitted.still and nearer < 2 * problem.record.outputs * np.log(settings.MUCH_NEARER)


def _settled(problem: Problem, fitted: Settled | None) -> bool:
    """Whether numbers alone stand still, or leave nothing but noise."""
    return fitted is not None and (fitted.still or is_white(parts_of(problem, fitted.y)[0]))


def _numbers_alone(
    problem: Problem, context: SearchContext, begin: Candidate, wholes: Linear, by_runs: Grown | None
) -> Settled | None:
    """The numbers without any law, those that runs found or the settled ones; None where the simulator does not run
    with them."""
    try:
        fit = refit_of_numbers(context, begin)
        if by_runs is None:
            return settle(problem, context, fit, wholes)
        fit = dataclasses.replace(by_runs.fit(problem, fit), candidate=begin)
        return Settled(begin, fit, context.simulator, wholes, tuple(context.data), by_runs.runs.y, True, by_runs.pushed)
    except ComputationError:
        return None


def _check_repeatable(problem: Problem, runs: Runs) -> None:
    """Raise `ComputationError` where a simulator gives other outputs for the same inputs."""
    again = problem.simulator.run(runs.calls[0])
    far = float(np.max(np.abs(again - runs.y[0])))
    if far > REPEATED * float(np.std(runs.y[0])):
        detail = f"it gave outputs that differ by {far:.3g} for the same inputs; it must begin anew, without chance"
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
    """What gives the search in the force equation of the linear plant, once however often it is called."""
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

    return search
