"""Campaigns of random records: structure test, short noisy records, well-posed records."""

import numpy as np
import scipy.stats

import jaxgray
from jaxgray.identification.validation.structure_test import SIGNIFICANCE

from .common import TRUTH, data, in_children, show

MORE = 6
"""Parameters of three coordinates seen at two beyond M, D, K of two: 18, less 3 of a change of the third, less 9."""


def structure_record(seed, dofs, h=0.01):
    """Record of a random chain, forces and sensors at its first two coordinates, noise 1 % of the outputs."""
    rng = np.random.default_rng(seed)
    M, D, K = data.random_system(rng, dofs)
    u = data.random_steps(rng, 4000, 2, h, (0.1, 1.0))
    clean = data.simulate(M, D, K, u, h, E=np.eye(dofs, 2))[:, :2]
    noise = 0.01 * clean.std(axis=0)
    return jaxgray.Record(u, clean + noise * rng.standard_normal(clean.shape), h), clean, noise


def optimal_power(found, record, clean, noise):
    """Power of the likelihood-ratio test that knows the third coordinate's form, at the same significance.

    The noise-free misfit of the best M, D, K of two coordinates over the noise is its noncentrality; best to first
    order about the model found, which counts where the misfit is small.
    """
    misfit = (clean - found.estimation[0].simulated) / noise
    if np.sum(misfit**2) < 400:
        J = (
            data.sensitivities((found.mass, found.damping, found.stiffness), record.u, record.sampling_time)
            / noise[:, None]
        )
        J = J.reshape(misfit.size, -1)
        Q, _ = np.linalg.qr(J / np.linalg.norm(J, axis=0))
        misfit = misfit.ravel() - Q @ (Q.T @ misfit.ravel())
    noncentrality = np.sum(misfit**2)
    return float(scipy.stats.ncx2.sf(scipy.stats.chi2.isf(SIGNIFICANCE, MORE), MORE, noncentrality)), noncentrality


def structure_chunk(dofs, seeds):
    """(fired, p, optimal power, noncentrality) of every seed, None where the identification failed."""
    out = []
    for seed in seeds:
        record, clean, noise = structure_record(seed, dofs)
        try:
            found = jaxgray.identify(record)
        except jaxgray.ComputationError as error:
            print(dofs, seed, error, flush=True)
            out.append(None)
            continue
        test = found.structure_test
        power = optimal_power(found, record, clean, noise) if dofs == 3 else (0.0, 0.0)
        out.append((not test.fits, test.p_value, *power))
    return out


VISIBLE = 0.99
"""Power of the optimal test from which a record shows its third mode."""


def row_structure(seeds):
    """How often the structure test rejects true M, D, K records, and records that show a third mode; ten of each a
    seed. More are drawn of the latter, until so many show it: in some the third mode hardly moves."""
    first, count = 10 * seeds.start, 10 * len(seeds)
    result = {"count": count}
    for name, dofs, drawn in (("true", 2, count), ("third mode", 3, count + count // 5)):
        chunks = [range(k, min(k + 100, first + drawn)) for k in range(first, first + drawn, 100)]
        parts = [one for part in in_children(structure_chunk, [(dofs, chunk) for chunk in chunks]) for one in part]
        table = np.array([one for one in parts if one is not None], dtype=float)
        result[name] = {
            "fired": table[:, 0],
            "p_value": table[:, 1],
            "optimal": table[:, 2:],
            "failed": drawn - len(table),
        }
    false, third = result["true"], result["third mode"]
    print(
        f"fires on {int(false['fired'].sum())} of {count} true M, D, K records (bar 2 %); smallest p "
        f"{np.sort(false['p_value'])[:5].round(4).tolist()}; {false['failed']} failures",
        flush=True,
    )
    power, noncentrality = third["optimal"].T
    shows = np.flatnonzero(power > VISIBLE)[:count]
    drawn = int(shows[-1]) + 1
    print(
        f"fires on {int(third['fired'][shows].sum())} of {len(shows)} that show a third mode (bar 95 %); "
        f"{third['failed']} failures",
        flush=True,
    )
    print(
        f"    of all {drawn} drawn for them it fires on {int(third['fired'][:drawn].sum())}; the optimal test, which "
        f"knows the third mode's form, would on {power[:drawn].sum():.1f}",
        flush=True,
    )
    for k in np.flatnonzero(third["fired"][:drawn] == 0):
        print(f"    missed: misfit over noise {noncentrality[k]:.1f} (χ²), optimal power {power[k]:.3f}", flush=True)
    return result


SHORT_NOISE = 1.6
"""Noise of the short records, relative to the outputs."""


def short_chunk(seeds):
    """Per short noisy record: whether ours and the unconstrained are indefinite, and the errors of both."""
    out = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        u = data.random_steps(rng, 400, 2, 0.02, (0.1, 1.0))
        clean = data.simulate(*TRUTH, u, 0.02)
        y = clean + SHORT_NOISE * clean.std(axis=0) * rng.standard_normal(clean.shape)
        try:
            found = jaxgray.identify(jaxgray.Record(u, y, 0.02))
        except jaxgray.ComputationError as error:
            print(seed, error, flush=True)
            continue
        ours = (found.mass, found.damping, found.stiffness)
        lowest = [np.linalg.eigvalsh(X)[0] / np.linalg.eigvalsh(X)[-1] for X in ours]
        free = unconstrained_fit(u, y, 0.02, ours)
        out.append(
            (
                not (lowest[0] > 0 and lowest[1] > -1e-9 and lowest[2] > -1e-9),
                any(np.linalg.eigvalsh(X)[0] < 0 for X in free),
                *data.relative_errors(ours, TRUTH),
                *data.relative_errors(free, TRUTH),
            )
        )
    return out


def row_indefinite(seeds):
    """Short, noisy records: no indefinite result, median error no worse than unconstrained least squares."""
    first, count = 10 * seeds.start, 10 * len(seeds)
    table = np.array(in_children(short_chunk, [(range(first, first + count),)])[0], dtype=float)
    ours, theirs = table[:, 2:5], table[:, 5:]
    both = np.median(ours, axis=0), np.median(theirs, axis=0)
    print(
        f"{count} short noisy records, {count - len(table)} failures: {int(table[:, 0].sum())} indefinite (bar 0); "
        f"unconstrained {int(table[:, 1].sum())} (needs ≥ 10 %)",
        flush=True,
    )
    show("    median error", both[0])
    show("    unconstrained median error", both[1])
    show("    median over the records of the ratio of errors", np.median(ours / theirs, axis=0))
    apart = table[:, 1] > 0
    show("    the same where the unconstrained is indefinite", np.median(ours[apart] / theirs[apart], axis=0))
    return {"indefinite": table[:, 0].sum(), "unconstrained": table[:, 1].sum(), "medians": both}


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


FORMS = (
    (1, "zero", ("displacement",)),
    (1, "linear", ("acceleration",)),
    (2, "zero", ("displacement", "displacement")),
    (2, "zero", ("velocity", "displacement")),
    (2, "linear", ("displacement", "displacement")),
    (2, "linear", ("acceleration", "acceleration")),
    (3, "zero", ("displacement", "displacement", "displacement")),
    (3, "linear", ("acceleration", "displacement", "velocity")),
)


def well_posed_chunk(form, seeds):
    """Per record the failure, or None, and the largest error of an entry in standard errors."""
    n, hold, measured = form
    out = []
    for seed in seeds:
        rng = np.random.default_rng([seed, n])
        M, D, K = data.random_system(rng, n)
        # Units and time scale of its own, a sampling rate of 25 to 150 samples a radian of the mean motion.
        size, h = 10.0 ** rng.uniform(-4, 4), 10.0 ** rng.uniform(-2.6, -1.9)
        u = (
            data.random_steps(rng, 4000, n, h, (0.1, 1.0))
            if hold == "zero"
            else data.smooth_noise(rng, 4000, n, 10 * h)
        )
        x0 = rng.standard_normal(2 * n) * np.repeat([0.003, 0.03], n)
        y = data.simulate(M, D, K, u, h, hold=hold, measured=measured, x0=x0)
        y = y + rng.uniform(-1, 1, n) * y.std(axis=0)
        y = y + 10 ** rng.uniform(-3, -1.5) * y.std(axis=0) * rng.standard_normal(y.shape)
        try:
            found = jaxgray.identify(jaxgray.Record(u * size, y, h, hold=hold, measured=measured))
        except (jaxgray.ComputationError, ValueError) as error:
            out.append((str(error), np.inf))
            continue
        truth = [X * size for X in (M, D, K)]
        deviations = [
            np.max(np.abs(X - Y) / np.maximum(found.standard_errors[name], 1e-300))
            for X, Y, name in zip((found.mass, found.damping, found.stiffness), truth, found.standard_errors)
        ]
        out.append((None, max(deviations)))
    return out


def row_well_posed(seeds):
    """Random well-posed records of eight forms: none may fail; ten a seed."""
    count = 10 * len(seeds) // len(FORMS)
    first = 10 * seeds.start
    parts = in_children(well_posed_chunk, [(form, range(first, first + count)) for form in FORMS])
    failures = [(form, one[0]) for form, part in zip(FORMS, parts) for one in part if one[0] is not None]
    deviations = np.array([one[1] for part in parts for one in part])
    total = len(deviations)
    print(f"{total} random well-posed records: {len(failures)} failures (bar 0)", flush=True)
    for form, message in failures:
        print("   ", *form, message, flush=True)
    quantiles = np.quantile(deviations, [0.5, 0.9, 0.99, 1.0]).round(2).tolist()
    print(f"    largest error of an entry in standard errors, quantiles 50, 90, 99, 100 %: {quantiles}", flush=True)
    return {"failures": len(failures), "records": total, "deviations": deviations}
