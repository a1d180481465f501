"""Record to M, D, K beside the peers: errors, held-out fit, time, on the reference system and in one run.

    python benchmarks/peers.py [--seeds 10] [--only METHOD ...] [--python MODULE=PATH ...] [--json OUT]

Reference system of the paper, 20 000 samples, noise of 3e-4 m, data from SciPy (tests/independent.py). Every method
runs in a process of its own (peer_methods/worker.py) that stays open, so that it is warm from its second record on;
right before each run of a peer the jaxgray method of its kind runs on the same record, and the ratio is the median over
these pairs. A method slower than --slow seconds runs once. One that cannot run keeps its row, with the reason.

The peers are in the extra `benchmarks`. jax-sysid pins an older jax and has its own environment:

    python -m venv benchmarks/environments/jax_sysid_models
    benchmarks/environments/jax_sysid_models/bin/pip install -r benchmarks/environments/jax_sysid_models.txt
"""

import argparse
import json
import os
import pathlib
import queue
import subprocess
import sys
import tempfile
import threading

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

import independent as data  # noqa: E402
import numpy as np  # noqa: E402

TRUTH = tuple(data.REFERENCE.values())
BASE = {"subspace": "jaxgray-start", "gray box": "jaxgray-refine"}
ROWS = (
    ("subspace", "jaxgray-start", "jaxgray_methods", "jaxgray, subspace start, τ and i given"),
    ("subspace", "jaxgray-start-factor", "jaxgray_methods", "the same, input matrix from the factor alone"),
    ("subspace", "jaxgray-start-identify", "jaxgray_methods", "the same by identify(refine=False), with error bars"),
    ("subspace", "slicot", "slicot_moesp", "SLICOT MOESP + IB01CD, 100 block rows, Cholesky"),
    ("subspace", "slicot-fast-qr", "slicot_moesp", "SLICOT MOESP + IB01CD, 100 block rows, fast QR"),
    ("subspace", "sippy", "sippy_subspace", "SIPPY N4SID"),
    ("subspace", "nfoursid", "nfoursid_subspace", "nfoursid"),
    ("subspace", "jax-sysid", "jax_sysid_models", "jax-sysid LinearModel (black box by gradient)"),
    ("gray box", "jaxgray-refine", "jaxgray_methods", "jaxgray, refinement from the common guess"),
    ("gray box", "scipy", "scipy_graybox", "SciPy least_squares, tuned"),
    ("gray box", "mujoco", "mujoco_graybox", "mujoco[sysid]"),
    ("gray box", "jax-sysid-gray-box", "jax_sysid_models", "jax-sysid Model (Runge-Kutta)"),
    ("whole", "jaxgray-identify", "jaxgray_methods", "jaxgray identify: search, refinement, error bars, tests"),
)


class Worker:
    """One method in its process; None answers within the time limit end it."""

    def __init__(self, method, module, python, environment, timeout):
        self.timeout = timeout
        self.process = subprocess.Popen(
            [python, str(HERE / "peer_methods" / "worker.py"), module, method],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        self.answers = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()
        self.greeting = self._answer()

    def _listen(self):
        for line in self.process.stdout:
            self.answers.put(line)
        self.answers.put(None)

    def _answer(self):
        try:
            line = self.answers.get(timeout=self.timeout)
        except queue.Empty:
            self.process.kill()
            return {"error": f"no answer within {self.timeout:g} s"}
        if line is None:
            return {"error": f"the process ended with code {self.process.wait()}"}
        return json.loads(line)

    def run(self, path):
        try:
            self.process.stdin.write(f"{path}\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            return {"error": f"the process ended with code {self.process.wait()}"}
        return self._answer()

    def close(self):
        try:
            self.process.stdin.close()
            self.process.wait(10)
        except (BrokenPipeError, subprocess.TimeoutExpired):
            self.process.kill()


def held_out(matrices, seed):
    """Fit in % on an unseen record, worst output: noisy, and against the clean motion."""
    u, y, clean = data.reference_record(1000 + seed)
    with np.errstate(all="ignore"):
        found = data.simulate(*matrices, u, data.REFERENCE_TIME)
    if not np.all(np.isfinite(found)):
        return [-np.inf, -np.inf]
    return [
        float(np.min(100 * (1 - np.linalg.norm(z - found, axis=0) / np.linalg.norm(z - z.mean(axis=0), axis=0))))
        for z in (y, clean)
    ]


def python_of(module, given):
    own = HERE / "environments" / module / "bin" / "python"
    return given.get(module, str(own) if own.exists() else sys.executable)


def measure(options, folder):
    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": str(options.blas_threads),
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "PYTHONPATH": str(HERE.parent),
    }
    given = dict(pair.split("=", 1) for pair in options.python)
    rows = [row for row in ROWS if not options.only or row[1] in options.only or row[1] in BASE.values()]
    workers, table = {}, {}
    for kind, method, module, title in rows:
        worker = Worker(method, module, python_of(module, given), environment, options.timeout)
        table[method] = {"kind": kind, "title": title, "version": worker.greeting.get("version"), "runs": []}
        if "error" in worker.greeting:
            table[method]["failure"] = worker.greeting["error"]
        else:
            workers[method] = worker

    def once(method, seed):
        answer = workers[method].run(folder / f"{seed}.npz")
        if "error" in answer:
            table[method]["failure"] = answer["error"]
            workers.pop(method).close()
            return None
        return answer

    # The first record is what compiles and warms; who needs too long for it is not run again.
    for method in list(workers):
        answer = once(method, 0)
        if answer is not None:
            table[method]["first"] = answer
            slow = answer["seconds"] > options.slow
            if slow and not method.startswith("jaxgray") and not again_is_faster(once, method, answer, options.slow):
                table[method]["runs"].append({"seed": 0, **answer})
                workers.pop(method).close()
        print(f"  {method}: first run {answer['seconds']:.2f} s" if answer else f"  {method}: failed", flush=True)

    for seed in range(options.seeds):
        for kind, method, _, _ in rows:
            if method not in workers:
                continue
            base = BASE.get(kind)
            beside = once(base, seed) if base in workers and base != method else None
            answer = once(method, seed)
            if answer is not None:
                table[method]["runs"].append({"seed": seed, **answer})
                if beside is not None:
                    table[method].setdefault("pairs", []).append([answer["seconds"], beside["seconds"]])
        print(f"  record {seed + 1} of {options.seeds}", flush=True)
    for worker in workers.values():
        worker.close()
    return table


def again_is_faster(once, method, first, slow):
    """Whether a slow first run was compilation, told by a second one where that is not hopeless."""
    if first["seconds"] > 4 * slow:
        return False
    second = once(method, 0)
    return second is not None and second["seconds"] <= slow


def judge(table):
    for row in table.values():
        if not row["runs"]:
            continue
        errors = [data.relative_errors([np.array(X) for X in run["matrices"]], TRUTH) for run in row["runs"]]
        fits = [held_out([np.array(X) for X in run["matrices"]], run["seed"]) for run in row["runs"]]
        row["errors"] = np.median(errors, axis=0).tolist()
        row["errors_rms"] = np.sqrt(np.mean(np.square(errors), axis=0)).tolist()
        row["held_out_fit"], row["held_out_fit_clean"] = np.median(fits, axis=0).tolist()
        row["seconds"] = float(np.median([run["seconds"] for run in row["runs"]]))
        base = table.get(BASE.get(row["kind"], ""), {})
        if "pairs" in row:
            row["ratio"] = float(np.median([a / b for a, b in row["pairs"]]))
        elif base.get("runs") and base is not row:
            row["ratio"] = row["seconds"] / float(np.median([run["seconds"] for run in base["runs"]]))


def show(table):
    print(
        f"\n{'':56s}{'records':>8s}{'error M':>9s}{'D':>9s}{'K':>9s}"
        f"{'fit %':>8s}{'clean':>8s}{'time s':>9s}{'ratio':>8s}"
    )
    kind = None
    for row in table.values():
        if row["kind"] != kind:
            kind = row["kind"]
            print(f"{kind}" + (f" (ratio: time against {BASE[kind]})" if kind in BASE else ""))
        if not row["runs"]:
            print(f"  {row['title']:54s}  did not run: {row['failure']}")
            continue
        errors = "".join(f"{e:9.5f}" for e in row["errors"])
        ratio = f"{row['ratio']:8.1f}" if "ratio" in row else f"{'':>8s}"
        print(
            f"  {row['title']:54s}{len(row['runs']):8d}{errors}{row['held_out_fit']:8.2f}"
            f"{row['held_out_fit_clean']:8.2f}{row['seconds']:9.3f}{ratio}  {row['runs'][-1]['note']}"
        )
        if "failure" in row:
            print(f"    failed later: {row['failure']}")
    print("\nversions: " + ", ".join(sorted({row["version"] for row in table.values() if row["version"]})))


def bar(table):
    """The row to meet: not slower than SLICOT with 100 block rows, at equal or smaller errors."""
    ours = table["jaxgray-start"]
    peers = [table[name] for name in ("slicot", "slicot-fast-qr") if table.get(name, {}).get("runs")]
    if not (ours["runs"] and peers):
        return None
    peer = min(peers, key=lambda row: row["ratio"])
    smaller = [a <= b for a, b in zip(ours["errors"], peer["errors"])]
    print(
        f"\nbar: {peer['title']} takes {peer['ratio']:.1f} times as long (must be ≥ 1); jaxgray's median errors are "
        + ", ".join(f"{a / b:.2f} in {name}" for a, b, name in zip(ours["errors"], peer["errors"], "MDK"))
        + " of the peer's (must be ≤ 1)"
    )
    return {"ratio": peer["ratio"], "errors_not_larger": smaller, "met": peer["ratio"] >= 1 and all(smaller)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", nargs="*", metavar="METHOD", help=", ".join(row[1] for row in ROWS))
    parser.add_argument("--python", nargs="*", default=[], metavar="MODULE=PATH", help="interpreter for a peer")
    parser.add_argument("--slow", type=float, default=15.0, help="seconds from which a peer runs once")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds that a peer may take for one record")
    parser.add_argument("--blas-threads", type=int, default=1, help="for NumPy, SciPy and SLICOT; 1 was never slower")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for seed in range(max(options.seeds, 1)):
            u, y, _ = data.reference_record(seed)
            np.savez(folder / f"{seed}.npz", u=u, y=y, h=data.REFERENCE_TIME)
        table = measure(options, folder)
    judge(table)
    show(table)
    verdict = bar(table)
    if options.json:
        options.json.write_text(json.dumps({"cores": os.cpu_count(), "rows": table, "bar": verdict}, indent=1))


if __name__ == "__main__":
    main()
