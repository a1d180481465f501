"""Cost and accuracy against the number of coordinates.

    python benchmarks/coordinates.py [--coordinates 1 2 3 4 6 8 10] [--samples 20000] [--start-only] [--json OUT]

Chains of masses with every coordinate driven and measured, 1 % noise, simulated by SciPy. Errors of the entries are
given in standard errors too, so that "right" means the same for every size; the noise-free start shows what the
subspace step alone loses.
"""

import argparse
import json
import os
import pathlib
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402

H = 0.01


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--coordinates", type=int, nargs="*", default=[1, 2, 3, 4, 6, 8, 10])
    parser.add_argument("--samples", type=int, default=20000)
    parser.add_argument("--start-only", action="store_true")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    results = []
    for n in arguments.coordinates:
        rng = np.random.default_rng(n)
        truth = data.random_system(rng, n)
        u = data.random_steps(rng, arguments.samples, n, H, (0.1, 1.0))
        clean = data.simulate(*truth, u, H)
        y = clean + 0.01 * clean.std(axis=0) * rng.standard_normal(clean.shape)
        exact = jaxgray.identify(jaxgray.Record(u, clean, H), refine=False)
        record = jaxgray.Record(u, y, H)
        row = {"coordinates": n}
        row["noise_free"] = data.relative_errors((exact.mass, exact.damping, exact.stiffness), truth).tolist()
        for kind in ("start", "refined")[: 1 if arguments.start_only else 2]:
            took = []
            for _ in range(2):
                began = time.perf_counter()
                found = jaxgray.identify(record, refine=kind == "refined")
                took.append(time.perf_counter() - began)
            row[f"{kind}_first_s"], row[f"{kind}_s"] = took
            row[kind] = data.relative_errors((found.mass, found.damping, found.stiffness), truth).tolist()
        if not arguments.start_only:
            off = [
                np.abs(getattr(found, name) - X) / found.standard_errors[name]
                for name, X in zip(("mass", "damping", "stiffness"), truth)
            ]
            row["rms_in_standard_errors"] = float(np.sqrt(np.mean(np.square(off))))
        results.append(row)
        print(
            f"n = {n:2d}: noise-free start {max(row['noise_free']):.0e}; "
            + "; ".join(
                f"{kind} {row[f'{kind}_s']:.2f} s (first {row[f'{kind}_first_s']:.1f} s), errors "
                + " ".join(f"{e:.1e}" for e in row[kind])
                for kind in ("start", "refined")
                if kind in row
            )
            + (f"; entries off by {row['rms_in_standard_errors']:.2f} standard errors RMS" if "refined" in row else ""),
            flush=True,
        )
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
