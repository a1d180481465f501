"""Linear least-squares fit of M, D, K, first state and offsets: what a linear model must leave of a record."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal


@jax.jit
def outputs(Ad, B0, B1, offsets, x0, u, rise):
    """Displacements of many linear systems at once, (systems, samples, dofs); `rise` is the change over a sample."""
    dofs = offsets.shape[1]

    def step(x, drive):
        now, change = drive
        return (Ad * x[:, None, :]).sum(2) + (B0 * now).sum(2) + (B1 * change).sum(2), x[:, :dofs]

    return jnp.moveaxis(jax.lax.scan(step, x0, (u, rise))[1], 0, 1) + offsets[:, None]


def symmetric(entries, n):
    """Symmetric matrices from their upper triangles, (…, entries) → (…, n, n)."""
    X = np.zeros((*entries.shape[:-1], n, n))
    i, j = np.triu_indices(n)
    X[..., i, j] = entries
    X[..., j, i] = entries
    return X


def exponentials(X):
    """Exponentials of a stack of small matrices, by Taylor series of order 12 with scaling and squaring."""
    norm = np.max(np.abs(X).sum(axis=2))
    squarings = int(np.clip(np.ceil(np.log2(norm)) + 2, 0, 40)) if np.isfinite(norm) and norm > 0 else 0
    X = X / 2.0**squarings
    result = term = np.broadcast_to(np.eye(X.shape[1]), X.shape)
    for k in range(1, 13):
        term = term @ X / k
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return result


def free_run(parameters, u, rise, sampling_time, n):
    """Outputs for rows of parameters (upper triangles of M, D, K, first state, offsets)."""
    t = n * (n + 1) // 2
    M, D, K = (symmetric(parameters[:, k * t : (k + 1) * t], n) for k in range(3))
    x0, offsets = parameters[:, 3 * t : 3 * t + 2 * n], parameters[:, 3 * t + 2 * n :]
    m = u.shape[1]
    E = np.broadcast_to(np.eye(n, m), (len(M), n, m))
    block = np.zeros((len(M), 2 * n + 2 * m, 2 * n + 2 * m))
    block[:, :n, n : 2 * n] = np.eye(n)
    block[:, n : 2 * n, : 2 * n + m] = np.linalg.solve(M, np.concatenate([-K, -D, E], axis=2))
    block[:, 2 * n : 2 * n + m, 2 * n + m :] = np.eye(m) / sampling_time
    flow = exponentials(block * sampling_time)[:, : 2 * n]
    parts = flow[:, :, : 2 * n], flow[:, :, 2 * n : 2 * n + m], flow[:, :, 2 * n + m :]
    return np.asarray(outputs(*parts, offsets, x0, u, rise))


def equation_error(u, y, sampling_time, hold, bandwidth_hz=8.0):
    """Rows of M, D, K by least squares on filtered derivatives of noise-free outputs: a start for the fit."""
    n = y.shape[1]
    omega = 2 * np.pi * bandwidth_hz
    denominator = np.poly([-omega] * 3)

    def filtered(x, power, method):
        numerator = omega**3 * np.eye(power + 1)[0]
        b, a, _ = scipy.signal.cont2discrete((numerator, denominator), sampling_time, method=method)
        return scipy.signal.lfilter(b.ravel(), a, x, axis=0)

    a, v, q = (filtered(y, power, "foh") for power in (2, 1, 0))
    pushed = filtered(u, 0, "zoh" if hold == "zero" else "foh")
    t = n * (n + 1) // 2
    i, j = np.triu_indices(n)
    columns = np.zeros((n, len(y), 3 * t + n))
    for k, (r, c) in enumerate(zip(i, j)):
        for which, x in enumerate((a, v, q)):
            columns[r, :, which * t + k] = x[:, c]
            columns[c, :, which * t + k] = x[:, r]
    for k in range(n):
        columns[k, :, 3 * t + k] = 1.0
    right = np.zeros((n, len(y)))
    right[: u.shape[1]] = pushed.T
    scale = np.sqrt(np.mean(columns**2, axis=(0, 1))) + 1e-300
    table = (columns / scale).reshape(-1, 3 * t + n)
    normal = table.T @ table
    normal += 1e-13 * np.trace(normal) * np.eye(len(normal))
    found = np.linalg.solve(normal, table.T @ right.ravel()) / scale
    return found[: 3 * t]


def fit(start, u, y, sampling_time, hold, weights, steps=25):
    """Levenberg-Marquardt from one start; (weighted sum of squares, parameters), infinite where it fails."""
    n = y.shape[1]
    rise = np.zeros_like(u)
    if hold == "linear":
        rise[:-1] = np.diff(u, axis=0)
    t = n * (n + 1) // 2
    scale = np.concatenate([np.repeat([np.abs(start[k * t : (k + 1) * t]).max() for k in range(3)], t)])
    motion = np.sqrt(np.mean(y**2, axis=0))
    speed = np.sqrt(np.mean(np.gradient(y, sampling_time, axis=0) ** 2, axis=0))
    scale = np.concatenate([scale, motion, speed, motion])
    moves = 1e-5 * np.diag(scale)
    p, damping = np.array(start, dtype=float), 1e-3

    def run(rows):
        with np.errstate(all="ignore"):
            e = (y - free_run(rows, u, rise, sampling_time, n)) * weights
        return np.clip(np.where(np.isfinite(e), e, 1e6), -1e6, 1e6)

    cost, idle = None, 0
    for _ in range(steps):
        e, *moved = run(np.vstack([p, p + moves]))
        J = (np.stack(moved, axis=-1) - e[..., None]).reshape(e.size, -1) / 1e-5
        cost = np.sum(e**2)
        H, g = J.T @ J, J.T @ e.ravel()
        trials = damping * 10.0 ** np.arange(-2, 3)
        diagonal = np.diag(np.diag(H) + 1e-12 * np.trace(H))
        rows = np.stack([p - scale * np.linalg.solve(H + d * diagonal, g) for d in trials])
        costs = np.sum(run(rows) ** 2, axis=(1, 2))
        best = int(np.argmin(costs))
        gained = cost - costs[best]
        if gained > 0:
            p, cost = rows[best], costs[best]
            damping = max(trials[best], 1e-9)
        else:
            damping *= 1e4
        idle = 0 if gained > 1e-5 * cost else idle + 1
        if idle == 2:
            break
    return cost, p


def linear_residual(u, y, sampling_time, *, hold, start, rounds=4):
    """What the best linear model leaves of noise-free outputs; None where no fit succeeds.

    The outputs are weighted by their size, then by their residual (as by maximum likelihood), but none more than ten
    times as much as another relative to its size. The fitted offset is a nuisance and stays in the residual.
    """
    n = y.shape[1]
    i, j = np.triu_indices(n)
    true = np.concatenate([X[i, j] for X in (start.M, start.D, start.K)])
    nuisance = np.zeros(3 * n)
    starts = [np.concatenate([x, nuisance]) for x in (true, equation_error(u, y, sampling_time, hold))]
    size = np.sqrt(np.mean(y**2, axis=0))
    weights = 1 / size
    rise = np.zeros_like(u)
    if hold == "linear":
        rise[:-1] = np.diff(u, axis=0)
    for _ in range(rounds):
        fits = [fit(start, u, y, sampling_time, hold, weights) for start in starts]
        cost, best = min(fits, key=lambda pair: pair[0])
        if not np.isfinite(cost) or cost > 0.9 * np.sum((y * weights) ** 2):
            return None
        residual = y - free_run(best[None], u, rise, sampling_time, n)[0]
        left = np.sqrt(np.mean((residual + best[-n:]) ** 2, axis=0)) / size
        weights = 1 / (size * np.maximum(left, 0.1 * left.max()))
        starts = [best]
    return residual + best[-n:]
