"""What is said of a user's simulator: every run and every gain is the simulator's own."""

import dataclasses

import numpy as np

from ...numerics.responses.filters import white_part
from ...numerics.text import listed
from .. import settings
from ..acceptance import unproven
from ..conclusions.assembly import accepted_names, findings_of, not_found_of, summary_of
from ..conclusions.candidates import gate_of, rejected_of
from ..data_checks.record_findings import noise_findings
from ..estimation.context import SearchContext
from ..findings import Curves, Estimate, Finding, Gain, Member, ParameterShift
from ..model.free_run import FreeRun, overall, rms_of
from ..model.held_out_gain import gain_of
from ..noise.floor import ADOPTED, independent_floor
from ..result import Diagnosis
from ..search.state import SearchState
from .necessary_numbers import Necessary, necessary
from .runs.problem import Outputs, Parts, Problem, Runs, nearer, parts_of
from .runs.tracking import is_white
from .settling import Settled, foreseen_by, shown_by

UNSETTLED = "The laws and numbers still moved in the last run of the simulator"

MUCH_FARTHER = 2.0
"""Error, relative to that of the run that a force leads along the record, which is more than noise."""

WHITE = "white part of what is left"
"""Where the noise floor comes from if what is left is more than noise."""

SURE = 5.0
"""Standard errors by which a record begins in another state than its run, for sure."""


def diagnosis_of(
    problem: Problem,
    context: SearchContext,
    states: list[SearchState],
    every: list[Settled],
    *,
    baseline: Runs,
    fitted: Settled | None,
    followed: Runs,
    start: np.ndarray,
) -> Diagnosis:
    """The diagnosis of a simulator.

    **Arguments:** `problem`; `context`, `states`: of the searches in the linear plant, one a law; `every`: laws and
    numbers in the simulator after each; `baseline`: runs with the numbers as they were given, `start` as entries;
    `followed`: with the forces that lead along the records; `fitted`: with numbers alone, None where the simulator does
    not run with them.
    """
    names = problem.record.output_names
    state, settled = joined(states), every[-1]
    records, held = problem.parts()
    given, elsewhere = problem.begun(baseline.y), _begins_elsewhere(settled)
    shown = given if elsewhere else baseline.y
    floor, source = independent_floor(records[0])
    unexplained = state.unexplained or _leaves_more(problem, settled, followed, floor, source)
    if floor is None:
        left = parts_of(problem, settled.y)[0]
        floor, source = (_white_floor(left), WHITE) if unexplained else (rms_of(left), source)

    def gain(one: Outputs, other: Outputs) -> Gain:
        return gain_between(problem, context, one, other, given, floor)

    samples = sum(map(len, records))
    numbers = necessary(problem, settled, start, samples, None if unexplained else gain)
    settled = every[-1] = numbers.settled
    before, after = (parts_of(problem, y) for y in (shown, settled.y))

    context = dataclasses.replace(context, simulator=settled.linear, data=list(settled.data))
    plain = given if fitted is None else nearer(problem, fitted.y, given)
    steps = [plain, *(one.y for one in every)] if state.accepted else [settled.y]
    for k, accepted in enumerate(state.accepted):
        state.accepted[k] = dataclasses.replace(accepted, gain=gain(steps[k], steps[k + 1]))
    whole = gain(given, settled.y)
    state.fit = settled.fit
    laws = list(findings_of(context, state, records[0])) if state.accepted else []
    left = overall(rms_of(after[0]), floor)
    warnings = _warnings(problem, numbers, start, elsewhere, unexplained)
    # What the laws leave with the numbers as they were.
    as_given = None if unexplained else shown_by(problem, settled, settled.candidate.with_entries(start), baseline)
    wrong = []
    if as_given is not None:
        mended = gain(as_given, settled.y)
        wrong = _wrong(problem, numbers, start, mended)
    findings = wrong + laws
    if unexplained:
        verdict = "partly" if findings else "unexplained"
    else:
        several = any(finding.status == "equivalent" for finding in findings)
        verdict = "equivalent" if several else "named" if findings else "noise"
    if verdict == "unexplained":
        worst = int(np.argmax(rms_of(after[0]) / floor))
        findings.append(Finding("unexplained", names[worst], "unexplained", "model", (), {}, None, None))
    model = problem.linear_model()
    extended = None
    if wrong or laws:
        extended = summary_of(problem.linear_model(settled.candidate.terms), None, after[0][0], after[1], records, held)
    noise = () if unexplained else noise_findings(records[0], after[0][0].e)
    return Diagnosis(
        verdict=verdict,
        baseline=summary_of(model, None, before[0][0], before[1], records, held),
        noise_floor=dict(zip(names, map(float, floor))),
        noise_floor_source=source,
        findings=noise + tuple(findings),
        extended=extended,
        gain=whole if extended is not None else None,
        excess=left,
        baseline_excess=overall(rms_of(before[0]), floor),
        white=not unexplained and is_white(after[0]),
        explainable=None,
        depends_on=(),
        rejected=rejected_of(context, state, records[0]),
        not_found=not_found_of(state.screening, context, records[0], accepted_names(state.accepted)),
        shifts=_shifts(problem, numbers, start, unexplained),
        budget=_budget([before, *(parts_of(problem, y) for y in steps)], state, floor, unexplained),
        next_experiment=None,
        warnings=warnings,
        records=tuple(records),
        validation_records=tuple(held),
        curves=_curves(problem, shown, settled.y),
        identification=None,
        terms=settled.candidate.terms,
        own_model=True,
        gate=gate_of(state),
        beside=_beside(problem, settled),
    )


def _beside(problem: Problem, settled: Settled) -> np.ndarray:
    """Forces at the coordinates of the first record, beside those of the linear plant that does not vary."""
    part, wholes = problem.spans[0].fit, settled.wholes
    forces = settled.linear.forces(settled.candidate, settled.data[0])[: part.stop - part.start]
    return forces - wholes.beside(0, wholes.motions[0])[part]


def joined(states: list[SearchState]) -> SearchState:
    """The last state with all that was accepted, refused and refitted on the way."""
    last = states[-1]
    last.first = states[0].first
    last.accepted = [one for state in states for one in state.accepted]
    last.rejected = [one for state in states for one in state.rejected]
    for state in states:
        last.tried = state.tried | last.tried
    return last


def _leaves_more(problem: Problem, settled: Settled, followed: Runs, floor: np.ndarray | None, source: str) -> bool:
    """Whether laws and numbers leave more than noise: than a floor that is known of otherwise, than what the linear
    plant foresaw, or much more than a force that makes the simulator follow the records."""
    after = rms_of(parts_of(problem, settled.y)[0])
    foreseen = foreseen_by(settled.fit, settled.data)
    if floor is not None and source != ADOPTED and overall(after, floor) >= settings.MIN_EXCESS:
        return True
    led = rms_of(parts_of(problem, followed.y)[0])
    return overall(after, rms_of(foreseen)) >= settings.MIN_EXCESS or overall(after, led) >= MUCH_FARTHER


def _begins_elsewhere(settled: Settled) -> bool:
    """Whether some record of the fit surely begins in another state than its run of the simulator."""
    first, errors = len(settled.candidate.entries), np.sqrt(np.maximum(np.diag(settled.fit.covariance), 0.0))
    for x0, there in zip(settled.candidate.x0, settled.wholes.states):
        spread = errors[first : first + len(x0)]
        first += len(x0)
        if np.any((np.abs(x0 - there) > SURE * spread) & (spread > 0)):
            return True
    return False


def _warnings(
    problem: Problem, numbers: Necessary, start: np.ndarray, elsewhere: bool, unexplained: bool
) -> tuple[str, ...]:
    """What is to be known of the numbers; `elsewhere`: whether a record begins in another state than its run."""
    settled, names, warnings = numbers.settled, problem.simulator.names, []
    if not settled.still and not unexplained:
        warnings.append(f"{UNSETTLED}: their errors may be larger than is said.")
    if elsewhere:
        warnings.append(
            "The record does not begin where the simulator does: the first state of the record was fitted, to first "
            "order. Where the difference is large, make the first state one of the simulator's numbers."
        )
    moved = np.abs(numbers.values - start) > 3 * np.maximum(numbers.errors, 1e-12)
    if unexplained and np.any(moved):
        which = listed(name for name, one in zip(names, moved) if one)
        warnings.append(
            f"A part stays unexplained, and the fit changes {which} to make up for some of it: that is no finding."
        )
    loose = settled.fit.undetermined[: len(start)] | settled.linear.setup.held
    if np.any(loose):
        which = listed(name for name, one in zip(names, loose) if one)
        warnings.append(f"This record does not determine {which}: excite what they act on, or leave them out.")
    return tuple(warnings)


def _wrong(problem: Problem, numbers: Necessary, start: np.ndarray, gain: Gain) -> list[Finding]:
    """Findings of the numbers that have to be other, where their correction surely gains: `gain` of all together."""
    if unproven(gain) is not None:
        return []
    found, shared = [], dataclasses.replace(gain, together=len(numbers.moved))
    for one in numbers.moved:
        members = []
        for number in (one, *one.rivals):
            unit = abs(problem.units[number.k])
            value, error = float(number.value * problem.units[number.k]), float(number.error * unit)
            delta = value - float(start[number.k] * problem.units[number.k])
            parameters = {"delta": Estimate(delta, error, ""), "value": Estimate(value, error, "")}
            members.append(Member("parameter_error", problem.simulator.names[number.k], -number.behind, parameters))
        status = "named" if len(members) == 1 else "equivalent"
        what = "parameter_error", members[0].location, status, "model"
        found.append(Finding(*what, tuple(members), members[0].parameters, one.evidence, one.gain or shared))
    return found


def _shifts(problem: Problem, numbers: Necessary, start: np.ndarray, unexplained: bool) -> tuple[ParameterShift, ...]:
    """Every number as it was given, and as it would be beside those that have to be other; without an error where
    numbers make up for what is `unexplained`."""
    values = zip(problem.simulator.names, start * problem.units, numbers.values * problem.units)
    errors = [float(e) if e > 0 and not unexplained else None for e in numbers.errors * np.abs(problem.units)]
    return tuple(ParameterShift(name, float(old), float(new), error) for (name, old, new), error in zip(values, errors))


def _white_floor(runs: list[FreeRun]) -> np.ndarray:
    """Noise per output where what is left is more than that: its white part."""
    return np.sqrt(np.mean([white_part(run.e, run.kept) for run in runs], axis=0)) + 1e-300


def _budget(steps: list[Parts], state: SearchState, floor: np.ndarray, unexplained: bool) -> dict[str, float]:
    """Share of the numbers, of every law, and of what is left in the mean square error of the fit, in percent."""
    power = [float(np.mean((rms_of(parts[0]) / floor) ** 2)) for parts in steps]
    shares = [100 * (one - other) / power[0] for one, other in zip(power, power[1:])]
    names = ["numbers", *(f"{one.attempt.name[0]} at {one.attempt.name[1]}" for one in state.accepted)]
    rest = 100 * power[-1] / power[0]
    noise = min(rest, 100 / power[0]) if unexplained else rest
    return dict(zip(names, shares)) | {"noise": noise, "unexplained": rest - noise}


def _curves(problem: Problem, before: tuple[np.ndarray, ...], after: tuple[np.ndarray, ...]) -> tuple[Curves, ...]:
    made = []
    for held_out in (False, True):
        for span, old, new in zip(problem.spans, before, after):
            part = span.held if held_out else span.fit
            if part is not None:
                record = span.record[part]
                made.append(Curves(record.time, record.y, old[part], new[part], held_out))
    return tuple(made)


def gain_between(
    problem: Problem,
    context: SearchContext,
    before: Outputs,
    after: Outputs,
    baseline: Outputs,
    floor: np.ndarray | None = None,
    local: bool = False,
) -> Gain:
    """Gain from some runs to others, on held-out data where there are such.

    **Arguments:** `problem`; `context`; the runs, and those with the numbers as they were given; `floor`: noise per
    output, default what is left after; `local`: of a law that no other record shows.
    """
    every = [parts_of(problem, y) for y in (before, after, baseline)]
    held_out = bool(every[0][1]) and not local
    floor = rms_of(every[1][0]) if floor is None else floor
    runs, seen = (tuple(parts[k] for parts in every) for k in (held_out, False))
    return gain_of(*runs, floor, problem.record.output_names, held_out=held_out, rng=context.rng, seen=seen)
