"""Data from a simulator that shares nothing with the package: SciPy's matrix exponential, sample by sample."""

import numpy as np
import scipy.linalg
import scipy.signal

ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}

REFERENCE = {
    "M": np.array([[5.0, -1.0], [-1.0, 1.0]]),
    "D": np.array([[5.0, -0.01], [-0.01, 1.0]]),
    "K": np.array([[100.0, -5.0], [-5.0, 100.0]]),
}
"""The paper's simulated system (its equation 25), SI units."""

REFERENCE_TIME = 0.005
REFERENCE_NOISE = 3e-4


def random_steps(rng, samples, channels, sampling_time, hold_times=(0.5, 3.0)):
    """Independent ±1 steps with random hold times [s]."""
    u = np.empty((samples, channels))
    for column in u.T:
        k = 0
        while k < samples:
            n = max(1, int(rng.uniform(*hold_times) / sampling_time))
            column[k : k + n] = rng.choice([-1.0, 1.0])
            k += n
    return u


def smooth_noise(rng, samples, channels, bandwidth=0.1):
    """Low-pass filtered white noise, for linear holds; `bandwidth` relative to the Nyquist frequency."""
    sos = scipy.signal.butter(4, bandwidth, output="sos")
    u = scipy.signal.sosfilt(sos, rng.standard_normal((samples + 200, channels)), axis=0)[200:]
    return u / u.std(axis=0)


def state_space(M, D, K, E):
    """A, B of ẋ = A x + B u with x = (q, q̇)."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    return A, np.vstack([np.zeros((n, E.shape[1])), np.linalg.solve(M, E)])


def simulate(M, D, K, u, sampling_time, *, E=None, hold="zero", measured="displacement", x0=None, w=None):
    """Outputs of M q̈ + D q̇ + K q = E (u + w), exact at the samples; w is held over each sample."""
    n = len(M)
    E = np.eye(n, u.shape[1]) if E is None else E
    A, B = state_space(M, D, K, E)
    m = u.shape[1]
    block = np.zeros((2 * n + 2 * m, 2 * n + 2 * m))
    block[: 2 * n, : 2 * n] = A
    block[: 2 * n, 2 * n : 2 * n + m] = B
    block[2 * n : 2 * n + m, 2 * n + m :] = np.eye(m) / sampling_time
    flow = scipy.linalg.expm(block * sampling_time)
    Ad, G0, G1 = flow[: 2 * n, : 2 * n], flow[: 2 * n, 2 * n : 2 * n + m], flow[: 2 * n, 2 * n + m :]
    step = np.zeros_like(u)
    if hold == "linear":
        step[:-1] = np.diff(u, axis=0)
    drive = u @ G0.T + step @ G1.T
    if w is not None:
        drive = drive + w @ G0.T
    x = np.empty((len(u), 2 * n))
    state = np.zeros(2 * n) if x0 is None else np.asarray(x0, dtype=float)
    for k in range(len(u)):
        x[k] = state
        state = Ad @ state + drive[k]
    derivative = x @ A.T + (u if w is None else u + w) @ B.T
    quantities = {"displacement": x[:, :n], "velocity": x[:, n:], "acceleration": derivative[:, n:]}
    kinds = (measured,) * n if isinstance(measured, str) else measured
    return np.stack([quantities[kind][:, k] for k, kind in enumerate(kinds)], axis=1)


def random_system(rng, n):
    """A chain of masses between springs, with every coordinate sprung and damped to ground."""
    mass = np.diag(rng.uniform(0.5, 2.0, n))
    coupling = rng.uniform(0.3, 1.0, n - 1) * 60
    K = np.diag(rng.uniform(40, 160, n))
    D = np.diag(rng.uniform(0.3, 1.2, n))
    for k, c in enumerate(coupling):
        arm = np.zeros(n)
        arm[k], arm[k + 1] = 1.0, -1.0
        K = K + c * np.outer(arm, arm)
        D = D + 0.01 * c * np.outer(arm, arm)
    M = mass.copy()
    for k in range(n - 1):
        M[k, k + 1] = M[k + 1, k] = -0.1 * np.sqrt(mass[k, k] * mass[k + 1, k + 1])
    return M, D, K


def reference_record(seed, *, samples=20000, noise=REFERENCE_NOISE, offset=0.0, x0=None):
    """(u, y, clean y) of the reference system."""
    rng = np.random.default_rng(seed)
    u = random_steps(rng, samples, 2, REFERENCE_TIME)
    clean = simulate(*REFERENCE.values(), u, REFERENCE_TIME, x0=x0)
    return u, clean + offset + noise * rng.standard_normal(clean.shape), clean


def relative_errors(found, truth):
    """Relative Frobenius error of each matrix."""
    return np.array([np.linalg.norm(np.asarray(a) - b) / np.linalg.norm(b) for a, b in zip(found, truth)])


def sensitivities(truth, u, sampling_time):
    """Derivatives of the outputs of a two-coordinate system by M, D, K (upper triangles), first state and offsets.

    Central differences of `simulate`; samples × outputs × 15.
    """
    columns = []
    for matrix in range(3):
        for r, c in ((0, 0), (0, 1), (1, 1)):
            step = 1e-4 * np.linalg.norm(truth[matrix])
            pair = []
            for sign in (1, -1):
                changed = [X.copy() for X in truth]
                changed[matrix][r, c] += sign * step
                changed[matrix][c, r] = changed[matrix][r, c]
                pair.append(simulate(*changed, u, sampling_time))
            columns.append((pair[0] - pair[1]) / (2 * step))
    columns += [simulate(*truth, 0 * u, sampling_time, x0=x0) for x0 in np.eye(4)]
    columns += [np.tile(row, (len(u), 1)) for row in np.eye(2)]
    return np.stack(columns, axis=-1)
