"""The closed form in traced code: for oscillating hidden modes, differentiable by the realisation.

The eigenvectors of the zero dynamics enter only through residues, which do not depend on their lengths: their
derivatives are those of perturbation theory with the lengths held.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ....numerics.matrices.linear_algebra import null_basis
from .form import Canonical

SIMPLE = 1e-12
"""Distance of two zeros, relative to the largest, below which their eigenvectors have no derivative."""


@jax.custom_jvp
def eigenvalues_and_vectors(
    F: Float[Array, "states states"],
) -> tuple[Complex[Array, " states"], Complex[Array, "states states"], Complex[Array, "states states"]]:
    """λ, X and X⁻¹ with F X = X diag(λ)."""
    values, X = jnp.linalg.eig(F)
    return values, X, jnp.linalg.inv(X)


@eigenvalues_and_vectors.defjvp
def _eigenvalues_and_vectors_jvp(primals, tangents):
    values, X, Y = eigenvalues_and_vectors(*primals)
    inner = Y @ tangents[0].astype(X.dtype) @ X
    gap = values[None, :] - values[:, None]
    apart = jnp.abs(gap) > SIMPLE * jnp.max(jnp.abs(values))
    turn = jnp.where(apart, inner / jnp.where(apart, gap, 1.0), 0.0)
    return (values, X, Y), (jnp.diag(inner), X @ turn, -turn @ Y)


def traced_canonical(
    A: Float[Array, "states states"], B: Float[Array, "states outputs"], C: Float[Array, "outputs states"], hidden: int
) -> Canonical:
    """`closed_form` in traced code.

    **Arguments:** `A`, `B`, `C`: as there; `hidden`: number of hidden coordinates.

    **Returns:** a `Canonical`, ordered; not a number where a pair of zeros does not oscillate.
    """
    p = C.shape[0]
    CA = C @ A
    M = jnp.linalg.inv(CA @ B)
    seen = jnp.concatenate([C / jnp.linalg.norm(C), CA / jnp.linalg.norm(CA)])
    V = null_basis(seen)
    back = jnp.linalg.solve(V.T @ V, V.T)
    Bn, CAA = B @ M, CA @ A
    P = seen.T @ jnp.linalg.solve(seen @ seen.T, jnp.eye(2 * p, p)) / jnp.linalg.norm(C)

    def turned(X):
        return A @ X - Bn @ (CAA @ X)

    F, G1, G2 = back @ turned(V), back @ turned(P), back @ (turned(Bn) - P)
    z, X, Y = eigenvalues_and_vectors(F)
    left, right = M @ CAA @ V @ X, Y @ jnp.concatenate([G1, G2], axis=1)
    upper = jnp.argsort(-z.imag)[:hidden]
    upper = upper[jnp.argsort(jnp.abs(z[upper]))]
    z, left, right = z[upper], left[:, upper], right[upper]
    to = right[:, :p] + z[:, None] * right[:, p:]
    S = 2j * z.imag[:, None, None] * left.T[:, :, None] * to[:, None, :]
    S = (S + jnp.swapaxes(S, 1, 2)) / 2
    largest = jnp.argmax(jnp.abs(jnp.diagonal(S, axis1=1, axis2=2)), axis=1)
    column = jnp.take_along_axis(S, largest[:, None, None], axis=2)[:, :, 0]
    v = column / jnp.sqrt(jnp.take_along_axis(column, largest[:, None], axis=1))
    oscillates = z.imag > 0
    rate = jnp.where(oscillates, z.imag, jnp.nan)
    damper = (v.imag / rate[:, None]).T
    spring = v.real.T - z.real * damper
    telling = jnp.take_along_axis(spring, jnp.argmax(jnp.abs(spring), axis=0)[None], axis=0)
    sign = jnp.where(telling < 0, -1.0, 1.0)
    spring, damper = spring * sign, damper * sign
    K = -M @ CAA @ P - M @ CAA @ V @ G2 + damper @ damper.T
    D = -M @ CAA @ Bn
    own = [(X + X.T) / 2 for X in (M, D, K)]
    return Canonical(*own, z.real**2 + z.imag**2, -2 * z.real, spring, damper)
