"""Clocks of outputs beside that of the inputs: how they are set and run, from what the model leaves of the outputs.

A row that was sampled at another time than its clock says is off by the output's slope times the difference. Of these
columns counts what the model's own parameters cannot do.
"""

from dataclasses import replace

import equinox as eqx
import numpy as np

from ..records import Record
from ..records.stamped import ClockError, mended
from .refinement.conic import pseudo_inverse
from .refinement.normal_equations import Criterion, Iterate, sensitivities, without_noise
from .refinement.uncertainty import uncertainty
from .result import Identification
from .setup.prediction import Batch
from .setup.preparation import prepare

RANK_TOLERANCE = 1e-10
"""Relative singular value below which a direction of the parameters is none."""

LEAST = 1e-150
"""Size of what moves no output."""


def with_clocks(found: Identification, records: list[Record]) -> tuple[Identification, list[Record], np.ndarray]:
    """One step of the clocks of some records towards the inputs' own.

    **Arguments:** `found`: fitted to what stands for the records; `records`: their rows, as mended so far.

    **Returns:** `found` with what the clocks leave open in its covariance, and `clocks` with the steps of this call;
    the records with their clocks mended; and every step in its standard errors, empty where no other clock runs.
    """
    others = [(k, clock) for k, r in enumerate(records) if r.has_own_times for clock in r.stamps.other_clocks]
    if not others or found.refinement is None or len(found.refinement.nuisance.x0) != len(records):
        return found, records, np.zeros(0)
    refinement, scaling = found.refinement, found.scaling
    batch = Batch.of([prepare(r, scaling) for r in found.records])
    plain = Iterate(refinement.blocks, without_noise(refinement.nuisance), np.eye(found.model.outputs))
    W = np.asarray(refinement.whitening)
    J = np.asarray(sensitivities(plain, Criterion(batch, found.setting, found.structure))[1])
    free = np.ones(J.shape[3], bool)
    free[: len(found.fixed)] &= ~found.fixed
    J = J[..., free]
    T, e = np.zeros((*J.shape[:3], 2 * len(others))), np.zeros(J.shape[:3])
    for k, (record, fit) in enumerate(zip(records, found.estimation)):
        n = record.samples
        e[k, :n] = np.nan_to_num(fit.residual) / np.asarray(scaling.outputs)
    for column, (k, clock) in enumerate(others):
        record, run = records[k], found.estimation[k].simulated
        slope = np.gradient(run, record.sampling_time, axis=0) / np.asarray(scaling.outputs)
        for j in range(record.outputs):
            rows = np.flatnonzero((record.stamps.place[:, j] >= 0) & (record.stamps.clock == clock))
            place = record.stamps.place[rows, j]
            T[k, place, j, 2 * column] = slope[place, j]
            T[k, place, j, 2 * column + 1] = slope[place, j] * (record.stamps.time[rows] - record.start_time)
    kept = np.asarray(batch.kept)[..., None]
    J, T, e = (np.einsum("op,rnpc->rnoc", W, X * kept).reshape(-1, X.shape[3]) for X in (J, T, e[..., None]))
    size = np.maximum(np.linalg.norm(T, axis=0), LEAST)
    T = T / size
    own = T - J @ np.linalg.lstsq(J, T, rcond=RANK_TOLERANCE)[0]
    inverse = pseudo_inverse(own.T @ own)
    variance = float(e[:, 0] @ e[:, 0]) / len(e)
    step = inverse @ (own.T @ e[:, 0]) / size
    # What no output shows has no error that could be said.
    shown = np.diag(inverse) > 0
    error = np.where(shown, np.sqrt(variance * np.where(shown, np.diag(inverse), 1.0)) / size, np.inf)
    if not np.all(np.isfinite(step)):
        return found, records, np.zeros(0)
    records, clocks = list(records), []
    for column, (k, clock) in enumerate(others):
        record = records[k]
        at = slice(2 * column, 2 * column + 2)
        stamps = mended(record.stamps, record.start_time, clock, *map(float, step[at]))
        records[k] = replace(record, stamps=stamps)
        there = ((record.stamps.place >= 0) & (record.stamps.clock == clock)[:, None]).any(axis=0)
        names = tuple(name for name, one in zip(record.output_names, there) if one)
        clocks.append(ClockError(k, clock, names, *map(float, (*step[at], *error[at]))))
    # What the clocks may do, the other parameters are not known by.
    inner = pseudo_inverse(T.T @ T)
    information = np.array(refinement.normal.information)
    lost = J.T @ T @ inner @ T.T @ J
    information[np.ix_(free, free)] -= lost
    less = eqx.tree_at(lambda one: one.normal.information, refinement, information)
    spread = uncertainty(less, scaling, found.structure, fixed=found.fixed)
    return replace(found, uncertainty=spread, clocks=tuple(clocks)), records, step / np.maximum(error, LEAST)
