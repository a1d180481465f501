"""From a sampled state-space model to M, D, K, and back: what every peer needs and none has. NumPy and SciPy alone."""

import numpy as np
import scipy.linalg

GUESS = (np.diag([6.0, 1.2]), np.diag([4.0, 0.8]), np.diag([120.0, 80.0]))
"""M, D, K that the gray-box fits start from: diagonals off by a fifth, couplings left out."""

ENTRIES = ((0, 0), (0, 1), (1, 1))


def symmetric(entries):
    """Three 2 × 2 symmetric matrices from their nine upper entries."""
    a = np.asarray(entries, dtype=float).reshape(3, 3)
    return tuple(np.array([[m[0], m[1]], [m[1], m[2]]]) for m in a)


def entries_of(matrices):
    """The nine upper entries of M, D, K."""
    return np.array([X[k] for X in matrices for k in ENTRIES])


def continuous(M, D, K):
    """A, B of ẋ = A x + B u with x = (q, q̇)."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    return A, np.vstack([np.zeros((n, n)), np.linalg.inv(M)])


def physical(A, B, C, h):
    """M, D, K of x⁺ = A x + B u, y = C x with held inputs and displacements measured.

    Matrix logarithm; basis of displacements and velocities, T = [C; C A_c]; then the paper's order: M⁻¹ is the
    symmetric part of B₂, K = argmin ‖M⁻¹K + A21‖ over symmetric K, D likewise with A22.
    """
    A, B, C = (np.asarray(X, dtype=float) for X in (A, B, C))
    n = len(A)
    logarithm = scipy.linalg.logm(A) / h
    if np.linalg.norm(logarithm.imag) > 1e-8 * np.linalg.norm(logarithm.real):
        raise ValueError("a pole on the negative real axis: the sampled model has no continuous one")
    Ac = logarithm.real
    held = scipy.linalg.expm(np.block([[Ac, np.eye(n)], [np.zeros((n, 2 * n))]]) * h)[:n, n:]
    T = np.vstack([C, C @ Ac])
    Ac = T @ Ac @ np.linalg.inv(T)
    B2 = (T @ np.linalg.solve(held, B))[n // 2 :]
    X = (B2 + B2.T) / 2
    return np.linalg.inv(X), symmetric_fit(X, Ac[n // 2 :, n // 2 :]), symmetric_fit(X, Ac[n // 2 :, : n // 2])


def symmetric_fit(X, target):
    """argmin ‖X S + target‖_F over symmetric S."""
    n = len(X)
    pairs = [(r, c) for r in range(n) for c in range(r, n)]
    columns = []
    for r, c in pairs:
        S = np.zeros((n, n))
        S[r, c] = S[c, r] = 1.0
        columns.append((X @ S).ravel())
    found = np.linalg.lstsq(np.stack(columns, axis=1), -target.ravel(), rcond=None)[0]
    S = np.zeros((n, n))
    for (r, c), value in zip(pairs, found):
        S[r, c] = S[c, r] = value
    return S
