"""Gram matrix of the filtered rows, without filtering: from correlations and the all-pass structure.

The rows are those of `compression`: responses to the first state, a one, and f_0 … f_{2i−1} of every signal.
Two facts replace the pass over thousands of filtered columns. The product of a signal v with a Laguerre-filtered
one w is a sum over lags, Σ_t v_t (L_k w)_t = Σ_m ℓ_k(m) r(m+1), ℓ_k(m) = (A^m b)_k, with r the correlation of the
two, the same for every time constant and order. And since L_{j+1} = 𝒜 L_j with an all-pass 𝒜, the products S(j, k)
of two filtered signals obey, Δ being what the first and the last sample leave,

    (1 − a²) S(0, k+1) = β (a C(k+1) + C(k)) − Δ(0, k+1) − a Δ(0, k),          β² = 1 − a²,
    S(j+1, k+1) = S(j, k) − [Δ(j+1, k+1) + a Δ(j+1, k) + a Δ(j, k+1) + a² Δ(j, k)] / (1 − a²).

The result is that of summing the rows, to rounding.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .filter_bank import cascade

LAG_BLOCK = 256
"""Lags whose kernels are built at a time; chunks are a multiple of it."""


class Moments(eqx.Module):
    """What a record leaves behind for every time constant, carried from chunk to chunk.

    `states` of the Laguerre cascades, the last column for the response to the first state; `products` Σ_t v^c_t
    (L_k w^d)_t, c over the signals and a one, d over the signals and the first state; `plain`: products of the
    signals and the one among themselves.
    """

    states: Float[Array, "time_constants orders signals_plus_one"]
    products: Float[Array, "time_constants orders signals_plus_one signals_plus_one"]
    plain: Float[Array, "signals_plus_one signals_plus_one"]


def no_moments(poles: Float[Array, " time_constants"], signals: int, block_rows: int) -> Moments:
    """Before the first sample: filters at rest, a unit impulse one sample before the record."""
    orders, wide = 2 * block_rows - 1, signals + 1
    b = jax.vmap(lambda a: cascade(a, orders)[1])(poles)
    states = jnp.zeros((len(poles), orders, wide)).at[:, :, -1].set(b)
    return Moments(states, jnp.zeros((len(poles), orders, wide, wide)), jnp.zeros((wide, wide)))


def _weighted_sums(A: Array, b: Array, sequences: Float[Array, "lags columns"]) -> tuple[Array, list[Array]]:
    """Σ_m A^m b s(m) for every column and pole, and the powers A^1, A^2, A^4, … met on the way."""
    kernel, power, squares = b[:, :, None], A, [A]
    while kernel.shape[2] < LAG_BLOCK:
        kernel = jnp.concatenate([kernel, power @ kernel], axis=2)
        power = power @ power
        squares.append(power)
    lags, columns = sequences.shape
    blocks = sequences.reshape(-1, LAG_BLOCK, columns).transpose(1, 0, 2).reshape(LAG_BLOCK, -1)
    # One product for all time constants: they share the sequences.
    sums = (kernel.reshape(-1, LAG_BLOCK) @ blocks).reshape(*kernel.shape[:2], -1, columns)
    while sums.shape[2] > 1:
        sums = jnp.pad(sums, ((0, 0), (0, 0), (0, sums.shape[2] % 2), (0, 0)))
        later = sums[:, :, 1::2]
        moved = (power @ later.reshape(*later.shape[:2], -1)).reshape(later.shape)
        sums = sums[:, :, ::2] + moved
        power = power @ power
        squares.append(power)
    return sums[:, :, 0], squares


def add_samples(
    moments: Moments,
    poles: Float[Array, " time_constants"],
    signals: Float[Array, "samples signals"],
    kept: Float[Array, " samples"],
) -> Moments:
    """The moments after more samples.

    **Arguments:** `moments` so far; `poles`; `signals`: scaled u and y, a multiple of `LAG_BLOCK` long; `kept`: 1
    for samples that count, all before the first 0.
    """
    length, channels = signals.shape
    orders = moments.states.shape[1]
    A, b = jax.vmap(lambda a: cascade(a, orders))(poles)
    a = poles[:, None]
    values = jnp.concatenate([signals, jnp.ones((length, 1))], axis=1) * kept[:, None]
    spectra = jnp.fft.rfft(values, 2 * length, axis=0)
    cross = spectra[:, :, None] * jnp.conj(spectra[:, None, :channels])
    correlations = jnp.fft.irfft(cross, 2 * length, axis=0)[1 : length + 1]
    samples = jnp.sum(kept).astype(int)
    backwards = jnp.roll(values[::-1, :channels], samples - length, axis=0)
    columns = jnp.concatenate([correlations.reshape(length, -1), values, backwards], axis=1)
    sums, squares = _weighted_sums(A, b, columns)
    lagged, own, ends = jnp.split(sums, [(channels + 1) * channels, (channels + 1) * (channels + 1)], axis=2)
    lagged = lagged.reshape(*sums.shape[:2], channels + 1, channels)

    # What the states at the start of the chunk still contribute: Σ_t v_t A^t, lower triangular Toeplitz.
    shifted = jnp.pad(own, ((0, 0), (1, 0), (0, 0)))[:, :-1]
    first = (own + a[:, :, None] * shifted) / jnp.sqrt(1 - a**2)[:, :, None]
    lag = jnp.arange(orders)[:, None] - jnp.arange(orders)[None, :]
    toeplitz = jnp.where((lag >= 0)[None, :, :, None], first[:, jnp.maximum(lag, 0)], 0.0)
    carried = jnp.einsum("tjkc,tkd->tjcd", toeplitz, moments.states)

    moved = moments.states
    for k, power in enumerate(squares):
        moved = jnp.where((samples >> k) & 1, power @ moved, moved)
    return Moments(
        moved + jnp.pad(ends, ((0, 0), (0, 0), (0, 1))),
        moments.products + carried + jnp.pad(lagged, ((0, 0),) * 3 + ((0, 1),)),
        moments.plain + values.T @ values,
    )


def gram(moments: Moments, poles: Float[Array, " time_constants"]) -> Float[Array, "time_constants columns columns"]:
    """Gram matrix of the rows [first state | 1 | f_0 | … | f_{2i−1}], signals side by side within an order.

    **Arguments:** `moments` after the last sample; `poles`.
    """
    return jax.vmap(lambda states, products, a: _gram(states, products, moments.plain, a))(
        moments.states, moments.products, poles
    )


def _gram(states, products, plain, a):
    orders, wide = states.shape
    channels = wide - 1
    beta = jnp.sqrt(1 - a**2)
    # By (d, e): the first state has no samples of its own.
    C = jnp.concatenate([products[:, :channels], jnp.zeros((orders, 1, wide))], axis=1)
    V = jnp.pad(plain[:channels, :channels], ((0, 1), (0, 1)))
    b = cascade(a, orders)[1]
    start = jnp.zeros((orders, wide)).at[:, -1].set(b)
    Delta = jnp.einsum("jd,ke->jkde", states, states) - jnp.einsum("jd,ke->jkde", start, start)
    corner = (a * beta * (C[0] + C[0].T) + beta**2 * V - Delta[0, 0]) / beta**2
    row = (beta * (a * C[1:] + C[:-1]) - Delta[0, 1:] - a * Delta[0, :-1]) / beta**2
    row = jnp.concatenate([corner[None], row])
    column = jnp.swapaxes(row, 1, 2)
    lost = Delta[1:, 1:] + a * (Delta[1:, :-1] + Delta[:-1, 1:]) + a**2 * Delta[:-1, :-1]

    def down(above, k):
        below = jnp.concatenate([column[k + 1][None], above[:-1] - lost[k] / beta**2])
        return below, below

    rest = jax.lax.scan(down, row, jnp.arange(orders - 1))[1]
    S = jnp.concatenate([row[None], rest])

    last = channels
    filtered = S[:, :, :channels, :channels].transpose(0, 2, 1, 3).reshape(orders * channels, -1)
    raw = products[:, :channels, :channels].transpose(1, 0, 2).reshape(channels, -1)
    first_state = S[:, :, last, last]
    first_filtered = S[:, :, last, :channels].reshape(orders, -1)
    first_raw, first_one = products[:, :channels, last], products[:, last, last][:, None]
    one_filtered = products[:, last, :channels].reshape(1, -1)
    one_raw, count = plain[last : last + 1, :channels], plain[last:, last:]
    return jnp.block(
        [
            [first_state, first_one, first_raw, first_filtered],
            [first_one.T, count, one_raw, one_filtered],
            [first_raw.T, one_raw.T, plain[:channels, :channels], raw],
            [first_filtered.T, one_filtered.T, raw.T, filtered],
        ]
    )
