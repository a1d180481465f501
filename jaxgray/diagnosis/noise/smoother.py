"""The states of a model on a record, smoothed with the whole record."""

import numpy as np
from jaxtyping import Bool, Float

from ...mechanics.systems.statespace import StateSpace
from ...numerics.responses.filters import white_part
from .whitening import _FLOOR, _kalman_gain, _respond

UNDAMPED = 1e-8
"""Decay a sample that every motion has at least, for the smoother."""

DOUBLINGS = 34
"""Of the sum of a stationary covariance: enough for that decay."""


def smoothed_states(
    system: StateSpace,
    e: Float[np.ndarray, "samples outputs"],
    kept: Bool[np.ndarray, "samples outputs"],
    force: Float[np.ndarray, " inputs"],
    ratio: float,
) -> Float[np.ndarray, "samples states"]:
    """What a residual says of the states: fixed-interval smoothing with noise at every coordinate.

    Forward innovations filter, then the backward recursion of Rauch, Tung and Striebel with its stationary gain.

    **Arguments:** as for `estimate_noise_model`; `ratio` (ρ) of force noise.

    **Returns:** states of the sampled plant.

    **Reference:** Rauch, Tung & Striebel (1965).
    """
    level = np.mean(e**2, axis=0)
    V = np.maximum(white_part(e, kept), _FLOOR * np.maximum(level, 1e-300)) + 1e-300
    A, B, C = (np.asarray(X) for X in (system.A, system.B, system.C))
    D = np.asarray(system.D)
    Q = B * (ratio * force) @ B.T
    gain, innovation = (
        np.asarray(X) for X in _kalman_gain(A, C, Q, np.zeros((len(A), len(C))), np.diag(V) + D * (ratio * force) @ D.T)
    )
    predicted_gain = np.linalg.solve(A, gain) if np.linalg.cond(A) < 1e12 else np.linalg.pinv(A) @ gain
    states = len(A)
    eye = np.eye(states)
    residual = np.where(kept, e, 0.0)
    ahead = np.asarray(_respond(A - gain @ C, gain, eye, np.zeros((states, len(C))), residual))
    epsilon = residual - ahead @ C.T
    here = ahead + epsilon @ predicted_gain.T
    # An undamped plant that nothing corrects has no stationary covariance; next to it there is one.
    closed = (1 - UNDAMPED) * (A - gain @ C)
    P = _stationary(closed, Q + gain @ (np.diag(V) + D * (ratio * force) @ D.T) @ gain.T)
    filtered = P - predicted_gain @ innovation @ predicted_gain.T
    back = np.linalg.lstsq(P.T, (filtered @ A.T).T, rcond=1e-12)[0].T
    # x_s[k] = here[k] + back (x_s[k+1] − ahead[k+1]), run from the end.
    drive = here[:-1] - ahead[1:] @ back.T
    turned = _respond(back, eye, back, eye, drive[::-1], here[-1])
    return np.concatenate([np.asarray(turned)[::-1], here[-1:]])


def _stationary(A: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Σ Aᵏ Q Aᵏᵀ by doubling (Smith 1968), which asks nothing of how far apart the sizes of the states are."""
    for _ in range(DOUBLINGS):
        more = Q + A @ Q @ A.T
        if not np.all(np.isfinite(more)):
            break
        Q, A = more, A @ A
    return Q
