"""What an input does between its samples."""

import jax.numpy as jnp
import numpy as np

from ...numerics.responses.band_limited import band_limited
from .base import AbstractInputEffect, Parameter


class IntersampleHold(AbstractInputEffect):
    """The input between samples is not held as said.

    Under a zero-order hold linear_share = 1 stands for a linear hold; a record under a linear hold (start and end
    of a sample differ) is moved the other way, 1 standing for a zero-order hold. What comes after it is late or bent.
    """

    rank = 0

    id = "intersample_hold"
    family = "actuator"
    law = "u between samples: (1 − linear_share)·hold as said + linear_share·the other of zero-order and linear"
    parameters = (Parameter("linear_share", lower=0.0, upper=2.0, amplitude=True),)
    parity = "odd"
    signature = "half a sample of delay or advance"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "input"
    resembles = "timing"

    def shapes(self, scales):
        return [np.array([1.0])]

    def apply(self, p, start, end, time):
        following = jnp.concatenate([start[1:], start[-1:]])
        other = jnp.where(jnp.any(start != end), start, following)
        return start, end + p[0] * (other - end)

    def at_samples(self, p, start, end, seen, time):
        return seen


class BandLimitedInput(AbstractInputEffect):
    """The input between samples is smooth: its samples are those of a sensor behind an anti-alias filter.

    share = 1 stands for an input without frequencies beyond half the sampling rate. What comes after it is late or
    bent.
    """

    rank = 0

    id = "band_limited_input"
    family = "actuator"
    law = "u between samples: (1 − share)·hold as said + share·band-limited"
    parameters = (Parameter("share", lower=0.0, upper=2.0, amplitude=True),)
    parity = "odd"
    signature = "missing gain that grows with frequency: a third of (π f)², f in cycles a sample"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "input"
    resembles = "timing"

    def shapes(self, scales):
        return [np.array([1.0])]

    def apply(self, p, start, end, time):
        smooth = band_limited(start, jnp)
        following = jnp.concatenate([smooth[1:], smooth[-1:]])
        return start + p[0] * (smooth - start), end + p[0] * (following - end)

    def at_samples(self, p, start, end, seen, time):
        return seen
