"""Records of systems, noise and loops that are known, and the Cramér-Rao bound of their M, D, K, by SciPy alone."""

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.signal

from .common import data as independent

SYSTEMS = ("one light", "one heavy", "two light", "two heavy", "two close", "three light", "three heavy")
DOFS = {"one": 1, "two": 2, "three": 3}
NOISES = ("white", "coloured", "quantised", "process", "innovations")
POLE = 0.95
"""Of coloured noise, from sample to sample."""
KEEP = np.exp(-1)
"""Of the controller's filtered slope, from sample to sample."""


def system_of(rng, kind):
    """M, D, K of a random system of this kind."""
    size, how = kind.split()
    n = DOFS[size]
    M, D, K = independent.random_system(rng, n)
    if how == "close":
        coupling = np.array([[0.0, 1.0], [1.0, 0.0]])
        K = rng.uniform(60, 140) * (np.diag([1.0, rng.uniform(1.01, 1.04)]) + rng.uniform(-0.01, 0.01) * coupling)
        M = rng.uniform(0.5, 2.0) * np.eye(2)
    mean = np.mean(modes(M, D, K)[n:])
    wanted = rng.uniform(0.1, 0.5) if how == "heavy" else 10 ** rng.uniform(-2.5, -2)
    return M, D * wanted / mean, K


def modes(M, D, K):
    """Undamped natural frequencies [Hz], and damping ratios of the poles whose shapes are nearest to theirs."""
    n = len(M)
    squared, V = scipy.linalg.eigh(K, M)
    A, _ = independent.state_space(M, D, K, np.eye(n))
    poles, X = np.linalg.eig(A)
    upper = np.argsort(-poles.imag)[:n]
    shares = np.abs(V.T @ M @ X[:n, upper]) ** 2
    _, place = scipy.optimize.linear_sum_assignment(-shares / shares.sum(axis=0))
    s = poles[upper][place]
    return np.concatenate([np.sqrt(squared) / 2 / np.pi, -s.real / np.abs(s)])


def sampled(M, D, K, h):
    """Ad, Bd of displacements and velocities under held forces."""
    n = len(M)
    A, B = independent.state_space(M, D, K, np.eye(n))
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((n, 3 * n))]]) * h)
    return flow[: 2 * n, : 2 * n], flow[: 2 * n, 2 * n :]


def response(A, B, C, inputs, x0):
    """Outputs C x of x(k + 1) = A x(k) + B inputs(k), mode by mode."""
    values, V = np.linalg.eig(A)
    both = np.linalg.solve(V, np.hstack([B, x0[:, None]]).astype(complex))
    parts = C @ V
    total = np.zeros((len(inputs), len(C)))
    for value, row, part in zip(values, both, parts.T):
        if value.imag < 0:
            continue
        drive = inputs @ row[:-1].real + 1j * (inputs @ row[:-1].imag)
        x, _ = scipy.signal.lfilter([0.0, 1.0], [1.0, -value], drive, zi=row[-1:])
        weight = 2.0 if value.imag > 0 else 1.0
        total += weight * (np.outer(x.real, part.real) - np.outer(x.imag, part.imag))
    return total


def record_of(rng, kind, noise, decibels, samples, loop):
    """True M, D, K, sampling time, inputs, outputs, and the standard deviations of noise at forces and sensors."""
    M, D, K = system_of(rng, kind)
    n = len(M)
    omega = 2 * np.pi * modes(M, D, K)[:n]
    h = 2 * np.pi / omega[-1] / rng.uniform(10, 25)
    Ad, Bd = sampled(M, D, K, h)
    reference = independent.random_steps(rng, samples, n, h, (2 * h, 2 * np.pi / omega[0]))
    gains = np.zeros((2, n))
    if loop == "closed":
        gains = np.array([0.5 * np.diag(K), 0.4 * np.sqrt(np.diag(K) * np.diag(M))])
        while growth(Ad, Bd, gains, h) > max(growth(Ad, Bd, 0 * gains, h), 0.98):
            gains = 0.8 * gains
    rest = np.zeros((samples, n))
    _, clean = looped(Ad, Bd, reference, rest, rest, np.zeros(n), gains, h)
    sensor = 10 ** (-decibels / 20) * clean.std(axis=0)
    force, step = np.zeros(n), np.zeros(n)
    w, v = rest, rest
    if noise in ("process", "innovations"):
        sensor = sensor / np.sqrt(2)
        power = scipy.linalg.solve_discrete_lyapunov(Ad, Bd @ Bd.T)
        force = np.full(n, np.mean(sensor) / np.sqrt(np.mean(np.diag(power)[:n])))
        w = force * rng.standard_normal(rest.shape)
    if noise == "coloured":
        white = rng.standard_normal((samples + 200, n))
        v = sensor * np.sqrt(1 - POLE**2) * scipy.signal.lfilter([1.0], [1.0, -POLE], white, axis=0)[200:]
    elif noise == "quantised":
        step = np.sqrt(12) * sensor
    else:
        v = sensor * rng.standard_normal(rest.shape)
    u, y = looped(Ad, Bd, reference, w, v, step, gains, h)
    return (M, D, K), h, u, y, force, sensor


def growth(Ad, Bd, gains, h):
    """By what the slowest motion under the controller shrinks in a sample."""
    n = Bd.shape[1]
    C, eye, none = np.eye(n, 2 * n), np.eye(n), np.zeros((n, n))
    slope = np.hstack([(1 - KEEP) / h * C, KEEP * eye, -(1 - KEEP) / h * eye])
    u = -np.hstack([gains[0][:, None] * C, none, none]) - gains[1][:, None] * slope
    state = np.hstack([Ad, np.zeros((2 * n, 2 * n))]) + Bd @ u
    return np.max(np.abs(np.linalg.eigvals(np.vstack([state, slope, np.hstack([C, none, none])]))))


def looped(Ad, Bd, reference, w, v, step, gains, h):
    """Forces and readings where the controller acts on readings; the force noise `w` is not recorded."""
    samples, n = reference.shape
    x, slope, before = np.zeros(len(Ad)), np.zeros(n), None
    u, y = np.empty_like(reference), np.empty_like(reference)
    for k in range(samples):
        y[k] = x[:n] + v[k]
        if step.any():
            y[k] = step * np.round(y[k] / step)
        slope = KEEP * slope + (1 - KEEP) * (y[k] - (y[k] if before is None else before)) / h
        before = y[k]
        u[k] = reference[k] - gains[0] * y[k] - gains[1] * slope
        x = Ad @ x + Bd @ (u[k] + w[k])
    return u, y


def bound(truth, h, u, y, noise, force, sensor):
    """Covariance of the upper triangles of M, D, K at the bound."""
    n = len(truth[0])
    rows, columns = np.triu_indices(n)
    entries = 3 * len(rows)
    begin = np.concatenate([X[rows, columns] for X in truth] + [np.zeros(3 * n)])
    steps = np.concatenate([np.full(len(rows), 1e-5 * np.linalg.norm(X)) for X in truth] + [np.ones(3 * n)])
    if noise in ("process", "innovations"):
        begin = np.concatenate([begin, 2 * np.log(force), 2 * np.log(sensor)])
        steps = np.concatenate([steps, np.full(2 * n, 1e-4)])
    C = np.eye(n, 2 * n)

    def errors(theta):
        """Prediction errors, and the covariance of white ones."""
        matrices = []
        for part in theta[:entries].reshape(3, -1):
            X = np.zeros((n, n))
            X[rows, columns] = X[columns, rows] = part
            matrices.append(X)
        Ad, Bd = sampled(*matrices, h)
        x0, offset = theta[entries : entries + 2 * n], theta[entries + 2 * n : entries + 3 * n]
        if noise not in ("process", "innovations"):
            e = y - offset - response(Ad, Bd, C, u, x0)
            if noise != "coloured":
                return e, np.diag(sensor**2)
            e[1:] = e[1:] - POLE * e[:-1]
            return e, np.diag(sensor**2 * (1 - POLE**2))
        force2, sensor2 = np.exp(theta[-2 * n : -n]), np.exp(theta[-n:])
        # In units of the noise and of samples.
        size, unit = np.mean(sensor2), np.repeat([1.0, h], n)
        scaled = unit[:, None] * Ad / unit, unit[:, None] * Bd * np.sqrt(force2 / size)
        P = size * scipy.linalg.solve_discrete_are(scaled[0].T, C.T, scaled[1] @ scaled[1].T, np.diag(sensor2 / size))
        P = P / unit[:, None] / unit
        S = C @ P @ C.T + np.diag(sensor2)
        gain = np.linalg.solve(S, C @ P @ Ad.T).T
        e = y - offset - response(Ad - gain @ C, np.hstack([Bd, gain]), C, np.hstack([u, y - offset]), x0)
        return e, S

    S = errors(begin)[1]
    W = np.linalg.inv(np.linalg.cholesky(S))
    J = np.empty((y.size, len(begin)))
    slopes = []
    for k, size in enumerate(steps):
        (plus, more), (minus, less) = (errors(begin + sign * size * np.eye(len(begin))[k]) for sign in (1, -1))
        J[:, k] = ((plus - minus) @ W.T).ravel() / (2 * size)
        slopes.append(np.linalg.solve(S, more - less) / (2 * size))
    slopes = np.array(slopes)
    information = J.T @ J + len(y) / 2 * np.einsum("iab,jba->ij", slopes, slopes)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    # A first state that the filter forgets at once moves nothing.
    inverse = np.linalg.pinv(information * scale[:, None] * scale, rcond=1e-13, hermitian=True)
    return (scale[:, None] * inverse * scale)[:entries, :entries]
