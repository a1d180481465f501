"""What is said of a user's simulator: every run and every gain is the simulator's own."""

import dataclasses

import numpy as np

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
from ..noise.whitening import white_part
from ..result import Diagnosis
from ..search.state import SearchState
from .problem import Outputs, Parts, Problem, Runs, nearer, parts_of
from .settling import Settled, with_numbers

UNSETTLED = "The laws and numbers still moved in the last run of the simulator"

MUCH_FARTHER = 2.0
"""Error, relative to that of the run that a force leads along the record, which is more than noise."""

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
    settled, state = every[-1], joined(states)
    records = [span.record[span.fit] for span in problem.spans if span.fit is not None]
    held = [span.record[span.held] for span in problem.spans if span.held is not None]
    given, elsewhere = problem.begun(baseline.y), _begins_elsewhere(settled)
    shown = given if elsewhere else baseline.y
    before, after = (parts_of(problem, y) for y in (shown, settled.y))
    floor, source = independent_floor(records[0])
    floor = rms_of(after[0]) if floor is None else floor

    def gain(one: Outputs, other: Outputs) -> Gain:
        return gain_between(problem, context, one, other, given, floor)

    context = dataclasses.replace(context, simulator=settled.linear, data=list(settled.data))
    plain = given if fitted is None else nearer(problem, fitted.y, given)
    steps = [plain, *(one.y for one in every)] if state.accepted else [settled.y]
    for k, accepted in enumerate(state.accepted):
        state.accepted[k] = dataclasses.replace(accepted, gain=gain(steps[k], steps[k + 1]))
    whole = gain(given, settled.y)
    state.fit = settled.fit
    laws = list(findings_of(context, state, records[0])) if state.accepted else []
    # In shares of what the laws leave with the numbers as they were.
    left = overall(rms_of(after[0]), floor)
    # What the linear plant foresaw and the simulator does not keep.
    foreseen = [FreeRun(e, e, d.kept) for e, d in zip(settled.fit.residual, settled.data)]
    lost = overall(rms_of(after[0]), rms_of(foreseen)) >= settings.MIN_EXCESS
    unexplained = state.unexplained or lost or (source != ADOPTED and left >= settings.MIN_EXCESS)
    # A force makes the simulator follow the record much more closely than laws and numbers do.
    led = overall(rms_of(after[0]), rms_of(parts_of(problem, followed.y)[0]))
    unexplained = unexplained or led >= MUCH_FARTHER
    warnings = _warnings(problem, settled, start, elsewhere, unexplained)
    as_given = None if unexplained else with_numbers(problem, settled, start, baseline)
    numbers = []
    if as_given is not None:
        mended = gain_between(problem, context, as_given, settled.y, as_given, floor)
        numbers = _numbers(problem, settled, start, mended, sum(map(len, records)))
    findings = numbers + laws
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
    if numbers or laws:
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
        shifts=_shifts(problem, settled, start),
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


def is_white(runs: list[FreeRun]) -> bool:
    """Whether runs leave about as much as the white part of it."""
    return all(np.all(run.rmse**2 <= settings.MIN_EXCESS**2 * white_part(run.e, run.kept)) for run in runs)


def _errors(settled: Settled) -> np.ndarray:
    count = len(settled.candidate.entries)
    return np.sqrt(np.maximum(np.diag(settled.fit.covariance)[:count], 0.0))


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
    problem: Problem, settled: Settled, start: np.ndarray, elsewhere: bool, unexplained: bool
) -> tuple[str, ...]:
    """What is to be known of the numbers; `elsewhere`: whether a record begins in another state than its run."""
    names, entries, warnings = problem.simulator.names, settled.candidate.entries, []
    if not settled.still:
        warnings.append(f"{UNSETTLED}: their errors may be larger than is said.")
    if elsewhere:
        warnings.append(
            "The record does not begin where the simulator does: its first state was fitted, to first order; put it "
            "among the numbers where it is large."
        )
    moved = np.abs(entries - start) > 3 * np.maximum(_errors(settled), 1e-12)
    if unexplained and np.any(moved):
        which = listed(name for name, one in zip(names, moved) if one)
        warnings.append(f"Beside what is not explained, {which} would be other: no finding, since they make up for it.")
    loose = settled.fit.undetermined[: len(entries)] | settled.linear.setup.held
    if np.any(loose):
        which = listed(name for name, one in zip(names, loose) if one)
        warnings.append(f"This record does not determine {which}: excite what they act on, or leave them out.")
    return tuple(warnings)


def _numbers(problem: Problem, settled: Settled, start: np.ndarray, gain: Gain, samples: int) -> list[Finding]:
    """Findings of the numbers that are off for sure, and whose correction surely gains."""
    if unproven(gain) is not None:
        return []
    found = []
    for k, (name, error) in enumerate(zip(problem.simulator.names, _errors(settled))):
        off, unit = settled.candidate.entries[k] - start[k], abs(problem.units[k])
        evidence = (off / error) ** 2 - np.log(samples) if error > 0 else 0.0
        if evidence < settings.MIN_DELTA_BIC:
            continue
        delta = off * problem.units[k]
        parameters = {
            "delta": Estimate(float(delta), float(error * unit), ""),
            "value": Estimate(float(settled.candidate.entries[k] * problem.units[k]), float(error * unit), ""),
        }
        member = Member("parameter_error", name, 0.0, parameters)
        found.append(Finding("parameter_error", name, "named", "model", (member,), parameters, float(evidence), gain))
    return found


def _shifts(problem: Problem, settled: Settled, start: np.ndarray) -> tuple[ParameterShift, ...]:
    """Every number as it was given and as it is fitted."""
    values = zip(problem.simulator.names, start * problem.units, settled.candidate.entries * problem.units)
    errors = [
        None if loose or error == 0.0 else float(error)
        for error, loose in zip(_errors(settled) * np.abs(problem.units), settled.fit.undetermined)
    ]
    return tuple(ParameterShift(name, float(old), float(new), error) for (name, old, new), error in zip(values, errors))


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
