"""Linear systems at times that follow no clock: steps of any length, exact for inputs that follow their hold.

    x(t_{k+1}) = e^{A d_k} x(t_k) + B₀(d_k) u_k + B₁(d_k) u_{k+1}

The matrices of every step are polynomials of its length: interpolated between Chebyshev points, of which there are as
many as it takes, they cost one product for all steps. The recursion goes through many blocks of steps side by side.

**Reference:** Trefethen, *Approximation Theory and Approximation Practice*, ch. 2 to 8.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

POINTS = (16, 32, 64, 128)
"""Chebyshev points that are tried."""

EXACT = 1e-12
"""Error of the matrices between the points, relative to the largest entry, that is rounding."""


def step_matrices(
    at: Callable[[Array], Array], lengths: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, "steps rows columns"]:
    """A smooth matrix function of a step's length, for many lengths.

    **Arguments:** `at`: from lengths (points) to matrices (points × rows × columns); `lengths`, 0 or more.

    **Raises:** `ValueError` where the longest step is too long for any number of points.
    """
    longest = max(float(np.max(lengths)), 1e-300)
    for points in POINTS:
        angle = (np.arange(points) + 0.5) * np.pi / points
        nodes = (1 + np.cos(angle)) / 2 * longest
        table = np.asarray(at(nodes))
        if not np.all(np.isfinite(table)):
            break
        between = (nodes[:-1] + nodes[1:]) / 2
        exact = np.asarray(at(between))
        found = np.tensordot(_weights(between / longest, angle), table, 1)
        if np.max(np.abs(found - exact)) <= EXACT * max(np.max(np.abs(exact)), 1.0) * points:
            return np.tensordot(_weights(lengths / longest, angle), table, 1)
    raise ValueError(f"steps of up to {longest:.3g} are too long for this system; cut the record at its longest gap.")


def _weights(share: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Weights of the values at Chebyshev points, at shares of the interval."""
    at = np.arccos(np.clip(2 * share - 1, -1.0, 1.0))
    order = np.arange(len(angle))
    values = np.cos(at[:, None] * order) * np.where(order == 0, 1.0, 2.0)
    return values @ np.cos(order[:, None] * angle) / len(angle)


@jax.jit
def run_through(
    transitions: Float[Array, "blocks length states states"], forced: Float[Array, "blocks length states"]
) -> tuple[Float[Array, "blocks length states states"], Float[Array, "blocks length states"]]:
    """What the state before the first step becomes after every step of x⁺ = A_k x + f_k: its factors, and what is
    added; steps in blocks."""
    blocks, _, states = forced.shape

    def step(state, now):
        P, f = state
        A, g = now
        new = A @ P, (A @ f[:, :, None])[:, :, 0] + g
        return new, new

    begin = jnp.broadcast_to(jnp.eye(states), (blocks, states, states)), jnp.zeros((blocks, states))
    along = jax.tree.map(lambda X: jnp.moveaxis(X, 1, 0), (transitions, forced))
    (P_end, f_end), (P, f) = jax.lax.scan(step, begin, along)

    def block(state, now):
        A, g = now
        return (A @ state[0], A @ state[1] + g), state

    _, (Q, x) = jax.lax.scan(block, (jnp.eye(states), jnp.zeros(states)), (P_end, f_end))
    P, f = jnp.moveaxis(P, 0, 1), jnp.moveaxis(f, 0, 1)
    return P @ Q[:, None], f + (P @ x[:, None, :, None])[..., 0]


def response(
    transitions: Float[np.ndarray, "steps states states"], forced: Float[np.ndarray, "steps states"]
) -> tuple[Float[np.ndarray, "steps states states"], Float[np.ndarray, "steps states"]]:
    """`run_through` for any number of steps: of the state after every step the factor of the first one, and what inputs
    add."""
    steps, states = forced.shape
    length = max(int(np.sqrt(steps)), 1)
    blocks = -(-steps // length)
    more = blocks * length - steps
    A = np.concatenate([transitions, np.broadcast_to(np.eye(states), (more, states, states))])
    f = np.concatenate([forced, np.zeros((more, states))])
    P, x = run_through(A.reshape(blocks, length, states, states), f.reshape(blocks, length, states))
    return np.asarray(P).reshape(-1, states, states)[:steps], np.asarray(x).reshape(-1, states)[:steps]
