"""Records for the fleet's benchmark, by SciPy alone: systems that differ, effects, aging machines, endless records."""

import pathlib
import sys

import numpy as np
import scipy.linalg
import scipy.signal

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import independent as data  # noqa: E402

H = 0.02
NOISE = 3e-4
SUBSTEPS = 8


def inputs(rng, samples):
    """Steps with random hold times at both coordinates."""
    return data.random_steps(rng, samples, 2, H, (0.2, 1.5))


def with_force(M, D, K, u, friction=0.0, cubic=0.0):
    """Outputs with dry friction and a cubic spring at the first coordinate, in small steps that hold the force.

    Friction takes from each step what brings the velocity to zero, at most its level.
    """
    A, B = data.state_space(M, D, K, np.eye(2))
    block = np.block([[A, B], [np.zeros((2, 6))]]) * (H / SUBSTEPS)
    flow = scipy.linalg.expm(block)
    Ad, Bd = flow[:4, :4], flow[:4, 4:]
    b, x, y = Bd[:, 0], np.zeros(4), np.empty((len(u), 2))
    for k, drive in enumerate(u @ Bd.T):
        y[k] = x[:2]
        for _ in range(SUBSTEPS):
            middle = x[0] + x[2] * H / SUBSTEPS / 2
            free = Ad @ x + drive - b * cubic * middle**3
            x = free + b * np.clip(-free[2] / b[2], -friction, friction)
    return y


def outputs(rng, M, D, K, u, **effects):
    """Outputs with noise."""
    y = with_force(M, D, K, u, **effects) if any(effects.values()) else data.simulate(M, D, K, u, H)
    return y + NOISE * rng.standard_normal(y.shape)


def write(path, u, y, temperature=20.0, h=H):
    """A Parquet file of one record."""
    import pyarrow
    import pyarrow.parquet

    columns = {"time": h * np.arange(len(u)), "u1": u[:, 0], "u2": u[:, 1], "y1": y[:, 0], "y2": y[:, 1]}
    table = pyarrow.table(columns | {"temperature": np.full(len(u), temperature)})
    pyarrow.parquet.write_table(table, path)


def mixed_fleet(folder, records, hidden, corrupt, others, samples, seed=0):
    """Records of systems that differ by some percent, some with a hidden effect, some spoilt.

    **Returns:** truth by file name: M, D, K and the hidden effect, None where the record is spoilt.
    """
    folder.mkdir(parents=True, exist_ok=True)
    truth = {}
    for k in range(records):
        rng = np.random.default_rng([seed, k])
        name = f"unit_{k:04d}.parquet"
        M, D, K = (X * f for X, f in zip(data.REFERENCE.values(), 1 + 0.05 * rng.standard_normal(3)))
        place = k * hidden // records
        effect = None
        if hidden and k == place * records // hidden + (records // hidden) // 2:
            effect = ("coulomb_friction", "friction", 0.03) if place % 2 else ("cubic_stiffness", "cubic", 3e5)
        u = inputs(rng, samples)
        y = outputs(rng, M, D, K, u, **({} if effect is None else {effect[1]: effect[2]}))
        write(folder / name, u, y)
        truth[name] = {"matrices": (M, D, K), "effect": None if effect is None else effect[0]}
    for k in range(corrupt):
        (folder / f"unit_corrupt_{k}.parquet").write_bytes(b"PAR1" + bytes(range(200)))
        truth[f"unit_corrupt_{k}.parquet"] = None
    for k in range(others):
        path = folder / f"unit_others_{k}.parquet"
        import pyarrow
        import pyarrow.parquet

        pyarrow.parquet.write_table(pyarrow.table({"time": np.arange(9.0), "force": np.arange(9.0)}), path)
        truth[path.name] = None
    return truth


def aging_fleet(folder, machines, records, samples, seed=0, step=None, friction=None, begins=None):
    """Machines recorded again and again, temperature moving their stiffness by ±3 %.

    **Arguments:** `step`: number of the machine whose stiffness steps by 2 %; `friction`: of that in which dry friction
    grows; `begins`: record of each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for m in range(machines):
        rng = np.random.default_rng([seed, m])
        M, D, K0 = (X * f for X, f in zip(data.REFERENCE.values(), 1 + 0.05 * rng.standard_normal(3)))
        for r in range(records):
            season = np.clip(np.sin(2 * np.pi * 1.7 * r / records + m) + 0.1 * rng.standard_normal(), -1, 1)
            K, level = K0 * (1 - 0.03 * season), 0.0
            if m == step and r >= begins:
                K = K + np.diag([0.02 * K0[0, 0], 0.0])
            if m == friction and r >= begins:
                level = 0.001 * (r - begins + 1)
            u = inputs(rng, samples)
            write(
                folder / f"machine{m:02d}_{r:03d}.parquet",
                u,
                outputs(rng, M, D, K, u, friction=level),
                20 + 15 * season,
            )


WARM = 8192
"""Samples before a stretch that are simulated to forget what came earlier: below rounding after so many."""

BLOCK = 2**14


def endless(first, count):
    """Samples of one endless record, any stretch by itself: columns u1, u2, y1, y2."""
    start = max(0, first - WARM)
    blocks = range(start // BLOCK, (first + count - 1) // BLOCK + 1)
    parts, noises = [], []
    for block in blocks:
        rng = np.random.default_rng([77, block])
        # Held for 25 samples: quick to draw, and as broad as the resonances.
        parts.append(np.repeat(rng.choice([-1.0, 1.0], (BLOCK // 32, 2)), 32, axis=0))
        noises.append(NOISE * rng.standard_normal((BLOCK, 2)))
    cut = slice(start - blocks[0] * BLOCK, first + count - blocks[0] * BLOCK)
    u, noise = np.concatenate(parts)[cut], np.concatenate(noises)[cut]
    A, B = data.state_space(*data.REFERENCE.values(), np.eye(2))
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * H)
    values, vectors = np.linalg.eig(flow[:4, :4])
    modal = np.linalg.solve(vectors, flow[:4, 4:].astype(complex))
    q = np.empty((len(u), 4), complex)
    for k in range(4):
        q[0, k] = 0.0
        q[1:, k] = scipy.signal.lfilter([1.0], [1.0, -values[k]], (u @ modal[k])[:-1])
    y = (q @ vectors.T).real[:, :2] + noise
    return np.hstack([u, y])[first - start :]
