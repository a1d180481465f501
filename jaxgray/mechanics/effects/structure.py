"""A structure other than modelled: one more mode, or parameters that change during the record."""

import jax.numpy as jnp
import numpy as np

from .base import AbstractForceEffect, AbstractMatrixEffect, Parameter


def at_an_end(t0: float, times: tuple[float, ...]) -> str | None:
    """Why a change at once means nothing outside of the times that were tried, None inside of them."""
    if not times or times[0] <= t0 <= times[-1]:
        return None
    return "so near to an end of the record it stands for anything that happens there"


def step_at(t, t0, width):
    """0 before `t0`, 1 after, straight over `width` around it: the sampled step is differentiable by t0."""
    return jnp.clip((t - t0) / jnp.maximum(width, 1e-100) + 0.5, 0.0, 1.0)


class UnmodelledMode(AbstractMatrixEffect):
    """A mass on a spring and a damper, attached to a coordinate and not measured."""

    id = "unmodelled_mode"
    family = "structure"
    law = "added mass m = mass_ratio·mass[i, i] on a spring m·ω² and a damper 2·damping_ratio·m·ω, ω = 2π·frequency_hz"
    parameters = (
        Parameter("frequency_hz", (0, 0, -1), lower=0.0),
        Parameter("damping_ratio", lower=0.0, upper=1.0),
        Parameter("mass_ratio", lower=1e-6, amplitude=True),
    )
    parity = "odd"
    signature = "a pair of notch and peak, linear"
    reference = "Den Hartog, Mechanical Vibrations, 4th ed., McGraw-Hill 1956, §3.2"
    places = "coordinate"
    extra = True

    def shapes(self, scales):
        nyquist = 0.5 / scales.sampling_time
        natural = [f for f in scales.frequencies_hz if f > 0.0] or [2.0 / scales.duration, 0.2 * nyquist]
        highest = min(4.0 * max(natural), 0.8 * nyquist)
        lowest = min(0.3 * min(natural), 0.5 * highest)
        grid = [(f, 0.02) for f in np.geomspace(lowest, highest, 10)]
        # A line of the residual is where the mass resonates on the structure; only a light one does so at its own.
        grid += [(f, 0.002) for f in scales.lines_hz[:2]]
        return [np.array([f, damping, ratio]) for f, ratio in grid for damping in (0.01, 0.05)]

    def matrices(self, p, M, D, K, first, second):
        omega = 2.0 * jnp.pi * p[0]
        mass = jnp.maximum(p[2], 1e-9) * (first @ M @ first)
        arm = jnp.concatenate([first, -jnp.ones(1, dtype=M.dtype)])
        link = jnp.outer(arm, arm)
        M, D, K = (jnp.pad(X, ((0, 1), (0, 1))) for X in (M, D, K))
        return M.at[-1, -1].set(mass), D + 2.0 * p[1] * mass * omega * link, K + mass * omega**2 * link


class StiffnessDrift(AbstractForceEffect):
    """Stiffness that changes in proportion to time, by dk over the record."""

    id = "stiffness_drift"
    family = "structure"
    law = "f = dk·(t/duration)·q"
    parameters = (
        Parameter("dk", (1, -1, 0), amplitude=True),
        Parameter("duration", (0, 0, 1), lower=0.0, counts=False),
    )
    parity = "odd"
    signature = "residual grows from the middle of the record to both ends"
    reference = "Poulimenos & Fassois, Mech. Syst. Signal Process. 20 (2006) 763-816"
    places = "spring"
    tied_to_clock = True
    alters = "stiffness", "dk"

    def shapes(self, scales):
        return [np.array([1.0, scales.duration])]

    def force(self, p, here, z):
        return p[0] * here.t / jnp.maximum(p[1], 1e-100) * here.q


class StiffnessStep(AbstractForceEffect):
    """Stiffness that changes at once: damage."""

    id = "stiffness_step"
    family = "structure"
    law = "f = dk·step(t − t0)·q"
    parameters = (
        Parameter("dk", (1, -1, 0), amplitude=True),
        Parameter("t0", (0, 0, 1), lower=0.0),
        Parameter("width", (0, 0, 1), lower=0.0, counts=False),
    )
    parity = "odd"
    signature = "fits before and after a moment differ"
    reference = "Basseville & Nikiforov, Detection of Abrupt Changes, Prentice Hall 1993"
    places = "spring"
    resembles = "change of a parameter"
    tied_to_clock = True
    onset = "t0", "width"
    alters = "stiffness", "dk"

    def shapes(self, scales):
        return [np.array([1.0, t0, scales.sampling_time]) for t0 in scales.times]

    def unresolved(self, p, scales):
        return at_an_end(float(p[1]), scales.times)

    def force(self, p, here, z):
        return p[0] * step_at(here.t, p[1], p[2]) * here.q


class MassStep(AbstractForceEffect):
    """Mass that comes or goes at once.

    The acceleration a of the model without it becomes a − compliance·f, and f is dm times that.
    """

    id = "mass_step"
    family = "structure"
    law = "f = dm·step(t − t0)·q̈"
    parameters = (
        Parameter("dm", (1, -1, 2), amplitude=True),
        Parameter("t0", (0, 0, 1), lower=0.0),
        Parameter("width", (0, 0, 1), lower=0.0, counts=False),
    )
    parity = "odd"
    signature = "fits before and after a moment differ, most at high frequency"
    reference = "Basseville & Nikiforov, Detection of Abrupt Changes, Prentice Hall 1993"
    places = "coordinate"
    resembles = "change of a parameter"
    tied_to_clock = True
    onset = "t0", "width"
    alters = "mass", "dm"

    def shapes(self, scales):
        typical = 0.02 / max(scales.compliance, 1e-100)
        return [np.array([typical, t0, scales.sampling_time]) for t0 in scales.times]

    def unresolved(self, p, scales):
        return at_an_end(float(p[1]), scales.times)

    def force(self, p, here, z):
        added = p[0] * step_at(here.t, p[1], p[2])
        # More mass than there is cannot be taken away.
        return added * here.a / jnp.maximum(1.0 + added * here.compliance, 0.05)
