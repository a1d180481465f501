"""Laws of the hidden effects, by the ids and parameter names of the catalogue, shared with nothing in the package.

Forces stand on the left side, M q̈ + D q̇ + K q + Σ b f = E u; `here` carries what a law sees at its place.
"""

from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class Effect:
    """One hidden effect: id, place (`y1`, `y1-y2`, `u1`, `u1->y1`, `record`) and parameters.

    A parameter `form` is a word; lists are for `play_hysteresis` (w, r) and `maxwell_slip_hysteresis` (k, d).
    """

    id: str
    place: str
    parameters: dict[str, Any] = field(default_factory=dict)


def index(name):
    """Zero-based number of a channel: `y2` → 1."""
    return int(name[1:]) - 1


def arm(place, n):
    """Vector b of a place: the coordinate, or the difference of two."""
    b = np.zeros(n)
    first, *second = place.split("-")
    b[index(first)] = 1.0
    if second:
        b[index(second[0])] = -1.0
    return b


def outside(q, gap):
    """How far q is beyond ±gap."""
    return q - jnp.clip(q, -gap, gap)


def limited(p, here):
    """What is left of a force whose limit falls with the speed; by voltage it rises again while braking."""
    if here.form == "voltage":
        return jnp.minimum(jnp.maximum(here.u, -p["u0"] - p["c"] * here.v), p["u0"] - p["c"] * here.v)
    most = p["u0"] - p["c"] * jnp.abs(here.v)
    return jnp.minimum(jnp.maximum(here.u, -most), most)


AT_INPUTS = ("input_position_gain", "speed_force_limit", "load_friction")
"""Laws in the equation of motion that act where an input does, and see it."""

FORCES = {
    "cubic_stiffness": lambda p, here: p["k3"] * here.q**3,
    "quadratic_stiffness": lambda p, here: p["k2"] * here.q**2,
    "dead_zone_stiffness": lambda p, here: p["k"] * outside(here.q, p["gap"]),
    "end_stop": lambda p, here: p["ks"] * outside(here.q, p["gap"]),
    "bilinear_stiffness": lambda p, here: p["ks"] * jnp.maximum(here.q, 0.0),
    "sine_stiffness": lambda p, here: p["k"] * p["length"] * jnp.sin(here.q / p["length"]),
    "constant_force": lambda p, here: p["f0"],
    "asymmetric_friction": lambda p, here: p["c_a"] * jnp.abs(here.v),
    "quadratic_drag": lambda p, here: p["c2"] * here.v * jnp.abs(here.v),
    "dahl_friction": lambda p, here: p["Fc"] * here.z[0],
    "bouc_wen_hysteresis": lambda p, here: here.z[0],
    "maxwell_slip_hysteresis": lambda p, here: (p["k"] * stops(p, here)).sum(),
    "stiffness_drift": lambda p, here: p["dk"] * here.t / here.duration * here.q,
    "stiffness_step": lambda p, here: p["dk"] * (here.middle >= p["t0"]) * here.q,
    "position_dependent_stiffness": lambda p, here: p["a"] * here.p * here.q,
    "periodic_disturbance": lambda p, here: -p["A"] * jnp.sin(2 * jnp.pi * p["frequency_hz"] * here.t + p["phase"]),
    "force_step": lambda p, here: -p["F"] * (here.middle >= p["t0"]),
    "input_position_gain": lambda p, here: -p["a"] * here.u * (here.q if here.form == "q" else here.v),
    "speed_force_limit": lambda p, here: here.u - limited(p, here),
}
"""The single-valued part of a force law; what is applied rather than restoring is negative on the left side."""

FRICTION = {
    "coulomb_friction": lambda p, q, speed, u: p["Fc"],
    "stribeck_friction": lambda p, q, speed, u: p["Fc"] + (p["Fs"] - p["Fc"]) * jnp.exp(-((speed / p["vs"]) ** 2)),
    "asymmetric_friction": lambda p, q, speed, u: p["Fc"],
    "position_dependent_friction": lambda p, q, speed, u: jnp.maximum(p["Fc"] * (1 + p["a"] * q), 0.0),
    "load_friction": lambda p, q, speed, u: p["mu"] * jnp.abs(u),
}
"""Level of the set-valued part, a force between −level and +level at rest, level · sgn v in motion."""

RATES = {
    "dahl_friction": lambda p, here: (here.v - jnp.abs(here.v) * here.z) / p["x_d"],
    "bouc_wen_hysteresis": lambda p, here: (
        p["A"] * here.v - p["beta"] * jnp.abs(here.v) * here.z - p["gamma"] * here.v * jnp.abs(here.z)
    ),
}
"""ż of the laws with a state that follows a differential equation."""


def stops(p, here):
    """Elastic stops after the monotone motion since the last step."""
    return jnp.clip(here.z + here.q - here.q_before, -p["d"], p["d"])


def states(effect):
    """Number of nonlinear states of an effect."""
    if effect.id == "maxwell_slip_hysteresis":
        return len(effect.parameters["d"])
    return int(effect.id in RATES)


def fractional(alpha, lowest, highest, spacing=0.6):
    """s^α as Σ c s/(s + p) + k0 + c1 s + c2 s²: rates p, weights c, and what the cut tails add.

    Trapezoidal rule in log p of s^α = (sin πα/π) ∫ p^(α−1) s/(s + p) dp, whose error falls as exp(−π²/spacing);
    below `lowest` the terms are constant, above `highest` they are s/p − s²/p².
    """
    grid = np.arange(np.floor(np.log(lowest) / spacing), np.ceil(np.log(highest) / spacing) + 1) * spacing
    scale = np.sin(np.pi * alpha) / np.pi * spacing
    p = np.exp(grid)

    def tail(end, power):
        return np.exp(end * power) / (np.exp(spacing * abs(power)) - 1)

    k0 = scale * tail(grid[0], alpha)
    c1 = scale * tail(grid[-1], alpha - 1)
    c2 = -scale * tail(grid[-1], alpha - 2)
    return p, scale * p**alpha, k0, c1, c2


def linear_parts(effects, M, D, K, E, step, duration):
    """Everything linear: mass, rows of forces and of linear states over (q, q̇, z), input map.

    Forces are M q̈ = −forces · (q, q̇, z) + E u; an added mass is one more coordinate.
    """
    M, D, K, E = (np.array(X, dtype=float) for X in (M, D, K, E))
    observed = len(M)
    for e in effects:
        p = e.parameters
        if e.id in ("gyroscopic_coupling", "circulatory_coupling"):
            i, j = (index(name) for name in e.place.split("-"))
            X, value = (D, p["g"]) if e.id == "gyroscopic_coupling" else (K, p["kc"])
            X[i, j] += value
            X[j, i] -= value
        if e.id == "unmodelled_mode":
            i, n = index(e.place), len(M)
            m = p["mass_ratio"] * M[i, i]
            omega = 2 * np.pi * p["frequency_hz"]
            link = np.zeros(n + 1)
            link[i], link[n] = 1.0, -1.0
            M, D, K = (np.pad(X, (0, 1)) for X in (M, D, K))
            E = np.pad(E, ((0, 1), (0, 0)))
            M[n, n] = m
            D += 2 * p["damping_ratio"] * omega * m * np.outer(link, link)
            K += m * omega**2 * np.outer(link, link)
    n = len(M)
    extra, rates = [], []
    for e in effects:
        if e.id != "fractional_damping":
            continue
        b = np.pad(arm(e.place, observed), (0, n - observed))
        poles, weights, k0, c1, c2 = fractional(e.parameters["alpha"], 0.05 / duration, 1.0 / step)
        eta = e.parameters["eta"]
        K += eta * (k0 + weights.sum()) * np.outer(b, b)
        D += eta * c1 * np.outer(b, b)
        M += eta * c2 * np.outer(b, b)
        extra.append(-eta * np.outer(b, weights))
        rates.append((poles, b))
    count = sum(len(poles) for poles, _ in rates)
    forces = np.hstack([K, D, *extra])
    follow = np.zeros((count, 2 * n + count))
    k = 0
    for poles, b in rates:
        rows = slice(k, k + len(poles))
        follow[rows, :n] = np.outer(poles, b)
        follow[rows, 2 * n :][:, rows] = -np.diag(poles)
        k += len(poles)
    return M, forces, follow, E


def held(u, time, middle, sampling_time, linear, delay):
    """Value of one held input at `time` − delay, in the sample that holds `middle` − delay; constant outside."""
    k = np.floor((middle - delay) / sampling_time + 1e-9).astype(int)
    before = u[np.clip(k, 0, len(u) - 1)]
    if not linear:
        return np.broadcast_to(before, time.shape)
    after = u[np.clip(k + 1, 0, len(u) - 1)]
    return before + (after - before) * ((time - delay) / sampling_time - k)


def lag(x, dt, tau, start):
    """ẏ = (x − y)/τ over segments on which x is the parabola through its start, middle and end (last axis)."""
    first, middle, last = x[:, 0], x[:, 1], x[:, 2]
    curve = 2 * (first - 2 * middle + last) / dt**2
    slope = (4 * middle - 3 * first - last) / dt
    particular = np.empty_like(x)
    for k, part in enumerate((0.0, 0.5, 1.0)):
        s = part * dt
        particular[:, k] = first + slope * s + curve * s**2 - tau * (slope + 2 * curve * s) + 2 * tau**2 * curve
    decay = np.exp(-dt / tau)
    begin = np.empty(len(x))
    y = start
    for k, (p0, p2, e) in enumerate(zip(particular[:, 0].tolist(), particular[:, 2].tolist(), decay.tolist())):
        begin[k] = y
        y = p2 + (y - p0) * e
    free = begin - particular[:, 0]
    return np.stack([begin, particular[:, 1] + free * np.sqrt(decay), particular[:, 2] + free * decay], axis=1)


def play(x, r):
    """Play operator of radius r, from rest at 0."""
    result = np.empty(x.size)
    y = 0.0
    for k, value in enumerate(x.ravel().tolist()):
        y = min(max(y, value - r), value + r)
        result[k] = y
    return result.reshape(x.shape)


INPUTS = {
    "actuator_lag": lambda p, u, dt: lag(u, dt, p["tau"], u[0, 0]),
    "actuator_creep": lambda p, u, dt: u + p["gain"] * lag(u, dt, p["tau"], u[0, 0]),
    "input_saturation": lambda p, u, dt: np.clip(u, -p["limit"], p["limit"]),
    "input_dead_zone": lambda p, u, dt: u - np.clip(u, -p["width"], p["width"]),
    "input_quadratic": lambda p, u, dt: u + p["a"] * u**2,
    "play_hysteresis": lambda p, u, dt: u + sum(w * play(u, r) for w, r in zip(p["w"], p["r"])),
}
"""What an input becomes, segment by segment (start, middle, end)."""

FORMS = {"square": np.square, "cube": lambda y: y**3, "abs": np.abs}

OUTPUTS = {
    "sensor_offset": lambda p, y, source, t: y + p["b"],
    "sensor_drift": lambda p, y, source, t: y + p["b1"] * t + p.get("b2", 0.0) * t**2,
    "sensor_crosstalk": lambda p, y, source, t: y + p["a"] * source,
    "sensor_nonlinearity": lambda p, y, source, t: y + p["a"] * FORMS[p["form"]](y),
}
"""What a sampled output becomes."""

RAW = ("sensor_clipping", "sensor_quantization", "outliers", "dropped_samples")
ELSEWHERE = (
    "fractional_damping",
    "gyroscopic_coupling",
    "circulatory_coupling",
    "unmodelled_mode",
    "mass_step",
    "input_delay",
    "intersample_hold",
    "sensor_delay",
    "sensor_lag",
    "clock_scale",
)
KNOWN = frozenset((*FORCES, *FRICTION, *INPUTS, *OUTPUTS, *RAW, *ELSEWHERE))
