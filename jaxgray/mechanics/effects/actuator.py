"""What happens to an input between the recorded command and the force on the plant.

In the units of these parameters "force" stands for the unit of the input. Before the record the input has its
first value.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from ...numerics.responses.lifting import respond
from .base import AbstractForceEffect, AbstractInputEffect, Parameter
from .friction import SLOWEST

SAMPLES = (0.5, 2.0, 8.0)
"""Typical delays and lags, in samples."""


def late(start, end, steps):
    """Input at start and end of every sample, straight between them, `steps` samples later (any real number ≥ 0).

    The end of one sample and the beginning of the next then fall into one: the straight line of the same mean and the
    same least-squares slope stands for the two. At rest at the first value before.
    """
    samples = start.shape[0]
    whole = jnp.clip(jnp.floor(steps), 0, samples)
    f = jnp.clip(steps - whole, -1.0, 1.0)
    at = jnp.arange(samples) + samples + 1 - whole.astype(int)
    a, b = (jnp.concatenate([jnp.full(samples + 1, start[0]), x]) for x in (start, end))
    # From the one before, its share f from 1 − f on; from this one, up to 1 − f.
    g = 1.0 - f
    a1, d1, a2, d2 = a[at - 1], (b - a)[at - 1], a[at], (b - a)[at]
    squares, cubes = (1.0 - g**2) / 2.0, (1.0 - g**3) / 3.0
    mean = a1 * f + d1 * squares + a2 * g + d2 * g**2 / 2.0
    before = a1 * squares + d1 * cubes + (f - 1.5) * (a1 * f + d1 * squares)
    after = a2 * g**2 / 2.0 + d2 * g**3 / 3.0 + (f - 0.5) * (a2 * g + d2 * g**2 / 2.0)
    slope = 12.0 * (before + after)
    return mean - slope / 2.0, mean + slope / 2.0


def above(start, end):
    """max(x, 0) of an x that is straight over each sample: the straight line of the same mean and the same
    least-squares slope."""
    top, low = jnp.maximum(start, end), jnp.minimum(start, end)
    crossing = (low < 0) & (top > 0)
    # A triangle over the part of the sample in which x is above 0.
    part = jnp.where(crossing, top / jnp.where(crossing, top - low, 1.0), 1.0)
    mean = top * part / 2.0
    near, far = mean * (4.0 - 2.0 * part), mean * (2.0 * part - 2.0)
    rising = end > start
    return (
        jnp.where(crossing, jnp.where(rising, far, near), jnp.maximum(start, 0.0)),
        jnp.where(crossing, jnp.where(rising, near, far), jnp.maximum(end, 0.0)),
    )


def outside(start, end, limit):
    """x − clip(x, ±limit), as in `above`."""
    over, under = above(start - limit, end - limit), above(-start - limit, -end - limit)
    return over[0] - under[0], over[1] - under[1]


def decay(lag):
    """exp(−1/lag), with the limit 0 (and slope 0) for lag → 0; `lag` is a time constant in samples."""
    fast = lag < 1e-2
    return jnp.where(fast, 0.0, jnp.exp(-1.0 / jnp.where(fast, 1.0, lag)))


def lag_step(lag, powers: int = 2):
    """Recursion x⁺ = A x + B (a, b, …) over one sample of τẋ + x = a + b s + …, s from 0 to 1: (A, B).

    **Arguments:** `lag`: τ in samples; `powers` of s, the zeroth among them: as many columns has B, which are
    ∫₀¹ exp(−(1 − s)/lag) s^k ds/lag.
    """
    # For a slow lag the recursion m_k = 1 − k·lag·m_{k−1} loses digits, and a series has all of them.
    slow = lag > 10.0
    rate, short = 1.0 / jnp.where(slow, lag, 10.0), jnp.where(slow, 0.0, lag)
    fast, series = [1.0 - decay(short)], []
    for k in range(powers):
        if k:
            fast.append(1.0 - k * short * fast[-1])
        terms = [(-1.0) ** j * math.factorial(k) / math.factorial(j + k + 1) * rate ** (j + 1) for j in range(10)]
        series.append(sum(terms))
    return decay(lag)[None, None], jnp.where(slow, jnp.stack(series), jnp.stack(fast))[None]


def _moments(lag):
    """Mean and least-squares slope of exp(−s/lag) over 0 ≤ s ≤ 1."""
    slow = lag > 10.0
    y = 1.0 / jnp.where(slow, lag, 10.0)
    series = -y + y**2 / 2.0 - 3.0 * y**3 / 20.0 + y**4 / 30.0 - y**5 / 168.0
    E = decay(lag)
    mean_slow = -lag * jnp.expm1(-y)
    mean = jnp.where(slow, mean_slow, lag * (1.0 - E))
    first = jnp.where(slow, 0.0, lag) ** 2 * (1.0 - E) - jnp.where(slow, 0.0, lag) * E
    return mean, jnp.where(slow, series, 12.0 * first - 6.0 * mean)


def lagged(start, end, lag):
    """An input through a first-order lag of `lag` samples: over each sample the straight line closest to the lagged
    input (least squares: same mean and first moment), the recursion itself exact."""
    lag = jnp.asarray(lag, dtype=start.dtype)
    A, B = lag_step(lag)
    mean, slope = _moments(lag)
    # Lagged input: a + b(s − lag) + c exp(−s/lag) with c = x − a + b·lag.
    C = jnp.stack([mean, slope])[:, None]
    D = jnp.stack(
        [
            jnp.stack([1.0 - mean, 0.5 - lag + mean * lag]),
            jnp.stack([-slope, 1.0 + slope * lag]),
        ]
    )
    line = respond(A, B, C, D, jnp.stack([start, end - start], axis=1), start[:1])
    return line[:, 0] - 0.5 * line[:, 1], line[:, 0] + 0.5 * line[:, 1]


def lag_state(start, end, lag):
    """An input through a first-order lag of `lag` samples, at the samples."""
    A, B = lag_step(jnp.asarray(lag, dtype=start.dtype))
    eye, none = jnp.eye(1, dtype=start.dtype), jnp.zeros((1, 2), dtype=start.dtype)
    return respond(A, B, eye, none, jnp.stack([start, end - start], axis=1), start[:1])[:, 0]


class InputDelay(AbstractInputEffect):
    """The force comes later than the command."""

    id = "input_delay"
    family = "actuator"
    law = "u(t − tau)"
    parameters = (Parameter("tau", (0, 0, 1), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "residual in quadrature with the input, growing with frequency"
    reference = "Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012"
    places = "input"
    resembles = "timing"
    # It commutes with every law that does not depend on the clock, and straight lines that stand for a step within a
    # sample reach beyond it, which a limit would cut off.
    rank = 2

    def shapes(self, scales):
        return [np.array([count * scales.sampling_time]) for count in SAMPLES]

    def apply(self, p, start, end, time):
        return late(start, end, p[0] / time)

    def at_samples(self, p, start, end, seen, time):
        steps = p[0] / time
        whole = jnp.clip(jnp.floor(steps), 0, len(start))
        part = steps - whole
        at = jnp.arange(len(start)) + len(start) + 1 - whole.astype(int)
        before = jnp.full(len(start) + 1, start[0])
        a, b, now = (jnp.concatenate([before, x]) for x in (start, end, seen))
        return jnp.where(part > 0, b[at - 1] + part * (a - b)[at - 1], now[at])


class ActuatorLag(AbstractInputEffect):
    """The force follows the command as a first-order system."""

    id = "actuator_lag"
    family = "actuator"
    law = "tau·u̇_a + u_a = u"
    parameters = (Parameter("tau", (0, 0, 1), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "delay with a gain that drops over frequency"
    reference = "Franklin, Powell & Workman, Digital Control of Dynamic Systems, 3rd ed., Addison-Wesley 1998"
    places = "input"
    resembles = "timing"

    def shapes(self, scales):
        return [np.array([count * scales.sampling_time]) for count in SAMPLES]

    def apply(self, p, start, end, time):
        return lagged(start, end, p[0] / time)

    def at_samples(self, p, start, end, seen, time):
        return lag_state(start, end, p[0] / time)


class InputSaturation(AbstractInputEffect):
    """The force ends at a limit.

    The response is not linear in the limit: a shape stands for itself, and is plausible where its weight is near 1.
    """

    id = "input_saturation"
    family = "actuator"
    law = "clip(u, ±limit)"
    parameters = (Parameter("limit", (1, 0, 0), lower=0.0),)
    parity = "odd"
    signature = "bursts of residual at peaks of the command"
    reference = "Hippe, Windup in Control, Springer 2006"
    places = "input"

    def shapes(self, scales):
        return [np.array([scales.u_quantiles[k]]) for k in (0, 2, 3, 5)]

    def basis(self, p):
        return [np.array(p, dtype=float)]

    def combine(self, p, weights):
        return self.bounded(p)

    def apply(self, p, start, end, time):
        beyond = outside(start, end, p[0])
        return start - beyond[0], end - beyond[1]


class InputDeadZone(AbstractInputEffect):
    """Small commands make no force; a small width takes about width·sign(u) away."""

    id = "input_dead_zone"
    family = "actuator"
    law = "u − clip(u, ±width)"
    parameters = (Parameter("width", (1, 0, 0), lower=0.0, amplitude=True),)
    parity = "odd"
    signature = "residual like the sign of the command, full already at small commands"
    reference = "Tao & Kokotović, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, Wiley 1996"
    places = "input"

    def shapes(self, scales):
        return [np.array([part * scales.u]) for part in (0.05, 0.3)]

    def apply(self, p, start, end, time):
        return outside(start, end, p[0])


class InputQuadratic(AbstractInputEffect):
    """The force has a part with the square of the command (electromagnets, amplifiers)."""

    id = "input_quadratic"
    family = "actuator"
    law = "u + a·u²"
    parameters = (Parameter("a", (-1, 0, 0), amplitude=True),)
    parity = "even"
    signature = "even harmonics filtered by the plant"
    reference = "Schoukens & Tiels, Automatica 85 (2017) 272-292"
    places = "input"

    def shapes(self, scales):
        return [np.array([1.0])]

    def apply(self, p, start, end, time):
        # Between them a parabola: its mean and slope.
        bend = (end - start) ** 2 / 6.0
        return start + p[0] * (start**2 - bend), end + p[0] * (end**2 - bend)


class PlayHysteresis(AbstractInputEffect):
    """Prandtl-Ishlinskii sum of three play operators beside the command itself (piezo stacks, gears)."""

    id = "play_hysteresis"
    family = "actuator"
    law = "u + Σ w·play(u, r), play: z⁺ = clip(z, u − r, u + r)"
    parameters = (Parameter("w", amplitude=True),) * 3 + (Parameter("r", (1, 0, 0), lower=0.0),) * 3
    parity = "odd"
    signature = "loop of output against command that stays when everything is slow"
    reference = "Kuhnen, Eur. J. Control 9 (2003) 407-418"
    places = "input"

    def shapes(self, scales):
        sets = ((0.03, 0.1, 0.3), (0.1, 0.3, 0.7))
        return [np.array([1.0, 1.0, 1.0, *(part * scales.u_peak for part in parts)]) for parts in sets]

    def apply(self, p, start, end, time):
        w, r = p[:3], p[3:]

        def play(z, ends):
            first = jnp.clip(z, ends[0] - r, ends[0] + r)
            last = jnp.clip(first, ends[1] - r, ends[1] + r)
            # It stays until the command has come r away, and follows from there.
            moved = outside(ends[0] - first, ends[1] - first, r)
            return last, (first + moved[0], first + moved[1])

        _, (first, last) = jax.lax.scan(play, jnp.zeros_like(r), jnp.stack([start, end], axis=1))
        return start + first @ w, end + last @ w


class ActuatorCreep(AbstractInputEffect):
    """The force goes on growing slowly after the command has changed (piezo stacks, polymers)."""

    id = "actuator_creep"
    family = "actuator"
    law = "u + gain·u_c, tau·u̇_c + u_c = u"
    parameters = (Parameter("gain", amplitude=True), Parameter("tau", (0, 0, 1), lower=0.0))
    parity = "odd"
    signature = "one-sided slow tails after steps, that come back after a step back"
    reference = "Krejčí & Kuhnen, IEE Proc. Control Theory Appl. 148 (2001) 185-192"
    places = "input"

    def shapes(self, scales):
        return [np.array([1.0, part * scales.duration]) for part in (0.01, 0.05, 0.2, 0.6)]

    def apply(self, p, start, end, time):
        slow_start, slow_end = lagged(start, end, p[1] / time)
        return start + p[0] * slow_start, end + p[0] * slow_end

    def at_samples(self, p, start, end, seen, time):
        return seen + p[0] * lag_state(start, end, p[1] / time)


class InputPositionGain(AbstractForceEffect):
    """The force of an input depends on where (form q) or how fast (form v) its coordinate moves.

    Its law is on the left side: an applied force a·u·q is f = −a·u·q.
    """

    id = "input_position_gain"
    family = "actuator"
    law = "applied force a·u·q or a·u·v beside u"
    parameters = (
        Parameter("a", (0, -1, 0), amplitude=True),
        Parameter("form", lower=0.0, upper=1.0, counts=False, choices=("q", "v")),
    )
    parity = "even"
    signature = "lines at sums and differences of the frequencies of input and motion"
    reference = "Preumont, Mechatronics: Dynamics of Electromechanical and Piezoelectric Systems, Springer 2006"
    places = "input"

    def shapes(self, scales):
        return [np.array([1.0, form]) for form in (0.0, 1.0)]

    def force(self, p, here, z):
        return -p[0] * here.u * jnp.where(p[1] < 0.5, here.q, here.v)


class SpeedForceLimit(AbstractForceEffect):
    """The largest force falls with the speed (motors on a limited voltage, engines, hydraulic pumps).

    Its law is on the left side: f is what the command asks for and the plant does not get. In the form "voltage" the
    induced voltage raises the limit while braking by as much as it lowers it while driving: −u0 − c·v ≤ u ≤ u0 − c·v.
    """

    id = "speed_force_limit"
    family = "actuator"
    law = "applied force clip(u, ±(u0 − c·|v|))"
    parameters = (
        Parameter("u0", (1, 0, 0), lower=0.0),
        Parameter("c", (1, -1, 1), lower=0.0),
        Parameter("form", lower=0.0, upper=1.0, counts=False, choices=("speed", "voltage")),
    )
    parity = "odd"
    contains = ("input_saturation",)
    renamed = ("input_saturation",)
    signature = "bursts of residual where command and speed are large together"
    reference = "Siciliano, Sciavicco, Villani & Oriolo, Robotics: Modelling, Planning and Control, Springer 2009, §5.2"
    places = "input"

    def shapes(self, scales):
        at_rest, speed = (scales.u_quantiles[3], 1.2 * scales.u_peak), max(scales.v_peak, SLOWEST)
        return [
            np.array([u0, share * u0 / speed, form]) for u0, share in zip(at_rest, (0.3, 0.7)) for form in (0.0, 1.0)
        ]

    def basis(self, p):
        return [np.array(p, dtype=float)]

    def combine(self, p, weights):
        return self.bounded(p)

    def widened(self, p, simple):
        return self.bounded([simple.get("limit", p[0]), *p[1:]])

    def named_values(self, p):
        return super().named_values(p) | {"limit": float(p[0])}

    def force(self, p, here, z):
        most = jnp.maximum(p[0] - p[1] * jnp.abs(here.v), 0.0)
        low = jnp.where(p[2] < 0.5, -most, -p[0] - p[1] * here.v)
        return here.u - jnp.clip(here.u, low, jnp.where(p[2] < 0.5, most, low + 2 * p[0]))
