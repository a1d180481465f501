"""Shear frames on a moving base, simulated by SciPy alone: what a shake table and accelerometers would record."""

from dataclasses import dataclass
from types import SimpleNamespace

import hidden_laws
import hidden_simulation
import numpy as np
import scipy.linalg
import scipy.signal


@dataclass(frozen=True)
class Frame:
    """Masses [kg], stiffness [N/m] and damping [N s/m] of every storey from the ground up."""

    masses: np.ndarray
    storeys: np.ndarray
    dampers: np.ndarray

    @property
    def mass(self):
        return np.diag(np.asarray(self.masses, float))

    @property
    def stiffness(self):
        return chain(self.storeys)

    @property
    def damping(self):
        return chain(self.dampers)

    @property
    def rates(self):
        """M⁻¹D and M⁻¹K."""
        return np.linalg.solve(self.mass, self.damping), np.linalg.solve(self.mass, self.stiffness)

    @property
    def frequencies_hz(self):
        return np.sort(np.sqrt(np.linalg.eigvals(self.rates[1]).real)) / (2 * np.pi)


THREE = Frame(np.array([120.0, 120.0, 100.0]), np.array([1.9e5, 1.7e5, 1.6e5]), np.array([140.0, 120.0, 110.0]))
"""Modes at 2.872, 7.742 and 10.862 Hz, about 1 % damped."""

THREE_TIME = 0.005
THREE_NOISE = 0.004
THREE_BAND = (0.5, 25.0)


def chain(links):
    """The matrix of springs (or dampers) from the ground to the first floor and from floor to floor."""
    n = len(links)
    arms = np.eye(n) - np.eye(n, k=-1)
    return arms.T @ np.diag(links) @ arms


def random_frame(rng, storeys, damping):
    """A frame of random masses and springs, lightest mode near 1 to 3 Hz, with about this damping ratio."""
    masses = rng.uniform(80, 150, storeys)
    springs = rng.uniform(0.7, 1.3, storeys) * 1.7e5 * (storeys / 3) ** 1.5
    plain = Frame(masses, springs, springs)
    w = 2 * np.pi * plain.frequencies_hz
    # In proportion to the springs the damping ratio grows with frequency: the mean of the modes counts.
    dampers = springs * 2 * damping / np.mean(w) * rng.uniform(0.8, 1.2, storeys)
    return Frame(masses, springs, dampers)


def band_noise(rng, samples, channels, band, sampling_time):
    """Band-limited noise of unit size."""
    high = min(band[1], 0.45 / sampling_time)
    sos = scipy.signal.butter(4, [band[0], high], "bandpass", fs=1 / sampling_time, output="sos")
    u = scipy.signal.sosfilt(sos, rng.standard_normal((samples + 2000, channels)), axis=0)[2000:]
    return u / u.std(axis=0)


def run(A, B, C, D, u, sampling_time):
    """Outputs from rest for an input that is linear between samples."""
    n, m = B.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m], block[n : n + m, n + m :] = A, B, np.eye(m) / sampling_time
    flow = scipy.linalg.expm(block * sampling_time)
    step = np.concatenate([np.diff(u, axis=0), np.zeros((1, m))])
    driven = u @ flow[:n, n : n + m].T + step @ flow[:n, n + m :].T
    x, state, Ad = np.empty((len(u), n)), np.zeros(n), flow[:n, :n]
    for k, drive in enumerate(driven):
        x[k] = state
        state = Ad @ state + drive
    return x @ C.T + u @ D.T


def shaken(rates, u, sampling_time, *, kind="acceleration", relative=False, measured="acceleration"):
    """Outputs of a frame with M⁻¹D and M⁻¹K on a base that moves by `u` (samples × 1).

    **Arguments:** `rates`: (M⁻¹D, M⁻¹K); `u`: acceleration [m/s²] or displacement [m] of the base; `kind`: which;
    `relative`: whether outputs are relative to the base; `measured`: of all outputs.
    """
    A22, A21 = rates
    n = len(A21)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-A21, -A22]])
    r, eye, zero = np.ones((n, 1)), np.eye(n), np.zeros((n, n))
    if kind == "acceleration":
        # z = q − r x, relative: z̈ + A22 ż + A21 z = −r ẍ.
        B = np.vstack([0 * r, -r])
        rows = {"displacement": (eye, zero), "velocity": (zero, eye), "acceleration": (-A21, -A22)}[measured]
        D = -r if relative and measured == "acceleration" else 0 * r
    else:
        # The state (q, q̇ − A22 r x) does without the derivative of x.
        B = np.vstack([A22 @ r, (A21 - A22 @ A22) @ r])
        rows = {"displacement": (eye, zero), "velocity": (zero, eye)}[measured]
        D = {"displacement": -r if relative else 0 * r, "velocity": A22 @ r}[measured]
    return run(A, B, np.hstack(rows), D, u, sampling_time)


def forced(frame, u, sampling_time, *, measured="acceleration"):
    """Outputs of a frame with a force at every floor, linear between samples."""
    A22, A21 = frame.rates
    n = len(A21)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-A21, -A22]])
    B = np.vstack([np.zeros((n, n)), np.linalg.inv(frame.mass)])
    C = {"displacement": np.eye(n, 2 * n), "velocity": np.eye(2 * n)[n:], "acceleration": A[n:]}[measured]
    return run(A, B, C, B[n:] if measured == "acceleration" else np.zeros((n, n)), u, sampling_time)


def three_storeys(seed, *, base=True, samples=8000):
    """(u, y) of `THREE`: the base shaken [m/s²], or a force at every floor [N]."""
    rng = np.random.default_rng(seed)
    u = band_noise(rng, samples, 1 if base else 3, THREE_BAND, THREE_TIME) * (1.2 if base else 100.0)
    y = shaken(THREE.rates, u, THREE_TIME) if base else forced(THREE, u, THREE_TIME)
    return u, y + THREE_NOISE * rng.standard_normal(y.shape)


LAWS = ("end_stop", "bilinear_stiffness", "coulomb_friction", "stiffness_step")
"""What can go wrong in one storey."""


def storey_law(name, frame, storey, drift, duration, rng):
    """A damaged storey, as `hidden_simulation` takes it.

    **Arguments:** `name`: one of `LAWS`; `frame`; `storey`: its number from 0; `drift`: RMS drift of that storey
    without the law [m]; `duration` of the record [s]; `rng`.
    """
    k, size = frame.storeys[storey], rng.uniform(0.7, 1.5)
    return hidden_laws.Effect(
        name,
        place_of(storey),
        {
            "end_stop": {"gap": 1.2 * size * drift, "ks": k},
            "bilinear_stiffness": {"ks": 0.15 * size * k},
            "coulomb_friction": {"Fc": 0.05 * size * k * drift},
            "stiffness_step": {"dk": -0.1 * k, "t0": duration * rng.uniform(0.3, 0.6)},
        }[name],
    )


def place_of(storey):
    """The name of a storey, counted from 0."""
    return "y1" if storey == 0 else f"y{storey}-y{storey + 1}"


def shaken_with(frame, u, sampling_time, effects):
    """Absolute accelerations of all floors on a base with acceleration `u`, linear between samples, and drifts [m] of
    all storeys; `effects` act in storeys, dry friction with true rest."""
    n, u = len(frame.masses), np.asarray(u, dtype=float)
    system = hidden_simulation.System(frame.mass, frame.damping, frame.stiffness, -frame.mass @ np.ones((n, 1)))
    q, v, t, substeps = hidden_simulation.motion(system, u, sampling_time, effects, hold="linear")
    q, v, t = (x[::substeps][: len(u)] for x in (q, v, t))
    pull = -(q @ frame.stiffness + v @ frame.damping)
    for effect in effects:
        arm, p = hidden_laws.arm(effect.place, n), effect.parameters
        d, rate = q @ arm, v @ arm
        if effect.id in hidden_laws.FRICTION:
            # At rest it holds what pulls, the base included.
            yields = arm / frame.masses
            holding = (pull @ yields - (yields @ frame.masses) * u[:, 0]) / (arm @ yields)
            f = np.where(np.abs(rate) > 1e-9 * rate.std(), p["Fc"] * np.sign(rate), holding)
        else:
            here = SimpleNamespace(q=d, v=rate, middle=t)
            f = np.asarray(hidden_laws.FORCES[effect.id](p, here))
        pull = pull - f[:, None] * arm
    return pull / frame.masses, np.diff(q, axis=1, prepend=0.0)
