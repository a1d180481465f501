"""Shear frames on a moving base and lightly damped structures under forces: does the refinement end where it should?

    python benchmarks/frames.py [--rows three,base,force,diagnosis,starts] [--seeds 20] [--records 200] [--first 1]
        [--json OUT]

Data come from SciPy (tests/frames.py). Every fit is held against that of the truth itself, which only the noise of the
samples limits; the errors of M⁻¹K and of the natural frequencies against the Cramér-Rao bound, by central differences
of the same simulator over M, D, K that the experiment determines. Seeds 1 to 999 served development.

three   the frame of `tests/frames.py` as a structural engineer would ask for it, five ways
base    random frames of 2 to 8 storeys: damping 0.5 to 5 %, 50 to 400 Hz, 20 to 200 s, motion of the base measured as
        displacement or acceleration, outputs absolute or relative, every kind of sensor that goes with it
force   random systems of 2 to 6 coordinates under forces, damping 0.2 to 10 %, with each structure that the truth has
diagnosis  random frames of 2 to 4 storeys on a shaken base with a gap, a bilinear brace, dry friction or a loss of
        stiffness by 10 % in one storey, from accelerometers on every floor and the base; and as many linear ones
starts  refinement from M, D, K that are 5, 20 and 50 % off, beside `scipy.optimize.least_squares`
"""

import argparse
import json
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize

jax.config.update("jax_enable_x64", True)

import frames  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.initialization.start import model_run, total_deviation  # noqa: E402
from jaxgray.identification.refinement.normal_equations import Criterion, Iterate, join, part  # noqa: E402
from jaxgray.identification.refinement.refine import refine  # noqa: E402
from jaxgray.identification.setup.prediction import Batch, Nuisance, Setting  # noqa: E402
from jaxgray.identification.setup.preparation import prepare, scaling_of  # noqa: E402
from jaxgray.identification.setup.structure import Structure  # noqa: E402
from jaxgray.mechanics.modal_uncertainty import modal_uncertainty  # noqa: E402
from jaxgray.mechanics.systems.drives import Force  # noqa: E402

ASKED = {
    "forces": (False, {}),
    "forces, diagonal-mass + chain": (False, {"structure": ("diagonal-mass", "chain")}),
    "base, start alone": (True, {"refine": False}),
    "base": (True, {}),
    "base, diagonal-mass + chain": (True, {"structure": ("diagonal-mass", "chain")}),
}

SENSORS = (
    ("acceleration", True, "displacement"),
    ("acceleration", True, "velocity"),
    ("acceleration", True, "acceleration"),
    ("acceleration", False, "acceleration"),
    ("displacement", False, "displacement"),
    ("displacement", False, "velocity"),
    ("displacement", True, "displacement"),
)
"""Motion of the base, whether outputs are relative to it, and what they measure."""

STRUCTURES = (("diagonal-mass",), ("chain",), ("modal-damping",), ("diagonal-mass", "chain", "modal-damping"))


def fit_percent(y, simulated):
    """Fit per output."""
    return 100 * (1 - np.linalg.norm(y - simulated, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))


def record_of(u, y, time, measured, base):
    units = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}
    return jaxgray.Record(
        u,
        y,
        time,
        hold="linear",
        measured=measured,
        input_units=[units[base]] if base else ["N"] * u.shape[1],
        output_units=[units[measured]] * y.shape[1],
    )


def split(u, y, clean, time, measured, base, share=0.3):
    """Estimation and validation records, and the fit of the truth on the latter."""
    cut = int(round((1 - share) * len(u)))
    first, second = (record_of(u[k], y[k], time, measured, base) for k in (slice(None, cut), slice(cut, None)))
    return first, second, fit_percent(y[cut:], clean[cut:])


def rates_of(matrices):
    return np.linalg.solve(matrices[0], matrices[1]), np.linalg.solve(matrices[0], matrices[2])


def frequencies(A22, A21):
    n = len(A21)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-A21, -A22]])
    poles = np.linalg.eigvals(A)
    return np.sort(np.abs(poles[poles.imag > 0])) / (2 * np.pi)


def many(systems, u, sampling_time):
    """Outputs of many systems (A, B, C, D) of one order from rest, input linear between samples."""
    discrete = []
    for A, B, C, D in systems:
        n, m = B.shape
        block = np.zeros((n + 2 * m, n + 2 * m))
        block[:n, :n], block[:n, n : n + m], block[n : n + m, n + m :] = A, B, np.eye(m) / sampling_time
        flow = scipy.linalg.expm(block * sampling_time)
        discrete.append((flow[:n, :n], flow[:n, n : n + m], flow[:n, n + m :], C, D))
    Ad, B0, B1, C, D = (np.stack(parts) for parts in zip(*discrete))
    step = np.concatenate([np.diff(u, axis=0), np.zeros_like(u[:1])])
    x = np.zeros((len(Ad), Ad.shape[1], 1))
    out = np.empty((len(u), len(Ad), C.shape[1]))
    for k in range(len(u)):
        out[k] = (C @ x + D @ u[k][:, None])[:, :, 0]
        x = Ad @ x + B0 @ u[k][:, None] + B1 @ step[k][:, None]
    return out.transpose(1, 0, 2)


def base_system(A22, A21, kind, relative, measured):
    caught = {}

    def keep(A, B, C, D, u, time):
        caught["system"] = A, B, C, D

    original, frames.run = frames.run, keep
    try:
        frames.shaken((A22, A21), None, None, kind=kind, relative=relative, measured=measured)
    finally:
        frames.run = original
    return caught["system"]


def bound(frame, u, time, noise, kind, relative, measured):
    """Cramér-Rao covariance of (M⁻¹K, natural frequencies) for free symmetric M, D, K and a free first state."""
    M, D, K = frame.mass / frame.mass[0, 0], frame.damping / frame.mass[0, 0], frame.stiffness / frame.mass[0, 0]
    n = len(M)
    moves = []
    for which, X in enumerate((M, D, K)):
        for r in range(n):
            for c in range(r, n):
                if (which, r, c) == (0, 0, 0):
                    continue
                E = np.zeros((n, n))
                E[r, c] = E[c, r] = 1e-5 * np.sqrt(X[r, r] * X[c, c])
                moves.append((which, E))

    def moved(which, E, sign):
        each = [M, D, K]
        each[which] = each[which] + sign * E
        return rates_of(each)

    pairs = [moved(*move, sign) for move in moves for sign in (1, -1)]
    y = many([base_system(*pair, kind, relative, measured) for pair in pairs], u, time)
    J = (y[0::2] - y[1::2]).reshape(len(moves), -1).T / 2
    A, _, C, _ = base_system(*rates_of((M, D, K)), kind, relative, measured)
    free, Ad = [], scipy.linalg.expm(A * time)
    x = np.eye(2 * n)
    for _ in range(len(u)):
        free.append(C @ x)
        x = Ad @ x
    own = np.concatenate([np.stack(free), np.broadcast_to(np.eye(n), (len(u), n, n))], axis=2).reshape(len(u) * n, -1)
    own = own / np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    Q = np.linalg.svd(own, full_matrices=False)[0]
    J = J - Q @ (Q.T @ J)
    values, vectors = np.linalg.eigh(J.T @ J)
    kept = values > 1e-9 * values[-1] * 1e-4
    spread = vectors[:, kept] / np.sqrt(values[kept])

    def of(pair):
        return np.concatenate([pair[1].ravel(), frequencies(*pair)])

    T = np.stack([(of(moved(*move, 1)) - of(moved(*move, -1))) / 2 for move in moves], axis=1)
    return noise**2 * np.sum((T @ spread) ** 2, axis=1)


def row_three(seeds):
    results = {}
    for name, (base, options) in ASKED.items():
        short, modes = [], []
        for seed in seeds:
            u, y = frames.three_storeys(seed, base=base)
            clean = (frames.shaken if base else lambda r, *a: frames.forced(frames.THREE, *a))(
                frames.THREE.rates, u, frames.THREE_TIME
            )
            records = split(u, y, clean, frames.THREE_TIME, "acceleration", "acceleration" if base else None)
            extra = {"excitation": "base-acceleration"} if base else {}
            found = jaxgray.identify(records[0], validation=records[1], **options, **extra)
            short.append(float(np.max(records[2] - list(found.fit_percent["validation"].values()))))
            if found.covariance is not None:
                off = np.asarray(found.model.modes().natural_frequency_hz) - frames.THREE.frequencies_hz
                errors = modal_uncertainty(found.model, found.covariance).natural_frequency_hz
                modes.append(float(np.max(np.abs(off) / errors)))
        results[name] = {"points_below_truth": short, "modes_in_standard_errors": modes}
        text = f", modes within {max(modes):.2f} standard errors" if modes else ""
        print(f"three: {name}: at most {max(short):.3f} points below the truth{text}", flush=True)
    return results


def drawn_frame(seed):
    """A random frame, its record, and how it was measured."""
    rng = np.random.default_rng(seed)
    storeys = int(rng.integers(2, 9))
    damping = np.exp(rng.uniform(np.log(0.005), np.log(0.05)))
    frame = frames.random_frame(rng, storeys, damping)
    rates = np.array([50.0, 100.0, 200.0, 400.0])
    time = 1 / rng.choice(rates[rates * 0.45 > min(frame.frequencies_hz[-1], 179.0)])
    samples = int(min(rng.choice([20.0, 60.0, 200.0]) / time, 40000))
    kind, relative, measured = SENSORS[int(rng.integers(len(SENSORS)))]
    band = 0.5, min(1.5 * frame.frequencies_hz[-1], 0.4 / time)
    u = frames.band_noise(rng, samples, 1, band, time) * (1.2 if kind == "acceleration" else 0.002)
    clean = frames.shaken(frame.rates, u, time, kind=kind, relative=relative, measured=measured)
    noise = np.exp(rng.uniform(np.log(0.001), np.log(0.03))) * clean.std()
    y = clean + noise * rng.standard_normal(clean.shape)
    return frame, u, y, clean, time, noise, (kind, relative, measured)


def row_base(seeds, efficiency=True):
    rows = []
    for seed in seeds:
        frame, u, y, clean, h, noise, (kind, relative, measured) = drawn_frame(seed)
        first, second, truth = split(u, y, clean, h, measured, kind)
        began = time.perf_counter()
        row = {"seed": seed, "storeys": len(frame.masses), "kind": kind, "relative": relative, "measured": measured}
        row |= {"samples": len(u), "rate": 1 / h, "visible": bool(frame.frequencies_hz[-1] < 0.45 / h)}
        try:
            found = jaxgray.identify(first, validation=second, excitation=f"base-{kind}", relative=relative)
        except jaxgray.ComputationError as error:
            rows.append(row | {"failed": str(error)})
            print(f"base {row} failed: {error}", flush=True)
            continue
        row["seconds"] = time.perf_counter() - began
        row["points_below_truth"] = float(np.max(truth - list(found.fit_percent["validation"].values())))
        row["worse_than_start"] = _worse_than_start(found, first)
        if efficiency and row["samples"] <= 20000 and row["storeys"] <= 5 and row["visible"]:
            variances = bound(frame, first.u, h, noise, kind, relative, measured)
            rates = rates_of((found.mass, found.damping, found.stiffness))
            hz = frequencies(*rates)
            if len(hz) == len(frame.masses):
                off = np.concatenate([rates[1].ravel(), hz])
                off = off - np.concatenate([frame.rates[1].ravel(), frequencies(*frame.rates)])
                row["over_bound"] = (off**2 / variances).tolist()
        rows.append(row)
        print(f"base {row | {'over_bound': np.sqrt(np.mean(row.get('over_bound', np.nan)))}}", flush=True)
    return rows


def _worse_than_start(found, record):
    """How many points of fit the start was ahead of the refined model on the data of the fit, at any output's mean."""
    signals = prepare(record, found.scaling)
    start = np.asarray(model_run(found.start.matrices, found.setting, signals)[1])
    matrices = found.scaling.matrices_in(found.mass, found.damping, found.stiffness)
    end = np.asarray(model_run(matrices, found.setting, signals)[1])
    # −2 ln L per sample: positive where the start is the better one.
    return float(np.sum(np.log(end) - np.log(start)))


def summary(rows):
    short = np.array([row["points_below_truth"] for row in rows if "failed" not in row])
    print(f"{len(rows)} records, {sum('failed' in row for row in rows)} failed")
    over = int((short > 0.3).sum())
    print(f"points below the truth: median {np.median(short):.3f}, worst {short.max():.3f}, over 0.3: {over}")
    worse = np.array([row["worse_than_start"] for row in rows if "failed" not in row])
    print(f"worse than the start: {(worse > 1e-3).sum()}")
    over = [np.mean(row["over_bound"]) for row in rows if "over_bound" in row]
    if over:
        print(f"M⁻¹K and modes, RMS over the bound: {np.sqrt(np.mean(over)):.3f} ({len(over)} records)")


def random_forced(seed):
    """A random lightly damped chain, its structures, and a record under forces."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    damping = np.exp(rng.uniform(np.log(0.002), np.log(0.1)))
    frame = frames.random_frame(rng, n, damping)
    names = STRUCTURES[seed % len(STRUCTURES)]
    if "modal-damping" in names:
        w = 2 * np.pi * frame.frequencies_hz
        alpha, beta = np.linalg.lstsq(np.stack([1 / (2 * w), w / 2], axis=1), np.full(n, damping), rcond=None)[0]
        alpha, beta = max(alpha, 0.0), max(beta, 1e-6)

        class Modal(frames.Frame):
            @property
            def damping(self):
                return alpha * self.mass + beta * self.stiffness

        frame = Modal(frame.masses, frame.storeys, frame.dampers)
    measured = ("displacement", "velocity", "acceleration")[int(rng.integers(3))]
    h = 1 / (rng.uniform(6, 20) * frame.frequencies_hz[-1])
    samples = int(rng.choice([4000, 8000, 16000]))
    u = frames.band_noise(rng, samples, n, (0.02 / h / 10, 0.4 / h), h) * 100.0
    clean = frames.forced(frame, u, h, measured=measured)
    noise = np.exp(rng.uniform(np.log(0.001), np.log(0.03))) * clean.std(axis=0)
    return frame, names, u, clean + noise * rng.standard_normal(clean.shape), clean, h, measured


def row_force(seeds):
    rows = []
    for seed in seeds:
        frame, names, u, y, clean, h, measured = random_forced(seed)
        first, second, truth = split(u, y, clean, h, measured, None)
        row = {"seed": seed, "storeys": len(frame.masses), "structure": names, "measured": measured}
        try:
            found = jaxgray.identify(first, validation=second, structure=names)
            plain = jaxgray.identify(first, validation=second)
        except jaxgray.ComputationError as error:
            rows.append(row | {"failed": str(error)})
            print(f"force {row} failed: {error}", flush=True)
            continue
        row["points_below_truth"] = float(np.max(truth - list(found.fit_percent["validation"].values())))
        row["free_below_truth"] = float(np.max(truth - list(plain.fit_percent["validation"].values())))
        row["worse_than_start"] = _worse_than_start(found, first)
        sizes = [np.sqrt(np.sum(r.standard_errors[k] ** 2)) for r in (found, plain) for k in ("mass", "stiffness")]
        row["errors_smaller"] = bool(sizes[0] <= sizes[2] * 1.001 and sizes[1] <= sizes[3] * 1.001)
        errors = np.concatenate([found.standard_errors[k].ravel() for k in ("mass", "damping", "stiffness")])
        truths = np.concatenate([X.ravel() for X in (frame.mass, frame.damping, frame.stiffness)])
        values = np.concatenate([X.ravel() for X in (found.mass, found.damping, found.stiffness)])
        known = errors > 1e-9 * np.abs(values).max()
        row["rms_error"] = float(np.sqrt(np.mean(((values - truths)[known] / errors[known]) ** 2)))
        rows.append(row)
        print(f"force {row}", flush=True)
    return rows


def drawn_damage(seed, name):
    """A frame on a shaken base with a law in one storey (None: linear), its record, the place of the law."""
    rng = np.random.default_rng([seed, 7])
    frame = frames.random_frame(rng, int(rng.integers(2, 5)), np.exp(rng.uniform(np.log(0.005), np.log(0.03))))
    h, samples = 1 / float(rng.choice([100.0, 200.0])), int(rng.choice([4000, 8000]))
    u = 1.2 * frames.band_noise(rng, samples, 1, (0.5, min(1.5 * frame.frequencies_hz[-1], 0.4 / h)), h)
    storey = int(rng.integers(len(frame.masses)))
    effects = []
    if name is not None:
        drift = np.std(frames.shaken_with(frame, u, h, [])[1][:, storey])
        effects = [frames.storey_law(name, frame, storey, drift, samples * h, rng)]
    clean = frames.shaken_with(frame, u, h, effects)[0]
    noise = np.exp(rng.uniform(np.log(0.001), np.log(0.01))) * clean.std()
    return record_of(
        u, clean + noise * rng.standard_normal(clean.shape), h, "acceleration", "acceleration"
    ), frames.place_of(storey)


def row_diagnosis(seeds):
    rows = []
    for seed in seeds:
        # As many with a law as without.
        name = (*frames.LAWS, *[None] * len(frames.LAWS))[seed % (2 * len(frames.LAWS))]
        record, place = drawn_damage(seed, name)
        began = time.perf_counter()
        row = {"seed": seed, "law": name, "place": place, "floors": record.outputs}
        try:
            found = jaxgray.diagnose(record, excitation="base-acceleration")
        except jaxgray.ComputationError as error:
            rows.append(row | {"failed": str(error)})
            print(f"diagnosis {rows[-1]}", flush=True)
            continue
        named = [f for f in found.findings if f.stage == "model" and f.members]
        classes = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in named]
        row |= {"verdict": found.verdict, "found": [(f.effect, f.location, f.status) for f in named]}
        row |= {"seconds": time.perf_counter() - began, "excess": found.excess}
        row["in_class"] = len(named) == 1 and (name, place) in classes[0]
        row["alone"] = row["in_class"] and len(classes[0]) == 1
        rows.append(row)
        print(f"diagnosis {row}", flush=True)
    hidden = [row for row in rows if row["law"]]
    plain = [row for row in rows if not row["law"]]
    shares = {k: sum(row.get(k, False) for row in hidden) for k in ("in_class", "alone")}
    false = sum(bool(row.get("found")) or "failed" in row for row in plain)
    print(f"diagnosis: {shares} of {len(hidden)}; false or failed {false} of {len(plain)} linear ones")
    return rows


def perturbed(frame, rng, off):
    """M, D, K with every mass, spring and damper off by up to a share of itself."""
    parts = [
        np.asarray(x) * (1 + off * rng.choice([-1, 1], len(x)) * rng.uniform(0.8, 1.0, len(x)))
        for x in (frame.masses, frame.dampers, frame.storeys)
    ]
    return np.diag(parts[0]), frames.chain(parts[1]), frames.chain(parts[2])


def peer(start, batch, setting):
    """SciPy's `least_squares` on the same weighted errors over the same entries, first states and offsets."""
    n, (records, _, outputs) = len(start[0]), batch.y.shape
    criterion = Criterion(batch, setting, Structure())
    entries = 3 * n * (n + 1) // 2

    def errors(theta):
        blocks = part(theta[:entries], (n,) * 3)
        x0, offset = jnp.split(theta[entries:], [records * 2 * n])
        nuisance = Nuisance(x0.reshape(records, 2 * n), offset.reshape(records, outputs), None)
        return criterion.errors(Iterate(blocks, nuisance, jnp.eye(outputs)))[0].ravel()

    value, jacobian = jax.jit(errors), jax.jit(jax.jacfwd(errors))
    first = np.concatenate([join([np.asarray(X) for X in start]), np.zeros(records * (2 * n + outputs))])
    size = np.concatenate(
        [np.abs(first[:entries]) + 1e-3 * np.max(np.abs(first[:entries])), np.ones(len(first) - entries)]
    )

    def bounded(f, theta):
        found = np.asarray(f(theta))
        return found if np.all(np.isfinite(found)) else np.full(found.shape, 1e6)

    found = scipy.optimize.least_squares(
        lambda t: bounded(value, t), first, lambda t: bounded(jacobian, t), x_scale=size, max_nfev=200
    )
    return [np.asarray(X) for X in part(found.x[:entries], (n,) * 3)]


def row_starts(seeds):
    """Share of refinements that end at the optimum, from starts that are off by 5, 20 and 50 %."""
    results = {}
    for off in (0.05, 0.2, 0.5):
        rows = []
        for seed in seeds:
            rng = np.random.default_rng([seed, int(100 * off)])
            frame = frames.random_frame(rng, int(rng.integers(2, 5)), np.exp(rng.uniform(np.log(0.005), np.log(0.05))))
            h = 1 / (10 * frame.frequencies_hz[-1])
            u = frames.band_noise(rng, 4000, len(frame.masses), (0.01 / h, 0.4 / h), h) * 100.0
            clean = frames.forced(frame, u, h, measured="displacement")
            y = clean + 0.005 * clean.std(axis=0) * rng.standard_normal(clean.shape)
            record = record_of(u, y, h, "displacement", None)
            scaling = scaling_of([record])
            n = len(frame.masses)
            drive = Force(np.eye(n)).scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
            setting, signals = Setting(drive, record.measured, record.hold), [prepare(record, scaling)]
            batch = Batch.of(signals)
            truth = [np.asarray(X) for X in scaling.matrices_in(frame.mass, frame.damping, frame.stiffness)]
            start = [np.asarray(X) for X in scaling.matrices_in(*perturbed(frame, rng, off))]
            best = float(np.sum(np.log(total_deviation(truth, setting, signals))))
            row = {"seed": seed}
            for name, run in (("jaxgray", refine), ("SciPy", peer)):
                began = time.perf_counter()
                try:
                    end = run(start, batch, setting)
                    end = (end.mass, end.damping, end.stiffness) if name == "jaxgray" else end
                    left = float(np.sum(np.log(total_deviation(end, setting, signals))))
                except (jaxgray.ComputationError, np.linalg.LinAlgError, ValueError):
                    left = np.inf
                row[name] = {"above_truth": left - best, "seconds": time.perf_counter() - began}
            rows.append(row)
        results[str(off)] = rows
        shares = {k: sum(r[k]["above_truth"] < 0.01 for r in rows) for k in ("jaxgray", "SciPy")}
        print(f"starts {100 * off:.0f} % off: at the optimum {shares} of {len(rows)}", flush=True)
    return results


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", default="three,base,force")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--json")
    given = parser.parse_args()
    rows, results = given.rows.split(","), {}
    records = range(given.first, given.first + given.records)
    if "three" in rows:
        results["three"] = row_three(range(given.first, given.first + given.seeds))
    if "starts" in rows:
        results["starts"] = row_starts(range(given.first, given.first + given.seeds))
    for name, run in (("base", row_base), ("force", row_force), ("diagnosis", row_diagnosis)):
        if name in rows:
            results[name] = run(records)
            if name != "diagnosis":
                summary(results[name])
    if given.json:
        pathlib.Path(given.json).write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
