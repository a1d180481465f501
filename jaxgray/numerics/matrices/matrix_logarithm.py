"""Principal logarithm of a matrix in traced code, by inverse scaling and squaring."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_NEWTON_STEPS = (14, 8, 7, 6, 6)
"""Of each of the square roots."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


_FIRST_STEPS = np.concatenate([np.arange(steps) == 0 for steps in _NEWTON_STEPS])


def _roots(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A^(1/2^5): principal square roots one after the other, by the product form of the Denman-Beavers iteration."""
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    def step(pair, first):
        X, M = pair
        M = jnp.where(first, X, M)
        inverse = jnp.linalg.solve(M, eye)
        return (X @ (eye + inverse) / 2, (eye + (M + inverse) / 2) / 2), None

    # One loop for all roots: each of its own would be traced and compiled again.
    return jax.lax.scan(step, (A, A), jnp.asarray(_FIRST_STEPS))[0][0]


def matrix_logarithm(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Principal logarithm of a real matrix without eigenvalues on the negative real axis.

    Five square roots bring A near the identity; there the logarithm is the integral of
    (A − I)(I + t(A − I))⁻¹ over 0 … 1, taken by ten Gauss-Legendre nodes (the Padé approximant of
    that order).

    **Arguments:** `A`: the matrix. With an eigenvalue on the negative real axis the result is not a
    logarithm (the iteration does not converge); check the eigenvalues where that can happen.

    **Returns:** X with exp(X) = A.

    **Reference:** Higham, *Functions of Matrices*, §11.4 and algorithm 6.14.
    """
    root = _roots(A)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    difference = root - eye
    nodes = jnp.asarray((_NODES + 1) / 2)[:, None, None]
    terms = jnp.linalg.solve(eye + nodes * difference, jnp.broadcast_to(difference, (10, *A.shape)))
    return 2 ** len(_NEWTON_STEPS) * jnp.sum(jnp.asarray(_WEIGHTS / 2)[:, None, None] * terms, axis=0)
