"""Records identified side by side, beside one by one.

    python benchmarks/many_records.py [--records 256] [--samples 2000] [--singles 16] [--devices 1 2 4] [--json OUT]

Every record has a system and an input of its own. "One by one" are `identify` per record with the same τ and i,
and the batch's own program called for one record at a time, which shows what batching itself brings; they are timed
over the first records and scaled up. The refinement alone, from the same subspace starts, is timed too: all records
as one batch beside `refine` for each. With several devices (forced host devices, a process each) the work is shared,
and the results are compared with one device's.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import equinox as eqx
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.batch.many import CHUNK_SAMPLES  # noqa: E402
from jaxgray.identification.batch.steps import One, refine_one  # noqa: E402
from jaxgray.identification.refinement.refine import refine  # noqa: E402
from jaxgray.identification.setup.prediction import Batch  # noqa: E402
from jaxgray.identification.setup.preparation import prepare  # noqa: E402
from jaxgray.identification.setup.structure import structure_of  # noqa: E402

H = 4 * data.REFERENCE_TIME
OPTIONS = {"time_constants": 0.1, "block_rows": 6}


def record_of(seed, samples):
    rng = np.random.default_rng(seed)
    u = data.random_steps(rng, samples, 2, H, (0.2, 1.5))
    truth = [X * f for X, f in zip(data.REFERENCE.values(), 1 + 0.1 * rng.standard_normal(3))]
    y = data.simulate(*truth, u, H)
    return jaxgray.Record(u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape), H)


def timed(function, repeats=3):
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = function()
        times.append(time.perf_counter() - start)
    return float(np.median(times)), found


def refined_side_by_side(begun, signals):
    """A function that refines all records from their starts, as `identify_many` does: vmapped, chunk by chunk."""
    form = structure_of(None)
    rows = [
        eqx.partition(
            (
                b.start.matrices,
                One(s.u, s.y, np.asarray(s.kept, float), np.ones(len(s.u))),
                b.setting,
            ),
            eqx.is_array,
        )
        for b, s in zip(begun, signals)
    ]
    static = rows[0][1]
    program = jax.jit(jax.vmap(lambda arrays: refine_one(*eqx.combine(arrays, static), form, gaps=False)))
    size = max(1, CHUNK_SAMPLES // len(signals[0].u))
    chunks = [rows[k : k + size] for k in range(0, len(rows), size)]
    stacked = [jax.tree_util.tree_map(lambda *X: np.stack(X), *(d for d, _ in chunk)) for chunk in chunks]
    return lambda: jax.device_get([program(arrays) for arrays in stacked])


def shared(records, samples, devices, folder):
    """The batch in a process with so many host devices."""
    out = f"{folder}/{devices}.npz"
    command = [sys.executable, __file__, "--records", str(records), "--samples", str(samples), "--worker", out]
    flags = f"--xla_force_host_platform_device_count={devices}"
    # How many threads they need is for the package to say.
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    subprocess.run(command, env=environment | {"XLA_FLAGS": flags}, check=True)
    return dict(np.load(out))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=256)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--singles", type=int, default=16)
    parser.add_argument("--devices", type=int, nargs="*", default=[1, 2, 4])
    parser.add_argument("--json")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    records = [record_of(k, arguments.samples) for k in range(arguments.records)]
    took, found = timed(lambda: jaxgray.identify_many(records, **OPTIONS))
    if arguments.worker:
        matrices = np.stack([found.mass, found.damping, found.stiffness])
        np.savez(arguments.worker, seconds=took, matrices=matrices)
        return
    result = {"cores": os.cpu_count(), "batch_s": took, "successful": int(found.successful.sum())}
    result["alone"] = int(found.alone.sum())
    few, scale = records[: arguments.singles], arguments.records / arguments.singles
    result["identify_s"] = scale * timed(lambda: [jaxgray.identify(r, **OPTIONS) for r in few], 1)[0]
    begun = [jaxgray.identify(r, refine=False, **OPTIONS) for r in records]
    signals = [prepare(r, b.scaling) for r, b in zip(records, begun)]
    result["refine_batch_s"], ends = timed(refined_side_by_side(begun, signals))
    settled = np.concatenate([end.settled for end in ends])
    batches = [Batch.of([s]) for s in signals[: arguments.singles]]

    def refined():
        return [
            refine(b.start.matrices, batch, b.setting, deviation=jax.numpy.asarray(b.start.deviation))
            for b, batch in zip(begun, batches)
        ]

    took, ones = timed(refined, 1)
    result["refine_s"] = scale * took
    masses = np.concatenate([end.matrices[0] for end in ends])
    apart = max(np.abs(masses[k] / one.mass - 1).max() for k, one in enumerate(ones))
    result["refine_apart"], result["refine_settled"] = float(apart), int(settled.sum())
    result["program_s"] = scale * timed(lambda: [jaxgray.identify_many([r], **OPTIONS) for r in few], 1)[0]
    result["batch_again_s"] = timed(lambda: jaxgray.identify_many(records, **OPTIONS))[0]
    best = min(result["batch_s"], result["batch_again_s"])
    print(f"{arguments.records} records of {arguments.samples} samples, {result['cores']} cores")
    print(f"identify_many                           {best:8.3f} s", end="")
    print(f"  {result['successful']} successful, {result['alone']} of them one by one")
    for name, key in (
        ("identify, one by one", "identify_s"),
        ("identify_many of one record, one by one", "program_s"),
    ):
        result[key.replace("_s", "_ratio")] = result[key] / best
        print(f"{name:40s}{result[key]:8.3f} s  ratio {result[key] / best:.1f}")
    result["refine_ratio"] = result["refine_s"] / result["refine_batch_s"]
    print(f"refinement alone, one batch             {result['refine_batch_s']:8.3f} s", end="")
    print(f"  {result['refine_settled']} settled, mass {apart:.1e} from those one by one")
    print(f"refine, one by one                      {result['refine_s']:8.3f} s  ratio {result['refine_ratio']:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        runs = {k: shared(arguments.records, arguments.samples, k, folder) for k in arguments.devices}
    result["devices"] = {}
    for k, run in runs.items():
        first = runs[arguments.devices[0]]["matrices"]
        largest = np.abs(first).max(axis=(2, 3), keepdims=True)
        apart = float(np.nanmax(np.abs(run["matrices"] - first) / largest))
        result["devices"][k] = {"seconds": float(run["seconds"]), "apart": apart}
        print(f"{k} host devices: {float(run['seconds']):.3f} s, difference over largest entry {apart:.1e} (bar 1e-10)")
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
