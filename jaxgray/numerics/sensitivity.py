"""A linear response and its derivatives in blocks, laid out so that products over all samples are wide.

Differentiating `lifting.respond` gives the same numbers a channel at a time. Here everything stays by blocks: a row
for every channel and sample of a block, a column for every block. The order of the samples changes, which sums over
all of them do not see.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .lifting import SHORT_BLOCK, LiftedSystem, block_starts, lift


def by_blocks(signal: Float[Array, "samples channels"]) -> Float[Array, "channel_block blocks"]:
    """A signal laid out by blocks, ordered by channel, then by sample; what lacks in the last block is zero."""
    samples, channels = signal.shape
    padded = jnp.pad(signal, ((0, -samples % SHORT_BLOCK), (0, 0)))
    return padded.reshape(-1, SHORT_BLOCK, channels).transpose(2, 1, 0).reshape(channels * SHORT_BLOCK, -1)


def from_blocks(laid: Float[Array, "channel_block blocks"], samples: int) -> Float[Array, "samples channels"]:
    """The signal that `by_blocks` laid out."""
    return (
        laid.reshape(-1, SHORT_BLOCK, laid.shape[1]).transpose(2, 1, 0).reshape(-1, len(laid) // SHORT_BLOCK)[:samples]
    )


def lift_by_channel(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
) -> LiftedSystem:
    """Block form of a discrete-time system for signals laid out by `by_blocks`."""
    states, inputs = B.shape
    outputs = C.shape[0]
    system = lift(A, B, C, D, block=SHORT_BLOCK)
    toeplitz = system.toeplitz.reshape(SHORT_BLOCK, outputs, SHORT_BLOCK, inputs).transpose(1, 0, 3, 2)
    return LiftedSystem(
        observability=system.observability.reshape(SHORT_BLOCK, outputs, states).transpose(1, 0, 2).reshape(-1, states),
        toeplitz=toeplitz.reshape(outputs * SHORT_BLOCK, inputs * SHORT_BLOCK),
        reachability=system.reachability.reshape(states, SHORT_BLOCK, inputs).transpose(0, 2, 1).reshape(states, -1),
        transition=system.transition,
    )


def respond_in_blocks(
    system: LiftedSystem, u: Float[Array, "channel_block blocks"], x0: Float[Array, " states"]
) -> tuple[Float[Array, "channel_block blocks"], Float[Array, "states blocks"]]:
    """Response by blocks, and the state at the start of each."""
    starts = block_starts(system.transition, (system.reachability @ u).T, x0)[0].T
    return system.toeplitz @ u + system.observability @ starts, starts


def sensitivities_in_blocks(
    system: LiftedSystem,
    along: LiftedSystem,
    u: Float[Array, "channel_block blocks"],
    starts: Float[Array, "states blocks"],
) -> Float[Array, "columns channel_block blocks"]:
    """Derivatives of the response by parameters and by the first state, by blocks.

    **Arguments:** `system`: the lifted system; `along`: its derivatives by each parameter, with a first axis for these;
    `u`: the input by blocks; `starts`: states at the start of each block, from `respond_in_blocks`.

    **Returns:** one response for each parameter, then one for each state.
    """
    states, blocks = starts.shape
    parameters = along.transition.shape[0]
    known = jnp.concatenate([u, starts])
    moves = jnp.concatenate([along.reachability, along.transition], axis=2).reshape(parameters * states, -1)
    drive = (moves @ known).reshape(parameters, states, blocks).transpose(0, 2, 1)
    drive = jnp.concatenate([drive, jnp.zeros((states, blocks, states))])
    first = jnp.concatenate([jnp.zeros((parameters, states)), jnp.eye(states)])
    heads = jax.vmap(lambda r, x: block_starts(system.transition, r, x)[0])(drive, first)
    direct = jnp.concatenate([along.toeplitz, along.observability], axis=2)
    direct = (direct.reshape(-1, len(known)) @ known).reshape(parameters, -1, blocks)
    direct = jnp.concatenate([direct, jnp.zeros((states, *direct.shape[1:]))])
    # A sum of a few products, which the compiler melts into the loop that adds it; a product of matrices it would not.
    return direct + sum(c[None, :, None] * heads[:, None, :, k] for k, c in enumerate(system.observability.T))


def response_products(
    lifted: Callable[[Array], LiftedSystem],
    vector: Float[Array, " parameters"],
    x0: Float[Array, " states"],
    offset: Float[Array, " outputs"] | None,
    u: Float[Array, "channel_block blocks"],
    y: Float[Array, "channel_block blocks"],
    kept: Float[Array, "channel_block blocks"],
) -> Float[Array, "columns outputs columns outputs"]:
    """Inner products over the samples of what a response is sensitive to, and of its errors.

    **Arguments:** `lifted`: the system of some parameters, by `lift_by_channel`; `vector`: these; `x0`: first state;
    `offset` of the outputs, or None for none; `u`, `y`: input and measured output by blocks; `kept`: 1 for samples that
    count, else 0.

    **Returns:** one column for each parameter, state and offset, the error ŷ − y last.
    """
    system = lifted(vector)
    along = jax.tree_util.tree_map(lambda X: jnp.moveaxis(X, -1, 0), jax.jacfwd(lifted)(vector))
    run, starts = respond_in_blocks(system, u, x0)
    outputs = len(kept) // SHORT_BLOCK
    columns = [sensitivities_in_blocks(system, along, u, starts)]
    if offset is not None:
        run = run + jnp.repeat(offset, SHORT_BLOCK)[:, None]
        units = jnp.repeat(jnp.eye(outputs), SHORT_BLOCK, axis=1)
        columns.append(jnp.broadcast_to(units[:, :, None], (outputs, *kept.shape)))
    rows = jnp.concatenate([*columns, (run - y)[None]]) * kept
    flat = rows.reshape(len(rows) * outputs, -1)
    return (flat @ flat.T).reshape(len(rows), outputs, len(rows), outputs)
