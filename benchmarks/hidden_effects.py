"""Hides known effects in simulated records and counts how often `jaxgray.diagnose` finds them.

    python benchmarks/hidden_effects.py --seed S [--ids a,b] [--repeats 10] [--excess 1.5,4] [--nulls K] [--pairs K]
        [--raw K] [--loops K] [--without K] [--json OUT] [--cache DIR]

Data come from an independent simulator (tests/hidden.py), every record with a second one for validation. `--ids none`
leaves the single effects out. A failed run is counted and shown, and is never a success. `e/σ` is the residual of the
best linear model on the noisy record over the noise. `unseen`: a truth is in no class, and yet the final model errs on
held-out data by no more than the true noise: beside what was found, these data do not show it.
"""

import argparse
import json
import os
import pathlib
import sys
import time
import traceback
import warnings
import zlib
from collections import Counter, defaultdict

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAXGRAY_PROGRAMS", "0")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import hidden  # noqa: E402
from hidden_judging import judged  # noqa: E402
from hidden_matrices import table_of_matrices  # noqa: E402

import jaxgray  # noqa: E402

STREAMS = {"single": 0, "null": 1, "pair": 2, "raw": 3, "closed_loop": 4, "without": 5}
RECORD_STAGE = {"process": "process_noise"}
"""Finding of stage `record` that a kind of null must bring."""


def generator(seed, stream, *numbers):
    """One independent stream of random numbers for every record, whatever else is run."""
    return np.random.default_rng([seed, STREAMS[stream], *numbers])


def code(text):
    """A number for a name that does not depend on the rest of the list."""
    return zlib.crc32(text.encode())


def campaign(arguments):
    """(kind, truth label, function that makes the case, options of `diagnose`) of every record."""
    size = {"samples": arguments.samples, "dofs": arguments.dofs}
    seed, excess = arguments.seed, arguments.excess
    for effect_id in arguments.ids:
        for k in range(arguments.repeats):
            rng = generator(seed, "single", code(effect_id), k)
            yield "single", effect_id, rng, lambda r, e=effect_id: hidden.random_case(r, e, excess=excess, **size), {}
    for kind in hidden.NULLS:
        for k in range(arguments.nulls):
            rng = generator(seed, "null", code(kind), k)
            yield "null", kind, rng, lambda r, kind=kind: hidden.null_case(r, kind, **size), {}
    pairs = hidden.PAIRS[:20]
    for k in range(arguments.pairs):
        pair = pairs[k % len(pairs)]
        rng = generator(seed, "pair", k)
        yield "pair", " + ".join(pair), rng, lambda r, p=pair: hidden.random_pair(r, pair=p, excess=excess, **size), {}
    for effect_id in hidden.RAW:
        for k in range(arguments.raw):
            rng = generator(seed, "raw", code(effect_id), k)
            yield "raw", effect_id, rng, lambda r, e=effect_id: hidden.raw_case(r, e, **size), {}
    for k in range(arguments.loops):
        yield "closed_loop", "closed_loop", generator(seed, "closed_loop", k), _closed_loop(size), {}
    for k in range(arguments.without):
        effect_id = hidden.DYNAMIC[k % len(hidden.DYNAMIC)]
        rng = generator(seed, "without", k)
        make = lambda r, e=effect_id: hidden.random_case(r, e, excess=excess, **size)  # noqa: E731
        yield "without", effect_id, rng, make, {"exclude": [effect_id]}


def _closed_loop(size):
    return lambda r: hidden.closed_loop_case(r, **size)


def run(kind, truth, rng, make, options, fresh):
    """One record, from making it to judging it."""
    row = {"kind": kind, "truth": truth}
    start = time.perf_counter()
    stage = "making the record"
    try:
        case = make(rng)
        row |= {
            "dofs": len(case.noise),
            "excess": case.excess,
            "excitation": case.excitation,
            "hold": case.hold,
            "effects": [(e.id, e.place, e.parameters) for e in case.effects],
        }
        row["seconds_making"] = time.perf_counter() - start
        start = time.perf_counter()
        stage = "diagnose"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            estimation = jaxgray.Record(case.u, case.y, case.sampling_time, hold=case.hold, scheduling=case.scheduling)
            validation = jaxgray.Record(
                case.u_v, case.y_v, case.sampling_time, hold=case.hold, scheduling=case.scheduling_v
            )
            diagnosis = jaxgray.diagnose(estimation, validation=validation, **options)
        row["seconds"] = time.perf_counter() - start
        stage = "judging"
        row |= judged(rng, case, diagnosis, fresh=fresh)
    except Exception as error:
        if isinstance(error, hidden.TooHard):
            row["failed"] = f"no record: {error}"
        else:
            row["failed"] = f"{stage}: {type(error).__name__}: {str(error)[:300]}"
            row["traceback"] = traceback.format_exc(limit=-4)
        row["label"] = "failed"
    return row


def line(row, number):
    """One record on one line."""
    head = f"{number:5d} {row['kind']:11s} {row['truth']:30s}"
    if "dofs" in row:
        places = ",".join(place for _, place, _ in row["effects"])
        head += f" n{row['dofs']} {places:10s} e/σ {row['excess']:5.2f}"
    if "failed" in row:
        return f"{head} FAILED {row['failed']}"
    found = ", ".join(f"{effect}@{place}" for effect, place, _ in row["found"]) or "nothing"
    mark = "✓" if row["name_and_place"] else "~" if row["in_class"] else "·"
    extra = f" [{', '.join(row['record_stage'])}]" if row["record_stage"] else ""
    return f"{head} {mark} {row['verdict']:11s} {found}{extra}  {row['seconds']:.1f} s"


def share(rows, key):
    """Count of rows with a flag, as text."""
    return f"{sum(bool(row.get(key)) for row in rows)}/{len(rows)}"


def table_of_effects(rows):
    """Per id: how often right, in class, open, extra; parameters, gain, held-out error, time."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["truth"]].append(row)
    print(
        f"{'truth':42s} {'right':>7s} {'class':>7s} {'unseen':>6s} {'open':>6s} {'extra':>5s} {'fail':>4s} "
        f"{'1.96 se':>8s} {'3 se':>8s} {'gain in ci':>10s} {'held out':>8s} {'size':>5s} {'s':>6s}"
    )
    for name, group in [*groups.items(), ("all", rows)]:
        deviations = [d for row in group for d in row.get("deviations", {}).values()]
        gains = [row["gain"]["covered"] for row in group if "gain" in row]
        right = [row for row in group if row.get("name_and_place")]
        quiet = sum(row["held_out_excess"] <= 1.1 for row in right)
        sizes = [size for row in group for size in row.get("class_sizes", [])]
        unseen = sum(not row.get("in_class", True) and row["only_noise_left"] for row in group)
        extra = sum(row.get("false_extra", 0) for row in group)
        seconds = [row["seconds"] for row in group if "seconds" in row]
        print(
            f"{name:42s} {share(group, 'name_and_place'):>7s} {share(group, 'in_class'):>7s} "
            f"{unseen:6d} {share(group, 'open'):>6s} {extra:5d} "
            f"{sum('failed' in row for row in group):4d} {sum(d <= 1.96 for d in deviations):4d}/{len(deviations):<3d} "
            f"{sum(d <= 3 for d in deviations):4d}/{len(deviations):<3d} "
            f"{sum(gains):6d}/{len(gains):<3d} {quiet:4d}/{len(right):<3d} "
            f"{np.mean(sizes) if sizes else np.nan:5.2f} {np.median(seconds) if seconds else np.nan:6.1f}"
        )


def confusion(rows):
    """Truth → what was said."""
    said = defaultdict(Counter)
    for row in rows:
        said[row["truth"]][row["label"]] += 1
    for truth, labels in said.items():
        print(f"{truth:42s} → " + ",  ".join(f"{n}× {name}" for name, n in labels.most_common()))


def table_of_rest(rows, kind):
    """Counts where nothing acts through the dynamics, or where the truth was left out of the catalogue."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["truth"]].append(row)
    for name, group in groups.items():
        failed = sum("failed" in row for row in group)
        false = [row for row in group if row.get("found") and not row.get("in_class")]
        text = f"{kind:12s} {name:30s} {len(group)} records, {failed} failed"
        if kind == "without":
            stand_in = Counter(row["label"] for row in group)
            text += f", {share(group, 'open')} partly or unexplained: {dict(stand_in)}"
        else:
            wanted = RECORD_STAGE.get(name, name)
            hits = sum(
                wanted in row.get("record_stage", []) or any(f[0] == wanted for f in row.get("found", []))
                for row in group
            )
            if kind != "null" or name in RECORD_STAGE:
                text += f", {wanted} found in {hits}"
            text += f", false findings in {len(false)}"
            if false:
                text += f": {dict(Counter(row['label'] for row in false))}"
        print(text)


def false_record_findings(rows):
    """Findings of stage `record` where there was nothing of the kind."""
    false = Counter()
    for row in rows:
        true = {row["truth"], RECORD_STAGE.get(row["truth"])}
        false.update(name for name in row.get("record_stage", []) if name not in true)
    judged_rows = sum("record_stage" in row for row in rows)
    print(f"record-stage findings without cause, of {judged_rows} records: {dict(false) or 'none'}")


def summary(rows):
    """Every table."""
    by_kind = defaultdict(list)
    for row in rows:
        by_kind[row["kind"]].append(row)
    for kind in ("single", "pair"):
        if by_kind[kind]:
            print(f"\n== {kind}: counts by truth")
            table_of_effects(by_kind[kind])
            print(f"\n== {kind}: truth → said")
            confusion(by_kind[kind])
            print(
                f"\n== {kind}: M, D, K after the extension, where all is named and nothing besides; in standard errors"
            )
            table_of_matrices(by_kind[kind])
            behind = sorted(row["rivals_behind"] for row in by_kind[kind] if row.get("rivals_behind") is not None)
            within = sum(distance <= 10 for distance in behind)
            print(
                f"classes with the truth: rivals within 10 of it (BIC) in {within}/{len(behind)}: {np.round(behind, 1)}"
            )
    for kind in ("null", "raw", "closed_loop", "without"):
        if by_kind[kind]:
            print(f"\n== {kind}")
            table_of_rest(by_kind[kind], kind)
    print()
    false_record_findings(rows)
    failed = [row for row in rows if "failed" in row]
    print(f"{len(failed)} of {len(rows)} records failed")
    for reason, count in Counter(row["failed"] for row in failed).most_common():
        print(f"  {count}× {reason}")


def arguments_of(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--ids", default="all", help="ids of single effects, `all` or `none`")
    parser.add_argument("--repeats", type=int, default=10, help="records for every id")
    parser.add_argument("--excess", default="1.5,4", help="range of e/σ")
    parser.add_argument("--nulls", type=int, default=0, help="records of every kind with nothing hidden")
    parser.add_argument("--pairs", type=int, default=0, help="records with two effects (60: 20 pairs, 3 each)")
    parser.add_argument("--raw", type=int, default=0, help="records for every raw-record id")
    parser.add_argument("--loops", type=int, default=0, help="records in closed loop")
    parser.add_argument("--without", type=int, default=0, help="records with the true law left out of the catalogue")
    parser.add_argument("--samples", type=int, default=4000)
    parser.add_argument("--dofs", default="1,2,3", help="numbers of coordinates to draw from")
    parser.add_argument("--fresh", type=int, default=10, help="fresh records for the true gain; 0 leaves it out")
    parser.add_argument("--json", help="file for every record's figures")
    parser.add_argument("--cache", help="folder that keeps compiled programs for the next run")
    result = parser.parse_args(argv)
    every = {"all": list(hidden.DYNAMIC), "none": []}
    result.ids = every.get(result.ids) if result.ids in every else result.ids.split(",")
    unknown = sorted(set(result.ids) - set(hidden.DYNAMIC))
    if unknown:
        parser.error(f"--ids {','.join(unknown)}: not among {', '.join(hidden.DYNAMIC)}")
    result.excess = tuple(float(x) for x in result.excess.split(","))
    result.dofs = tuple(int(x) for x in result.dofs.split(","))
    return result


def main():
    arguments = arguments_of()
    if arguments.cache:
        jax.config.update("jax_compilation_cache_dir", arguments.cache)
    rows = []
    for number, (kind, truth, rng, make, options) in enumerate(campaign(arguments), 1):
        rows.append(run(kind, truth, rng, make, options, arguments.fresh))
        print(line(rows[-1], number), flush=True)
        if arguments.json:
            kept = {"arguments": vars(arguments), "rows": rows}
            text = json.dumps(kept, default=lambda x: np.asarray(x).tolist(), indent=1)
            pathlib.Path(arguments.json).write_text(text)
    summary(rows)


if __name__ == "__main__":
    main()
