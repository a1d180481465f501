"""One triangular factor of the filtered record, from which every order and weight is served.

For one time constant the rows are, sample by sample,

    [ responses to the initial state | 1 | f_0 (u, y) | f_1 (u, y) | … | f_{2i−1} (u, y) ].

The first two groups are projected out (the start need not be at rest, offsets do not matter), and a factor of
the rest is kept: R with RᵀR the Gram matrix of these columns, triangular once the inputs of all orders stand
before the outputs, so that its leading rows span the inputs. The Gram matrix comes from correlations; where the
columns are dependent, as without noise, the rows themselves are filtered and reduced by Householder QR. Either
way the record is taken in chunks: memory does not grow with it.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.responses.lifting import BLOCK
from ..setup.padding import CHUNK_BLOCKS
from .correlation import Moments, add_samples, gram, no_moments
from .filter_bank import cascade, lifted_cascade

LONGEST = 2**17
"""Samples up to which a record is one chunk of correlations; longer ones are taken in chunks of a quarter of it."""

RANK_TOLERANCE = 1e-9
"""Smallest squared pivot, relative, for which the Gram matrix is trusted instead of QR."""


class FactorState(eqx.Module):
    """What the Householder pass over a record carries from chunk to chunk, for one time constant.

    `filters`: states of the filter cascades, the last column for the response to the initial state;
    `accumulated`: triangular factor of the rows so far.
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
) -> FactorState:
    """Filter more samples and add their rows to the triangular factor.

    **Arguments:** `state`: so far; `a`: filter pole; `signals`: scaled u and y, a whole number of chunks
    long; `kept`: 1 for samples that count, 0 for padding.

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
        accumulated = jnp.linalg.qr(jnp.concatenate([carry.accumulated, rows]), mode="r")
        return FactorState(last, accumulated), None

    parts = (
        signals.reshape(-1, CHUNK_BLOCKS * BLOCK, channels),
        kept.reshape(-1, CHUNK_BLOCKS * BLOCK),
    )
    return jax.lax.scan(chunk, state, parts)[0]


def inputs_first(inputs: int, channels: int, block_rows: int) -> np.ndarray:
    """Order of a factor's columns with the inputs of every order before the outputs."""
    place = np.arange(2 * block_rows * channels).reshape(-1, channels)
    return np.concatenate([place[:, :inputs].ravel(), place[:, inputs:].ravel()])


def _pivot(factor: Array, size: Array, order: np.ndarray) -> Float[Array, ""]:
    """Smallest squared pivot relative to its column."""
    return jnp.min((jnp.diag(factor[:, order]) / jnp.where(size > 0, size, 1.0)[order]) ** 2)


def factor_of_gram(
    G: Float[Array, "columns columns"], inputs: int, block_rows: int
) -> tuple[Float[Array, "rows rows"], Float[Array, ""]]:
    """Factor from the Gram matrix of all columns, by Cholesky.

    **Arguments:** `G`; `inputs`: how many signals are inputs; `block_rows`.

    **Returns:** the factor after the initial state and the constant are projected out (2i·signals square), and its
    smallest squared pivot, relative to its column; not a number where there is no Cholesky factor.
    """
    first = 2 * block_rows
    order = inputs_first(inputs, (len(G) - first) // first, block_rows)
    whole = np.concatenate([np.arange(first), first + order])
    size = jnp.sqrt(jnp.diag(G))
    scale = jnp.where(size > 0, size, 1.0)
    lower = jnp.linalg.cholesky((G / scale[:, None] / scale[None, :])[whole][:, whole])
    factor = lower.T[first:, first:][:, np.argsort(order)] * scale[first:]
    return factor, _pivot(factor, size[first:], order)


def factor_of_rows(
    accumulated: Float[Array, "columns columns"], inputs: int, block_rows: int
) -> tuple[Float[Array, "rows rows"], Float[Array, ""]]:
    """The same from the triangular factor of all columns."""
    first = 2 * block_rows
    order = inputs_first(inputs, (len(accumulated) - first) // first, block_rows)
    rest = accumulated[first:, first:]
    factor = jnp.linalg.qr(rest[:, order], mode="r")[:, np.argsort(order)]
    return factor, _pivot(factor, jnp.linalg.norm(rest, axis=0), order)


def combine(
    factors: Float[Array, "records columns columns"], inputs: int, block_rows: int
) -> Float[Array, "columns columns"]:
    """One factor for several records of the same system."""
    if factors.shape[0] == 1:
        return factors[0]
    order = inputs_first(inputs, factors.shape[-1] // (2 * block_rows), block_rows)
    stacked = factors.reshape(-1, factors.shape[-1])[:, order]
    return jnp.linalg.qr(stacked, mode="r")[:, np.argsort(order)]


def moments_of(
    poles: Float[Array, " time_constants"],
    signals: Float[Array, "samples signals"],
    kept: Float[Array, " samples"],
    block_rows: int,
) -> Moments:
    """Moments of a whole record for every time constant, in one chunk or, for long records, several."""
    moments = no_moments(poles, signals.shape[1], block_rows)
    if len(signals) <= LONGEST:
        return add_samples(moments, poles, signals, kept)
    length = LONGEST // 4
    padding = -len(signals) % length
    parts = (
        jnp.pad(signals, ((0, padding), (0, 0))).reshape(-1, length, signals.shape[1]),
        jnp.pad(kept, (0, padding)).reshape(-1, length),
    )
    return jax.lax.scan(lambda carry, part: (add_samples(carry, poles, *part), None), moments, parts)[0]


@functools.partial(jax.jit, static_argnames=("inputs", "block_rows", "householder"))
def factors(
    poles: Float[Array, " time_constants"],
    signals: Float[Array, "samples signals"],
    kept: Float[Array, " samples"],
    *,
    inputs: int,
    block_rows: int,
    householder: bool,
) -> tuple[Float[Array, "time_constants columns columns"], Float[Array, " time_constants"]]:
    """Factors of one record for every time constant, and their smallest squared pivots.

    **Arguments:** `poles`: a = exp(−h/τ) of each; `signals`: u and y scaled to unit size, padded to a whole
    number of chunks; `kept`: 1 where a sample counts, 0 for padding at the end; `inputs`: how many signals are
    inputs; `block_rows`: the largest i wanted; every smaller one is contained; `householder`: filter the rows and
    take their QR (exact for dependent columns) instead of the Gram matrix.

    **Returns:** factors and pivots.
    """
    if not householder:
        grams = gram(moments_of(poles, signals, kept, block_rows), poles)
        return jax.vmap(lambda G: factor_of_gram(G, inputs, block_rows))(grams)

    def one(a):
        state = absorb(begin(a, signals.shape[1], block_rows), a, signals, kept)
        return factor_of_rows(state.accumulated, inputs, block_rows)

    return jax.lax.map(one, poles)
