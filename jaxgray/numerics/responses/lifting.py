"""Linear recursions in blocks: the one engine of filter bank, simulation, Jacobians and whitening.

A recursion x⁺ = A x + B u, y = C x + D u taken sample by sample is slow on any machine: each step is
a tiny product that waits for the one before. Taken in blocks of L samples it becomes

    Y_b = O x_b + T U_b,        x_{b+1} = A^L x_b + R U_b,

with T block-Toeplitz in the Markov parameters. T U_b is one matrix product for the whole record; only
the short recursion in x_b remains, which is lifted a second time when the state is small.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

BLOCK = 32
"""Samples per block: long enough that the scan is short, short enough that T stays in cache."""

SHORT_BLOCK = 16
"""The same where derivatives are taken too: the products with T, most of the work, are half as large."""

UPPER_BLOCK = 8
"""Blocks per block of the recursion over blocks: its T has an entry for every pair of states, and derivatives of it are
built anew for every parameter, which on short records costs more than all else."""

_SECOND_LEVEL_STATES = 8
_UNROLLED_BLOCKS = 48


class LiftedSystem(eqx.Module):
    """The matrices of one block of L samples.

    `observability` maps the state at the start of the block to its outputs, `toeplitz` the inputs to
    the outputs, `reachability` the inputs to the state at the start of the next block and `transition`
    the state from one block start to the next.
    """

    observability: Float[Array, "block_outputs states"]
    toeplitz: Float[Array, "block_outputs block_inputs"]
    reachability: Float[Array, "states block_inputs"]
    transition: Float[Array, "states states"]


def powers(A: Float[Array, "states states"], length: int) -> Float[Array, "length states states"]:
    """Powers A⁰ … A^(length−1) by doubling, so that the chain of products is log₂(length) long."""
    stack = jnp.eye(A.shape[0], dtype=A.dtype)[None]
    square = A
    while stack.shape[0] < length:
        stack = jnp.concatenate([stack, stack @ square], axis=0)
        square = square @ square
    return stack[:length]


def lift(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
    *,
    block: int = BLOCK,
) -> LiftedSystem:
    """Block form of a discrete-time system.

    **Arguments:** `A`, `B`, `C`, `D`: the recursion per sample; `block`: samples per block.

    **Returns:** a `LiftedSystem`; inputs and outputs of a block are ordered by sample, then by channel.
    """
    states, inputs = B.shape
    outputs = C.shape[0]
    observability, markov, to_state, transition = over_a_block(A, B, C, D, block)
    return LiftedSystem(
        observability=observability.reshape(block * outputs, states),
        toeplitz=by_lag(markov).transpose(0, 2, 1, 3).reshape(block * outputs, block * inputs),
        reachability=to_state.transpose(1, 0, 2).reshape(states, block * inputs),
        transition=transition,
    )


def over_a_block(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
    block: int,
) -> tuple[
    Float[Array, "block outputs states"],
    Float[Array, "block outputs inputs"],
    Float[Array, "block states inputs"],
    Float[Array, "states states"],
]:
    """What a block of samples does, sample by sample, for whatever layout: C A^s; the Markov parameters, from D on;
    from the input of every sample to the state after the block; A^block."""
    chain = powers(A, block + 1)
    seen = C @ chain[:block]
    markov = jnp.concatenate([D[None], seen[: block - 1] @ B], axis=0)
    return seen, markov, (chain[:block] @ B)[::-1], chain[block]


def by_lag(markov: Float[Array, "block outputs inputs"]) -> Float[Array, "block block outputs inputs"]:
    """[s, s′]: from the input of sample s′ to the output of sample s, zero where that is earlier."""
    lag = jnp.arange(len(markov))[:, None] - jnp.arange(len(markov))[None, :]
    return jnp.where((lag >= 0)[:, :, None, None], markov[jnp.maximum(lag, 0)], 0.0)


def block_starts(
    transition: Float[Array, "states states"],
    drive: Float[Array, "blocks states"],
    x0: Float[Array, " states"],
) -> tuple[Float[Array, "blocks states"], Float[Array, " states"]]:
    """States at the start of every block of x⁺ = A x + drive, and the state after the last.

    Small states are lifted again, until the sequential part of a 20 000-sample record is some
    twenty steps; large ones (filter cascades) are scanned, where a second lifting would cost more than
    it saves.
    """
    blocks, states = drive.shape
    if states > _SECOND_LEVEL_STATES or blocks <= _UNROLLED_BLOCKS:

        def step(x, r):
            return transition @ x + r, x

        last, starts = jax.lax.scan(step, x0, drive)
        return starts, last
    eye = jnp.eye(states, dtype=transition.dtype)
    upper = lift(transition, eye, eye, jnp.zeros_like(eye), block=UPPER_BLOCK)
    padded = jnp.pad(drive, ((0, -blocks % UPPER_BLOCK + UPPER_BLOCK), (0, 0)))
    grouped = padded.reshape(-1, UPPER_BLOCK * states)
    heads, _ = block_starts(upper.transition, grouped @ upper.reachability.T, x0)
    starts = (grouped @ upper.toeplitz.T + heads @ upper.observability.T).reshape(-1, states)
    return starts[:blocks], starts[blocks]


@functools.partial(jax.jit, static_argnames="block", inline=True)
def respond(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
    u: Float[Array, "samples inputs"],
    x0: Float[Array, " states"] | None = None,
    *,
    block: int = BLOCK,
) -> Float[Array, "samples outputs"]:
    """Response y of x⁺ = A x + B u, y = C x + D u from x(0) = x0 (at rest by default), exact.

    **Arguments:** `A`, `B`, `C`, `D`: the recursion per sample; `u`: input; `x0`: first state;
    `block`: samples per block.

    **Returns:** the outputs, one row a sample.
    """
    samples, inputs = u.shape
    outputs, states = C.shape
    start = jnp.zeros(states, dtype=jnp.result_type(A, u)) if x0 is None else x0
    system = lift(A, B, C, D, block=block)
    padded = jnp.pad(u, ((0, -samples % block), (0, 0))).reshape(-1, block * inputs)
    starts, _ = block_starts(system.transition, padded @ system.reachability.T, start)
    y = padded @ system.toeplitz.T + starts @ system.observability.T
    return y.reshape(-1, outputs)[:samples]


def respond_many(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
    u: Float[Array, "rows samples inputs"],
    *,
    block: int = BLOCK,
) -> Float[Array, "rows samples outputs"]:
    """Responses from rest to many inputs, all through the same block products.

    **Arguments:** as for `respond`; `u`: one input a row.

    **Returns:** the outputs, one response a row.
    """
    rows, samples, inputs = u.shape
    states, outputs = A.shape[0], C.shape[0]
    system = lift(A, B, C, D, block=block)
    padded = jnp.pad(u, ((0, 0), (0, -samples % block), (0, 0))).reshape(-1, block * inputs)
    drive = (padded @ system.reachability.T).reshape(rows, -1, states)

    def step(x, r):
        return x @ system.transition.T + r, x

    starts = jax.lax.scan(step, jnp.zeros((rows, states)), jnp.swapaxes(drive, 0, 1))[1]
    starts = jnp.swapaxes(starts, 0, 1).reshape(-1, states)
    y = padded @ system.toeplitz.T + starts @ system.observability.T
    return y.reshape(rows, -1, outputs)[:, :samples]


def free_response(
    A: Float[Array, "states states"], C: Float[Array, "outputs states"], samples: int
) -> Float[Array, "samples outputs states"]:
    """Outputs C A^k for k = 0 … samples−1: the response to each unit first state.

    **Arguments:** `A`, `C`: the recursion per sample; `samples`: how many.

    **Returns:** one outputs × states matrix a sample.
    """
    states = A.shape[0]
    outputs = C.shape[0]
    chain = powers(A, BLOCK + 1)
    block = (C @ chain[:BLOCK]).reshape(BLOCK * outputs, states)
    heads = powers(chain[BLOCK], -(-samples // BLOCK))
    return (block @ heads).reshape(-1, outputs, states)[:samples]


def scaled_free_response(
    A: Float[Array, "states states"], C: Float[Array, "outputs states"], samples: int
) -> Float[Array, "samples outputs states"]:
    """The same, every first state in units of what it moves: zero where it moves nothing, as the first displacement of
    what hangs on no spring moves no accelerometer."""
    free = free_response(A, C, samples)
    power = jnp.mean(free**2, axis=(0, 1))
    return free / jnp.sqrt(jnp.where(power > 0, power, 1.0))
