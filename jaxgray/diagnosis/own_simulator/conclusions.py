"""What is said of a user's simulator: every run and every gain is the simulator's own."""

import dataclasses

import numpy as np

from .. import settings
from ..acceptance import unproven
from ..conclusions.assembly import accepted_names, findings_of, not_found_of, summary_of
from ..conclusions.candidates import gate_of, rejected_of
from ..data_checks.record_findings import noise_findings
from ..estimation.context import SearchContext
from ..findings import Curves, Estimate, Finding, Gain, Member, ParameterShift
from ..model.free_run import FreeRun, overall, rms_of
from ..noise.floor import ADOPTED, independent_floor
from ..noise.whitening import white_part
from ..result import Diagnosis
from ..search.state import SearchState
from .gains import Outputs, Parts, gain_between, nearer, parts_of
from .problem import Problem, Runs
from .settling import Settled, with_numbers

UNSETTLED = "The laws and numbers still moved in the last run of the simulator"


def diagnosis_of(
    problem: Problem,
    context: SearchContext,
    states: list[SearchState],
    every: list[Settled],
    *,
    baseline: Runs,
    fitted: Runs,
    start: np.ndarray,
) -> Diagnosis:
    """The diagnosis of a simulator.

    **Arguments:** `problem`; `context`, `states`: of the searches in the linear plant, one a law; `every`: laws and
    numbers in the simulator after each; `baseline`: runs with the numbers as they were given, `start` as entries;
    `fitted`: with numbers alone.
    """
    names = problem.record.output_names
    settled, state = every[-1], joined(states)
    records = [span.record[span.fit] for span in problem.spans if span.fit is not None]
    held = [span.record[span.held] for span in problem.spans if span.held is not None]
    before, after = (parts_of(problem, y) for y in (baseline.y, settled.y))
    floor, source = independent_floor(records[0])
    floor = rms_of(after[0]) if floor is None else floor

    def gain(one: Outputs, other: Outputs) -> Gain:
        return gain_between(problem, context, one, other, baseline.y, floor)

    context = dataclasses.replace(context, simulator=settled.linear, data=list(settled.data))
    plain = nearer(problem, fitted.y, baseline.y)
    steps = [plain, *(one.y for one in every)] if state.accepted else [settled.y]
    for k, accepted in enumerate(state.accepted):
        state.accepted[k] = dataclasses.replace(accepted, gain=gain(steps[k], steps[k + 1]))
    whole = gain(baseline.y, settled.y)
    state.fit = settled.fit
    laws = list(findings_of(context, state, records[0])) if state.accepted else []
    # In shares of what the laws leave with the numbers as they were.
    as_given = with_numbers(problem, settled, start) or baseline.y
    mended = gain_between(problem, context, as_given, settled.y, as_given, floor)
    numbers = _numbers(problem, settled, start, mended, sum(map(len, records)))
    findings = numbers + laws
    left = overall(rms_of(after[0]), floor)
    lost = state.accepted and overall(rms_of(after[0]), rms_of(_linear_runs(context, state))) >= settings.MIN_EXCESS
    unexplained = state.unexplained or bool(lost) or (source != ADOPTED and left >= settings.MIN_EXCESS)
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
    warnings = ()
    if not settled.still:
        warnings += (f"{UNSETTLED}: their errors may be larger than is said.",)
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
        curves=_curves(problem, baseline.y, settled.y),
        identification=None,
        terms=settled.candidate.terms,
        own_model=True,
        gate=gate_of(state),
        beside=settled.linear.forces(settled.candidate, settled.data[0])[: records[0].samples],
    )


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
    errors = _errors(settled) * np.abs(problem.units)
    return tuple(
        ParameterShift(name, float(old), float(new), float(error)) for (name, old, new), error in zip(values, errors)
    )


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


def _linear_runs(context: SearchContext, state: SearchState) -> list[FreeRun]:
    """What the search left in the linear plant."""
    last = state.accepted[-1].attempt.fit
    return [FreeRun(e, e, d.kept) for e, d in zip(last.residual, context.data)]
