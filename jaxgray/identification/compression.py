"""One triangular factor of the filtered record, from which every order and weight is served.

For one time constant the rows are, sample by sample,

    [ responses to the initial state | 1 | f_0 (u, y) | f_1 (u, y) | … | f_{2i−1} (u, y) ].

The first two groups are projected out (the start need not be at rest, offsets do not matter), and the
triangular factor of the rest is kept. Chunks are streamed: memory does not grow with the record.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.lifting import BLOCK
from .filter_bank import cascade, lifted_cascade

CHUNK_BLOCKS = 32
"""Blocks filtered at a time; the chunk's rows stay in cache."""

RANK_TOLERANCE = 1e-9
"""Smallest squared pivot, relative, for which the Gram matrix is trusted instead of QR."""


class FactorState(eqx.Module):
    """What one pass over a record carries from chunk to chunk, per time constant.

    `filters`: states of the filter cascades, the last column for the response to the initial state;
    `accumulated`: Gram matrix, or triangular factor, of the rows so far.
    """

    filters: Float[Array, "orders signals"]
    accumulated: Float[Array, "columns columns"]


def columns_count(signals: int, block_rows: int) -> int:
    """Columns of the row above: 2i for initial state and constant, 2i for each signal."""
    return 2 * block_rows * (signals + 1)


def begin(a: Float[Array, ""], signals: int, block_rows: int) -> FactorState:
    """State before the first sample: filters at rest, a unit impulse one sample before the record."""
    orders = 2 * block_rows - 1
    _, b = cascade(a, orders)
    filters = jnp.zeros((orders, signals + 1)).at[:, -1].set(b)
    size = columns_count(signals, block_rows)
    return FactorState(filters, jnp.zeros((size, size)))


def absorb(
    state: FactorState,
    a: Float[Array, ""],
    signals: Float[Array, "samples signals"],
    kept: Float[Array, " samples"],
    *,
    householder: bool,
) -> FactorState:
    """Filter more samples and add their rows.

    **Arguments:** `state`: so far; `a`: filter pole; `signals`: scaled u and y, a whole number of chunks
    long; `kept`: 1 for samples that count, 0 for padding; `householder`: accumulate a triangular factor by
    QR (exact for dependent rows) instead of a Gram matrix.

    **Returns:** the state after them.
    """
    orders = state.filters.shape[0]
    channels = signals.shape[1]
    lifted = lifted_cascade(a, orders, BLOCK)
    observability = lifted.observability.reshape(BLOCK, orders, orders)
    toeplitz = lifted.toeplitz.reshape(BLOCK * orders, BLOCK)

    def chunk(carry, part):
        values, weight = part
        blocks = values.reshape(CHUNK_BLOCKS, BLOCK, channels)
        drive = jnp.einsum("kl,blc->bkc", lifted.reachability, blocks)
        drive = jnp.pad(drive, ((0, 0), (0, 0), (0, 1)))

        def step(x, r):
            return lifted.transition @ x + r, x

        last, starts = jax.lax.scan(step, carry.filters, drive)
        forced = jnp.einsum("tl,blc->btc", toeplitz, blocks).reshape(CHUNK_BLOCKS, BLOCK, orders, channels)
        free = jnp.einsum("lok,bkc->bloc", observability, starts)
        filtered = free.at[..., :channels].add(forced).reshape(-1, orders, channels + 1)
        samples = values.shape[0]
        rows = jnp.concatenate(
            [
                filtered[:, :, channels],
                jnp.ones((samples, 1)),
                values,
                filtered[:, :, :channels].reshape(samples, -1),
            ],
            axis=1,
        )
        rows = rows * weight[:, None]
        if householder:
            accumulated = jnp.linalg.qr(jnp.concatenate([carry.accumulated, rows]), mode="r")
        else:
            accumulated = carry.accumulated + rows.T @ rows
        return FactorState(last, accumulated), None

    parts = (
        signals.reshape(-1, CHUNK_BLOCKS * BLOCK, channels),
        kept.reshape(-1, CHUNK_BLOCKS * BLOCK),
    )
    return jax.lax.scan(chunk, state, parts)[0]


def finish(
    state: FactorState, block_rows: int, *, householder: bool
) -> tuple[Float[Array, "columns columns"], Float[Array, ""]]:
    """Triangular factor after the initial state and the constant are projected out.

    **Arguments:** `state` after the last sample; `block_rows`; `householder`: as for `absorb`.

    **Returns:** the upper triangular factor (2i·signals square) and its smallest squared pivot, relative to
    its column; not a number where the Gram matrix has no Cholesky factor.
    """
    first = 2 * block_rows
    if householder:
        factor = state.accumulated[first:, first:]
        size = jnp.linalg.norm(factor, axis=0)
    else:
        size = jnp.sqrt(jnp.diag(state.accumulated))
        scale = jnp.where(size > 0, size, 1.0)
        lower = jnp.linalg.cholesky(state.accumulated / scale[:, None] / scale[None, :])
        factor = (lower.T * scale)[first:, first:]
        size = size[first:]
    pivot = jnp.min((jnp.diag(factor) / jnp.where(size > 0, size, 1.0)) ** 2)
    return factor, pivot


def combine(factors: Float[Array, "records columns columns"]) -> Float[Array, "columns columns"]:
    """One factor for several records of the same system."""
    if factors.shape[0] == 1:
        return factors[0]
    return jnp.linalg.qr(factors.reshape(-1, factors.shape[-1]), mode="r")


@functools.partial(jax.jit, static_argnames=("block_rows", "householder"))
def factors(
    poles: Float[Array, " time_constants"],
    signals: Float[Array, "samples signals"],
    kept: Float[Array, " samples"],
    *,
    block_rows: int,
    householder: bool,
) -> tuple[Float[Array, "time_constants columns columns"], Float[Array, " time_constants"]]:
    """Factors of one record for every time constant, and their smallest squared pivots.

    **Arguments:** `poles`: a = exp(−h/τ) of each; `signals`: u and y scaled to unit size, padded to a whole
    number of chunks; `kept`: 1 where a sample counts; `block_rows`: the largest i wanted; every smaller one
    is contained; `householder`: as for `absorb`.

    **Returns:** factors and pivots.
    """

    def one(a):
        state = begin(a, signals.shape[1], block_rows)
        state = absorb(state, a, signals, kept, householder=householder)
        return finish(state, block_rows, householder=householder)

    return jax.lax.map(one, poles)


def padded_samples(samples: int) -> int:
    """A whole number of chunks, from a few sizes (steps of about 12 %), so that few lengths are compiled."""
    chunk = CHUNK_BLOCKS * BLOCK
    chunks = -(-samples // chunk)
    step = max(1, 2 ** max(0, int(np.log2(chunks)) - 3))
    return -(-chunks // step) * step * chunk
