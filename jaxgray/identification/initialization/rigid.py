"""Rigid bodies: records whose free run measures drift, not the model."""

import equinox as eqx
import numpy as np
import scipy.linalg

from ...records import Record
from ..setup.structure import Absent, Full, Structure
from .start import Start

SLOW = 0.05
"""Phase [rad] over the whole record below which a motion counts as rigid."""

TURNED = 1.0
"""Phase [rad] over the whole record below which an offset of the outputs cannot be told from a first state."""

DRIFT = 0.02
"""Share of an output's power left by the start above which the free run of a rigid body counts as drift."""

WINDOWS = 16
SHORTEST = 200


def rigid_modes(start: Start, samples: int) -> int:
    """Number of modes of a starting model too slow to be told from a rigid body in so many samples."""
    return int(np.sum(phases(start.matrices, samples) < SLOW))


def phases(matrices, samples: int) -> np.ndarray:
    """Phase [rad] through which every mode goes in so many samples, ascending.

    **Arguments:** `matrices`: M, D, K, time in samples; `samples`.
    """
    M, _, K = (np.asarray(X) for X in matrices)
    M = (M + M.T) / 2
    values = scipy.linalg.eigh((K + K.T) / 2, M + 1e-12 * np.trace(M) * np.eye(len(M)), eigvals_only=True)
    return np.sqrt(np.maximum(values, 0.0)) * samples


def windows(records: list[Record]) -> list[Record]:
    """Every record cut into windows, each with an initial state of its own.

    **Arguments:** `records`.

    **Returns:** sixteen windows a record, fewer where they would be shorter than 200 samples.
    """
    pieces = []
    for record in records:
        count = max(1, min(WINDOWS, record.samples // SHORTEST))
        length = record.samples // count
        pieces += [record[k * length : (k + 1) * length] for k in range(count)]
    return pieces


def without_stiffness(structure: Structure, start: Start, samples: int) -> Structure:
    """The structure without a stiffness where every mode of the start is rigid."""
    if isinstance(structure.stiffness, Full) and rigid_modes(start, samples) == len(start.matrices[0]):
        return eqx.tree_at(lambda s: s.stiffness, structure, Absent(), is_leaf=lambda x: isinstance(x, Full))
    return structure
