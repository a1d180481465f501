"""The nearest physical model of a canonical form: M ≻ 0 and K ⪰ 0 of all coordinates, entries that the form sets kept.

The conic programs (23) and (24) of the paper on the assembled blocks. Damping is one of them with a single hidden
coordinate; with more, the canonical form of a physical system may have an indefinite damping matrix.
"""

import numpy as np
from jaxtyping import Float

from ....numerics.matrices.linear_algebra import duplication, from_symmetric_vector, symmetric_vector
from ....numerics.matrices.positive import ClarabelSolver, PositiveLeastSquares
from ....numerics.outcomes import RESULTS, ComputationError
from .form import Canonical, canonical_gauge

LEAST_MASS = 1e-3
"""Smallest eigenvalue of the measured coordinates' mass, relative to the largest."""

LEAST_DAMPING = 1e-4
"""Smallest damping ratio of a hidden mode."""


def physical_canonical(found: Canonical) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, D, K of a canonical form, positive.

    **Arguments:** `found`: as `closed_form` gives it.

    **Returns:** M ≻ 0, D (D ⪰ 0 with one hidden coordinate), K ⪰ 0.

    **Raises:** `ComputationError` where the mass of the measured coordinates, or a hidden stiffness, is negative.
    """
    p, n = found.outputs, found.hidden
    values, vectors = np.linalg.eigh(found.mass)
    if not (values[-1] > 0 and np.all(found.squared > 0)):
        raise ComputationError(
            RESULTS.semidefinite_solver, stage="closed form", detail="a mass or a hidden stiffness is negative"
        )
    mass = (vectors * np.maximum(values, LEAST_MASS * values[-1])) @ vectors.T
    omega = np.sqrt(np.maximum(found.squared, 0.0))
    rate = np.maximum(found.rate, 2 * LEAST_DAMPING * omega)
    M, D, K = Canonical(mass, found.damping, found.stiffness, found.squared, rate, found.spring, found.damper).matrices
    gauge = canonical_gauge(p, n)
    K = nearest_positive(K, M, gauge[2])
    if n <= 1:
        D = nearest_positive(D, M, gauge[1])
    return M, D, K


def nearest_positive(
    X: Float[np.ndarray, "dofs dofs"], mass: Float[np.ndarray, "dofs dofs"], held: Float[np.ndarray, "dofs dofs"]
) -> Float[np.ndarray, "dofs dofs"]:
    """argmin ‖M⁻¹(Y − X)‖ over Y ⪰ 0 with some entries kept."""
    if np.linalg.eigvalsh(X)[0] >= 0:
        return X
    n = len(X)
    half = np.linalg.cholesky(mass)
    white = np.linalg.solve(half, np.linalg.solve(half, X).T)
    size = np.linalg.norm(white)
    inverse = np.linalg.inv(half)
    table = np.kron(inverse, inverse) @ duplication(n) / size
    start = symmetric_vector(X)
    problem = PositiveLeastSquares.from_residual(table, table @ start, (n,), (0.0,))
    mask = symmetric_vector(held.astype(float)) > 0
    problem = PositiveLeastSquares(problem.quadratic, problem.linear, problem.floors, problem.sizes, mask, start * mask)
    return from_symmetric_vector(np.asarray(ClarabelSolver()(problem)))
