"""The diagnosis that a static gain gives."""

import numpy as np

from ...identification import Identification
from ...identification.validation.residuals import fit_of
from ...mechanics.effects.base import AbstractEffect, AbstractInputEffect
from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import AbstractDrive, Force
from ...numerics.progress import AbstractProgress
from ...records import Record
from .. import settings
from ..data_checks.record_findings import noise_findings
from ..findings import Curves, Finding, Member, ModelSummary, Move
from ..model.free_run import FreeRun, overall, rms_of
from ..noise.effective_samples import independent_share
from ..result import Diagnosis
from ..static_gain.regression import StaticFit
from ..static_gain.search import search_static
from .assembly import estimates_of


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

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`; `catalogue`: of which input effects and springs are
    tried; `max_effects`; `identification`: the linear fit, None where there was none; `rng`; `progress`.

    **Returns:** a `Diagnosis` whose model has no mass and no damping.
    """
    search = search_static(records, held, drive, catalogue, max_effects, rng=rng, progress=progress)
    base, fit, base_runs, runs, taken = search.base, search.fit, search.base_runs, search.runs, search.taken
    strong = search.strong
    record, names = records[0], records[0].output_names
    floor = rms_of(runs[0])
    findings = []
    for k, selected in enumerate(taken):
        trial, rivals, gain = selected.trial, selected.rivals, selected.gain
        members = [_member(fit, k, taken[-1].trial.share, record, 0.0)]
        for rival in rivals:
            difference = rival.delta_bic - trial.delta_bic
            members.append(_member(rival.fit, len(rival.fit.terms) - 1, rival.share, record, difference))
        status = "equivalent" if rivals else "named"
        findings.append(
            Finding(
                *trial.name,
                status,
                "model",
                tuple(members),
                members[0].parameters,
                trial.delta_bic,
                gain,
                found_by=Move.STATIC_GAIN.value,
            )
        )
    if strong:
        verdict = "partly" if findings else "unexplained"
    else:
        verdict = "noise" if not findings else "equivalent" if any(one.rivals for one in taken) else "named"
    if verdict == "unexplained":
        findings.append(Finding("unexplained", names[0], "unexplained", "model", (), {}, None, None))
    shares, last = {}, base.cost
    for selected in taken:
        shares[" at ".join(selected.trial.name)] = 100 * (last - selected.fit.cost) / base.cost
        last = selected.fit.cost
    rest = 100 * last / base.cost
    warnings = (
        "The record says nothing of inertia: decided by a static gain; its model has no mass and no damping, and must "
        "not be used for other frequencies.",
    )
    if any(isinstance(term.effect, AbstractInputEffect) for term in fit.terms):
        warnings += (
            "At one frequency hysteresis differs from a delay or lag by the shape of the loop alone; repeat the record "
            "at another frequency to be sure.",
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
        gain=search.gain_over(base_runs, runs, floor) if taken else None,
        excess=overall(rms_of(runs[0]), floor),
        baseline_excess=overall(rms_of(base_runs[0]), floor),
        white=_is_white(runs[0]),
        explainable=None,
        depends_on=("the history of the input",) if verdict in ("partly", "unexplained") else (),
        rejected=tuple(search.rejected),
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


def _is_white(runs: list[FreeRun]) -> bool:
    """Whether nearly all samples of what is left are independent of one another."""
    shares = [independent_share(run.e[run.kept.all(axis=1)]) for run in runs]
    return min(shares) >= settings.WHITE_INNOVATIONS


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
