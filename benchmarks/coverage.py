"""Do 95 % intervals hold 95 % of the truths, and are errors as small as can be? And if not, does the result say so?

    python benchmarks/coverage.py [--noise white ...] [--decibels 60 40 20 10 0] [--samples 200 2000 20000]
        [--loops open closed] [--systems "two close" ...] [--records 21] [--first 0] [--json OUT]

A cell is a kind of noise, a signal-to-noise ratio of displacements, a length, and an open or a closed loop. Its records
are of random systems of seven kinds in turn, with noise of the same share of every output:

- white: of the sensors; coloured: of the sensors, autoregressive with a pole at 0.95; quantised: rounding to steps;
- process: half of it white noise at the forces, half white noise of the sensors; innovations: the same, identified with
  noise="innovations".

In a closed loop a controller of known gains acts on what the sensors say: proportional, and a filtered derivative. Its
forces are recorded beside the reference.

The bound is that of Cramér and Rao for M, D, K with first states, offsets and the noise's variances unknown, at the
true parameters: differences of the prediction errors of the true noise model, over the inputs that were recorded. For
quantised records it is that of white noise of the same power. Data and bounds are computed by SciPy alone.

Of every cell: root mean square of error over bound, coverage of the intervals of entries, natural frequencies and
damping ratios, the share of results with a warning; and the same of results without one. A cell fails where these leave
0.9 to 1.1 or 93 to 97 % by --sure standard errors, taken between records, where there are ten of them or more.
"""

import argparse
import collections
import itertools
import json
import os
import pathlib
import sys
import time
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

import jax  # noqa: E402
import numpy as np  # noqa: E402
import scipy.linalg  # noqa: E402
import scipy.optimize  # noqa: E402
import scipy.signal  # noqa: E402

jax.config.update("jax_enable_x64", True)

import independent  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.mechanics.modal_uncertainty import mode_errors  # noqa: E402

SYSTEMS = ("one light", "one heavy", "two light", "two heavy", "two close", "three light", "three heavy")
DOFS = {"one": 1, "two": 2, "three": 3}
NOISES = ("white", "coloured", "quantised", "process", "innovations")
POLE = 0.95
"""Of coloured noise, from sample to sample."""
KEEP = np.exp(-1)
"""Of the controller's filtered slope, from sample to sample."""
NORMAL = 1.959964
GROUPS = ("mass", "damping", "stiffness", "frequency", "ratio")


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


def judged(cell, kind, seed):
    """Errors of one record over the bound and over the standard errors, group by group, and what the result said."""
    noise, decibels, samples, loop = cell
    rng = np.random.default_rng(
        [seed, SYSTEMS.index(kind), samples, int(decibels), NOISES.index(noise), loop == "open"]
    )
    truth, h, u, y, force, sensor = record_of(rng, kind, noise, decibels, samples, loop)
    n = len(truth[0])
    rows, columns = np.triu_indices(n)
    about = {"noise": noise, "decibels": decibels, "samples": samples, "loop": loop, "system": kind, "seed": seed}
    begun = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            options = {"noise": "innovations"} if noise == "innovations" else {}
            found = jaxgray.identify(jaxgray.Record(u, y, h), **options)
    except (jaxgray.ComputationError, ValueError) as error:
        return about | {"refused": str(error)}
    about["seconds"] = time.perf_counter() - begun
    flat = np.concatenate([X[rows, columns] for X in truth])
    entries = np.concatenate([X[rows, columns] for X in (found.mass, found.damping, found.stiffness)]) - flat
    covariance = bound(truth, h, u, y, noise, force, sensor)
    upper = [(r, c) for c in range(n) for r in range(c + 1)]
    order = [upper.index(pair) for pair in zip(rows, columns)]
    own = np.sqrt(np.diag(found.covariance)).reshape(3, -1)[:, order].ravel()

    def modes_at(theta):
        matrices = np.zeros((3, n, n))
        matrices[:, rows, columns] = matrices[:, columns, rows] = theta.reshape(3, -1)
        return modes(*matrices)

    steps = 1e-6 * np.repeat([np.linalg.norm(X) for X in truth], len(rows))
    slopes = [(modes_at(flat + s * e) - modes_at(flat - s * e)) / (2 * s) for s, e in zip(steps, np.eye(len(flat)))]
    slopes = np.array(slopes).T
    modal = modes(found.mass, found.damping, found.stiffness) - modes_at(flat)
    f_error, ratio_error, _ = mode_errors(found.model, found.covariance)
    error = np.concatenate([entries, modal])
    least = np.sqrt(np.concatenate([np.diag(covariance), np.diag(slopes @ covariance @ slopes.T)]))
    stated = np.concatenate([own, f_error, ratio_error])
    groups = np.repeat(GROUPS, [len(rows)] * 3 + [n] * 2)
    covered = np.abs(error) <= NORMAL * stated
    for name in GROUPS:
        here = groups == name
        about[name] = {"squared": float(np.mean((error / least)[here] ** 2)), "covered": float(np.mean(covered[here]))}
        about[name]["stated"] = float(np.mean((stated / least)[here]))
    return about | {"warnings": list(found.warnings)}


def mean_of(values):
    """Mean between records and its standard error."""
    values = np.array([value for value in values if np.isfinite(value)])
    return (np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else (np.nan, np.nan)


def summary(rows):
    """Root mean square over the bound and coverage [%] with standard errors, all entries and every group."""
    out = {"records": len(rows)}
    sets = {"all": GROUPS[:3]} | {name: (name,) for name in GROUPS}
    for name, parts in sets.items():
        square, spread = mean_of([np.mean([row[part]["squared"] for part in parts]) for row in rows])
        covered = mean_of([100 * np.mean([row[part]["covered"] for part in parts]) for row in rows])
        out[name] = {"ratio": [np.sqrt(square), spread / 2 / np.sqrt(square)], "covered": list(covered)}
    return out


def fails(found, sure):
    """What of a summary lies outside the bars by more than so many standard errors."""
    said = []
    if found["records"] < 10:
        return said
    for name in ("all", "frequency", "ratio"):
        for what, low, high in (("ratio", 0.9, 1.1), ("covered", 93.0, 97.0)):
            value, spread = found[name][what]
            if value + sure * spread < low or value - sure * spread > high:
                said.append(f"{name} {what} {value:.2f} ± {spread:.2f}")
    return said


def line(name, rows, sure):
    """A printed line of a cell, and its summaries."""
    answered = [row for row in rows if "refused" not in row]
    quiet = [row for row in answered if not row["warnings"]]
    text = f"{name:38s}{len(answered):4d}"
    whole = {"refused": len(rows) - len(answered), "told": summary(answered), "quiet": summary(quiet)}
    for part in ("told", "quiet"):
        found = whole[part]
        text += f"  {found['all']['ratio'][0]:7.3g} ±{found['all']['ratio'][1]:5.2g}"
        for group in ("all", "frequency", "ratio"):
            text += f" {found[group]['covered'][0]:5.1f} ±{found[group]['covered'][1]:4.1f}"
        if part == "told":
            text += f"  {100 * (1 - len(quiet) / max(len(answered), 1)):4.0f} %"
    failed = fails(whole["quiet"], sure)
    print(text + (f"  FAILS: {'; '.join(failed)}" if failed else ""), flush=True)
    return whole | {"fails": failed}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", nargs="*", choices=NOISES, default=list(NOISES))
    parser.add_argument("--decibels", nargs="*", type=float, default=[60.0, 40.0, 20.0, 10.0, 0.0])
    parser.add_argument("--samples", nargs="*", type=int, default=[200, 2000, 20000])
    parser.add_argument("--loops", nargs="*", choices=("open", "closed"), default=["open", "closed"])
    parser.add_argument("--systems", nargs="*", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--records", type=int, default=21, help="of a cell")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--sure", type=float, default=3.0, help="standard errors")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    head = f"{'':38s}{'all results: error over bound, coverage [%] of entries, f, ζ; warned':>60s}; without warning"
    print(head, flush=True)
    rows, cells = [], {}
    for cell in itertools.product(arguments.noise, arguments.decibels, arguments.samples, arguments.loops):
        here = []
        for k in range(arguments.records):
            kind = arguments.systems[k % len(arguments.systems)]
            here.append(judged(cell, kind, arguments.first + k // len(arguments.systems)))
        rows += here
        name = f"{cell[0]}, {cell[1]:g} dB, {cell[2]}, {cell[3]}"
        cells[name] = line(name, here, arguments.sure)
        if arguments.json:
            pathlib.Path(arguments.json).write_text(json.dumps({"cells": cells, "records": rows}, indent=1))
    print("pooled")
    pooled = {}
    for key in ("noise", "decibels", "samples", "loop", "system"):
        for value in dict.fromkeys(row[key] for row in rows):
            here = [row for row in rows if row[key] == value]
            pooled[f"{key} {value}"] = line(f"{key} {value}", here, arguments.sure)
    answered = [row for row in rows if "refused" not in row]
    kinds = collections.Counter(" ".join(text.split()[:6]) for row in answered for text in row["warnings"])
    for text, count in kinds.most_common():
        print(f"{count:5d} × {text} …")
    for why, count in collections.Counter(row["refused"] for row in rows if "refused" in row).most_common():
        print(f"{count:5d} refused: {why}")
    if arguments.json:
        whole = {"cells": cells, "pooled": pooled, "warnings": kinds, "records": rows}
        pathlib.Path(arguments.json).write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    main()
