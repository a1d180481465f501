"""What an accelerator gains: batched simulation, batched refinement and a sweep's factors, beside the CPU in one run.

    python benchmarks/gpu.py [--records 256] [--samples 2000] [--repeats 5] [--cpu] [--json OUT]

Where jax sees no accelerator it says so and ends with 0; `--cpu` then still runs the cases on the CPU alone. Data come
from SciPy (tests/independent.py). The results of both devices must agree.
"""

import argparse
import json
import os
import pathlib
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.batch.steps import One, refine_one  # noqa: E402
from jaxgray.identification.setup.options import drive_of  # noqa: E402
from jaxgray.identification.setup.prediction import Batch, Nuisance, Setting, free_run  # noqa: E402
from jaxgray.identification.setup.preparation import prepare, scaling_of  # noqa: E402
from jaxgray.identification.setup.structure import Structure  # noqa: E402
from jaxgray.identification.subspace.compression import factors  # noqa: E402
from jaxgray.identification.subspace.filter_bank import pole  # noqa: E402
from jaxgray.numerics.matrices.linear_algebra import triangle_vector  # noqa: E402

H = data.REFERENCE_TIME
TIME_CONSTANTS, BLOCK_ROWS = 64, 10
AGREEMENT = 1e-6
"""Largest difference of two devices, relative to the norm of what they computed."""
CLOSE = 0.01
"""Largest difference of refined entries in standard errors: a refinement ends where the next step is next to nothing
beside the noise, and rounding decides whether it takes that step."""


def prepared(records, samples):
    """One system, many noise seeds and inputs, all in the scaling of the first record."""
    raw = [jaxgray.Record(*data.reference_record(seed, samples=samples)[:2], H) for seed in range(records)]
    scaling = scaling_of(raw[:1])
    drive = drive_of(raw[0], "force", None, False).scaled(scaling.coordinates, scaling.inputs, H)
    setting = Setting(drive, raw[0].measured, raw[0].hold)
    start = scaling.matrices_in(*(1.05 * X for X in data.REFERENCE.values()))
    return [prepare(record, scaling) for record in raw], setting, start


def cases(records, samples):
    """Name, compiled function, its arguments as arrays, how results are compared, and the bar."""
    signals, setting, start = prepared(records, samples)
    batch = Batch.of(signals)

    def resting(count):
        return Nuisance(jnp.zeros((count, 4)), jnp.zeros((count, 2)), None)

    @jax.jit
    def simulate(matrices, batch):
        return free_run(setting.system(*matrices), batch, resting(batch.u.shape[0]))

    @jax.jit
    def refine(start, batch):
        def one(u, y, kept):
            found = refine_one(start, One(u, y, kept, kept[:, 0]), setting, Structure(), gaps=False)
            entries = jnp.concatenate([triangle_vector(X) for X in found.matrices])
            return entries, jnp.sqrt(jnp.diag(found.covariance))

        return jax.vmap(one)(batch.u, batch.y, batch.kept)

    longest, _, _ = prepared(1, 20000)
    poles = pole(jnp.geomspace(0.01, 0.3, TIME_CONSTANTS), H)

    @jax.jit
    def compress(poles, stacked, inside):
        # A factor is unique up to the signs of its rows: its Gram matrix is what two devices can agree on.
        table, _ = factors(poles, stacked, inside, inputs=2, block_rows=BLOCK_ROWS, householder=False)
        return jnp.einsum("trc,trd->tcd", table, table)

    return (
        (f"simulate {records} records of {samples}", simulate, (start, batch), in_norm, AGREEMENT),
        (f"refine {records} records of {samples}", refine, (start, batch), in_standard_errors, CLOSE),
        (
            f"factors of {TIME_CONSTANTS} τ, 20 000 samples",
            compress,
            (poles, longest[0].stacked, longest[0].inside),
            in_norm,
            AGREEMENT,
        ),
    )


def timed(function, arguments, device, repeats):
    """First call, median of the later ones [s], and the result on the host."""
    here = jax.device_put(arguments, device)
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        result = jax.block_until_ready(function(*here))
        seconds.append(time.perf_counter() - began)
    return seconds[0], float(np.median(seconds[1:])), jax.tree_util.tree_map(np.asarray, result)


def in_norm(one, other):
    """Difference of two arrays relative to the norm of the first."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(one))


def in_standard_errors(one, other):
    """Largest difference of entries in standard errors."""
    return float(np.max(np.abs(one[0] - other[0]) / one[1]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=256)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cpu", action="store_true", help="run on the CPU where there is no accelerator")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()

    accelerators = [device for device in jax.devices() if device.platform != "cpu"]
    result = {"accelerator": accelerators[0].device_kind if accelerators else None, "rows": []}
    if not accelerators:
        print(f"jax {jax.__version__} sees no accelerator here (its devices: {jax.devices()}): nothing to compare.")
    else:
        print(f"{result['accelerator']} beside {os.cpu_count()} CPU cores, 64-bit floats, jax {jax.__version__}")
    failed = False
    if accelerators or options.cpu:
        devices = [jax.devices("cpu")[0], *accelerators[:1]]
        print(
            f"{'':40s}{'CPU s':>10s}{'first':>8s}"
            + (f"{'here s':>10s}{'first':>8s}{'ratio':>8s}" * len(accelerators[:1]))
        )
        for name, function, arguments, apart, bar in cases(options.records, options.samples):
            found = [timed(function, arguments, device, options.repeats) for device in devices]
            row = {"name": name, "first": [f[0] for f in found], "seconds": [f[1] for f in found]}
            line = f"{name:40s}" + "".join(f"{warm:10.4f}{first:8.1f}" for first, warm, _ in found)
            if accelerators:
                row["ratio"] = found[0][1] / found[1][1]
                row["difference"] = apart(found[0][2], found[1][2])
                failed |= not row["difference"] <= bar
                line += f"{row['ratio']:8.1f}   results differ by {row['difference']:.1e} (bar {bar:g})"
            print(line, flush=True)
            result["rows"].append(row)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
