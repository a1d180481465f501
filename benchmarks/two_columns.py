"""A simulation of which only the outputs are known, beside what was measured: what is said of the differences.

    python benchmarks/two_columns.py [--first 1] [--records 60] [--json OUT]

The simulation has one law; the machine has it with another size (20 to 40 % more or less), or has one law more, or is
the same. Both columns come from an independent simulator (tests/hidden_simulation.py), the simulated one without noise.
Seeds 1 to 99 served development.
"""

import argparse
import dataclasses
import json
import pathlib
import sys
import time
import warnings

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
from hidden_simulation import simulate  # noqa: E402

import jaxgray  # noqa: E402

KINDS = ("number", "law", "nothing")
LAWS = (
    ("coulomb_friction", "cubic_stiffness"),
    ("cubic_stiffness", "coulomb_friction"),
    ("quadratic_drag", "coulomb_friction"),
    ("coulomb_friction", "quadratic_stiffness"),
    ("bilinear_stiffness", "quadratic_drag"),
)
"""The law of the simulation, and one that it may lack."""

SIZES = {
    "coulomb_friction": "Fc",
    "cubic_stiffness": "k3",
    "quadratic_drag": "c2",
    "quadratic_stiffness": "k2",
    "bilinear_stiffness": "ks",
}


def judged(seed):
    kind, pair = KINDS[seed % len(KINDS)], LAWS[(seed // len(KINDS)) % len(LAWS)]
    rng = np.random.default_rng([seed, 31])
    case = hidden.random_pair(rng, pair=pair, dofs=(1, 2), samples=3000, excess=(8.0, 20.0))
    own, new = case.effects
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.2, 0.4)
    size = own.parameters[SIZES[own.id]]
    parts = {
        "number": (dataclasses.replace(own, parameters=own.parameters | {SIZES[own.id]: factor * size}),),
        "law": (own, new),
        "nothing": (own,),
    }
    run = {"hold": case.hold}
    records, columns = [], []
    for u in (case.u, case.u_v):
        y = simulate(case.system, u, case.sampling_time, parts[kind], **run)
        y = y + case.noise * rng.standard_normal(y.shape)
        records.append(jaxgray.Record(u, y, case.sampling_time, **run))
        columns.append(simulate(case.system, u, case.sampling_time, (own,), **run))
    row = {"seed": seed, "kind": kind, "laws": pair, "places": (own.place, new.place)}
    began = time.perf_counter()
    try:
        found = jaxgray.diagnose(records[0], simulated=columns[0], validation=records[1])
    except (jaxgray.ComputationError, ValueError) as error:
        return row | {"failed": str(error)}
    laws = [f for f in found.findings if f.stage == "model" and f.effect != "unexplained"]
    members = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in laws]
    name = f"{SIZES[own.id]} of {own.id} at {own.place}"
    truth = {"number": ("parameter_error", name), "law": (new.id, new.place), "nothing": None}[kind]
    row["right"] = not laws if truth is None else len(laws) == 1 and truth in members[0]
    row |= {"verdict": found.verdict, "found": [sorted(m) for m in members], "truth": truth}
    if kind == "number" and row["right"]:
        delta = laws[0].parameters["delta"]
        row["deviation"] = abs(delta.value - (factor - 1) * size) / delta.standard_error
    left = None if found.simulated is None else max(found.simulated.left_percent.values())
    return row | {"left": left, "seconds": time.perf_counter() - began}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--records", type=int, default=60)
    parser.add_argument("--json")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for seed in range(given.first, given.first + given.records):
        try:
            rows.append(judged(seed))
        except hidden.TooHard:
            continue
        print(rows[-1], flush=True)
        if given.json:
            pathlib.Path(given.json).write_text(json.dumps(rows, indent=1, default=float))
    for kind in KINDS:
        group = [r for r in rows if r["kind"] == kind]
        print(f"two columns, {kind}: {sum(r.get('right', False) for r in group)} of {len(group)}")


if __name__ == "__main__":
    main()
