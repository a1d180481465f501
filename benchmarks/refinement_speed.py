"""The prediction-error refinement of one record, beside a tuned SciPy gray-box fit from the same start.

    python benchmarks/refinement_speed.py [--samples 20000] [--repeats 5] [--json OUT]

The peer minimises the same output error over the same 15 parameters (nine entries, first state, offsets) with
`scipy.optimize.least_squares` (Levenberg-Marquardt of MINPACK, parameters scaled): the model is sampled by the matrix
exponential, brought to modal form, and simulated by `lfilter`, one complex filter per mode; the columns of first
state and offsets are analytic, the others 2-point differences. Both end where they end; errors are compared.
"""

import argparse
import json
import os
import pathlib
import sys
import time

os.environ["OPENBLAS_NUM_THREADS"] = str(os.cpu_count())
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.signal

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.refinement.normal_equations import Criterion, Iterate, join, part, sensitivities  # noqa: E402
from jaxgray.identification.refinement.refine import refine  # noqa: E402
from jaxgray.identification.setup.prediction import Batch, free_run  # noqa: E402
from jaxgray.identification.setup.preparation import prepare  # noqa: E402

H = data.REFERENCE_TIME
TRUTH = tuple(data.REFERENCE.values())
PICK = ((0, 0, 1), (0, 1, 1))


def of(p):
    return [np.array([[p[k], p[k + 1]], [p[k + 1], p[k + 2]]]) for k in (0, 3, 6)]


def simulated(p, u):
    """Outputs for nine entries and a first state, and the free responses, by modal filters."""
    A, B = data.state_space(*of(p), np.eye(2))
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * H)
    values, vectors = np.linalg.eig(flow[:4, :4])
    modal = np.linalg.solve(vectors, flow[:4, 4:].astype(complex))
    rows = np.linalg.inv(vectors)
    y, free = 0.0, 0.0
    for k in np.flatnonzero(values.imag > 0):
        forced = scipy.signal.lfilter([0.0, 1.0], [1.0, -values[k]], u @ modal[k])
        decay = values[k] ** np.arange(len(u))
        y = y + 2 * np.real(np.outer(forced, vectors[:2, k]))
        free = free + 2 * np.real(np.einsum("n,o,s->nos", decay, vectors[:2, k], rows[k]))
    return y + free @ p[9:13], free


def peer(start, u, y):
    scale = np.concatenate([np.abs(start), np.full(4, 0.01), np.full(2, 0.01)])

    def residual(q):
        p = q * scale
        return (simulated(p, u)[0] + p[13:] - y).ravel()

    def jacobian(q):
        p = q * scale
        here, free = simulated(p, u)
        columns = []
        for k in range(9):
            moved = p.copy()
            moved[k] += 1e-7 * scale[k]
            columns.append((simulated(moved, u)[0] - here).ravel() / 1e-7)
        rest = np.concatenate([free, np.broadcast_to(np.eye(2), (len(u), 2, 2))], axis=2).reshape(-1, 6) * scale[9:]
        return np.concatenate([np.stack(columns, axis=1), rest], axis=1)

    first = np.concatenate([start / scale[:9], np.zeros(6)])
    end = scipy.optimize.least_squares(residual, first, jacobian, method="lm", xtol=1e-8, ftol=1e-10)
    return of(end.x * scale), end.nfev


def timed(function, repeats):
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return float(np.median(times)), found


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=20000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    u, y, _ = data.reference_record(0, samples=arguments.samples)
    record = jaxgray.Record(u, y, H)
    begun = jaxgray.identify(record, refine=False)
    batch = Batch.of([prepare(record, begun.scaling)])
    deviation = jax.numpy.asarray(begun.start.deviation)
    start = np.concatenate([X[PICK] for X in (begun.mass, begun.damping, begun.stiffness)])

    def ours():
        found = refine(begun.start.matrices, batch, begun.setting, deviation=deviation)
        return begun.scaling.matrices_out(found.mass, found.damping, found.stiffness)

    end = refine(begun.start.matrices, batch, begun.setting, deviation=deviation)

    @jax.jit
    def jacobian(vector):
        def run(vector):
            matrices = begun.structure.matrices(part(vector, (2, 2, 2)), 2)
            return free_run(begun.setting.system(*matrices), batch, end.nuisance)

        return jax.jacfwd(run)(vector)

    vector = join(end.blocks)
    # Interleaved, so that whatever else the machine does strikes both.
    pairs = [(timed(ours, 1), timed(lambda: peer(start, u, y), 1)) for _ in range(arguments.repeats)]
    result = {
        "cores": os.cpu_count(),
        "refine_s": float(np.median([a[0] for a, _ in pairs])),
        "scipy_s": float(np.median([b[0] for _, b in pairs])),
        "steps": list(end.steps),
        "errors": data.relative_errors(pairs[0][0][1], TRUTH).tolist(),
        "scipy_errors": data.relative_errors(pairs[0][1][1][0], TRUTH).tolist(),
        "jacobian_ms": 1e3 * timed(lambda: jacobian(vector), 20)[0],
    }
    at, criterion = Iterate(end.blocks, end.nuisance, np.eye(2)), Criterion(batch, begun.setting, begun.structure)
    everything = timed(lambda: sensitivities(at, criterion), 10)
    result["sensitivities_ms"] = 1e3 * everything[0]
    result["ratio"] = result["scipy_s"] / result["refine_s"]
    print(f"N = {arguments.samples}, {result['cores']} cores")
    print(
        f"refinement from the start        {result['refine_s']:.3f} s (bar 0.1), steps {result['steps']}, errors",
        end="",
    )
    print("".join(f" {e:.1e}" for e in result["errors"]))
    print(f"SciPy least_squares, same start  {result['scipy_s']:.3f} s, errors", end="")
    print("".join(f" {e:.1e}" for e in result["scipy_errors"]) + f"  ratio {result['ratio']:.1f} (bar 5)")
    print(f"Jacobian by nine parameters      {result['jacobian_ms']:.2f} ms (bar 6)")
    print(f"with first state and offsets     {result['sensitivities_ms']:.2f} ms")
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
