"""Accuracy of the identification, row by row.

    python benchmarks/identification_accuracy.py [--row NAME ...] [--seeds 20] [--first 0] [--json OUT]

Data come from SciPy (tests/independent.py), never from jaxgray. Every row prints figures beside the bar they
are held against, and fails loudly where a run fails.
"""

import argparse
import json
import pathlib
import time

import numpy as np
from accuracy import campaigns, exact, realisations, reference, systems

ROWS = {
    name[4:]: function
    for module in (exact, reference, realisations, systems, campaigns)
    for name, function in vars(module).items()
    if name.startswith("row_")
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", nargs="*", choices=list(ROWS), default=list(ROWS))
    parser.add_argument(
        "--seeds", type=int, default=20, help="records a row; campaigns of random records take ten times as many"
    )
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    results = {}
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    for row in arguments.row:
        start = time.perf_counter()
        print(f"== {row}", flush=True)
        results[row] = ROWS[row](seeds)
        print(f"   {time.perf_counter() - start:.0f} s", flush=True)
    if arguments.json:
        text = json.dumps(results, default=lambda x: np.asarray(x).tolist(), indent=1)
        pathlib.Path(arguments.json).write_text(text)


if __name__ == "__main__":
    main()
