"""Results as plain dictionaries: what goes into the JSON files and onto the terminal."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ...identification.result import Identification
from ...identification.sweep import Sweep
from ...identification.validation.residuals import Fit
from ...mechanics.matrix_units import matrix_units
from ...mechanics.modal_uncertainty import antiresonance_errors, mode_errors
from ...mechanics.model import MechanicalModel
from ...mechanics.systems.zeros import zeros_of_pairs
from ...numerics.matrices.linear_algebra import triangle
from ...records import Record
from .export import model_document

IDENTIFICATION = "jaxgray/identification/1"
SWEEP = "jaxgray/sweep/1"
SIMULATION = "jaxgray/simulation/1"

LARGEST_CONDITION = 1e12
"""Condition number of the hidden coordinates' stiffness up to which they are held by springs."""


def identification_document(result: Identification, warnings: tuple[str, ...] = ()) -> dict:
    """An identification as the JSON schema `jaxgray/identification/1`.

    **Arguments:** `result`; `warnings`: from reading the files, put before those of the result.

    **Returns:** dictionaries, lists, numbers and texts; None or NaN (null in the file) where something is
    not known, as all uncertainty is without refinement.
    """
    model = result.model
    spread = result.uncertainty
    tests, found = result.residual_test, result.structure_test
    return {
        "schema": IDENTIFICATION,
        "model": model_document(model)
        | {
            "standard_errors": None
            if spread is None
            else {name: errors.tolist() for name, errors in result.standard_errors.items()},
            "units": matrix_units(model),
        }
        | hidden_entries(result),
        "fit_percent": result.fit_percent,
        "rmse": result.rmse,
        "noise_floor": per_name(model.output_names, result.noise_floor),
        "start": {
            "method": result.start.method,
            "time_constant": result.start.time_constant,
            "block_rows": result.start.block_rows,
            "singular_values": result.start.singular_values,
        },
        "refined": result.refinement is not None,
        "modes": modes_document(result),
        "zeros_hz": antiresonances(model),
        "covariance": None if spread is None else {"names": list(spread.names), "matrix": spread.covariance.tolist()},
        "condition_number": None if spread is None else spread.condition_number,
        "at_edge": None if spread is None else list(spread.at_edge),
        "weak_directions": None if spread is None else list(spread.weak_directions),
        "unmoved": None if spread is None else list(spread.unmoved),
        "hidden": hidden_document(result),
        "residual_test": {
            "white": tests.white,
            "input_explained": tests.input_explained,
            "feedback": tests.feedback,
        },
        "structure_test": None
        if found is None
        else {"fits": found.fits, "p_value": found.p_value, "explained_percent": found.explained_percent},
        "aic": result.aic,
        "bic": result.bic,
        "noise": result.noise,
        "clocks": [dataclasses.asdict(clock) for clock in result.clocks],
        "records": {
            "estimation": [record_document(record) for record in result.records],
            "validation": [record_document(record) for record in result.validation_records],
        },
        "warnings": list(dict.fromkeys((*warnings, *result.warnings))),
    }


def hidden_entries(result: Identification) -> dict:
    """Of every entry of the matrices, what it is: "set", "canonical", "open" or "physical"; nothing without hidden
    coordinates."""
    if result.hidden is None or not result.model.hidden:
        return {}
    dofs = range(result.model.dofs)
    kind = result.hidden.kind
    names = ("mass", "damping", "stiffness")
    return {"entries": {name: [[kind(name, r, c) for c in dofs] for r in dofs] for name in names}}


def hidden_document(result: Identification) -> dict | None:
    """What is known of coordinates that no output measures; None where every one is."""
    known = result.hidden
    if known is None:
        return None
    order = known.order
    return {
        "coordinates": list(known.names),
        "canonical": known.canonical,
        "rank": known.rank,
        "parameters": known.parameters,
        "combinations": list(known.combinations),
        "elements": [dataclasses.asdict(element) for element in known.elements],
        "alternatives": [model_document(model) for model in known.alternatives],
        "order": None
        if order is None
        else {
            "steps": [dataclasses.asdict(step) for step in order.steps],
            "singular_values": order.singular_values,
        },
        "static_stiffness": static_stiffness(result),
        "zeros_standard_errors_hz": zero_errors(result),
        "sentences": known.sentences(),
    }


def static_stiffness(result: Identification) -> dict | None:
    """Static stiffness K11 − K12 K22⁻¹ K21 of the measured coordinates, the hidden ones free to follow, with standard
    errors by the delta method; None where hidden ones alone are free to move."""
    model, p = result.model, result.model.outputs
    K = np.asarray(model.stiffness)
    if p == len(K) or not np.linalg.cond(K[p:, p:]) < LARGEST_CONDITION:
        return None
    # K11 − K12 K22⁻¹ K21 = Tᵀ K T with T = [I; −K22⁻¹ K21], of which the derivative is Tᵀ dK T.
    T = np.concatenate([np.eye(p), -np.linalg.solve(K[p:, p:], K[p:, :p])])
    errors = None
    if result.covariance is not None:
        rows, columns = triangle(len(K))
        count = len(rows)
        slopes = np.einsum("ki,kj->kij", T[rows], T[columns])
        slopes = np.where((rows == columns)[:, None, None], slopes, slopes + np.swapaxes(slopes, 1, 2))
        own = result.covariance[2 * count :, 2 * count :]
        errors = np.sqrt(np.maximum(np.einsum("kij,kl,lij->ij", slopes, own, slopes), 0.0)).tolist()
    return {"value": (T.T @ K @ T).tolist(), "standard_error": errors}


def zero_errors(result: Identification) -> dict[str, list[float]] | None:
    """Standard errors of the antiresonances, in the order of `antiresonances`; None without refinement."""
    if result.covariance is None:
        return None
    found = antiresonance_errors(result.model, result.covariance)
    return {f"{source}->{place}": errors.tolist() for (source, place), errors in found.items()}


def modes_document(result: Identification) -> list[dict]:
    """Every mode with its standard errors; None without refinement."""
    return modes_of(result.model, None if result.uncertainty is None else result.covariance)


def modes_of(model: MechanicalModel, covariance: Float[np.ndarray, "entries entries"] | None) -> list[dict]:
    """Every mode of a model, with standard errors where the covariance of its entries is known."""
    modes = model.modes()
    frequencies, ratios, _ = (None, None, None) if covariance is None else mode_errors(model, covariance)
    return [
        {
            "frequency_hz": float(modes.natural_frequency_hz[k]),
            "frequency_standard_error": None if frequencies is None else float(frequencies[k]),
            "damping_ratio": float(modes.damping_ratio[k]),
            "damping_ratio_standard_error": None if ratios is None else float(ratios[k]),
            "shape": modes.mode_shapes[:, k].tolist(),
        }
        for k in range(len(modes.natural_frequency_hz))
    ]


def antiresonances(model: MechanicalModel) -> dict[str, list[float]]:
    """Antiresonances in Hz of every input and output, as `u1->y1`; none where the input never arrives."""
    found = zeros_of_pairs(model)
    return {
        f"{source}->{place}": found[source, place].antiresonance_hz.tolist() if (source, place) in found else []
        for source in model.input_names
        for place in model.output_names
    }


def record_document(record: Record) -> dict:
    """What a record was like, without its samples."""
    return {
        "samples": record.samples,
        "sampling_time": record.sampling_time,
        "hold": record.hold,
        "missing": per_name(record.output_names, record.missing.sum(axis=0)),
    }


def per_name(names: tuple[str, ...], values) -> dict[str, float]:
    """Numbers by the names of their channels."""
    return dict(zip(names, np.asarray(values).tolist()))


def sweep_document(result: Sweep, warnings: tuple[str, ...] = ()) -> dict:
    """A sweep as the JSON schema `jaxgray/sweep/1`: one cell per choice, in rows of equal τ.

    **Arguments:** `result`; `warnings`: from reading the files.

    **Returns:** dictionaries, lists, numbers and texts; NaN (null in the file) where a choice gave no model.
    """
    held_out = result.validation_fit_percent
    best = result.best_index

    def cell(k: tuple[int, int]) -> dict:
        return {
            "time_constant": float(result.time_constants[k[0]]),
            "block_rows": int(result.block_rows[k[1]]),
            "fit_percent": {"estimation": per_name(result.output_names, result.fit_percent[k])}
            | ({} if held_out is None else {"validation": per_name(result.output_names, held_out[k])}),
            "mass": result.mass[k].tolist(),
            "damping": result.damping[k].tolist(),
            "stiffness": result.stiffness[k].tolist(),
        }

    shape = len(result.time_constants), len(result.block_rows)
    return {
        "schema": SWEEP,
        "time_constants": result.time_constants.tolist(),
        "block_rows": result.block_rows.tolist(),
        "best": cell(best),
        "unstable": result.unstable,
        "failed": result.failed,
        "cells": [[cell((row, column)) for column in range(shape[1])] for row in range(shape[0])],
        "warnings": list(warnings),
    }


def simulation_document(record: Record, fit: Fit, warnings: tuple[str, ...] = ()) -> dict:
    """The free run of a model against a record as the JSON schema `jaxgray/simulation/1`.

    **Arguments:** `record`; `fit`: of the free run; `warnings`: from reading the file.

    **Returns:** dictionaries, lists, numbers and texts.
    """
    return {
        "schema": SIMULATION,
        "fit_percent": per_name(record.output_names, fit.fit_percent),
        "rmse": per_name(record.output_names, fit.rmse),
        "units": dict(zip(record.output_names, record.output_units)),
        "record": record_document(record),
        "warnings": list(warnings),
    }
