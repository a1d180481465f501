"""The fleet: what it finds, what it survives, how fast it is, and what more would cost.

    python benchmarks/fleet.py ROW … [--records N] [--samples N] [--machines N] [--repetitions N] [--json OUT]

Rows: hidden (records with a hidden effect, corrupt ones, others), robust (workers, scheduler and command killed),
drift (machines of which two change), healthy (machines of which none does), long (one record generated on the fly),
speed (one worker and two, and the cost of more), refusals (what is said where nothing can be done). Records are made by
SciPy (fleet_records.py); commands run as their users would run them. Work that was done is not done again: with
--folder a campaign may be stopped and called again.
"""

import argparse
import contextlib
import glob
import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import fleet_records as made
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[1]
CHANNELS = ["--inputs", "u1,u2", "--outputs", "y1,y2"]


def command(*argv, **more):
    """A started command of its own session, so that signals reach all of its processes."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    argv = [sys.executable, "-m", "jaxgray", *map(str, argv)]
    return subprocess.Popen(argv, env=environment, start_new_session=True, text=True, **more)


def finished(*argv):
    """A command to its end: seconds, exit code, and what it said on the error stream."""
    begun = time.perf_counter()
    process = command(*argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    said = process.communicate()[1]
    return time.perf_counter() - begun, process.returncode, said


def table_of(out):
    import pandas

    return pandas.read_parquet(out / "results.parquet").set_index("file").sort_index()


def fleet_of(records, out, *more):
    return ["fleet", f"{records}/*.parquet", *CHANNELS, "--out", out, *more]


def hidden(options, folder):
    """Records with a hidden effect are named, spoilt ones have reasons, the others lie within their intervals."""
    count = options.records
    effects = max(1, count // 20)
    truth = made.mixed_fleet(folder / "records", count, effects, 3, 2, options.samples)
    seconds, code, said = finished(
        *fleet_of(folder / "records", folder / "out", "--task", "diagnose", "--workers", options.workers, "--quiet")
    )
    assert code == 0, said
    table = table_of(folder / "out")
    table.index = [pathlib.Path(name).name for name in table.index]
    named, falsely, far, entries = 0, [], 0, 0
    for name, true in truth.items():
        row = table.loc[name]
        if true is None:
            assert row.outcome == "failed" and row.failure, name
            continue
        found = row.effect if row.outcome not in ("noise", "failed") else None
        if true["effect"] is not None:
            named += found == true["effect"] and row.place == "y1"
        elif found is not None:
            falsely.append(name)
        for matrix, X in zip(("mass", "damping", "stiffness"), true["matrices"]):
            for place, value in (("y1", X[0, 0]), ("y1_y2", X[0, 1]), ("y2", X[1, 1])):
                entries += 1
                far += not abs(row[f"{matrix}_{place}"] - value) < 3 * row[f"{matrix}_{place}_error"]
    return {
        "records": count,
        "hidden": effects,
        "named with their place": int(named),
        "false": len(falsely),
        "spoilt, with their reason": 5,
        "entries": entries,
        "entries beyond three standard errors": int(far),
        "seconds": seconds,
    }


def children(pid):
    listed = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()
    return [int(k) for k in listed] + [grand for k in listed for grand in children(int(k))]


def workers_of(pid):
    found = []
    for child in children(pid):
        with contextlib.suppress(OSError):
            if b"spawn_main" in pathlib.Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(child)
    return found


def done(out):
    with contextlib.suppress(FileNotFoundError):
        return sum(name.endswith(".json") and name[0] != "." for name in os.listdir(out / "results"))
    return 0


def written(out):
    """When every result was written: one that changes was done again."""
    return {path: os.stat(path).st_mtime_ns for path in glob.glob(f"{out}/results/*.json")}


def robust(options, folder):
    """Workers killed, the scheduler killed, the command stopped: afterwards the table is that of a quiet run."""
    count = options.records
    made.mixed_fleet(folder / "records", count, 0, 1, 1, options.samples)
    total = count + 2
    quiet = fleet_of(folder / "records", folder / "quiet", "--workers", 2, "--no-pages", "--quiet")
    assert finished(*quiet)[1] == 0
    out = folder / "out"
    kills = 0
    # Five times a worker, then Ctrl-C.
    log = open(folder / "log.txt", "a")
    process = command(*fleet_of(folder / "records", out, "--workers", 2, "--no-pages"), stdout=log, stderr=log)
    last = 0
    while process.poll() is None:
        time.sleep(0.05)
        # A worker now and then, so that some of them die at work and some when their answer is on its way.
        if kills < 5 and done(out) > last:
            found = workers_of(process.pid)
            if found:
                os.kill(found[kills % len(found)], signal.SIGKILL)
                kills, last = kills + 1, done(out) + total // 50
        elif kills == 5 and done(out) > last:
            os.killpg(process.pid, signal.SIGINT)
            break
    process.wait(60)
    stopped, first, before = process.returncode, done(out), written(out)
    # A scheduler of its own, killed when 40 % are done.
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    dask = [sys.executable, "-m", "dask"]
    quietly = {"env": environment, "stdout": log, "stderr": log, "start_new_session": True}
    scheduler = subprocess.Popen([*dask, "scheduler", "--port", str(port), "--dashboard-address", ":0"], **quietly)
    address = f"tcp://127.0.0.1:{port}"
    time.sleep(5)
    worker = subprocess.Popen([*dask, "worker", address, "--nthreads", "1", "--no-dashboard"], **quietly)
    time.sleep(10)
    assert scheduler.poll() is None and worker.poll() is None, f"scheduler or worker ended; see {folder}/log.txt"
    process = command(
        *fleet_of(folder / "records", out, "--scheduler", address, "--no-pages"), stdout=log, stderr=subprocess.PIPE
    )
    at_kill = None
    while process.poll() is None:
        time.sleep(0.05)
        if done(out) >= max(0.4 * total, first + 1):
            os.killpg(scheduler.pid, signal.SIGKILL)
            at_kill = done(out)
            break
    assert at_kill is not None, "the command ended before its scheduler was killed"
    lost = process.communicate(timeout=120)[1].strip().splitlines()
    second, between = done(out), written(out)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(worker.pid, signal.SIGKILL)
    halves = [path for path in out.rglob("*") if path.suffix == ".json" and not _whole(path)]
    seconds, code, said = finished(*fleet_of(folder / "records", out, "--workers", 2, "--no-pages", "--quiet"))
    assert code == 0, said
    after = written(out)
    again = sum(between[path] != at for path, at in before.items()) + sum(
        after[path] != at for path, at in between.items()
    )
    one, other = table_of(folder / "quiet"), table_of(out)
    numbers = one.select_dtypes("number").columns.drop("seconds")
    equal = np.allclose(one[numbers], other[numbers], rtol=1e-6, equal_nan=True)
    equal &= bool((one.outcome == other.outcome).all())
    return {
        "records": total,
        "workers killed": kills,
        "exit code of the stopped command": stopped,
        "results after it": first,
        "results when the scheduler was killed": at_kill,
        "results after its death": second,
        "said then": lost[-1] if lost else "",
        "exit code then": process.returncode,
        "results done again": again,
        "half-written results": len(halves),
        "left behind": len(list(out.rglob(".part-*"))),
        "results in the end": done(out),
        "table equals the quiet one": bool(equal),
    }


def _whole(path):
    try:
        json.loads(path.read_text())
    except ValueError:
        return False
    return True


def drift(options, folder):
    """A stiffness step of 2 % in one machine and growing friction in another, among healthy ones."""
    step, friction, begins = 1, options.machines - 1, options.records // 2
    if not (folder / "records").exists():
        made.aging_fleet(
            folder / "records", options.machines, options.records, options.samples, 0, step, friction, begins
        )
    return _drifts(options, folder) | {
        "truth": f"machine{step:02d} stiffness[0,0] +2 % and machine{friction:02d} Coulomb friction, from {begins + 1}"
    }


def healthy(options, folder):
    """Repetitions of machines of which none changes."""
    alarms = []
    for repetition in range(options.repetitions):
        place = folder / f"healthy{repetition}"
        if not (place / "records").exists():
            made.aging_fleet(place / "records", options.machines, options.records, options.samples, 100 + repetition)
        alarms.append(_drifts(options, place)["changes"])
    return {
        "machines": options.machines,
        "records of each": options.records,
        "repetitions": options.repetitions,
        "alarms": [one for some in alarms for one in some],
    }


def _drifts(options, folder):
    more = ["--machine", "{machine}_{when}.parquet", "--covariates", "temperature", "--no-pages"]
    seconds, code, said = finished(
        *fleet_of(folder / "records", folder / "out", "--workers", options.workers, *more, "--quiet")
    )
    assert code == 0, said
    found = json.loads((folder / "out" / "drift.json").read_text())
    return {
        "machines": options.machines,
        "records of each": options.records,
        "seconds": seconds,
        "changes": [one["sentence"] for one in found["drifts"]],
        "not compared": found["not_compared"],
    }


def long(options, folder):
    """One record generated on the fly by two workers: time, memory, and the factor of a single pass."""
    import distributed
    import jax

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(ROOT))
    from jaxgray.fleets import compress_on_workers
    from jaxgray.fleets.worker import environment

    given = {"inputs": ["u1", "u2"], "outputs": ["y1", "y2"], "sampling_time": made.H}
    given |= {"time_constants": [0.1], "block_rows": 8}

    def memory():
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    def one_form(R):
        return R * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, :, None] / np.linalg.norm(R, axis=1)[:, None]

    os.environ["PYTHONPATH"] = f"{ROOT}:{pathlib.Path(__file__).parent}"
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, env=environment(), dashboard_address="127.0.0.1:0", silence_logs=50
    )
    with cluster, distributed.Client(cluster) as client:
        few = min(options.samples, 10**6)
        parts = compress_on_workers(made.endless, samples=few, client=client, **given)
        before = max(client.run(memory).values())
        begun = time.perf_counter()
        record = compress_on_workers(made.endless, samples=options.samples, client=client, **given)
        seconds = time.perf_counter() - begun
        peak = max(client.run(memory).values())
        whole = compress_on_workers(
            made.endless, samples=few, client=client, chunk_samples=few, householder=True, **given
        )
        apart = float(np.max(np.abs(one_form(whole.factor) - one_form(parts.factor))))
    model = record.model()
    errors = made.data.relative_errors((model.mass, model.damping, model.stiffness), made.data.REFERENCE.values())
    return {
        "samples": options.samples,
        "seconds": seconds,
        "samples a second": options.samples / seconds,
        "largest memory of a worker [MiB]": peak,
        f"the same with {few} samples [MiB]": before,
        f"factor of {few} samples beside that of one pass": apart,
        "errors of M, D, K": errors.tolist(),
    }


def speed(options, folder):
    """Throughput on one worker and two, in turn, without what compiles, and what a million records would cost."""
    made.mixed_fleet(folder / "records", options.records, 0, 0, 0, options.samples)
    rates, busy, memory = {1: [], 2: []}, {1: [], 2: []}, []
    for turn in range(options.repetitions):
        for workers in (1, 2):
            out = folder / f"out{turn}_{workers}"
            rates[workers].append(_rate(options, folder / "records", out, workers))
            runs = [json.loads(pathlib.Path(p).read_text())["run"] for p in glob.glob(f"{out}/results/*.json")]
            memory.append(max(run["memory_mib"] for run in runs))
            # The median leaves out what compiles.
            busy[workers].append(float(np.median([run["processor_seconds"] for run in runs if len(run) > 2])))
            shutil.rmtree(out)
    ratios = np.divide(rates[2], rates[1])
    return {
        "records": options.records,
        "samples of each": options.samples,
        "records a second, one worker": rates[1],
        "records a second, two workers": rates[2],
        "ratios": ratios.tolist(),
        "median ratio": float(np.median(ratios)),
        "processor seconds a record, one worker": float(np.median(busy[1])),
        "processor seconds a record, two workers": float(np.median(busy[2])),
        "largest memory of a worker [MiB]": max(memory),
        "hours for 1e6 records on two workers": 1e6 / float(np.median(rates[2])) / 3600,
        "cores": os.cpu_count(),
    }


def _rate(options, records, out, workers):
    """Records a second, from when every worker has compiled, after a quarter, until the last few."""
    process = command(*fleet_of(records, out, "--workers", workers, "--no-pages", "--quiet"), stdout=subprocess.DEVNULL)
    times = []
    while process.poll() is None:
        # Looking takes a part of a core, too.
        time.sleep(0.25)
        count = done(out)
        if not times or count > times[-1][1]:
            times.append((time.perf_counter(), count))
    inside = [(t, n) for t, n in times if 0.3 * options.records <= n <= 0.95 * options.records]
    return (inside[-1][1] - inside[0][1]) / (inside[-1][0] - inside[0][0])


def refusals(options, folder):
    """What is said where nothing can be done: one line each, and what was done is kept."""
    made.mixed_fleet(folder / "records", 6, 0, 0, 0, 1000)
    made.write(folder / "records" / "slower.parquet", *np.zeros((2, 100, 2)), h=2 * made.H)
    said = {}

    def tell(what, *argv):
        _, code, text = finished(*argv)
        lines = [line for line in text.strip().splitlines() if line]
        said[what] = {"exit code": code, "lines": len(lines), "said": lines[-1] if lines else ""}

    out = folder / "out"
    tell("unreachable scheduler", *fleet_of(folder / "records", out, "--scheduler", "tcp://127.0.0.1:9"))
    tell("out that cannot be written", *fleet_of(folder / "records", "/proc/fleet"))
    tell("mixed sampling times", *fleet_of(folder / "records", out, "--workers", 1, "--no-pages"))
    said["mixed sampling times"]["failures"] = table_of(out).failure.dropna().tolist()
    small = folder / "small"
    small.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", small]).returncode == 0
    if mounted:
        try:
            tell("disk full", *fleet_of(folder / "records", small, "--workers", 1))
            said["disk full"]["whole results kept"] = sum(_whole(p) for p in (small / "results").glob("*.json"))
            said["disk full"]["not whole"] = sum(not _whole(p) for p in (small / "results").glob("*.json"))
        finally:
            subprocess.run(["umount", small])
    return said


ROWS = {f.__name__: f for f in (hidden, robust, drift, healthy, long, speed, refusals)}
REPETITIONS = {"healthy": 20, "speed": 5}
DEFAULTS = {"hidden": (500, 3000), "robust": (500, 2000), "drift": (60, 1000), "healthy": (60, 1000)}
DEFAULTS |= {"long": (0, 10**8), "speed": (2000, 2000), "refusals": (0, 0)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="+", choices=ROWS)
    parser.add_argument("--records", type=int, help="records, or records of each machine")
    parser.add_argument("--samples", type=int)
    parser.add_argument("--machines", type=int, default=50)
    parser.add_argument("--repetitions", type=int, help="of healthy machines, default 20; of speed, default 5")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=pathlib.Path, help="kept, so that a stopped campaign goes on")
    parser.add_argument("--json", type=pathlib.Path)
    arguments = parser.parse_args()
    results = {}
    for row in arguments.rows:
        options = argparse.Namespace(**vars(arguments))
        records, samples = DEFAULTS[row]
        options.records = records if arguments.records is None else arguments.records
        options.samples = samples if arguments.samples is None else arguments.samples
        options.repetitions = arguments.repetitions or REPETITIONS.get(row, 1)
        place = arguments.folder or pathlib.Path(tempfile.mkdtemp())
        folder = place / row
        folder.mkdir(parents=True, exist_ok=True)
        try:
            results[row] = ROWS[row](options, folder)
        finally:
            if arguments.folder is None:
                shutil.rmtree(place)
        print(row, json.dumps(results[row], indent=1, ensure_ascii=False), flush=True)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(results, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
