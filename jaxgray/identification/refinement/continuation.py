"""A poor start brought nearer: fits over windows with a first state of their own, first short ones, then longer ones.

Over a whole record a frequency that is off by a few percent is out of phase with the record, and steps lead to the next
of many minima. Over a period or two there is one.
"""

import jax
import numpy as np
import scipy.linalg
from jaxtyping import Bool

from ...numerics.outcomes import ComputationError
from ..setup.prediction import Batch, Nuisance, Setting
from ..setup.structure import Structure
from .cholesky import cholesky_steps
from .conic import conic_steps
from .normal_equations import FLOOR, Criterion, Iterate, Prior

WINDOWS = 32
"""Most windows, spread over the records."""

PERIODS = 2.0
"""Periods of the fastest mode in the first windows."""

SHORTEST = 32
"""Samples of a window at least."""

LONGER = 4
"""How many times longer the next windows are."""

STEPS = 25
"""Most steps on windows of one length."""


def lengthened(
    matrices: tuple[np.ndarray, np.ndarray, np.ndarray],
    batch: Batch,
    setting: Setting,
    structure: Structure,
    fixed: Bool[np.ndarray, " entries"] | None,
    prior: Prior | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, D, K after fits over ever longer windows.

    **Arguments:** as of `refine`; `matrices`: scaled M, D, K to start from.

    **Returns:** scaled M, D, K, those of the last length that gave something finite.

    **Reference:** Bock (1981), and Ribeiro et al., Automatica 121 (2020) 109158 (multiple shooting).
    """
    if not all(np.all(np.isfinite(X)) for X in matrices):
        return matrices
    length = _first_length(matrices)
    while (cut := _windows(batch, length)) is not None:
        records, _, outputs = cut.y.shape
        criterion = Criterion(cut, setting, structure, prior)
        nuisance = Nuisance(np.zeros((records, 2 * setting.dofs)), None, None)
        size = np.sqrt(np.mean(np.asarray(cut.y) ** 2, axis=(0, 1)))
        whitening = np.diag(1 / np.maximum(size, FLOOR))
        held = fixed is not None and np.any(fixed)
        blocks = structure.blocks(*matrices, lift=0.0 if held else 1e-3)
        begin = Iterate(blocks, nuisance, whitening)
        try:
            if held:
                end = conic_steps(begin, criterion, fixed=fixed, max_steps=STEPS)
            else:
                end = cholesky_steps(begin, criterion, max_steps=STEPS)
        except ComputationError:
            return matrices
        found = tuple(np.asarray(X) for X in criterion.matrices([np.asarray(block) for block in end.at.blocks]))
        if not all(np.all(np.isfinite(X)) for X in found):
            return matrices
        matrices = found
        length *= LONGER
    return matrices


def _first_length(matrices) -> int:
    """A few periods of the fastest mode, as a power of two so that little is compiled."""
    M, _, K = matrices
    values = scipy.linalg.eigh(K, M + 1e-9 * np.trace(M) / len(M) * np.eye(len(M)), eigvals_only=True)
    fastest = np.sqrt(max(float(values[-1]), 1e-12))
    return int(2 ** np.ceil(np.log2(max(PERIODS * 2 * np.pi / min(fastest, np.pi), SHORTEST))))


def _windows(batch: Batch, length: int) -> Batch | None:
    """Windows of one length, evenly spread over the records, without those that are mostly padding; None for fewer than
    two a record."""
    u, y, kept = (np.asarray(x) for x in (batch.u, batch.y, batch.kept))
    places = [(r, k) for r in range(len(u)) for k in range(u.shape[1] // length)]
    places = [(r, k) for r, k in places if kept[r, k * length : (k + 1) * length].mean() > 0.5]
    if len(places) < 2 * len(u):
        return None
    chosen = [places[j] for j in np.unique(np.linspace(0, len(places) - 1, WINDOWS).astype(int))]

    def cut(x):
        return jax.device_put(np.stack([x[r, k * length : (k + 1) * length] for r, k in chosen]))

    return Batch(cut(u), cut(y), cut(kept), True)
