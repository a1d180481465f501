"""A diagnosis as a plain dictionary: what goes into the JSON file and onto the terminal."""

import numpy as np

from ...diagnosis.findings import Estimate, Finding, Gain, ModelSummary, NextExperiment, SimulatedOutputs
from ...diagnosis.result import Diagnosis
from ...mechanics.energy import EnergyBalance
from ...mechanics.matrix_units import matrix_units
from .export import model_document, plain
from .identification import record_document
from .terms import term_document

DIAGNOSIS = "jaxgray/diagnosis/1"


def diagnosis_document(diagnosis: Diagnosis, notes: tuple[str, ...] = ()) -> dict:
    """A diagnosis as the JSON schema `jaxgray/diagnosis/1`.

    **Arguments:** `diagnosis`; `notes`: from reading the files, put before the warnings of the diagnosis.

    **Returns:** dictionaries, lists, numbers and texts; None where something is not known, never NaN.
    """
    document = {
        "schema": DIAGNOSIS,
        "verdict": diagnosis.verdict,
        "sentence": diagnosis.sentence,
        "own_model": diagnosis.own_model,
        "simulated": _simulated(diagnosis.simulated),
        "baseline": _summary(diagnosis.baseline)
        | {
            "noise_floor": diagnosis.noise_floor,
            "noise_floor_source": diagnosis.noise_floor_source,
            "excess": diagnosis.baseline_excess,
        },
        "findings": [_finding(finding) for finding in diagnosis.findings],
        "extended": None if diagnosis.extended is None else _extended(diagnosis),
        "remaining": {
            "white": diagnosis.white,
            "excess": diagnosis.excess,
            "explainable": diagnosis.explainable,
            "depends_on": diagnosis.depends_on,
        },
        "rejected": [
            {
                "effect": one.effect,
                "location": one.location,
                "delta_bic": one.delta_bic,
                "why": one.why,
                "parameters": _estimates(one.parameters),
                "gain": _gain(one.gain),
            }
            for one in diagnosis.rejected
        ],
        "not_found": [
            {"effect": one.effect, "location": one.location, "min_detectable": _sizes(one.min_detectable)}
            for one in diagnosis.not_found
        ],
        "gate": [
            {"effect": one.effect, "location": one.location, "delta_bic": one.delta_bic} for one in diagnosis.gate
        ],
        "shifts": [
            {
                "name": shift.name,
                "before": shift.before,
                "after": shift.after,
                "standard_error": shift.standard_error,
                "percent": shift.percent,
            }
            for shift in diagnosis.shifts
        ],
        "budget": diagnosis.budget,
        "energy": _energy(diagnosis.energy),
        "next_experiment": _experiment(diagnosis.next_experiment, diagnosis),
        "records": {
            "estimation": [record_document(record) for record in diagnosis.records],
            "validation": [record_document(record) for record in diagnosis.validation_records],
        },
        "warnings": list(dict.fromkeys((*notes, *diagnosis.warnings))),
    }
    return plain(document)


def _energy(balance: EnergyBalance | None) -> dict | None:
    """Where the work of the inputs goes, in percent of all energy that came in as well."""
    if balance is None:
        return None
    laws = [
        {"effect": law.effect, "location": law.place, "work": law.work, "creates": law.creates} for law in balance.laws
    ]
    amounts = {name: getattr(balance, name) for name in ("entered", "supplied", "stored", "damped", "circulated")}
    return {"unit": balance.unit, **amounts, "laws": laws, "residual": balance.residual}


def _simulated(simulated: SimulatedOutputs | None) -> dict | None:
    """What stands in for simulated outputs."""
    if simulated is None:
        return None
    findings = [_finding(finding) for finding in simulated.findings]
    return {"findings": findings, "left_percent": simulated.left_percent}


def _summary(summary: ModelSummary) -> dict:
    """Matrices with their errors and units, fits and errors of the free run."""
    errors = summary.standard_errors
    return {
        "model": model_document(summary.model)
        | {
            "standard_errors": None if errors is None else {k: np.asarray(X).tolist() for k, X in errors.items()},
            "units": matrix_units(summary.model),
        },
        "fit_percent": summary.fit_percent,
        "rmse": summary.rmse,
    }


def _extended(diagnosis: Diagnosis) -> dict:
    made = _summary(diagnosis.extended) | {"gain": _gain(diagnosis.gain)}
    made["model"]["effects"] = [term_document(term) for term in diagnosis.extended.model.effects or diagnosis.terms]
    return made


def _finding(finding: Finding) -> dict:
    return {
        "effect": finding.effect,
        "location": finding.location,
        "status": finding.status,
        "stage": finding.stage,
        "members": [
            {
                "effect": member.effect,
                "location": member.location,
                "delta_bic": member.delta_bic,
                "parameters": _estimates(member.parameters),
            }
            for member in finding.members
        ],
        "parameters": _estimates(finding.parameters),
        "delta_bic": finding.delta_bic,
        "gain": _gain(finding.gain),
        "message": finding.message,
        "found_by": finding.found_by,
    }


def _estimates(parameters: dict[str, Estimate]) -> dict:
    return {
        name: {"value": one.value, "standard_error": one.standard_error, "unit": one.unit}
        for name, one in parameters.items()
    }


def _sizes(parameters: dict[str, Estimate]) -> dict:
    return {name: {"value": one.value, "unit": one.unit} for name, one in parameters.items()}


def _gain(gain: Gain | None) -> dict | None:
    if gain is None:
        return None
    return {
        "per_output": {
            name: {"rmse_before": before, "rmse_after": after} for name, (before, after) in gain.per_output.items()
        },
        "percent": gain.percent,
        "ci95": gain.ci95,
        "ci99_lower": gain.ci99_lower,
        "held_out": gain.held_out,
        "together": gain.together,
    }


def _experiment(experiment: NextExperiment | None, diagnosis: Diagnosis) -> dict | None:
    if experiment is None:
        return None
    names = diagnosis.baseline.model.input_names
    u = np.asarray(experiment.input)
    return {
        "members": experiment.members,
        "text": experiment.text,
        "separation": experiment.separation,
        "separation_now": experiment.separation_now,
        "sampling_time": experiment.sampling_time,
        "samples": len(u),
        "input": dict(zip(names, u.T.tolist())),
    }
