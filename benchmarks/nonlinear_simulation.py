"""Simulation with three nonlinear effects and its Jacobian by all parameters, beside diffrax, at equal accuracy.

    python benchmarks/nonlinear_simulation.py [--samples 20000] [--repeats 5] [--json OUT]

The paper's system with Coulomb friction at one coordinate, a hardening spring at the other and backlash between them,
under random steps of force. Value and Jacobian by 17 parameters: nine entries of M, D, K, the four of the laws, and the
first state. jaxgray takes whole samples in 1, 2, 4, … steps; diffrax takes Tsit5 and Dopri5 with step size control,
told of every jump of the force (without, it is slower), derivatives forward through the solver (its `ForwardMode`).
Both are compared with diffrax's Dopri8 at a tolerance of 1e-11. Rows are timed in turns, warm; medians. The end gives
for every row of jaxgray the time of diffrax at the same error, from a straight line through its rows (logarithmic).
"""

import argparse
import functools
import json
import os
import pathlib
import sys
import time
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import independent as data  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from jaxgray.mechanics.effects import by_id  # noqa: E402
from jaxgray.mechanics.effects.base import Place, Term  # noqa: E402
from jaxgray.mechanics.runs.extended import Plant, slots_of  # noqa: E402
from jaxgray.mechanics.runs.tangents import Directions, run_and_tangents  # noqa: E402
from jaxgray.mechanics.systems.drives import Force  # noqa: E402

H = data.REFERENCE_TIME
M, D, K = data.REFERENCE.values()
FRICTION, EPS, CUBIC, CONTACT, GAP = 0.2, 0.002, 2e5, 60.0, 0.003
TERMS = (
    Term(by_id("coulomb_friction"), Place("y1", 0), jnp.array([FRICTION, EPS])),
    Term(by_id("cubic_stiffness"), Place("y2", 1), jnp.array([CUBIC])),
    Term(by_id("dead_zone_stiffness"), Place("y1-y2", 0, 1), jnp.array([CONTACT, GAP])),
)
LAWS = tuple(term.effect for term in TERMS)
FREE = ((0, 0), (1, 0), (2, 0), (2, 1))
"""Law and parameter that are differentiated by; the width over which the sign turns is a constant."""

NAMES = ("M", "D", "K", "laws", "first state")
PARTS = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 13), slice(13, 17))


def unpacked(theta):
    """M, D, K, values of the laws, first state."""
    X = jnp.zeros((3, 2, 2)).at[:, [0, 0, 1, 1], [0, 1, 0, 1]].set(theta[:9].reshape(3, 3)[:, [0, 1, 1, 2]])
    return (*X, theta[9:13], theta[13:17])


THETA = np.concatenate(
    [*(X[[0, 0, 1], [0, 1, 1]] for X in (M, D, K)), [FRICTION, CUBIC, CONTACT, GAP], [0.001, -0.002, 0.01, 0.0]]
)


def jaxgray_run(u):
    """Value and Jacobian by jaxgray, as a function of the steps per sample."""

    def run(theta, u, substeps):
        Mt, Dt, Kt, values, x0 = unpacked(theta)
        plant = Plant(Mt, Dt, Kt, Force(jnp.eye(2)), ("displacement",) * 2)
        slots = slots_of(TERMS, plant, LAWS)
        rows, columns = zip(*FREE)
        table = slots.values.at[jnp.array(rows), jnp.array(columns)].set(values)
        slots = type(slots)(slots.law, slots.arms, slots.channel, table)
        unit = jnp.eye(17)
        along = jax.vmap(lambda d: jax.jvp(unpacked, (theta,), (d,))[1])(unit)
        moved = jnp.zeros((17, *table.shape)).at[:, jnp.array(rows), jnp.array(columns)].set(along[3])
        directions = Directions(*along[:3], along[4], moved)
        return run_and_tangents(plant, x0, u, u, slots, directions, jnp.asarray(H), laws=LAWS, substeps=substeps)

    one, several = jax.jit(lambda theta, u: run(theta, u, 1)), jax.jit(run)

    def timed(substeps):
        theta = jnp.asarray(THETA)
        return jax.block_until_ready(one(theta, u) if substeps == 1 else several(theta, u, jnp.asarray(substeps)))

    return timed


def force(values, q, v):
    """The same laws, written anew: what stands on the left side of the equation of motion."""
    Fc, k3, k, gap = values
    stretch = q[0] - q[1]
    contact = k * (stretch - jnp.clip(stretch, -gap, gap))
    return jnp.stack([Fc * jnp.clip(v[0] / EPS, -1.0, 1.0) + contact, k3 * q[1] ** 3 - contact])


def diffrax_run(u, solver):
    """Value and Jacobian by diffrax, as a function of the tolerance."""
    samples = len(u)
    jumps = H * (1 + np.flatnonzero(np.any(np.diff(np.asarray(u), axis=0) != 0, axis=1)))

    def rates(t, x, args):
        (Mt, Dt, Kt, values), u = args
        now = u[jnp.clip(jnp.floor(t / H + 1e-9).astype(int), 0, samples - 1)]
        a = jnp.linalg.solve(Mt, now - Dt @ x[2:] - Kt @ x[:2] - force(values, x[:2], x[2:]))
        return jnp.concatenate([x[2:], a])

    def run(theta, u, tolerance):
        *matrices, values, x0 = unpacked(theta)
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance * 1e-2)

        def args_of(matrices, values):
            return (*matrices, values), u

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            0.0,
            H * (samples - 1),
            None,
            x0,
            args_of(matrices, values),
            saveat=diffrax.SaveAt(ts=H * jnp.arange(samples)),
            stepsize_controller=diffrax.ClipStepSizeController(control, jump_ts=jumps),
            adjoint=diffrax.ForwardMode(),
            max_steps=50_000_000,
        )
        y = solution.ys[:, :2]
        return y, (y, solution.stats["num_steps"])

    def both(theta, u, tolerance):
        J, (y, steps) = jax.jacfwd(run, has_aux=True)(theta, u, tolerance)
        return y, J, steps

    compiled = jax.jit(both)
    return lambda tolerance: jax.block_until_ready(compiled(jnp.asarray(THETA), u, jnp.asarray(tolerance)))


def errors(found, reference):
    """Relative errors of the value and of the Jacobian, the worst group of parameters for the latter."""
    y, J = (np.asarray(part) for part in found[:2])
    groups = [np.linalg.norm(J[..., p] - reference[1][..., p]) / np.linalg.norm(reference[1][..., p]) for p in PARTS]
    return float(np.linalg.norm(y - reference[0]) / np.linalg.norm(reference[0])), float(max(groups))


def time_at(error, rows, kind):
    """Time of diffrax at an error, on the line through its two nearest rows."""
    points = sorted((np.log(row[kind]), np.log(row["seconds"])) for row in rows)
    x, t = np.array(points).T
    k = int(np.clip(np.searchsorted(x, np.log(error)), 1, len(x) - 1))
    share = (np.log(error) - x[k - 1]) / (x[k] - x[k - 1])
    inside = x[0] <= np.log(error) <= x[-1]
    return float(np.exp(t[k - 1] + share * (t[k] - t[k - 1]))), inside


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=pathlib.Path)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", DeprecationWarning)
    u = jnp.asarray(data.random_steps(np.random.default_rng(1), arguments.samples, 2, H))

    begun = time.perf_counter()
    tight = diffrax_run(u, diffrax.Dopri8())(1e-11)
    reference = tuple(np.asarray(part) for part in tight[:2])
    print(f"reference: {int(tight[2])} steps of Dopri8, {time.perf_counter() - begun:.0f} s", flush=True)

    ours = jaxgray_run(u)
    programs = {("jaxgray", f"{s} steps per sample"): functools.partial(ours, s) for s in (1, 2, 4, 8)}
    for solver in (diffrax.Tsit5(), diffrax.Dopri5()):
        peer = diffrax_run(u, solver)
        for tolerance in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
            programs["diffrax", f"{type(solver).__name__} {tolerance:.0e}"] = functools.partial(peer, tolerance)
    rows = {}
    for key, program in programs.items():
        found = program()
        value, jacobian = errors(found, reference)
        rows[key] = {"value": value, "jacobian": jacobian, "times": []}
    for _ in range(arguments.repeats):
        for key, program in programs.items():
            begun = time.perf_counter()
            program()
            rows[key]["times"].append(time.perf_counter() - begun)
    print(f"{'':8s} {'':22s} {'ms':>9s}  {'error of value':>15s}  {'of Jacobian':>12s}")
    for (who, how), row in rows.items():
        row["seconds"] = float(np.median(row["times"]))
        print(f"{who:8s} {how:22s} {1e3 * row['seconds']:9.1f}  {row['value']:15.2e}  {row['jacobian']:12.2e}")
    peers = {n: [r for (w, h), r in rows.items() if w == "diffrax" and h.startswith(n)] for n in ("Tsit5", "Dopri5")}
    for (who, how), row in rows.items():
        if who == "jaxgray":
            for kind in ("value", "jacobian"):
                times = {name: time_at(row[kind], part, kind) for name, part in peers.items()}
                best = min(times, key=lambda name: times[name][0])
                row[f"ratio_{kind}"] = times[best][0] / row["seconds"]
                outside = "" if times[best][1] else " (beyond the rows of diffrax)"
                print(
                    f"at the {kind} error of jaxgray, {how}: {best} takes {row[f'ratio_{kind}']:.1f}× as long{outside}"
                )
    if arguments.json:
        arguments.json.write_text(json.dumps({" ".join(key): row for key, row in rows.items()}, indent=1))


if __name__ == "__main__":
    main()
