"""Accuracy of the identification on the paper's reference system, row by row.

    python benchmarks/identification_accuracy.py [--row NAME ...] [--seeds 20] [--json OUT]

Data come from SciPy (tests/independent.py), never from jaxgray. Every row prints figures beside the bar they
are held against, and fails loudly where a run fails.
"""

import argparse
import json
import os
import pathlib
import sys
import time
import warnings

os.environ.setdefault("NPROC", "4")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402

warnings.simplefilter("ignore", jaxgray.RecordWarning)

H = data.REFERENCE_TIME
TRUTH = tuple(data.REFERENCE.values())
PAPER = {"time_constants": 0.15, "block_rows": 10}
NAMES = ("M", "D", "K")


def identified(record, **options):
    found = jaxgray.identify(record, **options)
    return found, data.relative_errors((found.mass, found.damping, found.stiffness), TRUTH)


def show(title, figures):
    print(f"{title:58s}" + "  ".join(f"{n} {v:.5f}" for n, v in zip(NAMES, figures)), flush=True)


def bound(u, *, noise=data.REFERENCE_NOISE, kept=None, records=None):
    """Cramér-Rao bound of the entries (upper triangles of M, D, K), initial state and offsets estimated too.

    Sensitivities by central differences of the independent simulator.
    """
    information = 0.0
    for inputs in records or [u]:
        mask = np.ones((len(inputs), 2)) if kept is None else kept
        J = (data.sensitivities(TRUTH, inputs, H) * mask[..., None]).reshape(-1, 15) / noise
        I = J.T @ J
        information = information + I[:9, :9] - I[:9, 9:] @ np.linalg.solve(I[9:, 9:], I[9:, :9])
    return np.linalg.inv(information)


def bound_norms(covariance):
    """RMS relative Frobenius error at the bound; off-diagonal entries count twice."""
    twice = np.tile([1.0, 2.0, 1.0], 3) * np.diag(covariance)
    return np.sqrt(twice.reshape(3, 3).sum(axis=1)) / [np.linalg.norm(X) for X in TRUTH]


def row_paper(seeds):
    result = {}
    for name, options in (
        ("exact map at the paper's τ, i", PAPER),
        ("paper's map at the paper's τ, i", PAPER | {"map": "paper"}),
        ("paper's map and rows (N4SID) there", PAPER | {"map": "paper", "weight": "n4sid"}),
        ("automatic choice, start alone", {}),
    ):
        errors = []
        for seed in range(seeds):
            u, y, _ = data.reference_record(seed)
            errors.append(identified(jaxgray.Record(u, y, H), refine=False, **options)[1])
        show(f"{name}: median", np.median(errors, axis=0))
        show(f"{name}: worst", np.max(errors, axis=0))
        result[name] = {"median": np.median(errors, axis=0), "worst": np.max(errors, axis=0)}
    show("published (paper, τ = 0.15, i = 10)", (0.0303, 0.125, 0.00108))
    return result


def row_realisations(seeds):
    """One input, 50 noises per seed (1000 by default) in batches: error over bound, and coverage of the intervals."""
    u, _, clean = data.reference_record(0)
    covariance = bound(u)
    truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
    deviations, standard, alone, failed = [], [], 0, 0
    for part in range(seeds):
        rng = np.random.default_rng(10_000 + part)
        records = [
            jaxgray.Record(u, clean + data.REFERENCE_NOISE * rng.standard_normal(clean.shape), H) for _ in range(50)
        ]
        found = jaxgray.identify_many(records, time_constants=0.05, block_rows=8)
        alone += int(found.alone.sum())
        failed += int((~found.successful).sum())
        good = found.successful
        matrices = (found.mass, found.damping, found.stiffness)
        deviations.append(np.concatenate([X[:, (0, 0, 1), (0, 1, 1)] for X in matrices], axis=1)[good] - truth)
        standard.append(np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[good])
    deviations, standard = np.concatenate(deviations), np.concatenate(standard)
    twice = np.tile([1.0, 2.0, 1.0], 3)
    squares = (twice * np.mean(deviations**2, axis=0)).reshape(3, 3).sum(axis=1)
    ratio = np.sqrt(squares / (twice * np.diag(covariance)).reshape(3, 3).sum(axis=1))
    covered = 100 * np.mean(np.abs(deviations) < 1.959964 * standard, axis=0)
    show(f"{len(deviations)} realisations: RMS error / bound (bar 0.95 to 1.05)", ratio)
    print(f"    coverage of 95 % intervals, nine entries (bar 93 to 97 %): {covered.round(1).tolist()}")
    print(f"    identified one by one {alone}, failed {failed}", flush=True)
    return {"ratio": ratio, "coverage_percent": covered, "alone": alone, "failed": failed}


def row_weights(seeds):
    result = {}
    for weight in ("moesp", "n4sid", "cva", "past-inputs"):
        for way in ("best", "record", "factor"):
            errors = []
            for seed in range(seeds):
                u, y, _ = data.reference_record(seed)
                errors.append(
                    identified(jaxgray.Record(u, y, H), refine=False, weight=weight, input_matrix_from=way)[1]
                )
            result[f"{weight} {way}"] = np.median(errors, axis=0)
            show(f"{weight}, input matrix from {way}: median", result[f"{weight} {way}"])
            ratio = result[f"{weight} {way}"] / result["moesp best"]
            show("    ratio to the default (bar 2, past-inputs 3)", ratio)
    return result


def row_offset(seeds):
    cases = {
        "plain": {},
        "offset 0.01": {"offset": 0.01},
        "not at rest": {"x0": [0.01, -0.02, 0.05, 0.1]},
        "both": {"offset": 0.01, "x0": [0.01, -0.02, 0.05, 0.1]},
    }
    result = {}
    for refine in (False, True):
        for name, options in cases.items():
            errors = []
            for seed in range(seeds):
                u, y, _ = data.reference_record(seed, **options)
                errors.append(identified(jaxgray.Record(u, y, H), refine=refine)[1])
            label = f"{'refined' if refine else 'start'}, {name}"
            result[label] = np.median(errors, axis=0)
            show(f"{label}: median", result[label])
            if name != "plain":
                plain = result[f"{'refined' if refine else 'start'}, plain"]
                show("    ratio to plain (bar 1.1)", result[label] / plain)
    return result


def row_missing(seeds):
    result = {}
    errors, norms = [], []
    for seed in range(seeds):
        u, y, _ = data.reference_record(seed)
        kept = np.random.default_rng(1000 + seed).random(y.shape) > 0.1
        found, e = identified(jaxgray.Record(u, np.where(kept, y, np.nan), H))
        errors.append(e)
        norms.append(bound_norms(bound(u, kept=kept.astype(float))))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.sqrt(np.mean(np.square(norms), axis=0))
    show("10 % of samples missing: RMS error / bound (bar 1.1)", ratio)
    result["missing"] = ratio
    errors, norms = [], []
    for seed in range(seeds):
        pair = [data.reference_record(s, samples=10000) for s in (seed, 500 + seed)]
        found, e = identified([jaxgray.Record(u, y, H) for u, y, _ in pair])
        errors.append(e)
        norms.append(bound_norms(bound(None, records=[u for u, _, _ in pair])))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.sqrt(np.mean(np.square(norms), axis=0))
    show("two records: RMS error / bound (bar 1.1)", ratio)
    result["two records"] = ratio
    return result


def row_scaling(seeds):
    u, y, _ = data.reference_record(0, samples=6000)
    base, _ = identified(jaxgray.Record(u, y, H))
    worst = 0.0
    for su, sy, st in ((1e6, 1, 1), (1e-6, 1, 1), (1, 1e6, 1), (1, 1e-6, 1), (1, 1, 1e3), (1, 1, 1e-3)):
        found = jaxgray.identify(jaxgray.Record(u * su, y * sy, H * st))
        back = (
            found.mass / su * sy / st**2,
            found.damping / su * sy / st,
            found.stiffness / su * sy,
        )
        worst = max(worst, data.relative_errors(back, (base.mass, base.damping, base.stiffness)).max())
    print(f"rescaled by 1e±6, time by 1e±3: worst difference {worst:.1e} (bar 1e-6)", flush=True)
    return {"worst": worst}


def row_manipulator(seeds):
    """The paper's micro manipulator: eigenfrequencies 83.107 and 96.729 Hz."""
    target = np.array([83.107, 96.729])
    w = 2 * np.pi * target
    shapes = np.array([[1.0, 0.25], [-0.2, 1.0]])
    M = np.diag([3.2e-6, 2.9e-6])
    L = np.linalg.cholesky(M)
    Q, _ = np.linalg.qr(shapes)
    K = L @ Q @ np.diag(w**2) @ Q.T @ L.T
    D = L @ Q @ np.diag(2 * 0.02 * w) @ Q.T @ L.T
    worst = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 10000, 2, 1e-4, (0.002, 0.03))
        y = data.simulate(M, D, K, u, 1e-4)
        y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
        found = jaxgray.identify(jaxgray.Record(u, y, 1e-4))
        values = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(found.mass, found.stiffness)).real)) / 2 / np.pi
        worst.append(np.max(np.abs(values / target - 1)))
    print(f"micro manipulator: worst frequency error {100 * max(worst):.4f} % (bar 0.1 %)", flush=True)
    return {"worst_percent": 100 * max(worst)}


def row_process_noise(seeds):
    """White force noise whose output is half of the output noise; bound of the innovations likelihood."""
    A, B = data.state_space(*TRUTH, np.eye(2))
    result = {}
    probe = np.random.default_rng(0).standard_normal((20000, 2))
    level = data.simulate(*TRUTH, np.zeros((20000, 2)), H, w=probe).std(axis=0).mean()
    force = 0.5 * data.REFERENCE_NOISE / level
    errors = {"innovations": [], "output-error": []}
    norms = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 20000, 2, H)
        w = force * rng.standard_normal(u.shape)
        y = data.simulate(*TRUTH, u, H, w=w) + data.REFERENCE_NOISE * rng.standard_normal(u.shape)
        for noise, found in errors.items():
            found.append(identified(jaxgray.Record(u, y, H), noise=noise)[1])
        norms.append(bound_norms(innovations_bound(u, force)))
    for noise, found in errors.items():
        ratio = np.sqrt(np.mean(np.square(found), axis=0)) / np.sqrt(np.mean(np.square(norms), axis=0))
        show(f"process noise, {noise}: RMS error / bound (bar 1.1)", ratio)
        result[noise] = ratio
    return result


def innovations_bound(u, force):
    """Bound with known noise covariances: sensitivities filtered by the true stationary Kalman filter."""
    import scipy.linalg
    import scipy.signal

    A, B = data.state_space(*TRUTH, np.eye(2))
    C = np.eye(2, 4)
    block = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * H)
    Ad, Bd = block[:4, :4], block[:4, 4:]
    R = data.REFERENCE_NOISE**2 * np.eye(2)
    P = scipy.linalg.solve_discrete_are(Ad.T, C.T, force**2 * Bd @ Bd.T, R)
    S = C @ P @ C.T + R
    G = Ad @ P @ C.T @ np.linalg.inv(S)
    white = np.linalg.inv(np.linalg.cholesky(S))
    J = []
    for column in np.moveaxis(data.sensitivities(TRUTH, u, H), -1, 0):
        x = np.zeros(4)
        out = np.empty_like(column)
        for k, e in enumerate(column):
            out[k] = e - C @ x
            x = Ad @ x + G @ out[k]
        J.append((out @ white.T).ravel())
    J = np.stack(J, axis=1)
    I = J.T @ J
    return np.linalg.inv(I[:9, :9] - I[:9, 9:] @ np.linalg.solve(I[9:, 9:], I[9:, :9]))


BASE = (np.diag([2.0, 1.0]), np.array([[1.2, -0.4], [-0.4, 0.9]]), np.array([[300.0, -120.0], [-120.0, 200.0]]))


def row_base(seeds):
    """Base acceleration, relative displacement: errors of M⁻¹D and M⁻¹K, with and without known masses."""
    h, noise, r = 0.01, 2e-5, np.ones((2, 1))
    A22, A21 = (np.linalg.solve(BASE[0], X) for X in BASE[1:])
    errors = {"masses given": [], "masses not given": []}
    norms = {name: [] for name in errors}

    def run(damping, stiffness, u, **options):
        return data.simulate(np.eye(2), damping, stiffness, u, h, E=-r, hold="linear", **options)

    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        u = data.smooth_noise(rng, 6000, 1, 0.2)
        clean = run(A22, A21, u)
        record = jaxgray.Record(u, clean + noise * rng.standard_normal(clean.shape), h, hold="linear")
        columns = {"masses not given": [], "masses given": []}
        for place in range(2):
            for k in np.ndindex(2, 2):
                free, tied = np.zeros((2, 2)), np.zeros((2, 2))
                free[k] = 1.0
                tied[k] = tied[k[::-1]] = 1.0
                moves = {"masses not given": free}
                if k[0] <= k[1]:
                    moves["masses given"] = np.linalg.solve(BASE[0], tied)
                for name, move in moves.items():
                    step = 1e-4 * np.linalg.norm((A22, A21)[place])
                    pair = []
                    for sign in (1, -1):
                        changed = [A22, A21]
                        changed[place] = changed[place] + sign * step * move
                        pair.append(run(*changed, u))
                    columns[name].append(((pair[0] - pair[1]) / (2 * step), (place, move)))
        nuisance = [run(A22, A21, 0 * u, x0=x0) for x0 in np.eye(4)]
        nuisance += [np.tile(row, (len(u), 1)) for row in np.eye(2)]
        for name, fix in (("masses given", "mass[0,0]=2,mass[0,1]=0,mass[1,1]=1"), ("masses not given", None)):
            J = np.stack([c.ravel() for c, _ in columns[name]] + [c.ravel() for c in nuisance], axis=1) / noise
            count = len(columns[name])
            cov = np.linalg.inv(J.T @ J)[:count, :count]
            figure = []
            for place, truth in enumerate((A22, A21)):
                T = np.stack([m.ravel() * (q == place) for _, (q, m) in columns[name]], axis=1)
                figure.append(np.sqrt(np.trace(T @ cov @ T.T)) / np.linalg.norm(truth))
            norms[name].append(figure)
            found = jaxgray.identify(record, excitation="base-acceleration", relative=True, fix=fix)
            pair = (np.linalg.solve(found.mass, found.damping), np.linalg.solve(found.mass, found.stiffness))
            errors[name].append(data.relative_errors(pair, (A22, A21)))
    result = {}
    for name in errors:
        result[name] = np.sqrt(np.mean(np.square(errors[name]), 0)) / np.sqrt(np.mean(np.square(norms[name]), 0))
        print(f"base excitation, {name}: RMS error / bound of M⁻¹D, M⁻¹K {result[name].round(3)} (bar 1.1)", flush=True)
    return result


def row_structure(seeds):
    """How often the structure test rejects true M, D, K records, and records with a third mode."""
    count = 10 * max(seeds, 2)
    h, fired, failed = 0.01, {"true": 0, "third mode": 0}, 0
    for seed in range(count):
        for name, dofs in (("true", 2), ("third mode", 3)):
            rng = np.random.default_rng(seed)
            M, D, K = data.random_system(rng, dofs)
            u = data.random_steps(rng, 4000, 2, h, (0.1, 1.0))
            y = data.simulate(M, D, K, u, h, E=np.eye(dofs, 2))[:, :2]
            y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
            try:
                found = jaxgray.identify(jaxgray.Record(u, y, h))
            except jaxgray.ComputationError as error:
                failed += 1
                print(name, seed, error)
                continue
            fired[name] += not found.structure_test.fits
    print(f"structure test fires on {fired['true']} of {count} true records (bar 2 %),", end=" ")
    print(f"on {fired['third mode']} of {count} with a third mode (bar 95 %); {failed} failures", flush=True)
    return fired | {"count": count, "failed": failed}


def row_indefinite(seeds):
    """Short, noisy records: no indefinite result, median error no worse than unconstrained least squares."""
    count = max(seeds, 10) * 10
    indefinite = unconstrained = 0
    ours, theirs = [], []

    for seed in range(count):
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 400, 2, 0.02, (0.1, 1.0))
        clean = data.simulate(*TRUTH, u, 0.02)
        y = clean + 1.0 * clean.std(axis=0) * rng.standard_normal(clean.shape)
        found = jaxgray.identify(jaxgray.Record(u, y, 0.02))
        matrices = (found.mass, found.damping, found.stiffness)
        lowest = [np.linalg.eigvalsh(X)[0] / np.linalg.eigvalsh(X)[-1] for X in matrices]
        indefinite += not (lowest[0] > 0 and lowest[1] > -1e-9 and lowest[2] > -1e-9)
        free = unconstrained_fit(u, y, 0.02, (found.mass, found.damping, found.stiffness))
        unconstrained += any(np.linalg.eigvalsh(X)[0] < 0 for X in free)
        ours.append(data.relative_errors(matrices, TRUTH))
        theirs.append(data.relative_errors(free, TRUTH))
    print(
        f"{count} short noisy records: {indefinite} indefinite (bar 0); unconstrained indefinite {unconstrained} "
        "(needs ≥ 20 of 200)",
        flush=True,
    )
    show("    median error", np.median(ours, axis=0))
    show("    unconstrained median error", np.median(theirs, axis=0))
    return {
        "indefinite": indefinite,
        "unconstrained": unconstrained,
        "ratio": np.median(ours, 0) / np.median(theirs, 0),
    }


def unconstrained_fit(u, y, h, start):
    """Output-error least squares over symmetric M, D, K without the cone, by SciPy, from our answer."""
    import scipy.optimize

    pick = ((0, 0), (0, 1), (1, 1))
    scale = np.concatenate([np.full(3, np.linalg.norm(X)) for X in TRUTH])

    def matrices(p):
        p = p * scale
        return [np.array([[p[k], p[k + 1]], [p[k + 1], p[k + 2]]]) for k in (0, 3, 6)]

    def residual(p):
        try:
            e = y - data.simulate(*matrices(p[:9]), u, h, x0=p[9:13]) - p[13:]
        except np.linalg.LinAlgError:
            return np.full(y.size, 1e3)
        return np.clip(np.nan_to_num(e, nan=1e3), -1e3, 1e3).ravel()

    first = np.concatenate([[X[r, c] for X in start for r, c in pick] / scale, np.zeros(6)])
    return matrices(scipy.optimize.least_squares(residual, first, max_nfev=30).x[:9])


ROWS = {name[4:]: function for name, function in globals().items() if name.startswith("row_")}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", nargs="*", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    results = {}
    for row in arguments.row:
        start = time.perf_counter()
        print(f"== {row}", flush=True)
        results[row] = ROWS[row](arguments.seeds)
        print(f"   {time.perf_counter() - start:.0f} s", flush=True)
    if arguments.json:
        text = json.dumps(results, default=lambda x: np.asarray(x).tolist(), indent=1)
        pathlib.Path(arguments.json).write_text(text)


if __name__ == "__main__":
    main()
