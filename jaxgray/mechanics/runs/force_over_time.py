"""Force of a law over a motion that is known, sample by sample."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import AbstractForceEffect, Local


def force_over_time(law: AbstractForceEffect, p: Float[Array, " parameters"], here: Local, time) -> Float[Array, " n"]:
    """Force of a law, which remembers nothing before the first sample.

    **Arguments:** `law`; `p`: its parameters; `here`: what it sees at its place, series over time; `time` [s]: from one
    sample to the next.

    **Returns:** one force a sample.
    """
    samples = here.q.shape[0]
    z = jnp.zeros((law.states, samples))
    if law.states:
        later = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), here)

        def step(state, pair):
            return law.advance(p, state, *pair, time), state

        z = jax.lax.scan(step, jnp.zeros(law.states), (here, later))[1].T
    return jnp.broadcast_to(law.force(p, here, z), (samples,))
