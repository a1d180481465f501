"""Fixed sets of records whose answers every change of the diagnosis is held against, record by record.

    python benchmarks/yardstick.py --store NEW.json [--sets nulls,pairs] [--share 0.5] [--data DIR] [--cache DIR]
        [--setting NAME=VALUE ...]
    python benchmarks/yardstick.py --compare OLD.json NEW.json

The first command diagnoses the sets and stores every answer with its time after each record; called again with the same
file it does what is missing. `--setting` moves a threshold of `jaxgray/diagnosis/settings.py` first: how much hangs on
it shows in the comparison. The second counts per set what became better, worse and stayed the same, and tests the
difference by McNemar's test on the discordant records: unpaired counts of 200 records show no change below 6 %, paired
ones one of 3 %. Records are simulated (tests/hidden.py) from seeds that are spent: they say whether a change is one,
not how good the diagnosis is on records it has not seen.

singles   every effect once, the best linear fit off by about 1.3, 3 and 12 times the noise
nulls     nothing hidden: white, coloured and process noise, closed loops
pairs     twenty pairs of effects, once each
several   three or four effects at once, the best linear fit off by about 5 to 100 times the noise
measured  records in DIR with a known answer; left out where DIR is not given
"""

import argparse
import json
import math
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))

import hidden_effects  # noqa: E402  (sets the backend up)
import jax  # noqa: E402
import numpy as np  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.diagnosis import settings  # noqa: E402

hidden = hidden_effects.hidden

SEED = 20261125
"""Spent: answers on these records have been looked at."""

LEVELS = {"singles 1.3": (1.2, 1.4), "singles 3": (2.7, 3.3), "singles 12": (11.0, 13.0)}
NULLS = 6
"""Records of every kind of null."""

SEVERAL = (
    ("cubic_stiffness", "quadratic_stiffness", "constant_force", "sensor_offset"),
    ("coulomb_friction", "dead_zone_stiffness", "sine_stiffness"),
    ("input_saturation", "input_delay", "stribeck_friction"),
    ("cubic_stiffness", "coulomb_friction", "input_delay"),
    ("bilinear_stiffness", "coulomb_friction", "sensor_offset"),
    ("end_stop", "coulomb_friction", "actuator_lag"),
    ("quadratic_drag", "cubic_stiffness", "input_dead_zone"),
    ("play_hysteresis", "coulomb_friction", "cubic_stiffness"),
    ("unmodelled_mode", "coulomb_friction", "cubic_stiffness"),
    ("stiffness_step", "coulomb_friction", "quadratic_stiffness"),
)
"""Effects of one record, the smallest of them alone off by 3 to 20 times the noise."""

SIZE = {"samples": 4000, "dofs": (1, 2, 3)}

MEASURED = (
    ("silverbox", "silverbox_estimation.csv", "silverbox_validation.csv", "force", "position", {"cubic_stiffness"}),
    ("emps", "emps.csv", None, "force", "position", {"coulomb_friction", "asymmetric_friction"}),
    ("piezo", "piezo.csv", None, None, None, {"play_hysteresis"}),
    ("pendulum_energy", "pendulum_energy.csv", None, "torque", "angle", {"sine_stiffness"}),
    ("pendulum_pd", "pendulum_pd.csv", None, "torque", "angle", {"sine_stiffness"}),
)
"""Name, file, validation file, input, output, and effects of which the first finding must be one."""

HOLDS = {"silverbox": "linear"}

RIGHT, IN_CLASS, SILENT, WRONG = 3, 2, 1, 0
"""What an answer is worth: named with its place and nothing besides; in class; nothing said; something false."""


def cases():
    """(set, truth, number, generator, maker of the case, options of `diagnose`) of every simulated record."""
    for name, excess in LEVELS.items():
        for effect_id in hidden.DYNAMIC:
            rng = np.random.default_rng([SEED, hidden_effects.code(name), hidden_effects.code(effect_id)])
            make = lambda r, e=effect_id, x=excess: hidden.random_case(r, e, excess=x, **SIZE)  # noqa: E731
            yield name, effect_id, 0, rng, make, {}
    for kind in hidden.NULLS:
        for k in range(NULLS):
            rng = np.random.default_rng([SEED, 1, hidden_effects.code(kind), k])
            yield "nulls", kind, k, rng, lambda r, kind=kind: hidden.null_case(r, kind, **SIZE), {}
    for k in range(NULLS):
        rng = np.random.default_rng([SEED, 2, k])
        yield "nulls", "closed_loop", k, rng, lambda r: hidden.closed_loop_case(r, **SIZE), {}
    for k, pair in enumerate(hidden.PAIRS[:20]):
        rng = np.random.default_rng([SEED, 3, k])
        make = lambda r, p=pair: hidden.random_pair(r, pair=p, excess=(1.5, 4.0), **SIZE)  # noqa: E731
        yield "pairs", " + ".join(pair), 0, rng, make, {}
    for k, several in enumerate(SEVERAL):
        rng = np.random.default_rng([SEED, 4, k])
        make = lambda r, p=several: hidden.random_pair(r, pair=p, excess=(3.0, 20.0), **SIZE)  # noqa: E731
        yield "several", " + ".join(several), 0, rng, make, {}


def worth(row) -> int:
    """What the answer to a simulated record is worth."""
    if "failed" in row:
        return WRONG
    if row["set"] == "nulls":
        return WRONG if row["found"] else RIGHT
    if row["false_extra"]:
        return WRONG
    return RIGHT if row["name_and_place"] else IN_CLASS if row["in_class"] else SILENT


def measured(folder: pathlib.Path, name, file, held_out, source, output, expected) -> dict:
    """The answer to one measured record."""
    names = (folder / file).read_text().split("\n", 1)[0].split(",")
    bare = [column.split("[")[0].strip() for column in names]
    channels = {"inputs": [source or bare[1]], "outputs": [output or bare[2]]}
    records = [
        jaxgray.read_record(folder / one, hold=HOLDS.get(name, "zero"), **channels) for one in (file, held_out) if one
    ]
    start = time.perf_counter()
    found = jaxgray.diagnose(records[0], validation=records[1] if held_out else None)
    seconds = time.perf_counter() - start
    named = [f for f in found.findings if f.stage == "model"]
    members = [{m.effect for m in f.members} | {f.effect} for f in named]
    final = found.baseline if found.extended is None else found.extended
    row = {"verdict": found.verdict, "found": [(f.effect, f.location, f.status) for f in named], "seconds": seconds}
    row["found_by"] = [f.found_by for f in named]
    row["held_out"] = dict(final.rmse.get("validation", {}))
    row["worth"] = SILENT if not named else WRONG
    if named and members[0] & expected:
        row["worth"] = RIGHT if named[0].effect in expected and len(members[0]) == 1 else IN_CLASS
    return row


def store(path: pathlib.Path, sets: list[str], share: float, folder: pathlib.Path | None, *, more=dict, wanted=None):
    """Diagnose what the file does not hold yet, and write it after every record, with what `more` says of it; `wanted`:
    whether a record, by set, truth and number, is to be; default all."""
    rows = json.loads(path.read_text()) if path.exists() else []
    known = {(row["set"], row["truth"], row["number"]) for row in rows}

    def keep(row):
        rows.append(row | more())
        path.write_text(json.dumps(rows, default=lambda x: np.asarray(x).tolist(), indent=1))
        said = ", ".join(f"{e}@{p}" for e, p, _ in row.get("found", [])) or row.get("failed", "nothing")
        print(f"{row['set']:12s} {row['truth']:42s} {row['worth']} {said} {row.get('seconds', 0.0):.1f} s", flush=True)

    for number, (name, truth, k, rng, make, options) in enumerate(cases()):
        chosen = any(name.startswith(one) for one in sets) and (number * share) % 1.0 < share
        if not chosen or (name, truth, k) in known or not (wanted is None or wanted((name, truth, k))):
            continue
        row = hidden_effects.run("null" if name == "nulls" else "single", truth, rng, make, options, 0)
        row |= {"set": name, "number": k}
        keep(row | {"worth": worth(row)})
    for name, *rest in MEASURED if folder is not None and "measured" in sets else ():
        wished = wanted is None or wanted(("measured", name, 0))
        if wished and ("measured", name, 0) not in known and (folder / rest[0]).exists():
            row = {"set": "measured", "truth": name, "number": 0}
            try:
                row |= measured(folder, name, *rest)
            except Exception as error:
                row |= {"failed": f"{type(error).__name__}: {str(error)[:300]}", "worth": WRONG}
            keep(row)


def moved(assignments: list[str]):
    """Give thresholds other values, each as NAME=VALUE."""
    for text in assignments:
        name, _, value = text.partition("=")
        if not isinstance(getattr(settings, name, None), (int, float)):
            known = ", ".join(n for n, x in vars(settings).items() if isinstance(x, (int, float)))
            raise SystemExit(f"--setting {text}: {name!r} is no threshold; give one of {known}.")
        setattr(settings, name, type(getattr(settings, name))(float(value)))


def mcnemar(better: int, worse: int) -> float:
    """Two-sided exact p of so many discordant pairs."""
    n, k = better + worse, min(better, worse)
    return min(1.0, 2 * sum(math.comb(n, j) for j in range(k + 1)) / 2**n) if n else 1.0


def compare(old: list[dict], new: list[dict]):
    """Per set: how many answers became better, worse and stayed; p; times."""
    before, after = ({(r["set"], r["truth"], r["number"]): r for r in rows} for rows in (old, new))
    both = [key for key in before if key in after]
    print(
        f"{'set':12s} {'records':>7s} {'right':>11s} {'better':>6s} {'worse':>5s} {'same':>5s} {'p':>6s} {'time':>6s}"
    )
    for name in [*dict.fromkeys(key[0] for key in both), "all"]:
        keys = [key for key in both if name in (key[0], "all")]
        change = [after[key]["worth"] - before[key]["worth"] for key in keys]
        better, worse = sum(c > 0 for c in change), sum(c < 0 for c in change)
        right = [sum(rows[key]["worth"] == RIGHT for key in keys) for rows in (before, after)]
        pairs = [(before[k].get("seconds"), after[k].get("seconds")) for k in keys]
        ratio = np.median([b / a for a, b in pairs if a and b] or [np.nan])
        same = len(keys) - better - worse
        print(
            f"{name:12s} {len(keys):7d} {right[0]:4d} → {right[1]:4d} {better:6d} {worse:5d} {same:5d} "
            f"{mcnemar(better, worse):6.3f} {ratio:5.2f}×"
        )
    for key in both:
        a, b = before[key], after[key]
        if a["worth"] != b["worth"]:
            sign = "better" if b["worth"] > a["worth"] else "WORSE"
            print(f"  {sign:6s} {key[0]} {key[1]} #{key[2]}: {a.get('found')} → {b.get('found')}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=pathlib.Path, help="file of answers to make or to complete")
    parser.add_argument("--compare", nargs=2, type=pathlib.Path, metavar=("OLD", "NEW"))
    parser.add_argument("--sets", default="singles,nulls,pairs,measured")
    parser.add_argument("--share", type=float, default=1.0, help="share of the simulated records, the same ones always")
    parser.add_argument("--data", type=pathlib.Path, help="folder of measured records")
    parser.add_argument("--cache", help="folder that keeps compiled programs for the next run")
    parser.add_argument("--setting", action="append", default=[], metavar="NAME=VALUE", help="move a threshold first")
    given = parser.parse_args()
    if (given.store is None) == (given.compare is None):
        parser.error("give --store FILE or --compare OLD NEW")
    if given.compare:
        compare(*(json.loads(path.read_text()) for path in given.compare))
        return
    moved(given.setting)
    if given.cache:
        jax.config.update("jax_compilation_cache_dir", given.cache)
    store(given.store, given.sets.split(","), given.share, given.data)


if __name__ == "__main__":
    main()
