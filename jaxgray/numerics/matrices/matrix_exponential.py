"""Matrix exponential in traced code: one Padé approximant, scaling and squaring."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_PADE = np.array(
    [
        64764752532480000.0,
        32382376266240000.0,
        7771770303897600.0,
        1187353796428800.0,
        129060195264000.0,
        10559470521600.0,
        670442572800.0,
        33522128640.0,
        1323241920.0,
        40840800.0,
        960960.0,
        16380.0,
        182.0,
        1.0,
    ]
)
_RADIUS = 5.371920351148152
_SQUARINGS = 16


@functools.partial(jax.jit, inline=True)
def matrix_exponential(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """exp(A) by the [13/13] Padé approximant, for norms up to 3e5.

    One order for all norms: compiled several times over in every derivative, the branches of the general
    algorithm cost more than they save.

    **Arguments:** `A`: square matrix.

    **Returns:** exp(A), to rounding.

    **Reference:** Higham, *The scaling and squaring method for the matrix exponential revisited* (2005).
    """
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=0)))
    halvings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 1e-300) / _RADIUS)), 0, _SQUARINGS)
    X = A / 2**halvings
    X2 = X @ X
    X4 = X2 @ X2
    X6 = X4 @ X2
    even = jnp.tensordot(_PADE[0:8:2], jnp.stack([eye, X2, X4, X6]), 1)
    odd = jnp.tensordot(_PADE[1:8:2], jnp.stack([eye, X2, X4, X6]), 1)
    even = even + X6 @ jnp.tensordot(_PADE[8::2], jnp.stack([X2, X4, X6]), 1)
    odd = odd + X6 @ jnp.tensordot(_PADE[9::2], jnp.stack([X2, X4, X6]), 1)
    odd = X @ odd
    start = jnp.linalg.solve(even - odd, even + odd)

    def square(R, k):
        return jnp.where(k < halvings, R @ R, R), None

    return jax.lax.scan(square, start, jnp.arange(_SQUARINGS))[0]
