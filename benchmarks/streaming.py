"""Time and memory of the compression against the length of the record, from a file on disk.

    python benchmarks/streaming.py [--samples 10000 100000 1000000 10000000] [--json OUT]

Every length runs in a process of its own, so that its peak memory is its own. The record is written by SciPy in
pieces; only reading, compressing and identifying are timed, after a call that compiles. "beyond" is the peak of
resident memory over what the same process needs for one chunk, read twice: once while it compiles, once after.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[1]
NAMES = [f"data[{k}]" for k in range(4)]


def write(path, samples, chunk=2**16):
    """A record of the reference system, piece by piece, as a NPY matrix."""
    import numpy as np
    import scipy.linalg
    import scipy.signal

    sys.path.insert(0, str(ROOT / "tests"))
    import independent as data

    A, B = data.state_space(*data.REFERENCE.values(), np.eye(2))
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * data.REFERENCE_TIME)
    Ad, Bd = flow[:4, :4], flow[:4, 4:]
    values, vectors = np.linalg.eig(Ad)
    modal = np.linalg.solve(vectors, Bd.astype(complex))
    table = np.lib.format.open_memmap(path, mode="w+", dtype=float, shape=(samples, 4))
    rng = np.random.default_rng(0)
    state = np.zeros(4, complex)
    for first in range(0, samples, chunk):
        size = min(chunk, samples - first)
        u = data.random_steps(rng, size, 2, data.REFERENCE_TIME)
        q = np.empty((size, 4), complex)
        for k in range(4):
            drive = u @ modal[k]
            after, _ = scipy.signal.lfilter([1.0], [1.0, -values[k]], drive, zi=[values[k] * state[k]])
            q[:, k] = np.concatenate([[state[k]], after[:-1]])
            state[k] = after[-1]
        y = (q @ vectors.T).real[:, :2] + data.REFERENCE_NOISE * rng.standard_normal((size, 2))
        table[first : first + size] = np.hstack([u, y])
    table.flush()


def one(path, first):
    """Compile on the short file, then time the long one; prints JSON."""
    import resource
    import time

    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(ROOT / "tests"))
    import independent as data

    import jaxgray

    options = {"sampling_time": data.REFERENCE_TIME, "time_constants": 0.05, "block_rows": 8}

    def run(name):
        found = jaxgray.compress(name, inputs=NAMES[:2], outputs=NAMES[2:], **options)
        model = found.model()
        return data.relative_errors((model.mass, model.damping, model.stiffness), data.REFERENCE.values())

    # Once to compile, once as the long one will run.
    run(first)
    run(first)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    errors = run(path)
    took = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"seconds": took, "chunk_mib": before / 1024, "peak_mib": peak / 1024, "errors": errors.tolist()}))
    assert np.all(np.isfinite(errors))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="*", default=[10**4, 10**5, 10**6, 10**7])
    parser.add_argument("--json")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        one(*arguments.one)
        return
    import numpy as np

    environment = os.environ | {"NPROC": "4", "OPENBLAS_NUM_THREADS": "1"}
    results = []
    with tempfile.TemporaryDirectory() as folder:
        first = f"{folder}/chunk.npy"
        write(first, 2**16)
        for samples in arguments.samples:
            path = f"{folder}/record.npy"
            write(path, samples)
            command = [sys.executable, __file__, "--one", path, first]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            found = {"samples": samples} | json.loads(done.stdout.splitlines()[-1])
            found["growth_percent"] = 100 * (found["peak_mib"] / found["chunk_mib"] - 1)
            results.append(found)
            print(
                f"N = {samples:9d}: {found['seconds']:8.3f} s, peak {found['peak_mib']:7.1f} MiB, "
                f"{found['growth_percent']:4.1f} % beyond one chunk (bar 10); errors of M, D, K "
                + " ".join(f"{e:.1e}" for e in found["errors"]),
                flush=True,
            )
    lengths, times = np.array([[r["samples"], r["seconds"]] for r in results]).T
    long = lengths >= 2**16
    exponents = {"all": float(np.polyfit(np.log(lengths), np.log(times), 1)[0])}
    if long.sum() > 1:
        exponents["beyond one chunk"] = float(np.polyfit(np.log(lengths[long]), np.log(times[long]), 1)[0])
    print("time grows as N to the power " + ", ".join(f"{v:.2f} ({k})" for k, v in exponents.items()) + " (bar 1.05)")
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps({"runs": results, "exponents": exponents}, indent=1))


if __name__ == "__main__":
    main()
