"""Records of rows at times of their own: errors beside the Cramér-Rao bound, laws found, clocks.

    python benchmarks/own_times.py [--row NAME ...] [--seeds 50] [--first 1] [--json OUT]

The system is the paper's (equation 25). Data come from SciPy's matrix exponential, event by event, those with a hidden
law from an independent simulator (tests/hidden_simulation.py) on a grid twenty times finer. Beside the errors stands
what resampling to a uniform grid first makes of the same records. Seeds 1 to 99 served development.
"""

import argparse
import json
import pathlib
import sys
import time
import warnings

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
import hidden_simulation  # noqa: E402
import independent as data  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.records import Record  # noqa: E402

H = 0.02
"""Mean time between rows [s]: twenty in the shortest period."""

NOISE = data.REFERENCE_NOISE
TRUTH = tuple(data.REFERENCE.values())
FINE = 20


def run(matrices, time, u, x0):
    """Outputs at the times of rows with inputs held from each to the next: by the modes of the system."""
    A, B = data.state_space(*matrices, np.eye(2))
    values, vectors = np.linalg.eig(A)
    drive = u @ np.linalg.solve(vectors, B.astype(complex)).T / values
    z, seen = np.linalg.solve(vectors, x0.astype(complex)), []
    steps = np.exp(values * np.diff(time)[:, None])
    for k in range(len(time)):
        seen.append(z)
        if k < len(steps):
            z = steps[k] * (z + drive[k]) - drive[k]
    return (np.array(seen) @ vectors.T).real[:, :2]


def entries(theta):
    return [np.array([[a, b], [b, c]]) for a, b, c in theta.reshape(3, 3)]


def bound(time, u, sampled):
    """Standard errors at the Cramér-Rao bound, first state and offsets estimated too."""
    theta = np.concatenate([X[np.triu_indices(2)] for X in TRUTH])
    columns, x0 = [], np.zeros(4)
    for k, size in enumerate(np.abs(theta)):
        step = np.eye(9)[k] * 1e-5 * size
        columns.append(
            (run(entries(theta + step), time, u, x0) - run(entries(theta - step), time, u, x0)) / (2e-5 * size)
        )
    columns += [run(TRUTH, time, 0 * u, one) for one in np.eye(4)]
    columns += [np.broadcast_to(one, (len(time), 2)) for one in np.eye(2)]
    J = np.stack([column[sampled] for column in columns], axis=1) / NOISE
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:9]


def drawn(kind, seed, samples):
    """Times, inputs, which outputs were sampled."""
    rng = np.random.default_rng([seed, 38])
    if kind == "jitter":
        time = H * (np.arange(samples) + rng.uniform(-0.3, 0.3, samples))
        u = data.random_steps(rng, samples, 2, H)
        sampled = np.ones((samples, 2), bool)
    elif kind == "poisson":
        time = np.cumsum(rng.exponential(H, samples))
        u = data.random_steps(rng, samples, 2, H)
        sampled = np.ones((samples, 2), bool)
    else:
        # Outputs at two rates, a camera and an encoder, inputs when they change: three kinds of rows in one table.
        length = samples * H
        times = [np.arange(0, length, H), np.arange(0.3 * H, length, 2.7 * H)]
        events = [np.sort(rng.uniform(0, length, int(length / 1.5))) for _ in range(2)]
        time = np.unique(np.concatenate([*times, *events]))
        levels = [rng.choice([-1.0, 1.0], len(one) + 1) for one in events]
        u = np.stack([level[np.searchsorted(one, time, side="right")] for one, level in zip(events, levels)], axis=1)
        sampled = np.stack([np.isin(time, one) for one in times], axis=1)
    return rng, time, u, sampled


def errors_of(found):
    got = np.concatenate([X[np.triu_indices(2)] for X in (found.mass, found.damping, found.stiffness)])
    return got - np.concatenate([X[np.triu_indices(2)] for X in TRUTH])


def row_accuracy(kind, seeds, samples=20000):
    """RMS error over bound of every entry, pooled, and the share of 95 % intervals that hold."""
    rows = []
    for seed in seeds:
        rng, time, u, sampled = drawn(kind, seed, samples)
        clean = run(TRUTH, time, u, np.zeros(4))
        y = np.where(sampled, clean + NOISE * rng.standard_normal(clean.shape), np.nan)
        record = Record.from_stamps(time, u, y)
        least = bound(time, u, sampled)
        found = jaxgray.identify(record)
        se = np.concatenate([found.standard_errors[n][np.triu_indices(2)] for n in ("mass", "damping", "stiffness")])
        before = errors_of(jaxgray.identify(record.on_grid))
        e = errors_of(found)
        rows.append({"seed": seed, "ratio": e / least, "held": np.abs(e) < 1.96 * se, "resampled": before / least})
    ratio, resampled = (np.sqrt(np.mean([r[n] ** 2 for r in rows], axis=0)) for n in ("ratio", "resampled"))
    pooled = np.sqrt(np.mean(ratio**2))
    per_seed = np.sqrt([np.mean(r["ratio"] ** 2) for r in rows])
    held = np.mean([r["held"] for r in rows])
    spread = np.std(per_seed**2) / np.sqrt(len(rows)) / (2 * pooled)
    print(
        f"{kind}: error over bound {pooled:.3f} ± {spread:.3f} (entries {ratio.min():.2f} to {ratio.max():.2f}), "
        f"intervals hold {100 * held:.1f} %; resampled first {np.sqrt(np.mean(resampled**2)):.2f}",
        flush=True,
    )
    return rows


def row_exact(seeds):
    """Without noise: largest relative error of the matrices."""
    result = {}
    for kind in ("jitter", "poisson", "rates"):
        worst = 0.0
        for seed in seeds:
            _, time, u, sampled = drawn(kind, seed, 3000)
            y = np.where(sampled, run(TRUTH, time, u, np.zeros(4)), np.nan)
            found = jaxgray.identify(Record.from_stamps(time, u, y))
            worst = max(worst, max(data.relative_errors((found.mass, found.damping, found.stiffness), TRUTH)))
        result[kind] = worst
        print(f"no noise, {kind}, {len(seeds)} records: largest relative error {worst:.1e} (bar 1e-8)", flush=True)
    return result


def two_clocks(seed, samples=6000, late=0.3 * H, rate=50e-6):
    """A record whose outputs have a clock of their own: times, inputs, outputs, clocks; and when it begins."""
    rng = np.random.default_rng([seed, 42])
    events = np.arange(0, samples * H, H)
    u = data.random_steps(rng, samples, 2, H)
    seen = np.arange(0.2 * H, samples * H - 1, H)
    every = np.unique(np.concatenate([events, seen]))
    y = run(TRUTH, every, u[np.searchsorted(events, every, side="right") - 1], np.zeros(4))
    y = y[np.searchsorted(every, seen)] + NOISE * rng.standard_normal((len(seen), 2))
    time = np.concatenate([events, (seen - late) / (1 + rate)])
    order = np.argsort(time, kind="stable")
    time, clock = time[order], np.repeat([0, 1], [len(events), len(seen)])[order]
    held = u[np.maximum(np.searchsorted(events, time, side="right") - 1, 0)]
    outputs = np.concatenate([np.full((len(events), 2), np.nan), y])[order]
    return Record.from_stamps(time, held, outputs, clock=clock), late, rate


def row_clocks(seeds):
    """Two clocks, 0.3 samples and 50 ppm apart: deviations in standard errors."""
    rows = []
    for seed in seeds:
        record, late, rate = two_clocks(seed)
        (found,) = jaxgray.identify(record).clocks
        off = (found.offset - late - rate * record.start_time) / found.offset_error
        rows.append({"seed": seed, "offset": off, "rate": (found.rate - rate) / found.rate_error})
    z = np.array([[r["offset"], r["rate"]] for r in rows])
    inside = int(np.sum(np.all(np.abs(z) < 3, axis=1)))
    root = np.sqrt(np.mean(z**2, axis=0))
    print(
        f"two clocks: both within 3 standard errors in {inside} of {len(z)}; root mean square {root[0]:.2f} and "
        f"{root[1]:.2f}, largest {np.abs(z).max():.1f}",
        flush=True,
    )
    return rows


def jittered(case, rng, jitter=0.3):
    """Times, inputs held from each on, and clean outputs of a case at rows that wander."""
    samples, h = len(case.u), hidden.SAMPLING_TIME
    at = FINE * np.arange(samples) + np.rint(rng.uniform(-jitter, jitter, samples) * FINE).astype(int)
    at = np.maximum(at, 0)
    u = case.u[np.searchsorted(at, np.arange(at[-1] + 1), side="right").clip(1) - 1]
    y = hidden_simulation.simulate(case.system, u, h / FINE, case.effects, hold="zero", x0=case.extra.get("x0"))
    return at * h / FINE, case.u, y[at]


LAWS = (
    "coulomb_friction",
    "cubic_stiffness",
    "dead_zone_stiffness",
    "quadratic_drag",
    "input_delay",
    "input_saturation",
    "end_stop",
    "bilinear_stiffness",
    "stribeck_friction",
    "sine_stiffness",
)


def row_laws(seeds):
    """One hidden law at jittered rows and, the same case, at uniform ones."""
    rows = []
    for seed in seeds:
        law = LAWS[seed % len(LAWS)]
        rng = np.random.default_rng([seed, 39])
        case = hidden.random_case(rng, law, samples=2500, excess=(2.0, 8.0))
        time_of_rows, u, clean = jittered(case, rng)
        noise = case.noise * rng.standard_normal(clean.shape)
        uniform = hidden_simulation.simulate(
            case.system, case.u, hidden.SAMPLING_TIME, case.effects, hold="zero", x0=case.extra.get("x0")
        )
        records = {
            # Of one length, which compiles once.
            "jittered": Record.from_stamps(time_of_rows, u, clean + noise)[:2450],
            "uniform": Record(u, uniform + noise, hidden.SAMPLING_TIME)[:2450],
        }
        row = {"seed": seed, "law": law, "place": case.effects[0].place}
        for name, record in records.items():
            began = time.perf_counter()
            row[name] = judged(record, law, case.effects[0].place) | {"seconds": time.perf_counter() - began}
        rows.append(row)
        print(row, flush=True)
    for name in records:
        exact, inside = (sum(r[name][mark] for r in rows) for mark in ("exact", "in class"))
        print(f"laws, {name}: exact {exact}, in class {inside} of {len(rows)}")
    return rows


def judged(record, law, place):
    try:
        found = jaxgray.diagnose(record)
    except jaxgray.ComputationError as error:
        return {"exact": False, "in class": False, "failed": str(error)}
    laws = [f for f in found.findings if f.stage == "model" and f.effect != "unexplained"]
    members = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in laws]
    inside = len(members) == 1 and (law, place) in members[0]
    return {
        "exact": inside and len(members[0]) == 1,
        "in class": inside,
        "verdict": found.verdict,
        "found": [sorted(m) for m in members],
    }


def row_nothing(seeds):
    """Jittered rows without a law."""
    false, rows = 0, []
    for seed in seeds:
        rng = np.random.default_rng([seed, 40])
        case = hidden.null_case(rng, "white", samples=2500)
        time_of_rows, u, clean = jittered(case, rng)
        noise = case.noise * rng.standard_normal(clean.shape)
        found = jaxgray.diagnose(Record.from_stamps(time_of_rows, u, clean + noise)[:2450])
        rows.append({"seed": seed, "verdict": found.verdict})
        false += found.verdict != "noise"
        if found.verdict != "noise":
            print(seed, found, flush=True)
    print(f"nothing hidden: {false} of {len(rows)} false", flush=True)
    return rows


def row_cart(seeds):
    """A cart of 6 kg with asymmetric dry friction, 150 Hz, rows that wander by up to 0.9 samples."""
    rows = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 41])
        samples, h = 3000, 1 / 150
        at = np.sort(FINE * np.arange(samples) + np.rint(rng.uniform(-0.9, 0.9, samples) * FINE).astype(int))
        at = np.unique(np.maximum(at, 0))
        u = 25.0 * data.smooth_noise(rng, len(at), 1, 0.02)
        fine = u[np.searchsorted(at, np.arange(at[-1] + 1), side="right").clip(1) - 1]
        y = cart(fine[:, 0], h / FINE)[at]
        y = y + 2e-4 * rng.standard_normal(len(y))
        found = jaxgray.diagnose(Record.from_stamps(at * h / FINE, u, y))
        model = found.baseline if found.extended is None else found.extended
        mass, error = float(model.model.mass[0, 0]), float(model.standard_errors["mass"][0, 0])
        named = [f.effect for f in found.findings if f.stage == "model"]
        rows.append({"seed": seed, "named": named, "verdict": found.verdict, "mass": mass, "off": (mass - 6.0) / error})
        print(rows[-1], flush=True)
    return rows


def cart(u, h, mass=6.0, viscous=8.0, forward=4.0, backward=6.0):
    """Position of a cart with sticking dry friction that is larger one way: exponentials from one stop to the next."""
    x, v, seen, rate = 0.0, 0.0, np.empty(len(u)), viscous / mass
    for k, force in enumerate(u):
        seen[k], left = x, h
        while left > 0:
            if v > 0 or (v == 0 and force > forward):
                last = (force - forward) / viscous
            elif v < 0 or (v == 0 and force < -backward):
                last = (force + backward) / viscous
            else:
                break
            # v = last + (v0 − last) exp(−rate t), up to where it is zero.
            stop = np.log1p(-v / last) / rate if v * last < 0 else np.inf
            step = min(left, stop)
            x += last * step - (v - last) * np.expm1(-rate * step) / rate
            v = 0.0 if stop <= left else last + (v - last) * np.exp(-rate * step)
            left -= step
    return seen


ROWS = {
    "jitter": lambda seeds: row_accuracy("jitter", seeds),
    "poisson": lambda seeds: row_accuracy("poisson", seeds),
    "rates": lambda seeds: row_accuracy("rates", seeds),
    "exact": row_exact,
    "clocks": row_clocks,
    "laws": row_laws,
    "nothing": row_nothing,
    "cart": row_cart,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", nargs="*", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--json")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    results = {}
    for row in given.row:
        began = time.perf_counter()
        results[row] = ROWS[row](range(given.first, given.first + given.seeds))
        print(f"   {time.perf_counter() - began:.0f} s", flush=True)
        if given.json:
            text = json.dumps(results, indent=1, default=lambda x: np.asarray(x).tolist())
            pathlib.Path(given.json).write_text(text)


if __name__ == "__main__":
    main()
