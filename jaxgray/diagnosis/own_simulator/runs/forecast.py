"""The force that a simulator lacks, foretold by what it was along the motion so far.

The force on a machine mostly follows a law: where the measured motion returns to a displacement, a velocity and an
input, so does the force. Sums of curves over each are fitted to the force as far as it is known.

**Reference:** Eilers & Marx, *Flexible smoothing with B-splines and penalties*, Statistical Science 11 (1996) 89-121.
"""

import numpy as np
import scipy.linalg
import scipy.signal
from jaxtyping import Float

from ....numerics.matrices.bounded import bounded
from ....numerics.responses.filters import without_gaps
from ....records import Record
from .linearized import knot_shares

KNOTS = 25
"""Of a curve."""

ROUGH, SMALL = 1e-2, 1e-4
"""What the second differences of a curve, and its size, cost, relative to the squares of a curve's samples."""

TOLD = 0.9
"""Share of the mean square of a force that curves may leave of its last part, fitted to the rest, for a forecast."""

SMOOTHED, DEGREE = 11, 3
"""Samples over which a measured motion is smoothed, by polynomials of that degree."""


def forecast(
    record: Record,
    u: Float[np.ndarray, "samples inputs"],
    known: Float[np.ndarray, "known dofs"],
    otherwise: Float[np.ndarray, "rest dofs"],
) -> Float[np.ndarray, "rest dofs"]:
    """Forces beyond those that are known, by the measured motion and the inputs there; `otherwise` where the last
    quarter of them could not have been foretold from those before.

    **Arguments:** `record`: with all that was measured, NaN where nothing was; inputs `u` of the run; forces that are
    `known` over its first samples [N or N m]; `otherwise`: what they would be at the rest of them.

    **Returns:** forces at the rest of the samples, in the same units.
    """
    if not bounded(known):
        return otherwise
    table, rough, end = *_curves(record, u), len(known)

    def fitted(rows: slice) -> np.ndarray:
        size = np.sqrt(len(table[rows]) / KNOTS)
        penalties = np.concatenate([np.sqrt(ROUGH) * size * rough, np.sqrt(SMALL) * size * np.eye(table.shape[1])])
        target = np.concatenate([known[rows], np.zeros((len(penalties), known.shape[1]))])
        return np.linalg.lstsq(np.concatenate([table[rows], penalties]), target, rcond=None)[0]

    last = slice(end * 3 // 4, end)
    left = known[last] - table[last] @ fitted(slice(0, last.start))
    told = np.sum(left**2, axis=0) < TOLD * np.sum(known[last] ** 2, axis=0)
    ahead = table @ fitted(slice(0, end))
    # What the curves leave of the force goes on as it would without them.
    gone = np.where(known[-1] != 0.0, otherwise / np.where(known[-1] != 0.0, known[-1], 1.0), 0.0)
    return np.where(told, ahead[end:] + (known[-1] - ahead[end - 1]) * gone, otherwise)


def _curves(record: Record, u: Float[np.ndarray, "samples inputs"]) -> tuple[np.ndarray, np.ndarray]:
    """The shares of the knots of all curves at every sample (samples × knots), and their second differences."""
    q = _smoothed(record.y)
    along = np.concatenate([q, np.gradient(q, axis=0), u], axis=1).T
    along = [x for x in along if np.ptp(x) > 0.0]
    table = [knot_shares(x, np.linspace(np.min(x), np.max(x), KNOTS)) for x in along]
    return np.concatenate(table, axis=1), scipy.linalg.block_diag(*[np.diff(np.eye(KNOTS), 2, axis=0)] * len(table))


def _smoothed(y: Float[np.ndarray, "samples dofs"]) -> Float[np.ndarray, "samples dofs"]:
    """Outputs without the fastest part of their noise; between what is known of them on straight lines."""
    return scipy.signal.savgol_filter(without_gaps(y), min(SMOOTHED, len(y)), DEGREE, axis=0)
