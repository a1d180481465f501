"""The worked examples of learning, each on 20 unseen records: acceptance figures beside their bars.

    python benchmarks/learning.py [--part weights force excitation] [--records 20] [--first SEED] [--json OUT]

Data come from SciPy, in the examples themselves, never from jaxgray.

weights: τ and weights of the samples learned on four records; the default is `identify(refine=False)`, τ and block
rows chosen from its grid and the input matrix the better of its two ways. Error of the free run on new motion,
noise-free: no worse in every quartile, better in the median.

force: matrices and network trained together on every record: every entry of M, D, K within three standard errors of
the truth, held-out error below that of the best linear model.

excitation: of as many rough models and random phases: variance of the chosen entry predicted before against that found
over the realisations (within 20 %), and against that of the plain excitation (at least 2 times smaller).
"""

import argparse
import importlib.util
import json
import os
import pathlib
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / "examples"
SEED = 5000
"""Of the first record, where none is given: no example, and no choice in one, has seen these."""


def example(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def weights(records, first):
    """Quartiles of the error with the default and with what was learned."""
    module = example("learned_weights")
    found = module.run(0, range(first, first + records), 40)
    quartiles = {name: np.quantile(found[name], [0, 0.25, 0.5, 0.75, 1]).tolist() for name in ("default", "learned")}
    for name, q in quartiles.items():
        print(f"weights    {name:8s} error in % of the motion: " + "  ".join(f"{100 * v:.3f}" for v in q))
    better = [a < b for a, b in zip(quartiles["learned"], quartiles["default"])]
    print(f"weights    better in (least, quartile, median, quartile, worst): {better}", flush=True)
    return {"error": {k: found[k].tolist() for k in quartiles}, "quartiles": quartiles, "met": all(better[1:4])}


def force(records, first):
    """Deviations of M, D, K in standard errors, and held-out errors, of every record."""
    module = example("learned_force")
    rows = []
    for seed in range(first, first + records):
        found = module.run(seed, 1500)
        z = (found["joint"] - found["truth"]) / found["standard_errors"]
        linear = np.abs(found["linear"] - found["truth"]) / found["standard_errors"]
        rows.append(
            {
                "z": z.tolist(),
                "linear": linear.tolist(),
                **{k: found[k] for k in ("physics_alone", "with_network", "noise")},
            }
        )
        print(
            f"force      record {seed}: largest deviation {np.abs(z).max():.2f} standard errors (linear model "
            f"{linear.max():.0f}), held out {100 * found['with_network']:.2f} % against "
            f"{100 * found['physics_alone']:.2f} %, noise {100 * found['noise']:.2f} %",
            flush=True,
        )
    z = np.abs([row["z"] for row in rows])
    lower = sum(row["with_network"] < row["physics_alone"] for row in rows)
    print(
        f"force      entries within 3 standard errors: {np.sum(z < 3)} of {z.size}; root mean square {rms(z):.2f}; "
        f"records with all: {np.sum(np.all(z < 3, axis=1))} of {records}; held-out error lower: {lower} of {records}",
        flush=True,
    )
    return {"records": rows, "met": bool(np.all(z < 3)) and lower == records}


def rms(x):
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def excitation(records, first):
    """Predicted and found variance of the chosen entry, over several designs."""
    module = example("designed_excitation")
    rows = []
    for seed in range(first, first + records):
        found = module.run(seed, 400, 40)
        chosen = module.CHOSEN
        row = {name: {k: float(part[k][chosen]) for k in ("predicted", "found")} for name, part in found.items()}
        row["gain"] = row["plain"]["found"] / row["designed"]["found"]
        row["ratio"] = row["designed"]["predicted"] / row["designed"]["found"]
        rows.append(row)
        print(
            f"excitation design {seed}: predicted over found variance {row['ratio']:.3f}, "
            f"{row['gain']:.2f} times smaller than plain",
            flush=True,
        )
    ratio, gain = np.array([r["ratio"] for r in rows]), np.array([r["gain"] for r in rows])
    inside = np.abs(ratio - 1) < 0.2
    print(
        f"excitation predicted over found: mean {ratio.mean():.3f}, within 20 % in {inside.sum()} of {records} (400 "
        f"realisations each know it to 7 %); gain {gain.min():.2f} to {gain.max():.2f}",
        flush=True,
    )
    return {"designs": rows, "met": bool(inside.all() and gain.min() >= 2)}


PARTS = {"weights": weights, "force": force, "excitation": excitation}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--records", type=int, default=20)
    parser.add_argument("--first", type=int, default=SEED, help="seed of the first record")
    parser.add_argument("--json", type=pathlib.Path)
    arguments = parser.parse_args()
    results = {}
    for name in arguments.part:
        begun = time.perf_counter()
        results[name] = PARTS[name](arguments.records, arguments.first)
        results[name]["seconds"] = time.perf_counter() - begun
        print(f"{name:10s} {'met' if results[name]['met'] else 'NOT MET'} in {results[name]['seconds']:.0f} s")
        if arguments.json:
            arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
