"""Seconds of a diagnosis: the command in new processes, and one record after the other in a warm process.

    python benchmarks/diagnosis_speed.py [--seed 4242] [--rounds 5] [--records 8] [--tree DIR] [--json OUT]

Dry friction at one of two coordinates, in data of an independent simulator (tests/hidden.py). `jaxgray diagnose`
on 20 000 samples: first with an empty cache, then `--rounds` times with what it kept. With `--tree`, code of another
checkout takes turns with this one, and the ratio is that of pairs. Warm: `diagnose` on `--records` new records of 4000
samples in one process; the first of every hold compiles its programs and is not counted. A run counts where it ends in
*named*.
"""

import argparse
import itertools
import json
import os
import pathlib
import resource
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

FIRST_BAR, LATER_BAR, WARM_BAR = 60.0, 15.0, 4.0
EFFECT = "coulomb_friction"


def case_of(seed, samples):
    import hidden
    import numpy as np

    return hidden.random_case(np.random.default_rng(seed), EFFECT, dofs=(2,), samples=samples, excess=(1.5, 4))


def write_record(path, case):
    import numpy as np

    table = np.column_stack([case.sampling_time * np.arange(len(case.u)), case.u, case.y])
    np.savetxt(path, table, delimiter=",", header="time,u1,u2,y1,y2", comments="", fmt="%.9g")


def command(tree, record, hold, cache):
    """Seconds on the clock and of all cores, and the verdict, of `jaxgray diagnose` in a new process."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "JAXGRAY_", "XLA_"))}
    out = cache / "result.json"
    options = ["--inputs", "u1,u2", "--outputs", "y1,y2", "--hold", hold, "--json", str(out), "--quiet"]
    used, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "jaxgray", "diagnose", str(record), *options],
        env={**kept, "PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(cache)},
        cwd=cache,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    seconds, now = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime, json.loads(out.read_text())["verdict"]


def commands(case, trees, rounds):
    runs = {tree: [] for tree in trees}
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        write_record(folder / "record.csv", case)
        for turn in range(rounds + 1):
            for k, tree in enumerate(trees):
                cache = folder / f"cache{k}"
                cache.mkdir(exist_ok=True)
                runs[tree].append(command(tree, folder / "record.csv", case.hold, cache))
                seconds, busy, verdict = runs[tree][-1]
                when = "later" if turn else "first"
                print(f"  {tree.name:24s}{when} {seconds:6.1f} s  {busy:6.1f} s of cores  {verdict}", flush=True)
    first, later = ([run[0] for run in runs[trees[0]]][part] for part in (slice(1), slice(1, None)))
    print(f"`jaxgray diagnose`, 20 000 samples: first {first[0]:.1f} s (bar {FIRST_BAR:g})", end="")
    if later:
        print(
            f", later median {statistics.median(later):.1f} s, {min(later):.1f} to {max(later):.1f} (bar {LATER_BAR:g})"
        )
    for tree in trees[1:]:
        ratios = [a[0] / b[0] for a, b in zip(runs[trees[0]][1:], runs[tree][1:])]
        print(f"  over {tree}: {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
    return {str(tree): found for tree, found in runs.items()}


def warm(seed, records):
    import jax

    jax.config.update("jax_enable_x64", True)
    import warnings

    import jaxgray

    warnings.simplefilter("ignore")
    found, holds = [], set()
    seeds = itertools.count(seed + 1)
    while len(found) < records:
        case = case_of(next(seeds), 4000)
        record, validation = (
            jaxgray.Record(u, y, case.sampling_time, hold=case.hold)
            for u, y in ((case.u, case.y), (case.u_v, case.y_v))
        )
        began = time.perf_counter()
        result = jaxgray.diagnose(record, validation=validation)
        seconds, right = time.perf_counter() - began, [one.effect for one in result.findings] == [EFFECT]
        print(
            f"  {'warm' if case.hold in holds else 'not counted':24s}{seconds:6.1f} s  {case.hold:8s}{result.verdict}"
            f"{'' if right else ', wrong'}",
            flush=True,
        )
        if case.hold in holds:
            found.append((seconds, result.verdict))
        holds.add(case.hold)
    times = [seconds for seconds, _ in found]
    within = sum(seconds <= WARM_BAR for seconds in times)
    print(
        f"4000 samples, warm: median {statistics.median(times):.1f} s, {within} of {len(times)} within {WARM_BAR:g} s"
    )
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=4242)
    parser.add_argument("--rounds", type=int, default=5, help="later runs of the command; -1: none at all")
    parser.add_argument("--records", type=int, default=8)
    parser.add_argument("--tree", type=pathlib.Path, help="checkout whose code takes turns with this one")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    trees = [ROOT] if args.tree is None else [ROOT, args.tree.resolve()]
    result = {} if args.rounds < 0 else {"commands": commands(case_of(args.seed, 20_000), trees, args.rounds)}
    if args.records > 0:
        result["warm"] = warm(args.seed, args.records)
    if args.json:
        args.json.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
