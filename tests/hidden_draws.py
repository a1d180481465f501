"""Random systems, excitations, and effects of sensible size for them."""

from types import SimpleNamespace

import hidden_laws as laws
import independent
import numpy as np
import scipy.linalg
from hidden_laws import Effect
from hidden_simulation import System

SAMPLING_TIME = 0.01
QUIET = 10
"""Samples at rest before the excitation starts, so that what went before the record does not matter."""

COORDINATE = ("constant_force", "mass_step", "unmodelled_mode", "periodic_disturbance", "force_step")
PAIR = ("gyroscopic_coupling", "circulatory_coupling")
SPRING = (
    "cubic_stiffness",
    "quadratic_stiffness",
    "dead_zone_stiffness",
    "end_stop",
    "bilinear_stiffness",
    "sine_stiffness",
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "quadratic_drag",
    "dahl_friction",
    "position_dependent_friction",
    "fractional_damping",
    "bouc_wen_hysteresis",
    "maxwell_slip_hysteresis",
    "stiffness_drift",
    "stiffness_step",
    "position_dependent_stiffness",
)
INPUT = (*laws.INPUTS, "input_delay", "intersample_hold", *laws.AT_INPUTS)
OUTPUT = ("sensor_offset", "sensor_drift", "sensor_delay", "sensor_lag", "sensor_nonlinearity")
CROSS = ("sensor_crosstalk",)
DYNAMIC = (*SPRING, *COORDINATE, *PAIR, *INPUT, *OUTPUT, *CROSS)
"""Every effect that acts through the dynamics, an input or a sensor."""


def rms(x):
    """Root mean square over time."""
    return np.sqrt(np.mean(np.square(x), axis=0))


def log_uniform(rng, low, high):
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_system(rng, n):
    """Full M, chain K, modal damping: natural frequencies 1 to 5 Hz at least 12 % apart, damping ratios 0.5 to 5 %."""
    while True:
        M = np.diag(rng.uniform(0.5, 2.0, n))
        for i in range(n):
            for j in range(i):
                M[i, j] = M[j, i] = rng.uniform(-0.2, 0.2) * np.sqrt(M[i, i] * M[j, j])
        K = np.diag(rng.uniform(0.3, 1.5, n))
        for i in range(n - 1):
            link = np.zeros(n)
            link[i], link[i + 1] = 1.0, -1.0
            K += rng.uniform(0.3, 1.5) * np.outer(link, link)
        squares, shapes = scipy.linalg.eigh(K, M)
        first = rng.uniform(1.0, 5.0 if n == 1 else 2.0)
        K *= (2 * np.pi * first) ** 2 / squares[0]
        frequencies = first * np.sqrt(squares / squares[0])
        if frequencies[-1] < 5.5 and np.all(frequencies[1:] > 1.12 * frequencies[:-1]):
            break
    ratios = [log_uniform(rng, 0.005, 0.05) for _ in range(n)]
    D = M @ shapes @ np.diag(4 * np.pi * frequencies * ratios) @ shapes.T @ M
    return System(M, 0.5 * (D + D.T), K)


def steps(rng, samples):
    """Steps to random levels, held 0.1 to 1 s."""
    return np.repeat(rng.uniform(-1, 1, samples), rng.integers(10, 100, samples))[:samples]


def multisine(rng, samples):
    """Equal lines of random phase from 0.2 to 8 Hz."""
    duration = samples * SAMPLING_TIME
    lines = rng.choice(np.arange(int(0.2 * duration), int(8 * duration)), size=rng.integers(40, 120), replace=False)
    t = np.arange(samples) * SAMPLING_TIME
    phases = rng.uniform(0, 2 * np.pi, len(lines))
    return np.cos(2 * np.pi * np.outer(t, lines / duration) + phases).sum(axis=1)


def noise(rng, samples):
    """Low-pass filtered white noise, up to about 6 Hz."""
    return independent.smooth_noise(rng, samples, 1, rng.uniform(0.1, 0.16))[:, 0]


def chirp(rng, samples):
    """Two sweeps one after the other, either way, between about 0.2 and 8 Hz."""
    t = np.arange(samples) * SAMPLING_TIME
    half = t[-1] * rng.uniform(0.35, 0.65)
    rate = np.log(rng.uniform(30, 45)) / half
    ramp = np.where(t < half, t, t - half)
    up = rng.random() < 0.5
    phase = 2 * np.pi * 0.2 * (np.exp(rate * (ramp if up else half - ramp)) - 1) / rate
    return np.cos(phase + rng.uniform(0, 2 * np.pi)) * rng.uniform(0.7, 1.0)


EXCITATIONS = {"steps": steps, "multisine": multisine, "noise": noise, "chirp": chirp}


def excitation(rng, kind, samples, levels):
    """Inputs of one kind, each at its root mean square level, after a quiet start."""
    u = np.stack([EXCITATIONS[kind](rng, samples) for _ in levels], axis=1)
    u = u / rms(u) * levels
    u[:QUIET] = 0.0
    return u


def scheduling(rng, samples):
    """A slow channel between about −1 and 1."""
    t = np.arange(samples) * SAMPLING_TIME
    p = sum(np.sin(2 * np.pi * rng.uniform(0.03, 0.3) * t + rng.uniform(0, 2 * np.pi)) for _ in range(3))
    return p / np.abs(p).max()


def moves_all_modes(system, y):
    """Whether every mode makes at least 3 % of the motion of some output."""
    _, shapes = scipy.linalg.eigh(system.K, system.M)
    parts = rms(y @ np.linalg.inv(shapes).T)
    return np.all((np.abs(shapes) * parts / rms(y)[:, None]).max(axis=0) > 0.03)


def random_place(rng, effect_id, dofs):
    """A place where the effect can act."""
    one = f"y{rng.integers(dofs) + 1}"
    pairs = [f"y{i + 1}-y{j + 1}" for i in range(dofs) for j in range(i + 1, dofs)]
    if effect_id in PAIR or (effect_id in SPRING and pairs and rng.random() < 0.4):
        return str(rng.choice(pairs))
    if effect_id in INPUT:
        return f"u{rng.integers(dofs) + 1}"
    if effect_id in CROSS:
        sources = [f"{kind}{k + 1}" for kind in "yu" for k in range(dofs) if f"{kind}{k + 1}" != one]
        return f"{rng.choice(sources)}->{one}"
    if effect_id in (*COORDINATE, *SPRING, *OUTPUT):
        return one
    raise ValueError(f"no place is known for {effect_id!r}")


def surroundings(system, u, y, place):
    """What sets the size of an effect at its place: motion, stiffness, and typical forces in the linear system."""
    n = len(system.M)
    target = place.split("->")[-1]
    b = np.eye(n)[laws.index(target)] if target[0] == "u" else laws.arm(target, n)
    q = y @ b
    v = np.gradient(q, SAMPLING_TIME)
    stiffness = 1 / (b @ np.linalg.solve(system.K, b))
    source = None
    if "->" in place:
        name = place.split("->")[0]
        source = rms((y if name[0] == "y" else u)[:, laws.index(name)])
    return SimpleNamespace(
        q=q,
        v=v,
        u=u[:, laws.index(target)] if "-" not in target else None,
        k=stiffness,
        mass=b @ system.M @ b,
        spring=stiffness * rms(q),
        push=np.sqrt(np.mean(rms(u[:, b != 0]) ** 2)),
        source=source,
        duration=len(u) * SAMPLING_TIME,
    )


def random_effect(rng, effect_id, place, x, strength=1.0):
    """The effect with random parameters; `x` as of `surroundings`; `strength` 1 is 3 to 30 % of the typical force."""
    size = log_uniform(rng, 0.03, 0.3) * strength
    drawn = DRAWS[effect_id](rng, x, size, float(rng.choice([-1.0, 1.0])))
    return Effect(effect_id, place, {k: v if k == "form" else np.asarray(v).tolist() for k, v in drawn.items()})


def _cubic(rng, x, size, sign):
    limit = 0.4 * x.k / np.abs(x.q).max() ** 2 if sign < 0 else np.inf
    return {"k3": sign * min(size * x.spring / rms(x.q**3), limit)}


def _quadratic(rng, x, size, sign):
    return {"k2": sign * min(size * x.spring / rms(x.q**2), 0.4 * x.k / np.abs(x.q).max())}


def _outside(rng, x, size, quantiles, name):
    gap = float(np.quantile(np.abs(x.q), rng.uniform(*quantiles)))
    return {name: size * x.spring / rms(laws.outside(x.q, gap)), "gap": gap}


def _end_stop(rng, x, size, sign):
    p = _outside(rng, x, size, (0.7, 0.95), "ks")
    return p | {"ks": min(p["ks"], 5 * x.k)}


def _stribeck(rng, x, size, sign):
    Fc = size * x.push
    return {"Fc": Fc, "Fs": Fc * rng.uniform(1.4, 2.5), "vs": rng.uniform(0.1, 0.5) * rms(x.v)}


def _asymmetric(rng, x, size, sign):
    Fc = size * x.push
    return {"Fc": Fc, "c_a": sign * Fc * rng.uniform(0.2, 0.6) / rms(x.v)}


def _rubbing_place(rng, x, size, sign):
    return {"Fc": size * x.push, "a": sign * rng.uniform(0.5, 0.9) / np.abs(x.q).max()}


def _fractional(rng, x, size, sign):
    alpha = rng.uniform(0.3, 0.7)
    omega = rms(x.v) / rms(x.q)
    return {"eta": 0.5 * size * x.k / omega**alpha, "alpha": alpha}


def _bouc_wen(rng, x, size, sign):
    yielding = rng.uniform(0.3, 1.0) * rms(x.q)
    share = rng.uniform(0.5, 0.9)
    return {"A": 2 * size * x.push / yielding, "beta": share / yielding, "gamma": (1 - share) / yielding}


def _maxwell(rng, x, size, sign):
    d = np.array([0.2, 0.9]) * rng.uniform(0.7, 1.3, 2) * rms(x.q)
    weights = rng.uniform(0.5, 1.5, 2)
    return {"k": list(2 * size * x.push * weights / weights.sum() / d), "d": list(d)}


def _coupling(name, quantity):
    def draw(rng, x, size, sign):
        return {name: sign * size * min(x.spring, 2 * x.push) / rms(getattr(x, quantity))}

    return draw


def _position_gain(rng, x, size, sign):
    form = str(rng.choice(["q", "v"]))
    return {"a": sign * 2 * size / rms(getattr(x, form)), "form": form}


def _limit_of_speed(rng, x, size, sign):
    """A limit that is reached in some part of the record, at a speed that the record has."""
    share, reached = rng.uniform(0.3, 0.8), rng.uniform(0.5, 0.9)
    speed = np.abs(x.v).max() / share
    u0 = reached * float(np.max(np.abs(x.u) / np.maximum(1 - np.abs(x.v) / speed, 0.05)))
    return {"u0": u0, "c": u0 / speed, "form": str(rng.choice(["speed", "voltage"]))}


def _play(rng, x, size, sign):
    r = np.array([0.15, 0.5, 1.0])[: rng.integers(1, 4)] * rng.uniform(0.7, 1.3) * rms(x.u)
    return {"w": list(2 * size * rng.uniform(0.5, 1.5, len(r)) / len(r)), "r": list(r)}


def _drift(rng, x, size, sign):
    level = 3 * size * rms(x.q)
    curve = rng.choice([0.0, 1.0]) * rng.uniform(-1, 1)
    return {"b1": sign * level / x.duration, "b2": level * curve / x.duration**2}


def _nonlinear_sensor(rng, x, size, sign):
    form = str(rng.choice(list(laws.FORMS)))
    return {"a": sign * size * rms(x.q) / rms(laws.FORMS[form](x.q)), "form": form}


def _late(x, rng):
    """A time between 30 and 70 % of the record."""
    return rng.uniform(0.3, 0.7) * x.duration


DRAWS = {
    "cubic_stiffness": _cubic,
    "quadratic_stiffness": _quadratic,
    "dead_zone_stiffness": lambda rng, x, size, sign: _outside(rng, x, size, (0.15, 0.45), "k"),
    "end_stop": _end_stop,
    "bilinear_stiffness": lambda rng, x, size, sign: {"ks": sign * 1.4 * size * x.k},
    "sine_stiffness": lambda rng, x, size, sign: {
        "k": 2 * size * x.k,
        "length": np.abs(x.q).max() / rng.uniform(1.2, 2.8),
    },
    "constant_force": lambda rng, x, size, sign: {"f0": sign * size * x.spring},
    "coulomb_friction": lambda rng, x, size, sign: {"Fc": size * x.push},
    "stribeck_friction": _stribeck,
    "asymmetric_friction": _asymmetric,
    "quadratic_drag": lambda rng, x, size, sign: {"c2": size * x.push / rms(x.v**2)},
    "dahl_friction": lambda rng, x, size, sign: {"Fc": 1.5 * size * x.push, "x_d": rng.uniform(0.1, 0.6) * rms(x.q)},
    "position_dependent_friction": _rubbing_place,
    "fractional_damping": _fractional,
    "bouc_wen_hysteresis": _bouc_wen,
    "maxwell_slip_hysteresis": _maxwell,
    "gyroscopic_coupling": _coupling("g", "v"),
    "circulatory_coupling": _coupling("kc", "q"),
    "input_delay": lambda rng, x, size, sign: {"tau": rng.uniform(0.4, 4.0) * SAMPLING_TIME},
    "actuator_lag": lambda rng, x, size, sign: {"tau": log_uniform(rng, 0.01, 0.1)},
    "intersample_hold": lambda rng, x, size, sign: {"linear_share": 1.0},
    "input_saturation": lambda rng, x, size, sign: {"limit": float(np.quantile(np.abs(x.u), rng.uniform(0.6, 0.95)))},
    "input_dead_zone": lambda rng, x, size, sign: {"width": float(np.quantile(np.abs(x.u), rng.uniform(0.1, 0.4)))},
    "input_quadratic": lambda rng, x, size, sign: {"a": sign * size * rms(x.u) / rms(x.u**2)},
    "input_position_gain": _position_gain,
    "load_friction": lambda rng, x, size, sign: {"mu": 1.5 * size * x.push / np.mean(np.abs(x.u))},
    "speed_force_limit": _limit_of_speed,
    "play_hysteresis": _play,
    "actuator_creep": lambda rng, x, size, sign: {"gain": 2 * size, "tau": log_uniform(rng, 0.5, 5.0)},
    "sensor_offset": lambda rng, x, size, sign: {"b": sign * size * rms(x.q)},
    "sensor_drift": _drift,
    "sensor_delay": lambda rng, x, size, sign: {"tau": rng.uniform(0.4, 4.0) * SAMPLING_TIME},
    "sensor_lag": lambda rng, x, size, sign: {"tau": log_uniform(rng, 0.01, 0.1)},
    "sensor_crosstalk": lambda rng, x, size, sign: {"a": sign * size * rms(x.q) / x.source},
    "sensor_nonlinearity": _nonlinear_sensor,
    "unmodelled_mode": lambda rng, x, size, sign: {
        "frequency_hz": rng.uniform(1.0, 6.0),
        "damping_ratio": log_uniform(rng, 0.005, 0.05),
        "mass_ratio": 0.5 * size,
    },
    "stiffness_drift": lambda rng, x, size, sign: {"dk": sign * size * x.k},
    "stiffness_step": lambda rng, x, size, sign: {"dk": sign * size * x.k, "t0": _late(x, rng)},
    "mass_step": lambda rng, x, size, sign: {"dm": sign * size * x.mass, "t0": _late(x, rng)},
    "position_dependent_stiffness": lambda rng, x, size, sign: {"a": sign * size * x.k},
    "periodic_disturbance": lambda rng, x, size, sign: {
        "A": 1.4 * size * x.push,
        "frequency_hz": rng.uniform(0.5, 6.0),
        "phase": rng.uniform(0, 2 * np.pi),
    },
    "force_step": lambda rng, x, size, sign: {"F": sign * size * x.spring, "t0": _late(x, rng)},
}
