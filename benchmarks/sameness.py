"""Same input, same digits: over runs, threads, caches, chunks, and releases of jax.

    python benchmarks/sameness.py [--python OTHER/bin/python ...] [--seed 0] [--tasks NAME ...] [--json OUT]

`jaxgray identify` on three records of different kinds (two displacements under held forces, an acceleration under a
continuous force, two accelerations on a moving base) and `jaxgray diagnose` on one with dry friction run in new
processes: again, with nothing kept from before, on one core, with BLAS and with XLA on one thread or two. `--python`:
interpreters of other environments that can import jaxgray's dependencies, with other releases of jax. A fifth task
compresses a record in chunks of several sizes.

Every run is compared with the first, by what it prints and by all numbers of its JSON: "same" where no byte of either
differs, "as printed" where what is printed is the same, else how many lines differ; and the largest difference of an
entry of M, D, K in standard errors, or of its value where there are none.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

LIMIT = 900
"""Seconds that a run may take."""

CHUNKS = (100_000, 4096, 1000, 301)
"""Samples of a chunk, the first more than the record has."""

COMPRESSED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import jaxgray
chunk = int(sys.argv[2])
options = {"inputs": ("u1", "u2"), "outputs": ("y1", "y2"), "sampling_time": 0.02, "chunk_samples": chunk}
made = jaxgray.compress(sys.argv[1], time_constants=0.15, block_rows=6, **options)
model = made.model()
print(model)
import json
matrices = {name: getattr(model, name).tolist() for name in ("mass", "damping", "stiffness")}
open(sys.argv[3], "w").write(json.dumps({"model": matrices}))
"""

PRINTED = """
import sys, importlib.metadata
print(importlib.metadata.version("jax"), importlib.metadata.version("jaxlib"), importlib.metadata.version("numpy"))
"""


def written(folder, seed):
    """The records as files, and the words of the command for each task."""
    import independent

    rng = np.random.default_rng(seed)
    M, D, K = independent.REFERENCE.values()

    def table(name, u, y):
        y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
        path = folder / f"{name}.csv"
        heads = [f"u{k + 1}" for k in range(u.shape[1])] + [f"y{k + 1}" for k in range(y.shape[1])]
        np.savetxt(path, np.hstack([u, y]), delimiter=",", header=",".join(heads), comments="", fmt="%.17g")
        return path

    def words(command, path, h, *more, inputs="u1,u2", outputs="y1,y2"):
        return [command, str(path), "--inputs", inputs, "--outputs", outputs, "--sampling-time", str(h), *more]

    u = independent.random_steps(rng, 2000, 2, 0.02)
    forced = table("forced", u, independent.simulate(M, D, K, u, 0.02))
    u = independent.smooth_noise(rng, 1500, 1, 0.3)
    one = (np.array([[X]]) for X in (2.0, 0.8, 150.0))
    shaken = table("shaken", u, independent.simulate(*one, u, 0.03, hold="linear", measured="acceleration"))
    u = independent.smooth_noise(rng, 1500, 1, 0.3)
    # Relative to the base the structure is pushed by its own inertia.
    ground = -np.ones((2, 1))
    moved = independent.simulate(np.eye(2), D, K, u, 0.03, E=ground, hold="linear", measured="acceleration")
    based = table("based", u, moved + u)
    rubbed = table("rubbed", *_rubbed(rng))
    tasks = {
        "forces": words("identify", forced, 0.02),
        "acceleration": words(
            "identify", shaken, 0.03, "--hold", "linear", "--measured", "acceleration", inputs="u1", outputs="y1"
        ),
        "base": words(
            "identify",
            based,
            0.03,
            *("--hold", "linear", "--measured", "acceleration", "--excitation", "base-acceleration"),
            inputs="u1",
        ),
        "diagnosis": words(
            "diagnose",
            rubbed,
            0.05,
            *("--only", "coulomb_friction,quadratic_drag,cubic_stiffness", "--max-effects", "1"),
            inputs="u1",
            outputs="y1",
        ),
    }
    u = independent.random_steps(rng, 12_000, 2, 0.02)
    y = independent.simulate(M, D, K, u, 0.02)
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    rows = np.zeros(len(u), dtype=[(name, float) for name in ("u1", "u2", "y1", "y2")])
    for name, column in zip(rows.dtype.names, np.hstack([u, y]).T):
        rows[name] = column
    np.save(folder / "long.npy", rows)
    return tasks


def _rubbed(rng, samples=1500, h=0.05, substeps=200):
    """One mass with dry friction, by small semi-implicit steps."""
    import independent

    u = independent.random_steps(rng, samples, 1, h)
    m, d, k, friction = 1.0, 0.5, 12.0, 0.2
    y, q, v = np.empty((samples, 1)), 0.0, 0.0
    for n in range(samples):
        y[n] = q
        for _ in range(substeps):
            free = v + h / substeps * (u[n, 0] - d * v - k * q) / m
            v = np.sign(free) * max(abs(free) - h / substeps * friction / m, 0.0)
            q += h / substeps * v
    return u, y


class Runs:
    """Runs of the tasks under settings of the environment; `folder`: where caches and results go."""

    def __init__(self, tasks, folder):
        self._tasks, self._folder, self._count = tasks, folder, 0
        dropped = ("JAX", "XDG_", "XLA_", "OPENBLAS", "OMP_", "NPROC")
        self._settings = {name: value for name, value in os.environ.items() if not name.startswith(dropped)}
        self._settings |= {"PYTHONPATH": str(HERE.parent), "TF_CPP_MIN_LOG_LEVEL": "3"}

    def __call__(self, task, python=sys.executable, *, cache="cache", cores=None, **settings):
        """What a task prints, and its JSON; the error where it failed."""
        self._count += 1
        result = self._folder / f"result{self._count}.json"
        kept = {"XDG_CACHE_HOME": str(self._folder / cache)}
        if isinstance(task, int):
            words = [python, "-c", COMPRESSED, str(self._folder / "long.npy"), str(task), str(result)]
        else:
            words = [python, "-m", "jaxgray", *self._tasks[task], "--json", str(result)]

        def on_cores():
            if cores is not None:
                os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:cores]))

        ran = subprocess.run(
            words,
            env=self._settings | kept | settings,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            preexec_fn=on_cores,
        )
        if ran.returncode != 0:
            return ran.stderr.strip()[-300:]
        return ran.stdout, json.loads(result.read_text())


def compared(run, first):
    """How a run differs from the first, in words and as the largest difference of an entry."""
    if isinstance(run, str):
        return f"failed: {run}", None
    lines = [(a, b) for a, b in zip(run[0].splitlines(), first[0].splitlines()) if a != b]
    more = abs(len(run[0].splitlines()) - len(first[0].splitlines()))
    if run == first:
        return "same", 0.0
    said = "as printed" if run[0] == first[0] else f"{len(lines) + more} lines differ"
    return said, max((_difference(a, b) for a, b in zip(_models(run[1]), _models(first[1]))), default=float("nan"))


def _models(document):
    parts = (document, document.get("baseline"), document.get("extended"))
    return [part["model"] for part in parts if part and part.get("model")]


def _difference(model, first):
    """Largest difference of an entry of M, D, K, in standard errors where there are any, else relative."""
    worst = 0.0
    for name in ("mass", "damping", "stiffness"):
        a, b = np.array(model[name], float), np.array(first[name], float)
        errors = (first.get("standard_errors") or {}).get(name)
        unit = np.abs(b) if errors is None else np.array(errors, float)
        counted = np.isfinite(unit) & (unit > 0)
        worst = max(worst, float(np.max(np.abs(a - b)[counted] / unit[counted], initial=0.0)))
    return worst


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="*", default=[], help="interpreters with other releases of jax")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tasks", nargs="*", help="default all")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        tasks = written(folder, arguments.seed)
        wanted = arguments.tasks or [*tasks, "chunks"]
        runs = Runs(tasks, folder)
        (folder / "file").write_text("")
        one_thread = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
        variants = {
            "again": {},
            "nothing kept": {"cache": "file"},
            "one core": {"cores": 1},
            "BLAS with two threads": {"OPENBLAS_NUM_THREADS": "2"},
            "XLA on one thread": one_thread,
        }
        for path in arguments.python:
            release = subprocess.run([path, "-c", PRINTED], capture_output=True, text=True, check=True).stdout.split()
            variants["jax {}, jaxlib {}, numpy {}".format(*release)] = {"python": path}
        for task in [task for task in wanted if task != "chunks"]:
            first = runs(task)
            if isinstance(first, str):
                sys.exit(f"{task} failed: {first}")
            for variant, settings in variants.items():
                found.append(_told(task, variant, runs(task, **settings), first))
        if "chunks" in wanted:
            first = runs(CHUNKS[0])
            for chunk in CHUNKS[1:]:
                found.append(_told("chunks", f"{chunk} samples", runs(chunk), first))
            for variant in list(variants)[len(variants) - len(arguments.python) :]:
                found.append(_told("chunks", variant, runs(CHUNKS[0], **variants[variant]), first))
    same = sum(row["said"] in ("same", "as printed") for row in found)
    print(f"{same} of {len(found)} runs print the same digits as the first of their task")
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(found, indent=1))


def _told(task, variant, run, first):
    said, difference = compared(run, first)
    size = "" if difference in (None, 0.0) else f", entries by {difference:.1e}"
    print(f"{task:14s}{variant:40s}{said}{size}", flush=True)
    row = {"task": task, "variant": variant, "said": said, "difference": difference}
    if said.endswith("differ"):
        pairs = [(a, b) for a, b in zip(run[0].splitlines(), first[0].splitlines()) if a != b]
        for a, b in pairs[:3]:
            print(f"      {b.strip()}\n   -> {a.strip()}", flush=True)
        row["lines"] = pairs
    return row


if __name__ == "__main__":
    main()
