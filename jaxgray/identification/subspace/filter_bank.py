"""The λ-filters, as one Laguerre family per time constant.

λ_d(z) = (1−a)/(z−a) with a = exp(−h/τ) is λ(s) = 1/(1+sτ) under a hold. Its powers are collinear beyond
use; the Laguerre family f_0 = 1, f_j = L_{j−1} spans the same rows and is orthonormal for white signals,

    L_j(z) = √(1−a²)/(z−a) · ((1−a z)/(z−a))^j.

Multiplication by λ_d is bidiagonal in it, λ_d f_j = S_jj f_j + S_{j,j+1} f_{j+1}.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.linear_algebra import orthonormal_basis
from ...numerics.matrices.namespace import namespace
from ...numerics.responses.lifting import LiftedSystem, lift


def pole(time_constant: Float[Array, ""], sampling_time: float) -> Float[Array, ""]:
    """Discrete filter pole a = exp(−h/τ)."""
    return namespace(time_constant, sampling_time).exp(-sampling_time / time_constant)


def cascade(a: Float[Array, ""], orders: int) -> tuple[Float[Array, "orders orders"], Float[Array, " orders"]]:
    """State matrices of L_0 … L_{orders−1}; the states are the outputs.

    **Arguments:** `a`: filter pole; `orders`: number of filters.

    **Returns:** A (lower triangular) and b of x⁺ = A x + b u.
    """
    lag = jnp.arange(orders)[:, None] - jnp.arange(orders)[None, :]
    sign_power = (-a) ** jnp.maximum(lag - 1, 0)
    A = jnp.where(lag == 0, a, jnp.where(lag > 0, (1 - a**2) * sign_power, 0.0))
    return A, jnp.sqrt(1 - a**2) * (-a) ** jnp.arange(orders)


def lifted_cascade(a: Float[Array, ""], orders: int, block: int) -> LiftedSystem:
    """The cascade in blocks of `block` samples, outputs ordered by sample, then by filter."""
    A, b = cascade(a, orders)
    return lift(A, b[:, None], jnp.eye(orders), jnp.zeros((orders, 1)), block=block)


def lambda_shift(a: Float[Array, ""], size: int) -> Float[Array, "size size_plus_one"]:
    """Multiplication by λ_d on f_0 … f_{size−1}: the bidiagonal matrix S, `size` × (`size` + 1)."""
    rest = np.arange(size)[:, None] > 0
    main, upper = np.eye(size, size + 1) * rest, np.eye(size, size + 1, 1)
    return (a * main + upper * rest) / (1 + a) + jnp.sqrt((1 - a) / (1 + a)) * (upper * ~rest)


def lambda_powers(a: Float[Array, ""], size: int) -> Float[Array, "size size"]:
    """Rows λ_d^0 … λ_d^{size−1} in the Laguerre family (lower triangular)."""
    S = lambda_shift(a, size)[:, :size]

    def step(row, _):
        return row @ S, row

    return jax.lax.scan(step, jnp.eye(size)[0], None, length=size)[1]


def past_rows(
    a: Float[Array, ""], block_rows: Float[Array, ""], shifts: Float[Array, ""], padded: int, width: int
) -> Float[Array, "padded width"]:
    """Orthonormal rows that span λ_d^k f_0, …, λ_d^k f_{r−1} with k = `shifts`, r = `block_rows`.

    **Arguments:** `a`: filter pole; `block_rows`, `shifts`: how many rows, and how often they are multiplied
    by λ_d (both may be traced); `padded`: rows of the result, those beyond `block_rows` zero; `width`: size
    of the family.

    **Returns:** coefficients in f_0 … f_{width−1}.
    """
    S = lambda_shift(a, width)[:, :width]
    kept = jnp.arange(padded) < block_rows

    def step(rows, k):
        # Each shift worsens the condition by a small factor: one pass keeps it small, the last makes it exact.
        shifted = orthonormal_basis((rows @ S).T, kept, householder=False, passes=1).T
        return jnp.where(k < shifts, shifted, rows), None

    start = jnp.where(kept[:, None], jnp.eye(padded, width), 0.0)
    rows = jax.lax.scan(step, start, jnp.arange(padded))[0]
    return orthonormal_basis(rows.T, kept, householder=False, passes=1).T
