"""Forces that nobody recorded; applied forces, hence negative on the left side."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractForceEffect, Parameter
from .structure import at_an_end, step_at


class PeriodicDisturbance(AbstractForceEffect):
    """One line: an unbalance, the mains, a fan."""

    id = "periodic_disturbance"
    family = "disturbance"
    law = "applied force A·sin(2π·frequency_hz·t + phase)"
    parameters = (
        Parameter("A", (1, 0, 0), lower=0.0, amplitude=True),
        Parameter("frequency_hz", (0, 0, -1), lower=0.0),
        Parameter("phase"),
    )
    signature = "one line in the spectrum of the residual, incoherent with the input"
    reference = "Bodson & Douglas, Automatica 33 (1997) 2213-2221"
    places = "coordinate"
    tied_to_clock = True
    own_phase = True

    def shapes(self, scales):
        return [np.array([1.0, frequency, 0.0]) for frequency in scales.lines_hz]

    def looks(self, scales, grid):
        # The strongest of all lines that the record resolves.
        return max(len(grid), int(scales.duration / scales.sampling_time / 2))

    def basis(self, p):
        return [np.array([p[0], p[1], 0.0]), np.array([p[0], p[1], 0.5 * np.pi])]

    def combine(self, p, weights):
        return self.bounded([p[0] * np.hypot(*weights), p[1], np.arctan2(weights[1], weights[0])])

    def moved(self, p, change):
        # At one frequency straight in the plane of A cos(phase) and A sin(phase), in which the force is linear.
        if change[1] != 0:
            return p + change
        along, across = p[0] + change[0], p[0] * change[2]
        return np.array([np.hypot(along, across), p[1] + change[1], p[2] + np.arctan2(across, along)])

    def force(self, p, here, z):
        return -p[0] * jnp.sin(2.0 * jnp.pi * p[1] * here.t + p[2])


class ForceStep(AbstractForceEffect):
    """A constant force from a moment on."""

    id = "force_step"
    family = "disturbance"
    law = "applied force F·step(t − t0)"
    parameters = (
        Parameter("F", (1, 0, 0), amplitude=True),
        Parameter("t0", (0, 0, 1), lower=0.0),
        Parameter("width", (0, 0, 1), lower=0.0, counts=False),
    )
    contains = ("constant_force",)
    signature = "ring-down, then a shifted mean"
    reference = "Basseville & Nikiforov, Detection of Abrupt Changes, Prentice Hall 1993"
    places = "coordinate"
    tied_to_clock = True
    onset = "t0", "width"

    def shapes(self, scales):
        return [np.array([1.0, t0, scales.sampling_time]) for t0 in scales.times]

    def unresolved(self, p, scales):
        return at_an_end(float(p[1]), scales.times)

    def named_values(self, p):
        return super().named_values(p) | {"f0": -float(p[0])}

    def force(self, p, here, z):
        return -p[0] * step_at(here.t, p[1], p[2])
