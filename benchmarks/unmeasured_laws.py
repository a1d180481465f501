"""Laws where no sensor is: how often `jaxgray.diagnose(hidden=1)` names them from the motor's encoder alone.

    python benchmarks/unmeasured_laws.py --seeds 60 --nulls 60 --json laws.json

A drive of two inertias, a force and an encoder at the first, y1; the second, h1, is seen by nothing. In turn a cubic
spring, a backlash or Coulomb friction acts in the gear (y1-h1), or Coulomb friction or a cubic spring at the load (h1).
Records come from an independent simulator (`tests/hidden.py`), every one with a second for validation; the noise is
such that the best linear model of the drive, found by SciPy, is off by 1.3 to 12 times as much.
"""

import argparse
import json
import os
import pathlib
import sys
import time
import traceback

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAXGRAY_PROGRAMS", "0")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np
import scipy.optimize

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
import independent  # noqa: E402
from hidden_draws import log_uniform, rms  # noqa: E402

import jaxgray  # noqa: E402

SAMPLES, SAMPLING_TIME, TORQUE = 4000, 0.004, 20.0
EXCESS = 1.3, 12.0
"""Residual of the best linear model over the noise, squares of both added."""

LEAST_NOISE, LARGEST_NOISE = 1e-4, 0.1
"""Relative to the motion of the motor."""

LAWS = (
    ("cubic_stiffness", "y1-h1"),
    ("dead_zone_stiffness", "y1-h1"),
    ("coulomb_friction", "h1"),
    ("coulomb_friction", "y1-h1"),
    ("cubic_stiffness", "h1"),
)
LINE = np.array([[1.0, -1.0], [-1.0, 1.0]])
E = np.eye(2, 1)


def torque(rng):
    """Steps of random height, a tenth of a second long."""
    return np.repeat(rng.uniform(-TORQUE, TORQUE, (SAMPLES // 25 + 1, 1)), 25, axis=0)[:SAMPLES]


def drive(rng, law):
    """M, D, K of a drive; its load is held by a spring where the law is one at the load."""
    M = np.diag([rng.uniform(1.0, 3.0), rng.uniform(0.6, 2.0)])
    D = rng.uniform(0.3, 1.0) * LINE + np.diag(rng.uniform(0.8, 2.0, 2))
    K = rng.uniform(200.0, 400.0) * LINE
    return M, D, K + np.diag([0.0, rng.uniform(20.0, 60.0)]) if law == ("cubic_stiffness", "h1") else K


def hidden_law(rng, law, matrices, y):
    """The law with values for the linear motion `y`, and the stiffness that is left beside it."""
    name, place = law
    K = matrices[2]
    q = y[:, 0] - y[:, 1] if place == "y1-h1" else y[:, 1]
    size, spring = rms(q), K[0, 0] if place == "y1-h1" else K.sum()
    if name == "cubic_stiffness":
        most = 0.25 if place == "y1-h1" else 0.05
        values = {"k3": log_uniform(rng, most / 5, most) * spring / size**2}
    elif name == "dead_zone_stiffness":
        values = {"k": spring, "gap": rng.uniform(0.2, 0.6) * size}
        K = K - spring * LINE
    else:
        values = {"Fc": rng.uniform(0.05, 0.25) * rms(torque(rng))[0]}
    return hidden.Effect(name, place.replace("h1", "y2"), values), K


def linear_residual(matrices, u, y):
    """What the best linear model of the drive leaves of the motor's motion, from the true one without the law."""
    M, D, K = matrices
    held = K.sum() > 1.0
    start = np.array([M[0, 0], M[1, 1], -D[0, 1], D[0].sum(), D[1].sum(), -K[0, 1], *([K.sum()] if held else [])])

    def left(logarithms):
        p = start * np.exp(logarithms[: len(start)])
        M, D = np.diag(p[:2]), p[2] * LINE + np.diag(p[3:5])
        K = p[5] * LINE + np.diag([0.0, p[6] if held else 0.0])
        run = independent.simulate(M, D, K, u, SAMPLING_TIME, E=E)[:, 0]
        return np.nan_to_num((y[:, 0] - run) / rms(y)[0], nan=1e3, posinf=1e3, neginf=-1e3)

    end = scipy.optimize.least_squares(left, np.zeros(len(start)), max_nfev=40, x_scale=0.1)
    return rms(left(end.x)) * rms(y)[0]


def case(seed, law, system, *, tries=40):
    """Records for the fit and for validation, the law, and by how many times the noise the linear model is off."""
    rng = np.random.default_rng(seed)
    for _ in range(tries):
        matrices = drive(rng, system)
        inputs = [torque(rng), torque(rng)]
        linear = independent.simulate(*matrices, inputs[0], SAMPLING_TIME, E=E)
        if law is None:
            runs, effect, excess = (
                [independent.simulate(*matrices, u, SAMPLING_TIME, E=E)[:, :1] for u in inputs],
                None,
                1.0,
            )
            noise = log_uniform(rng, 3e-4, 3e-2) * rms(runs[0])[0]
        else:
            effect, K = hidden_law(rng, law, matrices, linear)
            system = hidden.System(*matrices[:2], K, E)
            runs = [hidden.simulate(system, u, SAMPLING_TIME, (effect,))[:, :1] for u in inputs]
            if not all(np.all(np.isfinite(y)) for y in runs):
                continue
            excess = log_uniform(rng, *EXCESS)
            noise = linear_residual(matrices, inputs[0], runs[0]) / np.sqrt(excess**2 - 1)
            if not LEAST_NOISE < noise / rms(runs[0])[0] < LARGEST_NOISE:
                continue
        noisy = [y + noise * rng.standard_normal(y.shape) for y in runs]
        records = [jaxgray.Record(u, y, SAMPLING_TIME) for u, y in zip(inputs, noisy)]
        return records, effect, excess
    raise RuntimeError(f"no record with {law} in {tries} tries")


def run(seed, law, system):
    """One record, diagnosed and judged; `system`: the law whose drive is taken where `law` is None."""
    row = {"seed": seed, "law": None if law is None else f"{law[0]} at {law[1]}"}
    try:
        (estimation, validation), effect, excess = case(seed, law, system)
        row |= {"excess": excess, "parameters": None if effect is None else effect.parameters}
        begun = time.perf_counter()
        structure = "y1-h1, y1-ground:damper, h1-ground:damper"
        if system == ("cubic_stiffness", "h1"):
            structure += ", h1-ground:spring"
        found = jaxgray.diagnose(estimation, validation=validation, hidden=1, structure=structure)
        row["seconds"] = time.perf_counter() - begun
        causes = [f for f in found.findings if f.stage == "model" and f.status != "unexplained"]
        named = [(f.effect, f.location) for f in causes]
        row |= {"verdict": found.verdict, "found": named, "excess_found": found.baseline_excess, "left": found.excess}
        row["class"] = [[(m.effect, m.location) for m in f.members] for f in causes]
        row["exact"] = named == ([] if law is None else [law]) and all(len(members) == 1 for members in row["class"])
        row["in_class"] = len(named) == 1 and law in row["class"][0] if law else not named
        if law in named:
            known = causes[named.index(law)].parameters
            row["deviations"] = {
                name: abs(known[name].value - value) / known[name].standard_error
                for name, value in effect.parameters.items()
            }
    except Exception:
        row |= {"failed": traceback.format_exc(limit=-3), "exact": False, "in_class": False}
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=60, help="records with a law, one law after the other")
    parser.add_argument("--nulls", type=int, default=60, help="records without one")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--json", type=pathlib.Path, help="file for every record's figures")
    given = parser.parse_args()
    cases = [(given.first + k, LAWS[k % len(LAWS)], LAWS[k % len(LAWS)]) for k in range(given.seeds)]
    cases += [(100_000 + given.first + k, None, LAWS[k % len(LAWS)]) for k in range(given.nulls)]
    rows = []
    for seed, law, system in cases:
        rows.append(run(seed, law, system))
        row = rows[-1]
        said = "FAILED" if "failed" in row else f"{row['verdict']}: {row['class']} {row['seconds']:.1f} s"
        mark = "✓" if row["exact"] else "~" if row["in_class"] else "·"
        print(f"{mark} {seed} {row['law']} ({row.get('excess', 0):.1f}): {said}", flush=True)
        if given.json:
            given.json.write_text(json.dumps(rows, indent=1, default=float))
    for kind, some in (("with a law", [r for r in rows if r["law"]]), ("without", [r for r in rows if not r["law"]])):
        if some:
            count = {key: sum(row[key] for row in some) for key in ("exact", "in_class")}
            print(f"{kind}: {len(some)} records, exact {count['exact']}, in class {count['in_class']}")
    deviations = [d for row in rows for d in row.get("deviations", {}).values()]
    print(f"parameters within 3 standard errors: {sum(d <= 3 for d in deviations)} of {len(deviations)}")


if __name__ == "__main__":
    main()
