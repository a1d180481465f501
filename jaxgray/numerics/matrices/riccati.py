"""Stationary Kalman filter in traced code, by the structure-preserving doubling algorithm."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_DOUBLINGS = 20


def kalman_gain(
    A: Float[Array, "states states"],
    C: Float[Array, "outputs states"],
    Q: Float[Array, "states states"],
    S: Float[Array, "states outputs"],
    R: Float[Array, "outputs outputs"],
) -> tuple[Float[Array, "states outputs"], Float[Array, "outputs outputs"]]:
    """Gain G and innovation covariance Σ of x⁺ = A x + w, y = C x + v.

    cov w = Q, cov v = R, cov(w, v) = S. Each doubling squares the closed-loop matrix: twenty serve a decay
    per sample down to 1e−6.

    **Arguments:** `A`, `C`, `Q`, `S`, `R`.

    **Returns:** G in x̂⁺ = A x̂ + G ε, and Σ = C P Cᵀ + R.

    **Reference:** Chu, Fan, Lin & Wang, *Structure-preserving algorithms for periodic discrete-time algebraic
    Riccati equations*.
    """
    states = A.shape[0]
    eye = jnp.eye(states)
    from_noise = jnp.linalg.solve(R, S.T).T
    F = (A - from_noise @ C).T
    G = C.T @ jnp.linalg.solve(R, C)
    H = Q - from_noise @ S.T

    def double(carry, _):
        F, G, H = carry
        W = jnp.linalg.solve(eye + G @ H, jnp.concatenate([F, G], axis=1))
        WF, WG = W[:, :states], W[:, states:]
        return (F @ WF, G + F @ WG @ F.T, H + F.T @ H @ WF), None

    (_, _, P), _ = jax.lax.scan(double, (F, G, H), None, length=_DOUBLINGS)
    innovation = C @ P @ C.T + R
    gain = jnp.linalg.solve(innovation, (A @ P @ C.T + S).T).T
    return gain, innovation
