"""The paper's system with a known effect hidden in it, simulated in small steps by NumPy and SciPy alone."""

import difflib
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from jaxtyping import Float

from .records import Record, random_steps

TRUTH = {
    "mass": np.array([[5.0, -1.0], [-1.0, 1.0]]),
    "damping": np.array([[5.0, -0.01], [-0.01, 1.0]]),
    "stiffness": np.array([[100.0, -5.0], [-5.0, 100.0]]),
}
SAMPLING_TIME = 0.005
SAMPLES = 6000
SUBSTEPS = 10
NOISE = 3e-4
HOLD_TIMES = (0.5, 3.0)


@dataclass(frozen=True)
class Hidden:
    """What is hidden: `effect`, `location` and `parameters` as a diagnosis names them."""

    effect: str
    location: str
    parameters: dict[str, float | list[float]] = field(default_factory=dict)


DEMONSTRATED = {
    one.effect: one
    for one in (
        Hidden("coulomb_friction", "y1", {"Fc": 0.2}),
        Hidden("cubic_stiffness", "y2", {"k3": 2e4}),
        Hidden("quadratic_drag", "y1", {"c2": 60.0}),
        Hidden("bilinear_stiffness", "y1", {"ks": 20.0}),
        Hidden("end_stop", "y2", {"ks": 50.0, "gap": 0.015}),
        Hidden("constant_force", "y1", {"f0": 0.1}),
        Hidden("stiffness_step", "y2", {"dk": 5.0, "t0": 14.0}),
        Hidden("unmodelled_mode", "y1", {"frequency_hz": 2.5, "damping_ratio": 0.02, "mass_ratio": 0.1}),
        Hidden("input_delay", "u1", {"tau": 0.0125}),
        Hidden("play_hysteresis", "u2", {"w": [0.1, 0.08, 0.06], "r": [0.2, 0.5, 0.9]}),
        Hidden("sensor_offset", "y2", {"b": 1e-3}),
    )
}
"""Every effect that can be demonstrated, where it sits and how large it is."""

LAWS = {
    "cubic_stiffness": lambda p, q, v, t: p["k3"] * q**3,
    "quadratic_drag": lambda p, q, v, t: p["c2"] * v * np.abs(v),
    "bilinear_stiffness": lambda p, q, v, t: p["ks"] * np.maximum(q, 0.0),
    "end_stop": lambda p, q, v, t: p["ks"] * (q - np.minimum(np.maximum(q, -p["gap"]), p["gap"])),
    "constant_force": lambda p, q, v, t: p["f0"] + 0.0 * q,
    "stiffness_step": lambda p, q, v, t: p["dk"] * (t >= p["t0"]) * q,
}
"""Forces on the left side of the equation of motion."""


def hidden_of(effect: str) -> tuple[Hidden, ...]:
    """What is hidden for this id.

    **Arguments:** `effect`: an id, or "none" for nothing.

    **Raises:** `ValueError` for an effect that cannot be demonstrated.
    """
    if effect == "none":
        return ()
    if effect not in DEMONSTRATED:
        near = difflib.get_close_matches(effect, DEMONSTRATED, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ValueError(
            f"--effect={effect!r} cannot be demonstrated; {hint}choose from {', '.join(DEMONSTRATED)}, none."
        )
    return (DEMONSTRATED[effect],)


def excitation(rng: np.random.Generator, samples: int, hidden: tuple[Hidden, ...]) -> Float[np.ndarray, "samples 2"]:
    """The paper's random steps; where something is hidden, steps of several heights, without which some effects look
    like a gain."""
    u = random_steps(samples, 2, SAMPLING_TIME, hold_times=HOLD_TIMES, rng=rng)
    if hidden:
        u += 0.6 * random_steps(samples, 2, SAMPLING_TIME, hold_times=(0.3, 1.5), rng=rng)
    return u


def simulate(
    u: Float[np.ndarray, "records samples 2"], hidden: tuple[Hidden, ...]
) -> Float[np.ndarray, "records samples 2"]:
    """Outputs without noise, from rest: the linear part exact over small steps, forces by Heun's rule within it, dry
    friction as the force that stops the motion within a step unless it exceeds Fc.

    **Arguments:** `u`: held inputs of several records; `hidden`: one effect, or none.
    """
    step = SAMPLING_TIME / SUBSTEPS
    one = hidden[0] if hidden else Hidden("none", "y1")
    p, index = one.parameters, int(one.location[1:]) - 1
    if one.effect == "play_hysteresis":
        u = u.copy()
        u[:, :, index] += sum(w * _play(u[:, :, index], r) for w, r in zip(p["w"], p["r"]))
    fine = np.repeat(u, SUBSTEPS, axis=1)
    if one.effect == "input_delay":
        late = round(p["tau"] / step)
        fine[:, late:, index] = fine[:, : fine.shape[1] - late, index].copy()
        fine[:, :late, index] = u[:, :1, index]
    M, D, K = _matrices(one, index)
    n = len(M)
    flow, held, ramp = _step(M, D, K, step)
    drive = fine @ held[:, :2].T
    at, law = held[:, index], LAWS.get(one.effect)
    correction = ramp[:, index]
    z = np.zeros((len(u), 2 * n))
    y = np.empty_like(u)
    for k in range(fine.shape[1]):
        if k % SUBSTEPS == 0:
            y[:, k // SUBSTEPS] = z[:, :2]
        free = z @ flow.T + drive[:, k]
        if law is not None:
            t = (k + 0.5) * step
            first = law(p, z[:, index], z[:, n + index], t)
            z = free - first[:, None] * at
            z -= (law(p, z[:, index], z[:, n + index], t) - first)[:, None] * correction
        elif one.effect == "coulomb_friction":
            holding = free[:, n + index] / at[n + index]
            z = free - np.clip(holding, -p["Fc"], p["Fc"])[:, None] * at
        else:
            z = free
    if one.effect == "sensor_offset":
        y[:, :, index] += p["b"]
    return y


def _matrices(one: Hidden, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, D, K with the hidden mode as one more coordinate, where there is one."""
    M, D, K = TRUTH.values()
    if one.effect != "unmodelled_mode":
        return M, D, K
    p, arm = one.parameters, np.zeros(3)
    arm[index], arm[2] = 1.0, -1.0
    mass, omega = p["mass_ratio"] * M[index, index], 2 * np.pi * p["frequency_hz"]
    M, D, K = (np.pad(X, (0, 1)) for X in (M, D, K))
    M[2, 2] = mass
    link = np.outer(arm, arm)
    return M, D + 2 * p["damping_ratio"] * mass * omega * link, K + mass * omega**2 * link


def _step(M, D, K, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(q, q̇) one step later: from (q, q̇), from a constant force, and from one that grows from 0 to 1 meanwhile."""
    n = len(M)
    block = np.zeros((4 * n, 4 * n))
    block[:n, n : 2 * n] = np.eye(n)
    block[n : 2 * n, :n], block[n : 2 * n, n : 2 * n] = -np.linalg.solve(M, K), -np.linalg.solve(M, D)
    block[n : 2 * n, 2 * n : 3 * n] = np.linalg.inv(M)
    block[2 * n : 3 * n, 3 * n :] = np.eye(n) / step
    flow = scipy.linalg.expm(block * step)[: 2 * n]
    return flow[:, : 2 * n], flow[:, 2 * n : 3 * n], flow[:, 3 * n :]


def _play(u: Float[np.ndarray, "records samples"], r: float) -> np.ndarray:
    """Play operator of radius r, from rest at 0."""
    result, z = np.empty_like(u), np.zeros(len(u))
    for k in range(u.shape[1]):
        z = np.clip(z, u[:, k] - r, u[:, k] + r)
        result[:, k] = z
    return result


def simulated(
    effect: str, seed: int, samples: int = SAMPLES
) -> tuple[Record, Record, Float[np.ndarray, "samples outputs"], tuple[Hidden, ...]]:
    """An estimation and a validation record with noise, the validation outputs without, and what is hidden.

    **Arguments:** `effect`: an id, or "none"; `seed` of inputs and noise; `samples` of each record.

    **Raises:** `ValueError` for an effect that cannot be demonstrated, or a seed that is none.

    **Reference:** Olofsson et al., equation (25) and the simulation that follows it.
    """
    hidden = hidden_of(effect)
    if seed < 0:
        raise ValueError(f"seed={seed} is negative; give a whole number from 0.")
    rng = np.random.default_rng(seed)
    u = np.stack([excitation(rng, samples, hidden) for _ in range(2)])
    clean = simulate(u, hidden)
    y = clean + NOISE * rng.standard_normal(clean.shape)
    units = {"input_units": ("N", "N"), "output_units": ("m", "m")}
    estimation, validation = (Record(a, b, SAMPLING_TIME, **units) for a, b in zip(u, y))
    return estimation, validation, clean[1], hidden
