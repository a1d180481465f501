"""From a realisation of order 2(p + n) to the canonical form, in closed form.

With H(s) = C (sI − A)⁻¹ B from forces at the measured coordinates to their displacements (CB = 0, CAB = M11⁻¹), the
coordinates (q, q̇, ξ), x = P q + B_n q̇ + V ξ with V the null space of [C; CA] and B_n = B M11, turn the system round:

    ξ̇ = F ξ + G1 q + G2 q̇,      u = M11 (q̈ − R1 q − R2 q̇ − R ξ).

The eigenvalues z of F are the transmission zeros, 2n of them, and

    H(s)⁻¹ = M11 s² + D11 s + K11 − Σ_j v_j(s) v_j(s)ᵀ / ((s − z_j)(s − z̄_j)),      v_j(s) = a_j + s b_j,

so that the residue at a zero, a complex symmetric matrix of rank one, gives v_j(z_j), and with it a_j and b_j.
"""

import numpy as np
from jaxtyping import Array, Complex, Float

from ....numerics.outcomes import RESULTS, ComputationError
from .form import Canonical

REAL = 1e-9
"""Imaginary part of a zero, relative to its size, below which it counts as real."""


def inverse_system(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states outputs"],
    C: Float[np.ndarray, "outputs states"],
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:
    """M11, R1, R2, R, F, G1, G2 of the system turned round (see above), and V.

    **Raises:** `ComputationError` where a force does not accelerate its own coordinate.
    """
    p = len(C)
    CA = C @ A
    inverse_mass = CA @ B
    values = np.linalg.svd(inverse_mass, compute_uv=False)
    if not values[-1] > 1e-12 * values[0]:
        raise ComputationError(
            RESULTS.unreachable, stage="closed form", detail="the inputs do not accelerate every measured coordinate"
        )
    M = np.linalg.inv(inverse_mass)
    size = np.linalg.norm(C), np.linalg.norm(CA)
    seen = np.concatenate([C / size[0], CA / size[1]])
    V = np.linalg.svd(seen)[2][2 * p :].T
    Bn = B @ M
    P = np.linalg.pinv(seen)[:, :p] / size[0]
    CAA = CA @ A

    def turned(X):
        return A @ X - Bn @ (CAA @ X)

    F, G1, G2 = V.T @ turned(V), V.T @ turned(P), V.T @ (turned(Bn) - P)
    return M, CAA @ P, CAA @ Bn, CAA @ V, F, G1, G2, V


def closed_form(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states outputs"],
    C: Float[np.ndarray, "outputs states"],
) -> Canonical:
    """The canonical form of a system with 2(p + n) states, p forces and the p displacements at which they act.

    **Arguments:** `A`, `B`, `C`: in any basis, continuous time.

    **Returns:** a `Canonical`, ordered; matrices of the measured coordinates symmetric, not yet positive.

    **Raises:** `ComputationError` where the inputs do not accelerate every measured coordinate, or the zeros are not
    those of second-order systems.

    **Reference:** H(s)⁻¹ is the dynamic stiffness condensed to the measured coordinates, M11 s² + D11 s + K11 −
    Z12 Z22⁻¹ Z21: Guyan, AIAA Journal 3 (1965) 380, exact and not only static.
    """
    M, R1, R2, R, F, G1, G2, _ = inverse_system(A, B, C)
    hidden = len(F) // 2
    z, X = np.linalg.eig(F)
    left, right = M @ R @ X, np.linalg.solve(X, np.concatenate([G1, G2], axis=1))
    p = len(M)
    residues = [np.outer(left[:, k], right[k, :p] + z[k] * right[k, p:]) for k in range(len(z))]
    modes = _pairs(z, residues)
    if len(modes) != hidden:
        raise ComputationError(
            RESULTS.order_not_found, stage="closed form", detail="the transmission zeros do not come in pairs"
        )
    squared, rate, spring, damper = (np.array(part) for part in zip(*modes))
    spring, damper = spring.T, damper.T
    K = -M @ R1 - M @ R @ G2 + damper @ damper.T
    D = -M @ R2
    symmetric = [np.real(S + S.T) / 2 for S in (M, D, K)]
    return Canonical(*symmetric, squared, rate, spring, damper).ordered()


def _pairs(z: Complex[np.ndarray, " zeros"], residues: list[np.ndarray]) -> list[tuple]:
    """ω², 2ζω, a, b of every pair of zeros."""
    oscillating = np.flatnonzero(z.imag > REAL * np.abs(z))
    modes = []
    for k in oscillating:
        v = _rank_one((z[k] - z[k].conj()) * residues[k])
        b = v.imag / z[k].imag
        modes.append((abs(z[k]) ** 2, -2 * z[k].real, v.real - z[k].real * b, b))
    real = np.flatnonzero(np.abs(z.imag) <= REAL * np.abs(z))
    real = real[np.argsort(z.real[real])]
    return modes + _real_pairs(z.real[real], [residues[k].real for k in real])


def _real_pairs(z: Float[np.ndarray, " zeros"], residues: list[np.ndarray]) -> list[tuple]:
    """The same of overdamped pairs, matched so that both residues are those of real vectors."""
    if len(z) % 2 or not len(z):
        return []
    best = None
    for matching in _matchings(tuple(range(len(z)))):
        modes, wrong = [], 0.0
        for i, j in matching:
            first, off = _real_rank_one((z[i] - z[j]) * residues[i])
            second, also = _real_rank_one((z[j] - z[i]) * residues[j])
            # The relative sign of the two is free: the smaller damper.
            b = min(((first - s * second) / (z[i] - z[j]) for s in (1.0, -1.0)), key=np.linalg.norm)
            modes.append((z[i] * z[j], -(z[i] + z[j]), first - z[i] * b, b))
            wrong += off + also
        if best is None or wrong < best[0]:
            best = wrong, modes
    return best[1]


def _matchings(items: tuple[int, ...]):
    if not items:
        yield []
        return
    for k, other in enumerate(items[1:], 1):
        for rest in _matchings(items[1:k] + items[k + 1 :]):
            yield [(items[0], other), *rest]


def _rank_one(S: Complex[np.ndarray, "n n"]) -> Complex[np.ndarray, " n"]:
    """v with v vᵀ nearest to a complex symmetric matrix."""
    S = (S + S.T) / 2
    u = np.linalg.svd(S)[0][:, 0]
    return u * np.sqrt(u.conj() @ S @ u.conj() + 0j)


def _real_rank_one(S: Float[np.ndarray, "n n"]) -> tuple[Float[np.ndarray, " n"], float]:
    """v with v vᵀ nearest to a symmetric matrix, and how much of the matrix is negative."""
    values, vectors = np.linalg.eigh((S + S.T) / 2)
    return vectors[:, -1] * np.sqrt(max(values[-1], 0.0)), float(max(-values[0], 0.0))


def canonical_of(
    M: Float[np.ndarray, "dofs dofs"],
    D: Float[np.ndarray, "dofs dofs"],
    K: Float[np.ndarray, "dofs dofs"],
    outputs: int,
) -> Canonical:
    """The canonical form of given M, D, K of which the first `outputs` coordinates are measured and driven."""
    dofs = len(M)
    rate = np.sqrt(max(np.linalg.norm(np.linalg.solve(M, K), 2), np.linalg.norm(np.linalg.solve(M, D), 2) ** 2))
    lower = np.concatenate([-np.linalg.solve(M, K) / rate**2, -np.linalg.solve(M, D) / rate], axis=1)
    A = np.concatenate([np.eye(dofs, 2 * dofs, dofs), lower])
    B = np.concatenate([np.zeros((dofs, outputs)), np.linalg.inv(M)[:, :outputs] / rate**2])
    return in_time_unit(closed_form(A, B, np.eye(outputs, 2 * dofs)), 1 / rate)


def in_time_unit(found: Canonical, unit: float) -> Canonical:
    """The same with time counted in units of 1/`unit`: from time in T = `unit` [s] to seconds."""
    return Canonical(
        found.mass * unit**2,
        found.damping * unit,
        found.stiffness,
        found.squared / unit**2,
        found.rate / unit,
        found.spring / unit,
        found.damper,
    )
