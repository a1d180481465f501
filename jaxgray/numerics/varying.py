"""Linear recursions whose matrices change from sample to sample: derivatives along a nonlinear run.

    d⁺ = F_k d + G_k

All blocks of samples advance side by side, each from unit and zero first states; then the states at the block starts
follow one another, and one product gives all samples: samples/block + block sequential steps in place of samples.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

BLOCK = 128
"""Samples per block: about as many as there are blocks in a long record."""


def varying_response(
    F: Float[Array, "samples states states"],
    G: Float[Array, "samples states columns"],
    first: Float[Array, "states columns"],
    *,
    block: int = BLOCK,
) -> Float[Array, "samples states columns"]:
    """All d of d⁺ = F_k d + G_k from a first d.

    **Arguments:** `F`, `G`: one matrix a sample; `first`: d at the first sample; `block`: samples per block.

    **Returns:** d at every sample, before its step.
    """
    samples, states, columns = G.shape
    blocks = -(-samples // block)

    def stacked(X):
        X = jnp.pad(X, ((0, blocks * block - samples), (0, 0), (0, 0)))
        return jnp.swapaxes(X.reshape(blocks, block, *X.shape[1:]), 0, 1)

    def step(C, now):
        f, g = now
        return _product(f, C) + jnp.concatenate([jnp.zeros((blocks, states, states)), g], axis=2), C

    begin = jnp.concatenate(
        [jnp.broadcast_to(jnp.eye(states), (blocks, states, states)), jnp.zeros((blocks, states, columns))], axis=2
    )
    last, inside = jax.lax.scan(step, begin, (stacked(F), stacked(G)))

    def onward(d, one):
        return one[:, :states] @ d + one[:, states:], d

    heads = jax.lax.scan(onward, first, last)[1]
    d = _product(inside[..., :states], heads[None]) + inside[..., states:]
    return jnp.swapaxes(d, 0, 1).reshape(-1, states, columns)[:samples]


def _product(A, B):
    """Products of many small matrices, as sums that the compiler fuses."""
    return sum(A[..., :, k, None] * B[..., k, None, :] for k in range(A.shape[-1]))
