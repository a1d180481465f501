"""Forces against the velocity that a constant damping matrix lacks."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractForceEffect, Parameter

SLOWEST = 1e-100
"""Least velocity that is divided by, so that no value of a parameter makes a NaN."""

WIDTH = 1e-5
"""Velocity over which the sign turns, as a share of the typical velocity."""

_FORCE = Parameter("Fc", (1, 0, 0), lower=0.0, amplitude=True)
_EPS = Parameter("eps", (0, 1, -1), lower=0.0, counts=False)


def ratio(v, width):
    """v/width, limited to ±40 so that neither exp nor its derivative overflows."""
    return jnp.clip(v / jnp.maximum(width, SLOWEST), -40.0, 40.0)


def direction(here, eps):
    """Sign of the velocity, turning over ± `eps`: tanh(v/eps), or as the step of a simulation solves it."""
    return jnp.tanh(ratio(here.v, eps)) if here.turn is None else here.turn


class CoulombFriction(AbstractForceEffect):
    """Dry friction: constant, against the velocity."""

    id = "coulomb_friction"
    family = "friction"
    law = "f = Fc·tanh(v/eps), eps fixed"
    parameters = (_FORCE, _EPS)
    parity = "odd"
    signature = "square wave in phase with the velocity"
    reference = "Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138"
    jumps = True
    places = "spring"
    resembles = "dry friction"

    def shapes(self, scales):
        return [np.array([1.0, WIDTH * scales.v])]

    def rubbing(self, p, here):
        return p[0], p[1]

    def force(self, p, here, z):
        return p[0] * direction(here, p[1])


class StribeckFriction(AbstractForceEffect):
    """Dry friction with another value near rest."""

    id = "stribeck_friction"
    family = "friction"
    law = "f = (Fc + (Fs − Fc)·exp(−(v/vs)²))·tanh(v/eps), eps fixed"
    parameters = (
        _FORCE,
        Parameter("Fs", (1, 0, 0), lower=0.0, amplitude=True),
        Parameter("vs", (0, 1, -1), lower=0.0),
        _EPS,
    )
    parity = "odd"
    contains = ("coulomb_friction",)
    signature = "friction that changes at low speed"
    reference = "Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138, §2.1"
    jumps = True
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0, 1.0, part * scales.v, WIDTH * scales.v]) for part in (0.1, 0.3, 1.0)]

    def bounded(self, p):
        # Narrower than the sign's own turn it would be the shape of that turn.
        p = super().bounded(p)
        p[2] = max(p[2], 2 * p[3])
        return p

    def unresolved(self, p, scales):
        less = p[1] < p[0]
        return "friction that falls towards rest is dry friction whose change of sign is rounded off" if less else None

    def widened(self, p, simple):
        # Coulomb's friction is that at rest as well: from too little there, a refit makes the rest narrow to nothing.
        return super().widened(p, simple | {"Fs": simple.get("Fc", p[1])})

    def rubbing(self, p, here):
        near_rest = jnp.exp(-(ratio(here.v, p[2]) ** 2))
        return p[0] * (1.0 - near_rest) + p[1] * near_rest, p[3]

    def force(self, p, here, z):
        size, eps = self.rubbing(p, here)
        return size * direction(here, eps)


class AsymmetricFriction(AbstractForceEffect):
    """Dry friction with viscous friction that differs by direction: c_a more forward, c_a less backward."""

    id = "asymmetric_friction"
    family = "friction"
    law = "f = Fc·tanh(v/eps) + c_a·|v|, eps fixed"
    parameters = (_FORCE, Parameter("c_a", (1, -1, 1), amplitude=True), _EPS)
    contains = ("coulomb_friction",)
    signature = "even harmonics in quadrature with the displacement"
    reference = "Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138"
    jumps = True
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0, 1.0, WIDTH * scales.v])]

    def rubbing(self, p, here):
        return p[0], p[2]

    def force(self, p, here, z):
        return p[0] * direction(here, p[2]) + p[1] * jnp.abs(here.v)


class QuadraticDrag(AbstractForceEffect):
    """Drag of a turbulent fluid, of an orifice."""

    id = "quadratic_drag"
    family = "friction"
    law = "f = c2·v·|v|"
    parameters = (Parameter("c2", (1, -2, 2), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "damping rises with amplitude"
    reference = "Morison, O'Brien, Johnson & Schaaf, J. Petrol. Technol. 2 (1950) 149-154"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0])]

    def force(self, p, here, z):
        return p[0] * here.v * jnp.abs(here.v)


class PositionDependentFriction(AbstractForceEffect):
    """Dry friction that changes along the path.

    Its amplitudes are Fc and Fc·a, not Fc and a: hence a basis of its own.
    """

    id = "position_dependent_friction"
    family = "friction"
    law = "f = Fc·(1 + a·q)·tanh(v/eps), eps fixed"
    parameters = (_FORCE, Parameter("a", (0, -1, 0), amplitude=True), _EPS)
    contains = ("coulomb_friction",)
    signature = "size of the friction varies with the position"
    reference = "Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138"
    jumps = True
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0, 1.0 / max(scales.q, SLOWEST), WIDTH * scales.v])]

    def basis(self, p):
        return [np.array([p[0], 0.0, p[2]]), np.array(p, dtype=float)]

    def combine(self, p, weights):
        total = weights[0] + weights[1]
        slope = p[1] * weights[1] / total if total > 0.0 else 0.0
        return self.bounded([p[0] * total, slope, p[2]])

    def rubbing(self, p, here):
        return p[0] * (1.0 + p[1] * here.q), p[2]

    def force(self, p, here, z):
        size, eps = self.rubbing(p, here)
        return size * direction(here, eps)


class LoadFriction(AbstractForceEffect):
    """Dry friction in proportion to the force that is transmitted (gears, ball screws, guides under load).

    Of a load that hardly varies it is Coulomb friction; another payload tells them apart.
    """

    id = "load_friction"
    family = "friction"
    law = "f = mu·|u|·tanh(v/eps), u the force of the input, eps fixed"
    parameters = (Parameter("mu", lower=0.0, amplitude=True), _EPS)
    parity = "odd"
    signature = "square wave in phase with the velocity, larger where the input is large"
    reference = "Hamon, Gautier & Garrec, IEEE/RSJ Int. Conf. on Intelligent Robots and Systems (2010) 6187-6193"
    jumps = True
    places = "input"
    resembles = "dry friction"
    told_apart = "Put another payload on: friction of the load changes with it, Coulomb friction stays."

    def shapes(self, scales):
        return [np.array([1.0, WIDTH * scales.v])]

    def rubbing(self, p, here):
        return p[0] * jnp.abs(here.u), p[1]

    def force(self, p, here, z):
        size, eps = self.rubbing(p, here)
        return size * direction(here, eps)


class FractionalDamping(AbstractForceEffect):
    """Structural damping: a fractional derivative of the displacement, between spring and damper.

    s^alpha·q = s^(alpha−1)·v is a sum of first-order states driven by the velocity, from

        s^(alpha−1) = (sin(pi·alpha)/pi) ∫ x^alpha/(s + x) d(ln x)

    by the trapezoidal rule with step d in ln x. The nodes below the lowest rate act as a spring, those above the
    highest as a damper; both are geometric series, summed in closed form. So the rule covers the whole axis, with a
    relative error of 2·sin(pi·alpha)·exp(−pi²/d).
    """

    id = "fractional_damping"
    family = "friction"
    law = "f = eta·s^alpha q, eta in force·time^alpha/length"
    parameters = (
        Parameter("eta", (1, -1, 0), lower=0.0, amplitude=True),
        Parameter("alpha", lower=0.05, upper=0.95),
        Parameter("slowest", (0, 0, -1), lower=0.0, counts=False),
        Parameter("fastest", (0, 0, -1), lower=0.0, counts=False),
    )
    parity = "odd"
    signature = "linear, damping wrong over frequency, odd and even lines clean"
    reference = "Diethelm, The Analysis of Fractional Differential Equations, Springer 2010"
    places = "spring"
    states = 8

    def shapes(self, scales):
        slowest, fastest = 0.5 / scales.duration, 0.5 * np.pi / scales.sampling_time
        return [np.array([1.0, alpha, slowest, fastest]) for alpha in (0.2, 0.4, 0.6, 0.8)]

    def moved(self, p, change):
        # Straight in the size at the middle of the rates and in the exponent.
        middle = np.log(np.sqrt(p[2] * p[3])) if p[2] * p[3] > 0 else 0.0
        if not p[0] > 0:
            return p + change
        new = p + change
        new[1] = np.clip(new[1], self.parameters[1].lower, self.parameters[1].upper)
        size = change[0] / p[0] + change[1] * middle
        new[0] = p[0] * np.exp(np.clip(size - (new[1] - p[1]) * middle, -1.0, 1.0))
        return new

    def _rates(self, p):
        """The rates x of the states [1/s] and the step of ln x."""
        lowest, highest = jnp.log(jnp.maximum(p[2], 1e-12)), jnp.log(jnp.maximum(p[3], 1e-12))
        step = jnp.maximum(highest - lowest, 1e-3) / (self.states - 1)
        return jnp.exp(lowest + step * jnp.arange(self.states)), step

    def force(self, p, here, z):
        rates, step = self._rates(p)
        alpha = jnp.clip(p[1], 1e-3, 1.0 - 1e-3)
        weights = rates**alpha
        spring = weights[0] / jnp.expm1(alpha * step)
        damper = weights[-1] / rates[-1] / jnp.expm1((1.0 - alpha) * step)
        total = jnp.tensordot(weights, z, 1) + spring * here.q + damper * here.v
        return p[0] * jnp.sin(jnp.pi * alpha) / jnp.pi * step * total

    def advance(self, p, z, before, after, time):
        rates, _ = self._rates(p)
        speed = (after.q - before.q) / time
        # −expm1 keeps the gain of slow states, for which 1 − exp cancels.
        return jnp.exp(-rates * time) * z - jnp.expm1(-rates * time) / rates * speed
