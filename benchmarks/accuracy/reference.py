"""The paper's reference system: medians, weights, offsets, missing samples, units, noise at the forces."""

import numpy as np

import jaxgray

from .common import PAPER, TRUTH, H, bound, bound_norms, data, identified, ratio_of, show


def row_paper(seeds):
    result = {}
    for name, options in (
        ("exact map at the paper's τ, i", PAPER),
        ("paper's map at the paper's τ, i", PAPER | {"map": "paper"}),
        ("paper's map and rows (N4SID) there", PAPER | {"map": "paper", "weight": "n4sid"}),
        ("automatic choice, start alone", {}),
    ):
        errors = []
        for seed in seeds:
            u, y, _ = data.reference_record(seed)
            errors.append(identified(jaxgray.Record(u, y, H), refine=False, **options)[1])
        show(f"{name}: median", np.median(errors, axis=0))
        show(f"{name}: worst", np.max(errors, axis=0))
        result[name] = {"median": np.median(errors, axis=0), "worst": np.max(errors, axis=0)}
    show("published (paper, τ = 0.15, i = 10)", (0.0303, 0.125, 0.00108))
    return result


def row_paper_blocks(seeds):
    """The exact map at the paper's τ and i, three blocks of seeds: how much the medians themselves scatter."""
    result = []
    for block in range(3):
        errors = []
        for seed in range(seeds.start + block * len(seeds), seeds.start + (block + 1) * len(seeds)):
            u, y, _ = data.reference_record(seed)
            errors.append(identified(jaxgray.Record(u, y, H), refine=False, **PAPER)[1])
        result.append(errors)
        show(f"block {block + 1}: median (bars 0.03, 0.125, 0.015)", np.median(errors, axis=0))
    show("all blocks: median", np.median(np.concatenate(result), axis=0))
    return {"errors": result}


def row_weights(seeds):
    result = {}
    for weight in ("moesp", "n4sid", "cva", "past-inputs"):
        for way in ("best", "record", "factor"):
            errors = []
            for seed in seeds:
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
            for seed in seeds:
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
    for seed in seeds:
        u, y, _ = data.reference_record(seed)
        kept = np.random.default_rng(1000 + seed).random(y.shape) > 0.1
        found, e = identified(jaxgray.Record(u, np.where(kept, y, np.nan), H))
        errors.append(e)
        norms.append(bound_norms(bound(u, kept=kept.astype(float))))
    ratio = ratio_of(errors, norms)
    show("10 % of samples missing: RMS error / bound (bar 1.1)", ratio)
    result["missing"] = ratio
    errors, norms = [], []
    for seed in seeds:
        pair = [data.reference_record(s, samples=10000) for s in (seed, 500 + seed)]
        found, e = identified([jaxgray.Record(u, y, H) for u, y, _ in pair])
        errors.append(e)
        norms.append(bound_norms(bound(None, records=[u for u, _, _ in pair])))
    ratio = ratio_of(errors, norms)
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


def row_process_noise(seeds):
    """White force noise whose output is half of the output noise; bound of the innovations likelihood."""
    A, B = data.state_space(*TRUTH, np.eye(2))
    result = {}
    probe = np.random.default_rng(0).standard_normal((20000, 2))
    level = data.simulate(*TRUTH, np.zeros((20000, 2)), H, w=probe).std(axis=0).mean()
    force = 0.5 * data.REFERENCE_NOISE / level
    errors = {"innovations": [], "output-error": []}
    norms = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 20000, 2, H)
        w = force * rng.standard_normal(u.shape)
        y = data.simulate(*TRUTH, u, H, w=w) + data.REFERENCE_NOISE * rng.standard_normal(u.shape)
        for noise, found in errors.items():
            found.append(identified(jaxgray.Record(u, y, H), noise=noise)[1])
        norms.append(bound_norms(innovations_bound(u, force)))
    for noise, found in errors.items():
        ratio = ratio_of(found, norms)
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
