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
import pathlib
import time
import warnings

import numpy as np
from accuracy.known_noise import NOISES, SYSTEMS, bound, modes, record_of

import jaxgray
from jaxgray.mechanics.modal_uncertainty import mode_errors

NORMAL = 1.959964
GROUPS = ("mass", "damping", "stiffness", "frequency", "ratio")


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
            if what == "covered":
                # All or none covered in a few records has a spread, too.
                spread = max(spread, 100 * np.sqrt(0.95 * 0.05 / found["records"]))
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
    kinds = collections.Counter(" ".join(text.split()[:3]) for row in answered for text in row["warnings"])
    for text, count in kinds.most_common():
        print(f"{count:5d} × {text} …")
    for why, count in collections.Counter(row["refused"] for row in rows if "refused" in row).most_common():
        print(f"{count:5d} refused: {why}")
    if arguments.json:
        whole = {"cells": cells, "pooled": pooled, "warnings": kinds, "records": rows}
        pathlib.Path(arguments.json).write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    main()
