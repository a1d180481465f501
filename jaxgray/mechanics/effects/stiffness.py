"""Restoring forces that a constant stiffness matrix lacks."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractForceEffect, Parameter

SHORTEST = 1e-100
"""Least length that is divided by, so that no value of a parameter makes a NaN."""

SMALL = 0.5
"""Angle [rad] within which a sine differs from a line and a cubic by less than 0.03 % of its largest force."""


BY_CONTACT = "dead_zone_stiffness", "end_stop"
"""Names of one law, in contact for more than half of the samples and for less."""


def beyond(x, gap):
    """The part of a signal outside ± `gap`: x − clip(x, ±gap)."""
    return x - jnp.clip(x, -gap, gap)


class CubicStiffness(AbstractForceEffect):
    """Hardening (k3 > 0) or softening spring."""

    id = "cubic_stiffness"
    family = "stiffness"
    law = "f = k3·q³"
    parameters = (Parameter("k3", (1, -3, 0), amplitude=True),)
    parity = "odd"
    signature = "third harmonic in phase with the displacement, resonance moves with amplitude"
    reference = "Kerschen, Worden, Vakakis & Golinval, Mech. Syst. Signal Process. 20 (2006) 505-592, §2"
    places = "spring"
    resembles = "hardening"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * here.q**3


class QuadraticStiffness(AbstractForceEffect):
    """Spring stiffer on one side than on the other, smoothly (a curved or preloaded part)."""

    id = "quadratic_stiffness"
    family = "stiffness"
    law = "f = k2·q²"
    parameters = (Parameter("k2", (1, -2, 0), amplitude=True),)
    parity = "even"
    signature = "even harmonics and a mean that grows with the square of the amplitude"
    reference = "Nayfeh & Mook, Nonlinear Oscillations, Wiley 1979, §2.3.1"
    places = "spring"
    resembles = "asymmetry"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * here.q**2


class DeadZoneStiffness(AbstractForceEffect):
    """Backlash or clearance: contact in more than half of the samples."""

    id = "dead_zone_stiffness"
    family = "stiffness"
    law = "f = k·(q − clip(q, ±gap)), |q| > gap in more than half of the samples"
    parameters = (
        Parameter("k", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("gap", (0, 1, 0), lower=0.0),
    )
    parity = "odd"
    signature = "apparent stiffness rises with amplitude, missing force within a gap around zero"
    reference = "Nordin & Gutman, Automatica 38 (2002) 1633-1649"
    places = "spring"
    resembles = "hardening"
    by_contact = BY_CONTACT
    replaces = "stiffness"

    def shapes(self, scales):
        return [np.array([1.0, part * scales.q_quantiles[0]]) for part in (0.1, 0.3, 0.6, 1.0)]

    def moved(self, p, change):
        # Far outside the gap f = k·q − k·gap·sgn q: straight in k and k·gap, since the stiffness beside it takes up k.
        k = p[0] + change[0]
        if not (k > 0 and p[0] > 0):
            return p + change
        return np.array([k, (p[0] * p[1] + change[0] * p[1] + p[0] * change[1]) / k])

    def force(self, p, here, z):
        return p[0] * beyond(here.q, p[1])


class EndStop(AbstractForceEffect):
    """Elastic stop on both sides: contact in less than half of the samples."""

    id = "end_stop"
    family = "stiffness"
    law = "f = ks·(q − clip(q, ±gap)), |q| > gap in less than half of the samples"
    parameters = (
        Parameter("ks", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("gap", (0, 1, 0), lower=0.0),
    )
    parity = "odd"
    signature = "bursts of missing force at the extremes of the displacement, quiet in between"
    reference = "Shaw & Holmes, J. Sound Vib. 90 (1983) 129-155"
    places = "spring"
    resembles = "hardening"
    by_contact = BY_CONTACT

    def shapes(self, scales):
        return [np.array([1.0, scales.q_quantiles[k]]) for k in (1, 3, 4, 5)]

    def force(self, p, here, z):
        return p[0] * beyond(here.q, p[1])


class BilinearStiffness(AbstractForceEffect):
    """Another stiffness on one side (a breathing crack, a one-sided contact without clearance)."""

    id = "bilinear_stiffness"
    family = "stiffness"
    law = "f = ks·max(q, 0)"
    parameters = (Parameter("ks", (1, -1, 0), amplitude=True),)
    signature = "even harmonics in proportion to the amplitude"
    reference = "Friswell & Penny, Struct. Health Monit. 1 (2002) 139-148"
    places = "spring"
    resembles = "asymmetry"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * jnp.maximum(here.q, 0.0)


class SineStiffness(AbstractForceEffect):
    """Periodic restoring force: pendulum, magnets, cogging."""

    id = "sine_stiffness"
    family = "stiffness"
    law = "f = k·length·sin(q/length)"
    parameters = (
        Parameter("k", (1, -1, 0), amplitude=True),
        Parameter("length", (0, 1, 0), lower=0.0),
    )
    parity = "odd"
    becomes = ("cubic_stiffness",)
    repeats = True
    signature = "softening with a bounded force"
    reference = "Nayfeh & Mook, Nonlinear Oscillations, Wiley 1979, §2.1.1"
    places = "spring"
    resembles = "hardening"

    def shapes(self, scales):
        # From a magnet that is passed once to many poles over the way, of which the record tells those apart that
        # differ by half a turn over the largest displacement.
        return [np.array([1.0, scales.q_peak / angle]) for angle in (0.5, 1.0, 2.0, *np.arange(4.0, 28.0, 2.5))]

    def unresolved(self, p, scales):
        angle = scales.q_peak / max(p[1], SHORTEST)
        return f"in {angle:.2g} rad it is a cubic spring" if angle < SMALL else None

    def force(self, p, here, z):
        length = jnp.maximum(p[1], SHORTEST)
        return p[0] * length * jnp.sin(here.q / length)


class ConstantForce(AbstractForceEffect):
    """Gravity or preload."""

    id = "constant_force"
    family = "stiffness"
    law = "f = f0"
    parameters = (Parameter("f0", (1, 0, 0), amplitude=True),)
    parity = "even"
    signature = "mean of the residual, filtered by the plant"
    reference = "Gautier, Janot & Vandanjon, IEEE Trans. Control Syst. Technol. 21 (2013) 428-444"
    places = "coordinate"
    resembles = "offset"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * jnp.ones_like(here.q)


class PositionDependentStiffness(AbstractForceEffect):
    """Stiffness that follows the scheduling channel p(t); its constant part k is in the stiffness matrix, so that
    k(1 + a′·p) has a = k·a′ here."""

    id = "position_dependent_stiffness"
    family = "stiffness"
    law = "f = a·p·q, p the scheduling channel, a the change of stiffness per unit of p"
    parameters = (Parameter("a", (1, -1, 0), amplitude=True),)
    signature = "stiffness modulated by the scheduling channel"
    reference = "Tóth, Modeling and Identification of Linear Parameter-Varying Systems, Springer 2010"
    places = "spring"
    scheduled = True

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * here.p * here.q
