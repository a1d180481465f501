"""Forces that remember where the motion came from, whatever its speed."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractForceEffect, Parameter, Scales
from .stiffness import SHORTEST

WITHIN_A_SAMPLE = 0.2
"""Share of the way that the place usually goes in a sample, below which a length of a hysteresis does not show: it is
dry friction."""

WIDTH = 0.02
"""Width of a loop, relative to its height, below which it is a line."""


def _too_short(name: str, length: float, scales: Scales) -> str | None:
    """What is said of a length that gives way within a sample; None of one that shows."""
    if length >= WITHIN_A_SAMPLE * scales.v * scales.sampling_time:
        return None
    return f"{name} is far less than the motion within a sample there: no more than dry friction"


class DahlFriction(AbstractForceEffect):
    """Dry friction that builds up over the length x_d after each reversal."""

    id = "dahl_friction"
    family = "hysteresis"
    law = "f = Fc·z, ż = (v − |v|·z)/x_d"
    parameters = (
        Parameter("Fc", (1, 0, 0), lower=0.0, amplitude=True),
        Parameter("x_d", (0, 1, 0), lower=0.0),
    )
    parity = "odd"
    contains = ("coulomb_friction",)
    signature = "loops at reversals of the motion"
    reference = "Dahl, A Solid Friction Model, Aerospace Corporation TOR-0158(3107-18)-1, 1968"
    places = "spring"
    resembles = "hysteresis"
    states = 1

    def shapes(self, scales):
        return [np.array([1.0, part * scales.q]) for part in (0.03, 0.1, 0.3, 1.0)]

    def unresolved(self, p, scales):
        return _too_short("x_d", p[1], scales)

    def force(self, p, here, z):
        return p[0] * z[0]

    def advance(self, p, z, before, after, time):
        step = after.q - before.q
        towards = jnp.sign(step)
        way = jnp.minimum(jnp.abs(step) / jnp.maximum(p[1], SHORTEST), 700.0)
        return towards + (z - towards) * jnp.exp(-way)


def _growth(y):
    """(1 − exp(−y))/y, also at 0."""
    small = jnp.abs(y) < 1e-5
    safe = jnp.where(small, 1.0, y)
    return jnp.where(small, 1.0 - 0.5 * y, -jnp.expm1(-safe) / safe)


def _relative_logarithm(y):
    """ln(1 + y)/y, also at 0; `y` is kept above −1."""
    y = jnp.maximum(y, -1.0 + 1e-12)
    small = jnp.abs(y) < 1e-5
    safe = jnp.where(small, 1.0, y)
    return jnp.where(small, 1.0 - 0.5 * y, jnp.log1p(safe) / safe)


def _relaxed(x, rate, way):
    """Solution of dx = (1 − rate·x) dw after `way` ≥ 0."""
    y = jnp.clip(rate * way, -40.0, 700.0)
    return x * jnp.exp(-y) + way * _growth(y)


class BoucWenHysteresis(AbstractForceEffect):
    """Rate-independent loop of the force against the displacement.

    The state kept is z/A, so that the force is linear in A. The loop closes at ±A/(beta + gamma).
    """

    id = "bouc_wen_hysteresis"
    family = "hysteresis"
    law = "f = z, ż = A·v − beta·|v|·z − gamma·v·|z|"
    parameters = (
        Parameter("A", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("beta", (0, -1, 0), lower=0.0),
        Parameter("gamma", (0, -1, 0)),
    )
    parity = "odd"
    becomes = ("coulomb_friction", "sine_stiffness", "cubic_stiffness")
    signature = "rate-independent loop with memory; loop and energy are determined better than beta and gamma"
    reference = "Wen, ASCE J. Eng. Mech. Div. 102 (1976) 249-263"
    places = "spring"
    resembles = "hysteresis"
    renamed = ("dahl_friction",)
    states = 1

    def shapes(self, scales):
        return [
            np.array([1.0, total / (1.0 + share), total * share / (1.0 + share)])
            for share in (1.0, -0.5)
            for total in (1.0 / max(part * scales.q, SHORTEST) for part in (0.05, 0.2, 0.6, 2.0))
        ]

    def bounded(self, p):
        result = super().bounded(p)
        result[2] = max(result[2], -0.99 * result[1])
        return result

    def unresolved(self, p, scales):
        # On its way out and back the slope differs by 2·beta·z, and z is at most the way.
        if p[1] * scales.q_peak < WIDTH:
            return "beta is nothing: a spring without memory"
        closing = p[1] + p[2]
        return _too_short("1/(beta + gamma)", 1.0 / closing, scales) if closing > 0 else None

    def force(self, p, here, z):
        return p[0] * z[0]

    def advance(self, p, z, before, after, time):
        # With x = z·sign(dq)/A: dx = (1 − beta·x − gamma·|x|)|dq|, in two pieces around x = 0, each exact.
        step = after.q - before.q
        towards = jnp.where(step < 0.0, -1.0, 1.0)
        x = z * towards
        opening, closing = p[1] - p[2], jnp.maximum(p[1] + p[2], 0.0)
        back = jnp.minimum(x, 0.0)
        to_zero = -back * _relative_logarithm(-opening * back)
        first = jnp.minimum(jnp.abs(step), to_zero)
        x = _relaxed(x, opening, first)
        return _relaxed(x, closing, jnp.abs(step) - first) * towards


class MaxwellSlipHysteresis(AbstractForceEffect):
    """Two springs in parallel, each with a slider that gives way at the deflection d."""

    id = "maxwell_slip_hysteresis"
    family = "hysteresis"
    law = "f = Σ k·z, z = stop(q, ±d): z⁺ = clip(z + dq, ±d)"
    parameters = (
        Parameter("k", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("k", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("d", (0, 1, 0), lower=0.0),
        Parameter("d", (0, 1, 0), lower=0.0),
    )
    parity = "odd"
    becomes = ("coulomb_friction",)
    signature = "loop made of straight pieces, with memory of reversals"
    reference = "Iwan, J. Appl. Mech. 33 (1966) 893-900"
    places = "spring"
    resembles = "hysteresis"
    states = 2

    def shapes(self, scales):
        pairs = ((0.05, 0.3), (0.1, 1.0), (0.3, 1.0), (0.6, 1.5))
        return [np.array([1.0, 1.0, short * scales.q, long * scales.q]) for short, long in pairs]

    def unresolved(self, p, scales):
        return _too_short("d", min(p[2], p[3]), scales)

    def moved(self, p, change):
        # A slider that gives way often shows k·d more than k: straight in k·d and d.
        k, d = p[:2], p[2:]
        short = d + change[2:]
        size = k * d + change[:2] * d + k * change[2:]
        new = p + change
        curved = (k > 0) & (size > 0) & (short > 0)
        new[:2][curved] = size[curved] / short[curved]
        return new

    def force(self, p, here, z):
        return p[0] * z[0] + p[1] * z[1]

    def advance(self, p, z, before, after, time):
        return jnp.clip(z + (after.q - before.q), -p[2:4], p[2:4])
