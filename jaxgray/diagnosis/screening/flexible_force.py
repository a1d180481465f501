"""A flexible force without physics: what any memoryless law of the motion could explain at most."""

import jax.numpy as jnp
import numpy as np

from ...mechanics.effects.base import AbstractForceEffect, Parameter

_COUNT = 14


class FlexibleForce(AbstractForceEffect):
    """A sum of bounded-growth functions of displacement and velocity, each with a weight of its own.

    It is never a finding: it opens the gate where no law of the catalogue does, and says how much of what is left some
    force could explain.
    """

    id = "flexible_force"
    family = "competitor"
    law = "f = Σ c_k φ_k(q, v), fourteen functions of displacement and velocity"
    parameters = (
        *(Parameter("c", (1, 0, 0), amplitude=True) for _ in range(_COUNT)),
        Parameter("q_scale", (0, 1, 0), counts=False),
        Parameter("v_scale", (0, 1, -1), counts=False),
    )
    parity = "none"
    signature = "anything that depends on displacement and velocity at one place"
    reference = "Masri & Caughey, J. Appl. Mech. 46 (1979) 433-447 (restoring force surface)"
    places = "spring"

    def shapes(self, scales):
        return [np.concatenate([np.ones(_COUNT), [1.5 * scales.q, 1.5 * scales.v]])]

    def force(self, p, here, z):
        x = here.q / jnp.maximum(p[-2], 1e-100)
        w = here.v / jnp.maximum(p[-1], 1e-100)
        functions = (
            x**2,
            x**3 / (1 + 0.1 * x**2),
            jnp.abs(x),
            jnp.tanh(4 * x),
            jnp.maximum(x - 0.7, 0.0),
            jnp.maximum(-x - 0.7, 0.0),
            jnp.maximum(x - 1.3, 0.0),
            jnp.maximum(-x - 1.3, 0.0),
            jnp.tanh(20 * w),
            jnp.tanh(3 * w),
            w * jnp.abs(w),
            x * w,
            x**2 * w / (1 + 0.1 * x**2),
            x * w**2 / (1 + 0.1 * w**2),
        )
        return sum(p[k] * value for k, value in enumerate(functions))
