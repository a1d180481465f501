"""A linear response and its derivatives in blocks, laid out so that products over all samples are wide.

Differentiating `lifting.respond` gives the same numbers a channel at a time. Here everything stays by blocks: a row
for every channel and sample of a block, a column for every block. The order of the samples changes, which sums over
all of them do not see.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .lifting import SHORT_BLOCK, block_starts, by_lag, over_a_block


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


class ChannelBlocks(eqx.Module):
    """What `lifting.LiftedSystem` holds, for signals laid out by `by_blocks`.

    `observability` has rows ordered by output, then by sample; `reachability` columns by input, then by sample;
    `markov` are the Markov parameters, from D on.
    """

    observability: Float[Array, "outputs_block states"]
    markov: Float[Array, "outputs inputs block"]
    reachability: Float[Array, "states inputs_block"]
    transition: Float[Array, "states states"]

    @property
    def toeplitz(self) -> Float[Array, "outputs_block inputs_block"]:
        """From the inputs of a block to its outputs."""
        outputs, inputs, block = self.markov.shape
        laid = by_lag(self.markov.transpose(2, 0, 1))
        return laid.transpose(2, 0, 3, 1).reshape(outputs * block, inputs * block)


def lift_by_channel(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
) -> ChannelBlocks:
    """Block form of a discrete-time system for signals laid out by `by_blocks`."""
    states, outputs = len(A), len(C)
    observability, markov, to_state, transition = over_a_block(A, B, C, D, SHORT_BLOCK)
    return ChannelBlocks(
        observability=observability.transpose(1, 0, 2).reshape(outputs * SHORT_BLOCK, states),
        markov=markov.transpose(1, 2, 0),
        reachability=to_state.transpose(1, 2, 0).reshape(states, -1),
        transition=transition,
    )


def respond_in_blocks(
    system: ChannelBlocks, u: Float[Array, "channel_block blocks"], x0: Float[Array, " states"]
) -> tuple[Float[Array, "channel_block blocks"], Float[Array, "states blocks"]]:
    """Response by blocks, and the state at the start of each."""
    starts = block_starts(system.transition, (system.reachability @ u).T, x0)[0].T
    return system.toeplitz @ u + system.observability @ starts, starts


def heads_along(
    system: ChannelBlocks,
    along: ChannelBlocks,
    u: Float[Array, "channel_block blocks"],
    starts: Float[Array, "states blocks"],
) -> Float[Array, "columns states blocks"]:
    """Derivatives of the states at the start of every block, by each parameter, then by each first state.

    **Arguments:** `system`: in blocks; `along`: its derivatives by each parameter, with a first axis for these; `u`:
    the input by blocks; `starts`: states at the start of each block, from `respond_in_blocks`.
    """
    states, blocks = starts.shape
    parameters = along.transition.shape[0]
    known = jnp.concatenate([u, starts])
    moves = jnp.concatenate([along.reachability, along.transition], axis=2).reshape(parameters * states, -1)
    drive = (moves @ known).reshape(parameters, states, blocks).transpose(0, 2, 1)
    drive = jnp.concatenate([drive, jnp.zeros((states, blocks, states))])
    first = jnp.concatenate([jnp.zeros((parameters, states)), jnp.eye(states)])
    heads = jax.vmap(lambda r, x: block_starts(system.transition, r, x)[0])(drive, first)
    return heads.transpose(0, 2, 1)


def sensitivities_in_blocks(
    system: ChannelBlocks,
    along: ChannelBlocks,
    u: Float[Array, "channel_block blocks"],
    starts: Float[Array, "states blocks"],
    heads: Float[Array, "columns states blocks"],
) -> Float[Array, "columns channel_block blocks"]:
    """Derivatives of the response by parameters and by the first state, by blocks.

    **Arguments:** as for `heads_along`, and what that returns.

    **Returns:** one response for each parameter, then one for each state.
    """
    states, blocks = starts.shape
    known = jnp.concatenate([u, starts])
    direct = jnp.concatenate([jax.vmap(lambda s: s.toeplitz)(along), along.observability], axis=2)
    direct = (direct.reshape(-1, len(known)) @ known).reshape(len(along.transition), -1, blocks)
    direct = jnp.concatenate([direct, jnp.zeros((states, *direct.shape[1:]))])
    # A sum of a few products, which the compiler melts into the loop that adds it; a product of matrices it would not.
    return direct + sum(c[None, :, None] * heads[:, None, k, :] for k, c in enumerate(system.observability.T))
