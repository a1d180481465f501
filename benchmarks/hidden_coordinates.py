"""Coordinates that no sensor sees: how well they are found, on simulated and measured records.

    python benchmarks/hidden_coordinates.py --rows drive --seeds 100 --json drive.json

Rows: `closed-form`, `drive`, `auto`, `motor-bench`, `link`, `storeys`. Simulated records come from SciPy, not from
jaxgray; seeds that fail are kept and counted.
"""

import argparse
import json
import pathlib
import sys
import time
import traceback

import jax
import numpy as np
import scipy.linalg
import scipy.signal

jax.config.update("jax_enable_x64", True)

import jaxgray  # noqa: E402

DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"


def simulated(M, D, K, E, C, u, h, *, base=False):
    """Displacements at the sensors C under forces E u held over every sample; absolute accelerations on a moving base
    (u its acceleration), from rest."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    if base:
        B, rows = np.concatenate([np.zeros((n, 1)), -np.ones((n, 1))]), C @ A[n:]
    else:
        B, rows = np.concatenate([np.zeros((n, E.shape[1])), np.linalg.solve(M, E)]), np.hstack([C, np.zeros_like(C)])
    system = (A, B, rows, np.zeros((len(rows), B.shape[1])))
    return scipy.signal.dlsim(scipy.signal.cont2discrete(system, h), u)[1]


def held_steps(rng, samples, length, channels=1):
    """A random input of ±1 that is held."""
    return np.repeat(rng.choice([-1.0, 1.0], (samples // length + 1, channels)), length, axis=0)[:samples]


# Two-inertia drive, encoder at the motor alone.

DRIVE = {"J1": 2.0, "J2": 1.0, "d": 0.6, "d1": 1.5, "d2": 0.8, "k": 300.0}
DRIVE_STRUCTURE = "y1-h1, y1-ground:damper, h1-ground:damper"
H = 0.004


def drive_matrices(p):
    line = np.array([[1.0, -1.0], [-1.0, 1.0]])
    return np.diag([p[0], p[1]]), p[2] * line + np.diag([p[3], p[4]]), p[5] * line


def drive_output(p, u, x0=None):
    M, D, K = drive_matrices(p)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    system = (A, np.array([[0.0], [0.0], [1 / p[0]], [0.0]]), np.eye(1, 4), np.zeros((1, 1)))
    return scipy.signal.dlsim(scipy.signal.cont2discrete(system, H), u, x0=x0)[1][:, 0]


def drive_bound(p, u, sigma):
    """Cramér-Rao bound of the six parameters, the first state estimated too, by central differences."""
    columns = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-5 * p[k]
        columns.append((drive_output(p + step, u) - drive_output(p - step, u)) / (2 * step[k]))
    columns += [drive_output(p, u, x) - drive_output(p, u) for x in np.eye(4)]
    J = np.stack(columns, axis=1)
    size = np.linalg.norm(J, axis=0)
    return np.sqrt(np.diag(np.linalg.inv((J / size).T @ (J / size))))[:6] / size[:6] * sigma


def drive_record(seed, sensor=0, samples=6000):
    rng = np.random.default_rng(seed)
    u = held_steps(rng, samples, 25)
    M, D, K = drive_matrices(np.array(list(DRIVE.values())))
    y = simulated(M, D, K, np.eye(2, 1), np.eye(2)[[sensor]], u, H)
    sigma = 1e-3
    return u, y, y + sigma * rng.standard_normal(y.shape), sigma


def row_drive(seeds):
    """Errors over the bound and coverage of masses, dampers and spring."""
    truth = np.array(list(DRIVE.values()))
    ratios, covered, failures = [], [], []
    for seed in seeds:
        u, _, y, sigma = drive_record(1000 + seed)
        try:
            found = jaxgray.identify(jaxgray.Record(u, y, H), hidden=1, structure=DRIVE_STRUCTURE)
            value = np.array([e.value for e in found.hidden.elements])
            error = np.array([e.standard_error for e in found.hidden.elements])
        except Exception as failure:
            failures.append({"seed": seed, "error": repr(failure)})
            continue
        ratios.append(((value - truth) / drive_bound(truth, u, sigma)).tolist())
        covered.append((np.abs(value - truth) < 1.96 * error).tolist())
    ratios, covered = np.array(ratios), np.array(covered)
    return {
        "seeds": len(seeds),
        "failures": failures,
        "rms_over_bound": float(np.sqrt(np.mean(ratios**2))),
        "rms_over_bound_each": np.sqrt(np.mean(ratios**2, axis=0)).tolist(),
        "standard_error_of_rms": float(np.sqrt(np.mean(ratios**2)) / np.sqrt(2 * len(ratios))),
        "coverage_percent": float(100 * np.mean(covered)),
        "coverage_each": (100 * np.mean(covered, axis=0)).tolist(),
    }


# Encoder at the link alone: masses may be exchanged.


def row_link(seeds):
    """Whether the exchange is declared, with the spring known, and what stays open without."""
    both, opened, failures = 0, 0, []
    M, D, K = drive_matrices(np.array([2.0, 1.0, 0.6, 0.0, 0.0, 300.0]))
    for seed in seeds:
        rng = np.random.default_rng(3000 + seed)
        u = held_steps(rng, 3000, 25)
        y = simulated(M, D, K, np.array([[0.0], [1.0]]), np.eye(1, 2), u, H)
        record = jaxgray.Record(u, y + 1e-3 * rng.standard_normal(y.shape), H)
        options = {"hidden": 1, "structure": "y1-h1", "input_map": "u1:h1"}
        try:
            known = jaxgray.identify(record, fix="stiffness[y1-h1]=300", **options)
            masses = sorted([known.mass[0, 0], *(float(m.mass[0, 0]) for m in known.hidden.alternatives)])
            both += len(masses) == 2 and np.allclose(masses, [1.0, 2.0], rtol=0.05)
            free = jaxgray.identify(record, **options)
            said = free.hidden.combinations
            opened += "mass[y1] + mass[h1]" in said and all(e.value is None for e in free.hidden.elements)
        except Exception as failure:
            failures.append({"seed": seed, "error": repr(failure)})
    return {"seeds": len(seeds), "failures": failures, "exchange_declared": int(both), "left_open": int(opened)}


# Five-storey chain on a shaken base, accelerometers on two floors.

STOREYS = "h1-ground, h1-y1, y1-h2, h2-h3, h3-y2"
FLOORS = (2, 0, 3, 4, 1)
"""Position of floors 1 to 5 among the coordinates y1 (floor 2), y2 (floor 5), h1, h2, h3."""


def storey_matrices(k, d, m):
    springs, dampers = np.zeros((5, 5)), np.zeros((5, 5))
    for j in range(5):
        arm = np.eye(5)[j] - (np.eye(5)[j - 1] if j else 0.0)
        springs, dampers = springs + k[j] * np.outer(arm, arm), dampers + d[j] * np.outer(arm, arm)
    return np.diag(m), dampers, springs


def storey_record(seed, k, samples=12000, h=0.01):
    rng = np.random.default_rng(seed)
    M, D, K = storey_matrices(k, np.full(5, 2.0), np.ones(5))
    # An input that acceleration sensors see as held: what a shaking table is commanded.
    u = np.repeat(rng.standard_normal((samples // 2, 1)), 2, axis=0)
    y = simulated(M, D, K, None, np.eye(5)[[1, 4]], u, h, base=True)
    return jaxgray.Record(u, y + 0.02 * np.std(y, axis=0) * rng.standard_normal(y.shape), h, measured="acceleration")


def storeys_found(record, masses):
    fix = ", ".join(f"mass[{name}]=1" for name in masses)
    found = jaxgray.identify(
        record, hidden=3, structure=STOREYS, fix=fix, excitation="base-acceleration", validation=None
    )
    springs = [e for e in found.hidden.elements if e.name.startswith("stiffness")]
    return found, np.array([e.value for e in springs]), np.array([e.standard_error for e in springs])


def row_storeys(seeds):
    """Stiffness of every storey within three standard errors, and a loss of 10 % placed; masses known."""
    k = np.array([1100.0, 1000.0, 950.0, 900.0, 800.0])
    within, placed, failures, z = 0, 0, [], []
    masses = ("y1", "y2", "h1", "h2", "h3")
    for seed in seeds:
        storey = seed % 5
        damaged = k * (1 - 0.1 * (np.arange(5) == storey))
        try:
            _, before, error = storeys_found(storey_record(5000 + seed, k), masses)
            _, after, also = storeys_found(storey_record(6000 + seed, damaged), masses)
        except Exception as failure:
            failures.append({"seed": seed, "error": repr(failure)})
            continue
        z.append(((before - k) / error).tolist())
        within += bool(np.all(np.abs(before - k) < 3 * error))
        change = (after - before) / np.sqrt(error**2 + also**2)
        placed += int(np.argmin(change)) == storey and change[storey] < -3
    z = np.array(z)
    return {
        "seeds": len(seeds),
        "failures": failures,
        "all_within_three_standard_errors": int(within),
        "loss_placed": int(placed),
        "rms_over_standard_error": float(np.sqrt(np.mean(z**2))) if len(z) else None,
        "beyond_three": int(np.sum(np.abs(z) > 3)),
    }


# How many coordinates are hidden.


def auto_record(seed, hidden):
    """A chain to ground with its first coordinate driven and measured."""
    rng = np.random.default_rng(seed)
    n = 1 + hidden
    m, k, samples, h = rng.uniform(0.7, 1.6, n), rng.uniform(200.0, 500.0, n), 4000, 0.01
    line = sum(k[j] * np.outer(a, a) for j, a in enumerate(np.eye(n)[j] - (np.eye(n, n, 1)[j]) for j in range(n)))
    D = 0.002 * line + 0.1 * np.eye(n)
    u = held_steps(rng, samples, 12)
    y = simulated(np.diag(m), D, line, np.eye(n, 1), np.eye(1, n), u, h)
    return jaxgray.Record(u, y + 0.01 * np.std(y) * rng.standard_normal(y.shape), h)


def row_auto(seeds):
    """The number of hidden coordinates found, 0 to 2 true, in turn."""
    right, more, table, failures = 0, 0, [], []
    for seed in seeds:
        hidden = seed % 3
        try:
            found = jaxgray.identify(auto_record(7000 + seed, hidden), hidden="auto")
        except Exception as failure:
            failures.append({"seed": seed, "error": repr(failure)})
            continue
        count = len(found.model.hidden)
        right, more = right + (count == hidden), more + (count > hidden)
        table.append([seed, hidden, count])
    wrong = [row for row in table if row[1] != row[2]]
    return {"records": len(seeds), "failures": failures, "right": int(right), "too_many": int(more), "wrong": wrong}


# The measured motor bench.


def lines_error(model, u, motor, load, period=2500):
    """Relative errors of the load angle at the excited lines: followed from the motor angle, from the current alone.

    The hidden coordinate follows from the measured one, (−ω² M₂₂ + iω D₂₂ + K₂₂) h = −(…)₂₁ q; the load follows the
    motor at rest, which sets its scale. From the current alone friction of the motor, which no linear model has, is in
    it: two inertias on a spring with a delay, fitted to the load angle itself, leave 8.4 % and 7.2 % of it, and one
    ratio of load to motor fitted to both angles 3.9 % and 4.3 %.
    """
    n = len(u) // period
    U, Y, L = (np.fft.rfft(x[: n * period].reshape(n, period).mean(axis=0)) for x in (u, motor, load))
    excited = np.flatnonzero(np.abs(U) > 0.1 * np.max(np.abs(U)))
    excited = excited[excited > 0]
    omega = 2 * np.pi * excited / (period / 2500.0)
    M, D, K = (np.asarray(X) for X in (model.mass, model.damping, model.stiffness))
    hold = (1 - np.exp(-1j * omega / 2500.0)) / (1j * omega / 2500.0)
    Z = K + 1j * omega[:, None, None] * D - omega[:, None, None] ** 2 * M
    scale = -K[1, 1] / K[0, 1]
    followed = -scale * Z[:, 1, 0] / Z[:, 1, 1] * Y[excited]
    driven = scale * np.linalg.solve(Z, np.broadcast_to([[1.0], [0.0]], (len(Z), 2, 1)))[:, 1, 0] * hold * U[excited]
    size = np.linalg.norm(L[excited])
    return {
        "from_motor": float(np.linalg.norm(followed - L[excited]) / size),
        "from_current": float(np.linalg.norm(driven - L[excited]) / size),
        "lines": len(excited),
    }


def row_motor_bench(_):
    """Antiresonance, resonance and the load angle, from current and motor angle alone."""
    paths = [DATA / f"motor_bench_{kind}.csv" for kind in ("estimation", "validation")]
    if not all(path.is_file() for path in paths):
        return {"skipped": f"{DATA} is not here"}
    columns = [np.loadtxt(path, delimiter=",", skiprows=1) for path in paths]
    table = columns[0]
    record = jaxgray.Record(
        table[:, 1:2], table[:, 2:3], 0.0004, input_names=("current",), output_names=("motor",), output_units=("rad",)
    )
    result = {}
    for name, structure in (("canonical", None), ("structure", "motor-h1, motor-ground:damper, h1-ground:damper")):
        found = jaxgray.identify(record, hidden=1, structure=structure)
        zeros = found.model.zeros(input=0, output=0)
        modes = found.model.modes()
        result[name] = {
            "antiresonance_hz": zeros.antiresonance_hz.tolist(),
            "resonance_hz": modes.natural_frequency_hz.tolist(),
            "damping_ratio": [float(x) for x in np.nan_to_num(modes.damping_ratio)],
            "antiresonance_damping": zeros.damping_ratio.tolist(),
            "warnings": list(found.warnings),
            "load_error": [lines_error(found.model, *t[:, 1:4].T) for t in columns],
        }
    return result


def row_closed_form(seeds):
    """Transfer function and canonical entries of random systems in a random state basis."""
    from jaxgray.identification.hidden import canonical_of, closed_form

    worst = {"transfer": 0.0, "entries": 0.0}
    cases = [(p, n, s) for p in (1, 2) for n in (1, 2, 3) for s in seeds]
    for p, n, s in cases:
        rng = np.random.default_rng([p, n, s])
        N = p + n
        X, Y, Z = rng.standard_normal((3, N, N))
        M, D, K = X @ X.T + N * np.eye(N), 0.3 * Y @ Y.T, 100 * (Z @ Z.T + 0.3 * np.eye(N))
        A = np.block([[np.zeros((N, N)), np.eye(N)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
        B, C = np.vstack([np.zeros((N, p)), np.linalg.inv(M)[:, :p]]), np.eye(p, 2 * N)
        Q = np.linalg.qr(rng.standard_normal((2 * N, 2 * N)))[0]
        T = Q * np.exp(rng.uniform(-1, 1, 2 * N))
        found = closed_form(np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T)
        truth = canonical_of(M, D, K, p)
        worst["entries"] = max(worst["entries"], float(np.max(np.abs(found.vector / truth.vector - 1))))
        rates = np.abs(np.linalg.eigvals(A))
        for w in np.geomspace(rates.min() / 3, rates.max() * 3, 60):
            H = C @ np.linalg.solve(1j * w * np.eye(2 * N) - A, B)
            Mc, Dc, Kc = found.matrices
            Hc = np.linalg.inv(Kc + 1j * w * Dc - w**2 * Mc)[:p, :p]
            worst["transfer"] = max(worst["transfer"], float(np.linalg.norm(H - Hc) / np.linalg.norm(H)))
    return {"systems": len(cases), **{f"worst_{k}": v for k, v in worst.items()}}


ROWS = {
    "closed-form": (row_closed_form, 20),
    "drive": (row_drive, 100),
    "auto": (row_auto, 200),
    "motor-bench": (row_motor_bench, 1),
    "link": (row_link, 20),
    "storeys": (row_storeys, 50),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default=",".join(ROWS), help="which, with commas")
    parser.add_argument("--seeds", type=int, help="how many")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--json", help="where the figures go")
    given = parser.parse_args()
    figures = {}
    for name in given.rows.split(","):
        function, count = ROWS[name]
        begun = time.perf_counter()
        try:
            figures[name] = function(range(given.first, given.first + (given.seeds or count)))
        except Exception:
            figures[name] = {"error": traceback.format_exc()}
        figures[name]["seconds"] = round(time.perf_counter() - begun, 1)
        print(name, json.dumps(figures[name]))
        sys.stdout.flush()
        if given.json:
            pathlib.Path(given.json).write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
