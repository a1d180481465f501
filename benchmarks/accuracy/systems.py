"""Other systems: the micro manipulator's units, base excitation."""

import numpy as np
import scipy.signal

import jaxgray

from .common import data, in_children

MANIPULATOR_HZ = np.array([83.107, 96.729])
"""Natural frequencies of the paper's micro manipulator."""


def micro_manipulator():
    """M, D, K with the frequencies of the paper's micro manipulator and 2 % damping; masses of its order (1e-6)."""
    w = 2 * np.pi * MANIPULATOR_HZ
    M = np.diag([3.2e-6, 2.9e-6])
    L = np.linalg.cholesky(M)
    Q, _ = np.linalg.qr(np.array([[1.0, 0.25], [-0.2, 1.0]]))
    return M, L @ Q @ np.diag(2 * 0.02 * w) @ Q.T @ L.T, L @ Q @ np.diag(w**2) @ Q.T @ L.T


def row_manipulator(seeds):
    """The paper's micro manipulator: how far its natural frequencies are off."""
    M, D, K = micro_manipulator()
    worst = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 10000, 2, 1e-4, (0.002, 0.03))
        y = data.simulate(M, D, K, u, 1e-4)
        y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
        found = jaxgray.identify(jaxgray.Record(u, y, 1e-4))
        values = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(found.mass, found.stiffness)).real)) / 2 / np.pi
        worst.append(np.max(np.abs(values / MANIPULATOR_HZ - 1)))
    print(f"micro manipulator: worst frequency error {100 * max(worst):.4f} % (bar 0.1 %)", flush=True)
    return {"worst_percent": 100 * max(worst)}


BASE = (np.diag([2.0, 1.0]), np.array([[1.2, -0.4], [-0.4, 0.9]]), np.array([[300.0, -120.0], [-120.0, 200.0]]))
BASE_TIME, BASE_NOISE = 0.01, 2e-5
GIVEN = "mass[0,0]=2,mass[0,1]=0,mass[1,1]=1"


def base_runs(pairs, u, kind, x0=None):
    """Outputs of every (M⁻¹D, M⁻¹K) for a base motion linear between samples; systems × samples × 2.

    Acceleration ẍ: relative displacement z, z̈ + A22 ż + A21 z = −r ẍ. Displacement x: absolute displacement q, whose
    state (q, q̇ − A22 r x) does without the derivative of x.
    """
    r, discrete = np.ones((2, 1)), []
    for A22, A21 in pairs:
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-A21, -A22]])
        B = np.vstack([0 * r, -r]) if kind == "acceleration" else np.vstack([A22 @ r, (A21 - A22 @ A22) @ r])
        discrete.append(scipy.signal.cont2discrete((A, B, np.eye(4), np.zeros((4, 1))), BASE_TIME, "foh"))
    A, B, C, D = (np.stack([system[k] for system in discrete]) for k in range(4))
    # SciPy's state under a linear hold is x − B1 u; C and D lead back.
    x = np.zeros((len(discrete), 4, 1)) if x0 is None else np.asarray(x0, float)[:, :, None]
    if x0 is not None:
        x = np.linalg.solve(C, x - D * u[0])
    out = np.empty((len(u), len(discrete), 2))
    for k, value in enumerate(u[:, 0]):
        out[k] = (C @ x + D * value)[:, :2, 0]
        x = A @ x + B * value
    return out.transpose(1, 0, 2)


def base_moves(given):
    """Directions in which M⁻¹D (place 0) and M⁻¹K (1) are free: all entries, or symmetric D, K under known masses."""
    moves = []
    for place in range(2):
        for k in np.ndindex(2, 2):
            move = np.zeros((2, 2))
            move[k] = 1.0
            if given:
                move[k[::-1]] = 1.0
                move = np.linalg.solve(BASE[0], move)
            if not given or k[0] <= k[1]:
                moves.append((place, move))
    return moves


def base_chunk(kind, seeds):
    """Per case (masses given, not given): errors, those of one exact Gauss-Newton step from the truth, bounds."""
    truth = tuple(np.linalg.solve(BASE[0], X) for X in (BASE[1], BASE[2]))
    sizes = [np.linalg.norm(X) for X in truth]
    table = {True: [], False: []}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        u = data.smooth_noise(rng, 6000, 1, 0.2)
        clean = base_runs([truth], u, kind)[0]
        noise = BASE_NOISE if kind == "acceleration" else 1e-3 * clean.std()
        y = clean + noise * rng.standard_normal(clean.shape)
        record = jaxgray.Record(u, y, BASE_TIME, hold="linear")
        rest = base_runs([truth] * 4, 0 * u, kind, x0=np.eye(4))
        offsets = np.broadcast_to(np.eye(2)[:, None], (2, len(u), 2))
        for given in table:
            changed, steps = [], []
            for place, move in base_moves(given):
                for sign in (1, -1):
                    pair = list(truth)
                    steps.append(1e-4 * sizes[place])
                    pair[place] = pair[place] + sign * steps[-1] * move
                    changed.append(tuple(pair))
            runs = base_runs(changed, u, kind)
            slopes = (runs[::2] - runs[1::2]) / (2 * np.array(steps[::2])[:, None, None])
            J = np.concatenate([slopes, rest, offsets]).reshape(len(slopes) + 6, -1).T / noise
            Q, R = np.linalg.qr(J)
            step = np.linalg.solve(R, Q.T @ (y - clean).ravel() / noise)[: len(slopes)]
            inverse = np.linalg.solve(R, np.eye(len(R)))
            covariance = (inverse @ inverse.T)[: len(slopes), : len(slopes)]
            row = []
            options = {"excitation": f"base-{kind}", "relative": kind == "acceleration"}
            found = jaxgray.identify(record, fix=GIVEN if given else None, **options)
            for place, X in enumerate((found.damping, found.stiffness)):
                T = np.stack([move.ravel() * (q == place) for q, move in base_moves(given)], axis=1)
                error = np.linalg.solve(found.mass, X) - truth[place]
                best = np.linalg.norm(T @ step)
                row.append((np.linalg.norm(error), best, np.sqrt(np.trace(T @ covariance @ T.T))))
            table[given].append(np.array(row) / np.array(sizes)[:, None])
    return {given: np.array(rows) for given, rows in table.items()}


def row_base(seeds):
    """Base acceleration (relative outputs) and base displacement (absolute): errors of M⁻¹D, M⁻¹K over the bound.

    Most of the variance lies in one direction, so that the ratio over n seeds has itself a standard error of about
    1/√(2n); beside it stands the same ratio for one exact Gauss-Newton step from the truth under the same noise,
    which is as good as any estimator can be.
    """
    result = {}
    chunks = [seeds[k : k + 50] for k in range(0, len(seeds), 50)]
    for kind in ("acceleration", "displacement"):
        parts = in_children(base_chunk, [(kind, chunk) for chunk in chunks])
        for given, name in ((True, "masses given"), (False, "masses not given")):
            rows = np.concatenate([part[given] for part in parts])
            rms = np.sqrt(np.mean(rows**2, axis=0))
            ours, best = rms[:, 0] / rms[:, 2], rms[:, 1] / rms[:, 2]
            result[f"{kind}, {name}"] = {"ratio": ours, "efficient": best, "seeds": len(rows)}
            print(
                f"base {kind}, {name}: RMS error / bound of M⁻¹D, M⁻¹K {ours.round(3)} (bar 1.1; ± "
                f"{1 / np.sqrt(2 * len(rows)):.3f}); an efficient estimator under the same noise {best.round(3)}",
                flush=True,
            )
    return result
