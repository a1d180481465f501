"""Records on an accelerated base as records of forces: M z̈ + D ż + K z + Σ b φ = −M r ẍ, once M is known.

Rows z̈ + r ẍ = −M⁻¹ (D ż + K z + Σ b φ) give M⁻¹K. The ratios of the masses are those that make M (M⁻¹K) symmetric:

    m_i (M⁻¹K)_ij = m_j (M⁻¹K)_ji,      M diagonal.
"""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.runs.extended import held_input
from ...mechanics.systems.drives import BaseAcceleration, Force
from ...numerics.outcomes import RESULTS, ComputationError
from ...records import Record
from .integrated_band import ROWS_PER_COEFFICIENT, integrated_band, motion_and_lines, weights_of
from .rows import Series, around_samples, series_of

MAX_MASS_RATIO = 10.0
"""Largest accepted ratio between a mass and the first."""

MAX_ASYMMETRY = 0.3
"""Largest accepted ‖K − Kᵀ‖/‖K‖ of K = M (M⁻¹K)."""


def as_forces(
    records: list[Record], drive: BaseAcceleration
) -> tuple[list[Record], Force, Float[np.ndarray, "dofs dofs"]]:
    """The motion relative to the base, and where the acceleration of the base acts as a force.

    **Arguments:** `records`; `drive`.

    **Returns:** the same with outputs relative to the base; the drive of forces; the mass, of which the first is 1.

    **Raises:** `ComputationError` where the records do not determine the ratios of the masses.
    """
    r = np.asarray(drive.direction, float)
    records = [_relative(one, drive, r) for one in records]
    band = integrated_band(records)
    mass = np.diag(_masses([series_of(one, band) for one in records], r))
    return records, Force(-mass @ r), mass


def _relative(record: Record, drive: BaseAcceleration, r: Float[np.ndarray, "dofs inputs"]) -> Record:
    """The record with the mean of the input before and after every sample as its input, and outputs relative to it."""
    base = np.asarray(around_samples(*map(np.asarray, held_input(jnp.asarray(record.u), record.hold))))
    shift = (record.u - base if drive.relative else -base) @ r.T
    seen = np.array([kind == "acceleration" for kind in record.measured])
    return dataclasses.replace(record, u=base, y=record.y + np.where(seen, shift, 0.0), hold="linear")


def _masses(series: list[Series], r: Float[np.ndarray, "dofs inputs"]) -> Float[np.ndarray, " dofs"]:
    """Masses relative to the first, from what makes M⁻¹K symmetric."""
    dofs = len(r)
    if dofs == 1:
        return np.ones(1)
    table = motion_and_lines(series)
    if len(table) < ROWS_PER_COEFFICIENT * table.shape[1]:
        raise ComputationError(RESULTS.too_short, stage="force equation", detail=f"{len(table)} rows of motion")
    found = weights_of(table, np.concatenate([one.a[one.rows] + one.input_rows @ r.T for one in series]))
    A = -found[:dofs].T
    # Along a spanning tree of the strongest couplings: a weak one does not determine a ratio.
    strength = A * A.T / np.maximum(np.abs(np.outer(np.diag(A), np.diag(A))), np.finfo(float).tiny)
    masses, known = np.ones(dofs), [0]
    while len(known) < dofs:
        others = [k for k in range(dofs) if k not in known]
        i, j = max(itertools.product(known, others), key=lambda pair: strength[pair])
        masses[j] = masses[i] * (A[i, j] / A[j, i] if strength[i, j] > 0 else np.nan)
        known.append(j)
    K = masses[:, None] * A
    sound = np.all((masses > 1 / MAX_MASS_RATIO) & (masses < MAX_MASS_RATIO))
    if not sound or np.linalg.norm(K - K.T) > MAX_ASYMMETRY * np.linalg.norm(K):
        raise ComputationError(RESULTS.nonfinite, stage="force equation", detail="no masses make M⁻¹K symmetric")
    return masses
