"""The diagnosis of records that say nothing of inertia: effects at the inputs of a static gain, judged held out."""

from dataclasses import dataclass

import numpy as np

from ..identification import Identification
from ..identification.structure_test import ROUNDING
from ..identification.validation import fit_of
from ..mechanics.drives import AbstractDrive, Force
from ..mechanics.effects.base import AbstractEffect, AbstractInputEffect, Term, places_of
from ..mechanics.model import MechanicalModel
from ..numerics.progress import AbstractProgress
from ..records import Record
from .assembly import estimates_of
from .force_fit import independent_share
from .force_route import rms_of
from .gain import gain_of
from .judgement import ACCEPTED, ALIKE, SIGNIFICANT, FreeRun, overall
from .problem import estimated
from .record_findings import noise_findings
from .result import Curves, Diagnosis, Finding, Gain, Member, ModelSummary, Rejected
from .static_fit import Static, StaticFit

EXPLAINED = 0.1
"""Least share of the remaining mean square error that a finding must explain."""


@dataclass(frozen=True)
class Trial:
    """A refitted candidate; `delta_bic` against the fit without, under its own share of independent samples."""

    fit: StaticFit
    delta_bic: float
    share: float
    runs: list[FreeRun]

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        term = self.fit.terms[-1]
        return term.effect.id, term.place.name

    @property
    def significance(self) -> float:
        """|β|/se of the new term's amplitude; of several, which may share one loop between them, what ΔBIC says."""
        term = self.fit.terms[-1]
        amplitudes = [j for j in estimated(term) if term.effect.parameters[j].amplitude]
        if len(amplitudes) != 1:
            return float(np.sqrt(max(self.delta_bic, 0.0) / len(amplitudes))) if amplitudes else np.inf
        error = self.fit.term_errors(len(self.fit.terms) - 1, self.share)[amplitudes[0]]
        return abs(float(term.values[amplitudes[0]])) / error if error > 0 else 0.0


def static_diagnosis(
    records: list[Record],
    held: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    *,
    identification: Identification | None,
    rng: np.random.Generator,
    progress: AbstractProgress,
) -> Diagnosis:
    """What a static gain gets wrong on records without information on inertia.

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`; `catalogue`: of which the input effects are tried;
    `max_effects`; `identification`: the linear fit, None where there was none; `rng`; `progress`.

    **Returns:** a `Diagnosis` whose model has no mass and no damping.
    """
    progress.stage("fitting a static gain")
    problem, later = Static(records), Static(held)
    names, inputs = records[0].output_names, records[0].input_names
    base = fit = problem.fit(())
    base_runs = problem.run(base), later.run(base)
    runs = base_runs
    taken: list[tuple[Trial, tuple[Trial, ...], Gain]] = []
    rejected: list[Rejected] = []
    strong = False
    effects = [e for e in catalogue if isinstance(e, AbstractInputEffect)]
    # One look more than effects may be added: whether something is left.
    for turn in range(0 if _is_rounding(base_runs[0], records) else max_effects + 1):
        accepted = {trial.name for trial, _, _ in taken}
        trials = []
        for effect in effects:
            for place in places_of(effect, inputs, names):
                if (effect.id, place.name) not in accepted:
                    progress.stage(f"refitting {effect.id} at {place.name}")
                    trial = _trial(problem, fit, effect, place)
                    trials += [] if trial is None else [trial]
        trials.sort(key=lambda trial: -trial.delta_bic)
        passed = []
        for trial in trials:
            why = _refused(fit, trial)
            if why is None:
                passed.append(trial)
            elif trial.delta_bic > 0:
                rejected.append(Rejected(*trial.name, trial.delta_bic, why))
        strong = bool(passed)
        if turn == max_effects:
            break
        found = None
        for trial in passed:
            new = problem.run(trial.fit), later.run(trial.fit)
            before, after, first = (x[1] or x[0] for x in (runs, new, base_runs))
            gain = gain_of(before, after, first, rms_of(first), names, held_out=bool(held), rng=rng)
            if gain.ci99_lower > 0:
                found = trial, gain, new
                break
            why = f"no sure gain on held-out data ({gain.percent:.1f} %, from {gain.ci99_lower:.1f} %)"
            rejected.append(Rejected(*trial.name, trial.delta_bic, why))
        if found is None:
            break
        trial, gain, runs = found
        rivals = []
        for other in passed:
            difference = trial.delta_bic - other.delta_bic
            if 0 <= difference < ALIKE and other is not trial:
                rivals.append(other)
            elif difference >= ALIKE:
                why = f"explained better by {' at '.join(trial.name)} (by {difference:.0f})"
                rejected.append(Rejected(*other.name, other.delta_bic, why))
        taken.append((trial, tuple(rivals[:3]), gain))
        fit = trial.fit
    return _diagnosis(records, held, drive, base, fit, base_runs, runs, taken, rejected, strong, identification, rng)


def _is_rounding(runs: list[FreeRun], records: list[Record]) -> bool:
    """Whether runs leave nothing but rounding of the outputs."""
    size = np.max([np.nanmax(np.abs(record.y), axis=0) for record in records], axis=0)
    return bool(np.all(rms_of(runs) <= ROUNDING * size))


def _trial(problem: Static, before: StaticFit, effect: AbstractEffect, place) -> Trial | None:
    """A candidate refitted from all its shapes; None where none is finite."""
    best = None
    shapes = effect.shapes(problem.scales(place))
    for values in shapes:
        start = np.array(values, float)
        start[[p.amplitude for p in effect.parameters]] *= 0.1
        made = problem.fit((*before.terms, Term(effect, place, effect.bounded(start))))
        if made is not None and (best is None or made.cost < best.cost):
            best = made
    if best is None:
        return None
    runs = problem.run(best)
    share = independent_share(max((run.e[run.kept.all(axis=1)] for run in runs), key=len))
    delta = before.criterion(share) - best.criterion(share) - 2 * np.log(len(shapes))
    return Trial(best, float(delta), share, runs)


def _refused(before: StaticFit, trial: Trial) -> str | None:
    if trial.delta_bic < ACCEPTED:
        return f"the refit explains too little (ΔBIC {trial.delta_bic:.0f})"
    if trial.significance < SIGNIFICANT:
        return f"only {trial.significance:.1f} standard errors from nothing"
    share = 1 - trial.fit.cost / before.cost
    return None if share >= EXPLAINED else f"explains only {100 * share:.0f} % of what is left"


def _model(fit: StaticFit, record: Record, drive: AbstractDrive) -> MechanicalModel:
    """Stiffness without mass and damping; the least-squares one where inputs and outputs differ in number."""
    dofs = record.outputs
    K = np.asarray(drive.input_map) @ np.linalg.pinv(fit.gain) if isinstance(drive, Force) else np.eye(dofs)
    none = np.zeros((dofs, dofs))
    return MechanicalModel(
        none,
        none,
        (K + K.T) / 2,
        drive=drive,
        measured=record.measured,
        input_names=record.input_names,
        output_names=record.output_names,
        input_units=record.input_units,
        output_units=record.output_units,
        effects=fit.terms,
    )


def _summary(fit: StaticFit, records, held, drive, runs) -> ModelSummary:
    model = _model(fit, records[0], drive)
    fits = {}
    for kind, group, made in zip(("estimation", "validation"), (records, held), runs):
        if group:
            measured = np.concatenate([np.where(run.kept, r.y, np.nan) for r, run in zip(group, made)])
            fits[kind] = fit_of(measured, np.concatenate([run.simulated for run in made]))
    per_output = [
        {kind: dict(zip(model.output_names, map(float, getattr(f, name)))) for kind, f in fits.items()}
        for name in ("fit_percent", "rmse")
    ]
    return ModelSummary(model, None, *per_output)


def _member(fit: StaticFit, index: int, share: float, record: Record, difference: float) -> Member:
    term = fit.terms[index]
    parameters = estimates_of(term, fit.term_errors(index, share), record)
    return Member(term.effect.id, term.place.name, float(difference), parameters)


def _diagnosis(records, held, drive, base, fit, base_runs, runs, taken, rejected, strong, identification, rng):
    record, names = records[0], records[0].output_names
    floor = rms_of(runs[0])
    findings = []
    for k, (trial, rivals, gain) in enumerate(taken):
        members = [_member(fit, k, taken[-1][0].share, record, 0.0)]
        for rival in rivals:
            difference = rival.delta_bic - trial.delta_bic
            members.append(_member(rival.fit, len(rival.fit.terms) - 1, rival.share, record, difference))
        status = "equivalent" if rivals else "named"
        findings.append(
            Finding(*trial.name, status, "model", tuple(members), members[0].parameters, trial.delta_bic, gain)
        )
    if strong:
        verdict = "partly" if findings else "unexplained"
    else:
        verdict = "noise" if not findings else "equivalent" if any(r for _, r, _ in taken) else "named"
    if verdict == "unexplained":
        findings.append(Finding("unexplained", names[0], "unexplained", "model", (), {}, None, None))
    before, after = (x[1] or x[0] for x in (base_runs, runs))
    shares, last = {}, base.cost
    for trial, _, _ in taken:
        shares[" at ".join(trial.name)] = 100 * (last - trial.fit.cost) / base.cost
        last = trial.fit.cost
    rest = 100 * last / base.cost
    warnings = (
        "The record says nothing of inertia: decided on a static gain; its model has no mass and no damping, and must "
        "not be used for other frequencies.",
        "At one frequency hysteresis differs from a delay or lag by the shape of the loop alone; repeat the record at "
        "another frequency to be sure.",
    )
    noise = noise_findings(record, runs[0][0].e)
    curves = []
    for held_out, group in enumerate((records, held)):
        for one, old, new in zip(group, base_runs[held_out], runs[held_out]):
            curves.append(Curves(one.time, one.y, old.simulated, new.simulated, bool(held_out)))
    return Diagnosis(
        verdict=verdict,
        baseline=_summary(base, records, held, drive, base_runs),
        noise_floor=dict(zip(names, map(float, floor))),
        noise_floor_source="residual of the final static model",
        findings=noise + tuple(findings),
        extended=_summary(fit, records, held, drive, runs) if taken else None,
        gain=gain_of(before, after, before, floor, names, held_out=bool(held), rng=rng) if taken else None,
        excess=overall(rms_of(runs[0]), floor),
        baseline_excess=overall(rms_of(base_runs[0]), floor),
        white=False,
        explainable=None,
        depends_on=("the history of the input",) if verdict in ("partly", "unexplained") else (),
        rejected=tuple(rejected),
        not_found=(),
        shifts=(),
        budget={**shares, "noise": 0.0 if strong else rest, "unexplained": rest if strong else 0.0},
        next_experiment=None,
        warnings=warnings,
        records=tuple(records),
        validation_records=tuple(held),
        curves=tuple(curves),
        identification=identification,
        terms=fit.terms,
        own_model=False,
    )
