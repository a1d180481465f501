"""Principal logarithm of a matrix in traced code, by inverse scaling and squaring."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_ROOTS = 5
_NEWTON_STEPS = (14, 8, 7, 6, 6)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)


def _square_root(A: Float[Array, "n n"], steps: int) -> Float[Array, "n n"]:
    """Principal square root by the product form of the Denman-Beavers iteration."""
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    def step(pair, _):
        X, M = pair
        inverse = jnp.linalg.solve(M, eye)
        return (X @ (eye + inverse) / 2, (eye + (M + inverse) / 2) / 2), None

    (X, _), _ = jax.lax.scan(step, (A, A), None, length=steps)
    return X


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
    root = A
    for steps in _NEWTON_STEPS[:_ROOTS]:
        root = _square_root(root, steps)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    difference = root - eye
    nodes = jnp.asarray((_NODES + 1) / 2)[:, None, None]
    terms = jnp.linalg.solve(eye + nodes * difference, jnp.broadcast_to(difference, (10, *A.shape)))
    return 2**_ROOTS * jnp.sum(jnp.asarray(_WEIGHTS / 2)[:, None, None] * terms, axis=0)
