"""Laws that robots need, on records of an independent simulator: friction that grows with the load, a limit of the
force that falls with the speed, and static records of load and deflection.

    python benchmarks/robot_laws.py [--first 1] [--records 20] [--rows two,one,limit,static] [--json OUT]

`two`, `one`: an axis that pushes one load or, in records of their own, two of them to and fro, with load friction:
named, or in a class with Coulomb friction and with what tells them apart, since the size of the force never changes.
`limit`: random systems whose input is limited by the speed. `static`: slow loads on a spring with backlash, a stop, a
cubic part or hysteresis. Seeds 1 to 99 served development.
"""

import argparse
import json
import pathlib
import sys
import time
import warnings

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np
import scipy.optimize

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
import hidden_draws as draws  # noqa: E402
from hidden_laws import Effect  # noqa: E402
from hidden_simulation import simulate  # noqa: E402

import jaxgray  # noqa: E402

H = 0.01
SAMPLES = 3000
LOADS = (1.0, 3.0)
"""Sizes of the force, relative to one another."""


def payloads(seed, loads):
    """Records of one axis with load friction, two of every load; the last ones are held out."""
    rng = np.random.default_rng([seed, 21])
    system = draws.random_system(rng, 1)
    level, mu = draws.log_uniform(rng, 0.3, 30.0), rng.uniform(0.05, 0.25)
    records = []
    for load in (*loads, *loads):
        u = load * level * np.where(draws.steps(rng, SAMPLES) > 0, 1.0, -1.0)[:, None]
        y = simulate(system, u, H, [Effect("load_friction", "u1", {"mu": mu})])
        noise = rng.uniform(0.005, 0.02) * y.std()
        records.append(jaxgray.Record(u, y + noise * rng.standard_normal(y.shape), H))
    return records[: len(loads)], records[len(loads) :], mu


def limited(seed):
    """A random system, one input of which is limited by the speed."""
    rng = np.random.default_rng([seed, 22])
    case = hidden.random_case(rng, "speed_force_limit", dofs=(1, 2), samples=SAMPLES, excess=(3.0, 12.0))
    made = ((case.u, case.y), (case.u_v, case.y_v))
    records = [jaxgray.Record(u, y, case.sampling_time, hold=case.hold) for u, y in made]
    return records[:1], records[1:], case.effects[0]


STATIC = ("dead_zone_stiffness", "end_stop", "cubic_stiffness", "play_hysteresis")


def static(seed):
    """Load and deflection, slow: y of k y + f(y) = u, or k y = u beside play, with noise."""
    rng = np.random.default_rng([seed, 23])
    law = STATIC[seed % len(STATIC)]
    k, level = draws.log_uniform(rng, 10.0, 1e4), draws.log_uniform(rng, 1.0, 100.0)
    n = int(rng.choice([800, 1500]))
    t = np.arange(n) / n
    # Loads that come and go some times, of growing size: up and down through all of the way.
    turns = rng.integers(4, 9)
    u = level * np.interp(t, np.linspace(0, 1, 2 * turns + 1), _alternating(2 * turns + 1, rng))
    free = level / k
    share = rng.uniform(0.15, 0.6)
    if law == "play_hysteresis":
        y = u / k + share / k * _play(u, rng.uniform(0.2, 0.6) * level)
    else:
        gap = rng.uniform(*{"dead_zone_stiffness": (0.1, 0.25)}.get(law, (0.6, 0.8))) * free

        def left(q, load):
            if law == "cubic_stiffness":
                return k * q + share * k * q**3 / free**2 - load
            return k * q + share * 5 * k * _outside(q, gap) - load

        y = np.array([scipy.optimize.brentq(left, -2 * free, 2 * free, args=(load,)) for load in u])
    noise = rng.uniform(0.002, 0.01) * y.std()
    records = [jaxgray.Record(u, y + noise * rng.standard_normal(n), H)]
    return records, [], law


def _alternating(count, rng):
    sign = np.where(np.arange(count) % 2, 1.0, -1.0)
    size = rng.uniform(0.5, 1.0, count)
    size[0], size[-2] = 0.0, 1.0
    size[-1] = 1.0
    return sign * size


def _outside(q, gap):
    return q - np.clip(q, -gap, gap)


def _play(u, r):
    z, out = 0.0, np.empty(len(u))
    for k, value in enumerate(u):
        z = min(max(z, value - r), value + r)
        out[k] = z
    return out


def judged(row, seed):
    began = time.perf_counter()
    if row in ("one", "two"):
        records, held, truth = payloads(seed, LOADS if row == "two" else LOADS[:1])
        truth, wanted, place = {"mu": truth}, "load_friction", "u1"
    elif row == "limit":
        records, held, effect = limited(seed)
        truth, wanted, place = effect.parameters, effect.id, effect.place
    else:
        records, held, wanted = static(seed)
        truth, place = {}, None
    try:
        found = jaxgray.diagnose(records if len(records) > 1 else records[0], validation=held or None)
    except jaxgray.ComputationError as error:
        return {"row": row, "seed": seed, "failed": str(error)}
    laws = [f for f in found.findings if f.stage == "model" and f.effect != "unexplained"]
    members = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in laws]
    hits = [{e for e, where in m if e == wanted and (place is None or where == place)} for m in members]
    one = len(laws) == 1 and bool(hits[0])
    result = {"row": row, "seed": seed, "wanted": [wanted, place], "verdict": found.verdict}
    result |= {"found": [sorted(m) for m in members], "alone": one and len(members[0]) == 1, "in_class": one}
    result["truth"] = truth
    result["values"] = {n: (e.value, e.standard_error) for f in laws[:1] for n, e in f.parameters.items()}
    if row == "one":
        coulomb = one and ("coulomb_friction", "y1") in members[0]
        result["right"] = coulomb and "payload" in str(found)
    else:
        result["right"] = result["alone"]
    return result | {"excess": found.baseline_excess, "seconds": time.perf_counter() - began}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--records", type=int, default=20, help="of each row")
    parser.add_argument("--rows", default="two,one,limit,static")
    parser.add_argument("--json")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for row in given.rows.split(","):
        for k in range(given.records):
            rows.append(judged(row, given.first + k))
            print(rows[-1], flush=True)
            if given.json:
                pathlib.Path(given.json).write_text(json.dumps(rows, indent=1, default=float))
    for row in given.rows.split(","):
        group = [r for r in rows if r["row"] == row]
        right, inside = (sum(r.get(name, False) for r in group) for name in ("right", "in_class"))
        print(f"{row}: right {right}, in class {inside} of {len(group)}")


if __name__ == "__main__":
    main()
