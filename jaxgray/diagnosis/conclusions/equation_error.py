"""From a search in the force equation to a `Diagnosis`."""

import dataclasses

import numpy as np

from ...identification import Identification
from ...identification.validation.residuals import fit_of
from ...mechanics.effects.base import Term
from ...numerics.responses.filters import white_part
from ...records import Record
from .. import settings
from ..data_checks.record_findings import noise_findings
from ..equation_error.library import Scores
from ..equation_error.regression import ForceFit
from ..equation_error.search import Search
from ..equation_error.unmeasured_forces import warnings_of
from ..findings import Curves, Finding, Member, ModelSummary, Move, NotFound
from ..model.free_run import overall, rms_of
from ..result import Diagnosis
from ..selection import Runs
from .assembly import estimates_of, shifts_of


def force_diagnosis(search: Search, identification: Identification | None) -> Diagnosis:
    """What a search in the force equation found, as a `Diagnosis`.

    **Arguments:** `search`; `identification`: the linear fit, None where there was none.

    **Returns:** a `Diagnosis` whose fits and errors are those of free runs over short windows.
    """
    record, held = search.records[0], search.held
    names = record.output_names
    floor = rms_of(search.runs[0])
    window = search.windows.samples * record.sampling_time
    source = f"residual of the final model over windows of {window:.3g} s"
    quiet = np.sqrt(white_part(np.nan_to_num(record.y), np.isfinite(record.y)))
    lost = not search.taken and bool(np.any(floor > settings.NOISE_MULTIPLE * quiet))
    if lost:
        floor, source = np.maximum(quiet, 1e-300), "fast part of the measured motion"
    findings = [_finding(search, k) for k in range(len(search.taken))]
    extended = gain = None
    shifts = ()
    if search.taken:
        extended = summary_of_windows(search, search.fit, search.runs)
        shifts = shifts_of(search.model(search.base), search.model(search.fit), search.matrix_errors(search.fit))
        # The same, from the same draws: one finding must not have two intervals.
        gain = (
            search.taken[0].gain if len(search.taken) == 1 else search.gain_over(search.base_runs, search.runs, floor)
        )
    verdict = "noise"
    if lost or (search.strong and findings):
        verdict = "partly" if findings else "unexplained"
    elif findings:
        verdict = "equivalent" if any(f.status == "equivalent" for f in findings) else "named"
    if verdict == "unexplained":
        findings.append(Finding("unexplained", names[0], "unexplained", "model", (), {}, None, None))
    errors = search.error(search.base), search.error(search.fit)
    warnings = (
        "No free run over the whole record is usable: decided by the force equation below "
        f"{search.equation.series[0].band.high:.3g} Hz; fits and errors are those of free runs over windows of "
        f"{window:.3g} s, with the first state of each estimated.",
        f"Relative force error where the machine moves: {errors[0]:.3g} before, {errors[1]:.3g} after.",
        *warnings_of(search.brief_forces, [*search.records, *held], search.model(search.fit)),
    )
    noise = noise_findings(record, _padded(search.runs[0][0].e, record))
    return Diagnosis(
        verdict=verdict,
        baseline=summary_of_windows(search, search.base, search.base_runs),
        noise_floor=dict(zip(names, map(float, floor))),
        noise_floor_source=source,
        findings=noise + tuple(findings),
        extended=extended,
        gain=gain,
        excess=overall(rms_of(search.runs[0]), floor),
        baseline_excess=overall(rms_of(search.base_runs[0]), floor),
        white=False,
        explainable=None,
        depends_on=_depends_on(search.scores) if verdict in ("partly", "unexplained") else (),
        rejected=tuple(search.rejected),
        not_found=_not_found(search, record),
        shifts=shifts,
        budget=_budget(search),
        next_experiment=None,
        warnings=warnings,
        records=tuple(search.records),
        validation_records=tuple(held),
        curves=curves_of(search, search.base_runs, search.runs),
        identification=identification,
        terms=search.fit.terms,
        own_model=False,
    )


def _padded(e: np.ndarray, record: Record) -> np.ndarray:
    """A residual over windows with zeros for what is left of the record."""
    return np.concatenate([e, np.zeros((record.samples - len(e), e.shape[1]))])


def _finding(search: Search, index: int) -> Finding:
    taken = search.taken[index]
    record = search.records[0]
    members = [_member(search.fit, index, record, 0.0)]
    if shared := _shared(search, index):
        own = {name: value for name, value in members[0].parameters.items() if name not in shared}
        members[0] = dataclasses.replace(members[0], parameters=own)
    for rival in taken.rivals:
        members.append(_member(rival.fit, -1, record, min(rival.delta_bic - taken.trial.delta_bic, 0.0)))
    status = "named" if len(members) == 1 else "equivalent"
    for one, difference in taken.stood_in:
        members.append(_member(one.fit, -1, record, min(difference, 0.0)))
    before, after = (search.error(one) for one in (search.taken[index - 1].fit if index else search.base, taken.fit))
    return Finding(
        *taken.trial.name,
        status,
        "model",
        tuple(members),
        members[0].parameters,
        taken.trial.delta_bic,
        taken.gain,
        f"Relative force error {before:.3g} before, {after:.3g} after."
        + (f" {', '.join(shared)} is that of the finding before." if shared else ""),
        Move.FORCE_EQUATION.value,
    )


def _shared(search: Search, index: int) -> list[str]:
    """Parameters of a law that an earlier finding has in the model already."""
    term, moving = search.fit.terms[index], search.fit.moving[index]
    return [p.name for j, p in enumerate(term.effect.parameters) if p.amplitude and j not in moving]


def _member(fit: ForceFit, index: int, record: Record, difference: float) -> Member:
    index %= len(fit.terms)
    term = fit.terms[index]
    parameters = estimates_of(term, fit.term_errors(index), record)
    return Member(term.effect.id, term.place.name, float(difference), parameters)


def summary_of_windows(search: Search, fit: ForceFit, runs: Runs) -> ModelSummary:
    """The model of a fit, and how near its runs over windows are to the records."""
    model = search.model(fit)
    fits = {}
    for kind, records, made in zip(("estimation", "validation"), (search.records, search.held), runs):
        if records:
            counted = [np.where(run.kept, r.y[: len(run.kept)], np.nan) for r, run in zip(records, made)]
            measured = np.concatenate(counted)
            fits[kind] = fit_of(measured, np.concatenate([run.simulated for run in made]))
    per_output = [
        {kind: dict(zip(model.output_names, map(float, getattr(f, name)))) for kind, f in fits.items()}
        for name in ("fit_percent", "rmse")
    ]
    return ModelSummary(model, search.matrix_errors(fit), *per_output)


def _not_found(search: Search, record: Record) -> tuple[NotFound, ...]:
    result = []
    for (effect, place), one in search.scores.best_by_place().items():
        if one.delta_bic >= settings.MIN_DELTA_BIC:
            continue
        shape = one.shape
        values = np.array(shape.values, float)
        amplitudes = [j for j, p in enumerate(shape.effect.parameters) if p.amplitude]
        values[amplitudes] = np.abs(values[amplitudes]) * one.smallest
        sizes = estimates_of(Term(shape.effect, shape.place, values), {}, record)
        names = [shape.effect.parameters[j].name for j in amplitudes] or list(sizes)
        result.append(NotFound(effect, place, {name: sizes[name] for name in names}))
    return tuple(result)


def _depends_on(scores: Scores) -> tuple[str, ...]:
    families = {"stiffness": "displacement", "friction": "velocity", "hysteresis": "the history of displacement"}
    words = []
    for (_, place), one in list(scores.best_by_place().items())[:3]:
        if one.delta_bic > 0:
            words.append(f"{families.get(one.shape.effect.family, one.shape.effect.family)} ({place})")
    return tuple(dict.fromkeys(words))


def _budget(search: Search) -> dict[str, float]:
    """Shares in the power of the force that the linear model leaves, in percent."""
    before = search.error(search.base) ** 2
    shares, last = {}, before
    for taken in search.taken:
        error = search.error(taken.fit) ** 2
        shares[" at ".join(taken.trial.name)] = 100 * (last - error) / before
        last = error
    rest = 100 * last / before
    return {**shares, "noise": 0.0 if search.strong else rest, "unexplained": rest if search.strong else 0.0}


def curves_of(search: Search, before: Runs, after: Runs) -> tuple[Curves, ...]:
    """Runs over windows of every record, before and after."""
    result = []
    for held_out, records in enumerate((search.records, search.held)):
        for k, record in enumerate(records):
            # Windows that do not count are not drawn: the worst of all would be one that something else pushed.
            old, new = (np.where(x[held_out][k].kept, x[held_out][k].simulated, np.nan) for x in (before, after))
            cut = len(old)
            result.append(Curves(record.time[:cut], record.y[:cut], old, new, bool(held_out)))
    return tuple(result)
