"""What happens to an output between the motion of the plant and the record.

In the units of these parameters "length" stands for the unit of the output. Before the record the output has its
first value.
"""

import jax.numpy as jnp
import numpy as np

from ...numerics.responses.lifting import respond
from .actuator import SAMPLES, lag_step
from .base import AbstractOutputEffect, Parameter
from .structure import at_an_end, step_at

LEAST_LOST = 0.5
"""Samples below which none was lost."""


def _times(y, time):
    return jnp.arange(y.shape[0]) * time


def interpolated(y, position):
    """A series at real sample numbers, by cubic Hermite (Catmull-Rom) pieces, constant beyond its ends."""
    position = jnp.clip(position, -2.0, y.shape[0] + 1.0)
    whole = jnp.floor(position)
    s = position - whole
    a, b, c, d = _cubics(y, whole.astype(int))
    return a + s * (b + s * (c + s * d))


def _cubics(y, k):
    """Coefficients of the powers of s = 0 to 1 from sample k to the next, by cubic Hermite (Catmull-Rom) pieces, the
    last one going on as it bends."""
    last = y.shape[0] - 1
    y0, y1, y2, y3 = (y[jnp.clip(k + shift, 0, last)] for shift in (-1, 0, 1, 2))
    y3 = jnp.where(k == last - 1, y0 - 3.0 * y1 + 3.0 * y2, y3)
    return y1, 0.5 * (y2 - y0), y0 - 2.5 * y1 + 2.0 * y2 - 0.5 * y3, 0.5 * (3.0 * (y1 - y2) + y3 - y0)


class SensorOffset(AbstractOutputEffect):
    """Wrong zero."""

    id = "sensor_offset"
    family = "sensor"
    law = "y + b"
    parameters = (Parameter("b", (0, 1, 0), amplitude=True),)
    parity = "even"
    signature = "mean of the residual, not filtered by the plant"
    reference = "Doebelin, Measurement Systems, 5th ed., McGraw-Hill 2003"
    places = "output"
    resembles = "offset"

    def shapes(self, scales):
        return [np.array([1.0])]

    def apply(self, p, y, source, time):
        return y + p[0]


class SensorDrift(AbstractOutputEffect):
    """Zero that wanders from the start of the record."""

    id = "sensor_drift"
    family = "sensor"
    law = "y + b1·t + b2·t²"
    parameters = (Parameter("b1", (0, 1, -1), amplitude=True), Parameter("b2", (0, 1, -2), amplitude=True))
    signature = "low frequencies, not filtered by the plant"
    reference = "Doebelin, Measurement Systems, 5th ed., McGraw-Hill 2003"
    places = "output"
    resembles = "offset"
    tied_to_clock = True

    def shapes(self, scales):
        return [np.array([1.0, 1.0])]

    def apply(self, p, y, source, time):
        t = _times(y, time)
        return y + (p[0] + p[1] * t) * t


class SensorDelay(AbstractOutputEffect):
    """The output is recorded late."""

    id = "sensor_delay"
    family = "sensor"
    law = "y(t − tau)"
    parameters = (Parameter("tau", (0, 0, 1), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "skew between channels"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "output"
    resembles = "timing"

    def shapes(self, scales):
        return [np.array([count * scales.sampling_time]) for count in SAMPLES]

    def apply(self, p, y, source, time):
        return interpolated(y, jnp.arange(y.shape[0]) - p[0] / time)


class SensorLag(AbstractOutputEffect):
    """First-order filter of the sensor or its amplifier, exact for an output of cubic pieces between samples."""

    id = "sensor_lag"
    family = "sensor"
    law = "tau·ẏ_m + y_m = y"
    parameters = (Parameter("tau", (0, 0, 1), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "delay with a gain that drops over frequency, of one output only"
    reference = "Doebelin, Measurement Systems, 5th ed., McGraw-Hill 2003"
    places = "output"
    resembles = "timing"

    def shapes(self, scales):
        return [np.array([count * scales.sampling_time]) for count in SAMPLES]

    def apply(self, p, y, source, time):
        pieces = jnp.stack(_cubics(y, jnp.arange(y.shape[0])), axis=1)
        A, B = lag_step(jnp.asarray(p[0] / time, dtype=y.dtype), pieces.shape[1])
        return respond(A, B, jnp.ones_like(A), jnp.zeros_like(B), pieces, y[:1])[:, 0]


class SensorCrosstalk(AbstractOutputEffect):
    """Another output, or an input, leaks into this one."""

    id = "sensor_crosstalk"
    family = "sensor"
    law = "y + a·source; of an input, a in units of the output per unit of the input"
    parameters = (Parameter("a", amplitude=True),)
    parity = "odd"
    signature = "residual is a copy of another channel, without dynamics"
    reference = "Doebelin, Measurement Systems, 5th ed., McGraw-Hill 2003"
    places = "cross"

    def shapes(self, scales):
        return [np.array([1.0])]

    def apply(self, p, y, source, time):
        return y + p[0] * source


class SensorNonlinearity(AbstractOutputEffect):
    """Curved characteristic of the sensor."""

    id = "sensor_nonlinearity"
    family = "sensor"
    law = "y + a·y² (square), y + a·y³ (cube, a per length²) or y + a·|y| (abs, a without unit)"
    parameters = (
        Parameter("a", (0, -1, 0), amplitude=True),
        Parameter("form", lower=0.0, upper=2.0, counts=False, choices=("square", "cube", "abs")),
    )
    signature = "harmonics not filtered by the plant"
    reference = "Tao & Kokotović, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, Wiley 1996"
    places = "output"

    def shapes(self, scales):
        return [np.array([1.0, form]) for form in (0.0, 1.0, 2.0)]

    def apply(self, p, y, source, time):
        curved = jnp.where(p[1] < 0.5, y**2, jnp.where(p[1] < 1.5, y**3, jnp.abs(y)))
        return y + p[0] * curved


class ClockScale(AbstractOutputEffect):
    """The clock of the output runs at another rate: a delay that grows in proportion to time."""

    id = "clock_scale"
    family = "sensor"
    law = "y at t·(1 + eps)"
    parameters = (Parameter("eps", lower=-0.1, upper=0.1, amplitude=True),)
    parity = "odd"
    signature = "residual like the velocity, growing over the record"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "record"
    tied_to_clock = True
    stage = "record"

    def shapes(self, scales):
        return [np.array([0.2 * scales.sampling_time / scales.duration])]

    def apply(self, p, y, source, time):
        return interpolated(y, jnp.arange(y.shape[0]) * (1.0 + p[0]))


class DroppedSamples(AbstractOutputEffect):
    """Samples of the outputs that the logger lost without a gap in the time column: what follows comes too early."""

    id = "dropped_samples"
    family = "sensor"
    law = "y at t + count·h·step(t − t0), h the sampling time; or rows missing from the time column"
    parameters = (
        Parameter("count", lower=-100.0, upper=100.0, amplitude=True),
        Parameter("t0", (0, 0, 1), lower=0.0),
        Parameter("width", (0, 0, 1), lower=0.0, counts=False),
    )
    parity = "odd"
    signature = "residual like the velocity from a moment on"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "record"
    tied_to_clock = True
    onset = "t0", "width"
    stage = "record"

    def shapes(self, scales):
        return [np.array([0.2, t0, scales.sampling_time]) for t0 in scales.times]

    def unresolved(self, p, scales):
        # Loggers lose whole samples. Less, or all from the start, is a shift in time: of inputs, a sensor, the hold.
        if abs(p[0]) < LEAST_LOST:
            return f"{abs(p[0]):.2g} of a sample is no lost one, but a shift in time"
        return at_an_end(p[1], scales.times)

    def apply(self, p, y, source, time):
        jump = p[0] * step_at(_times(y, time), p[1], p[2])
        return interpolated(y, jnp.arange(y.shape[0]) + jump)
