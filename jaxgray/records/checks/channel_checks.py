"""Checks of single channels, and of channels that are copies of others."""

from collections.abc import Iterator

import numpy as np

from jaxgray.records.checks.defects import clipped, fast_noise, grid_step, spikes, stuck
from jaxgray.records.checks.finding import RecordFinding
from jaxgray.records.checks.looked import Looked, is_constant, proportion
from jaxgray.records.record import Record


def too_short(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    needed = 50 * (record.inputs + record.outputs)
    if record.samples < needed:
        yield RecordFinding(
            "record_too_short",
            "record",
            f"The record has {record.samples} samples for {record.inputs} inputs and {record.outputs} "
            f"outputs. Measure at least {needed}.",
            "error" if record.samples < needed // 2 else "warning",
            {"samples": record.samples, "needed": needed},
        )


def constant(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for name, x in zip(record.input_names, record.u.T):
        if is_constant(x):
            yield RecordFinding(
                "constant_input",
                name,
                f"Input {name} is constant at {x[0]:.4g}: it excites nothing. Leave it out or move it.",
                "error",
                {"value": float(x[0])},
            )
    for name, x in zip(record.output_names, record.y.T):
        if is_constant(x):
            there = x[~np.isnan(x)]
            value = float(there[0]) if there.size else None
            seen = "has no value at all" if value is None else f"is constant at {value:.4g}"
            yield RecordFinding(
                "dead_channel",
                name,
                f"Output {name} {seen}. Check the sensor and its cable, or leave the output out.",
                "error",
                {"value": value},
            )


def doubled(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for kind, names, channels in (
        ("input", record.input_names, record.u.T),
        ("output", record.output_names, record.y.T),
    ):
        for k in range(len(names)):
            for j in range(k):
                factor = proportion(channels[j], channels[k])
                if factor is not None:
                    yield RecordFinding(
                        f"identical_{kind}s",
                        names[k],
                        f"{kind.capitalize()} {names[k]} is {factor:.6g} times {names[j]}, up to an "
                        "offset. Leave one of them out.",
                        "error",
                        {"other": names[j], "factor": factor},
                    )


def missing(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    gone = record.lost
    rows = gone.all(axis=1)
    if rows.any():
        yield _gap("record", rows, record, f"{int(rows.sum())} of {record.samples} rows are missing")
    for name, lost in zip(record.output_names, (gone & ~rows[:, None]).T):
        if lost.any() and not lost.all():
            yield _gap(name, lost, record, f"Output {name} misses {int(lost.sum())} of {record.samples} samples")


def _gap(location: str, lost: np.ndarray, record: Record, seen: str) -> RecordFinding:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost.astype(np.int8), [0]))))
    starts, stops = edges[::2], edges[1::2]
    longest = int((stops - starts).max())
    return RecordFinding(
        "dropped_samples",
        location,
        f"{seen}, in {len(starts)} gaps, the longest {longest} samples and the first at "
        f"{record.time[starts[0]]:.6g} s. They are left out; check the logger.",
        "warning",
        {"count": int(lost.sum()), "gaps": len(starts), "longest": longest, "first": int(starts[0])},
    )


def frozen(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for output in looked.moving:
        stretches = stuck(output.without_spikes)
        if stretches:
            count = sum(b - a for a, b in stretches)
            yield RecordFinding(
                "dropped_samples",
                output.name,
                f"Output {output.name} repeats its last value in {count} samples while it should move, first "
                f"at {record.time[stretches[0][0]]:.6g} s. Treat them as missing; check the logger.",
                "warning",
                {"count": count, "stretches": stretches},
            )


def clipping(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for output in looked.moving:
        x = output.without_spikes
        at = {side: clipped(x, upper=side == "upper") for side in ("lower", "upper")}
        count = sum(len(places) for places in at.values())
        if count:
            limits = {side: float(x[places[0]]) for side, places in at.items() if len(places)}
            said = " and ".join(f"{limit:.4g}" for limit in limits.values())
            yield RecordFinding(
                "sensor_clipping",
                output.name,
                f"Output {output.name} is cut off at {said} in {count} of {record.samples} samples. Widen "
                "the sensor's range or lower the excitation.",
                "warning",
                {"count": count, "share": count / record.samples, **limits},
            )


def quantization(looked: Looked) -> Iterator[RecordFinding]:
    for output in looked.moving:
        y = output.y
        step, fast, spread = grid_step(y), fast_noise(y), float(np.nanstd(y))
        if step is None or spread == 0.0:
            continue
        error = step / np.sqrt(12.0)
        # Where faster noise covers it, rounding is only a little more noise.
        if error >= 0.3 * fast and error >= 5e-4 * spread or error >= 1e-2 * spread:
            yield RecordFinding(
                "sensor_quantization",
                output.name,
                f"Output {output.name} lies on a grid of {step:.4g}, {100 * step / spread:.2g} % of its "
                "standard deviation. Use a finer resolution or a larger motion.",
                "warning" if error >= 3e-3 * spread else "note",
                {"step": step, "step_over_std": step / spread, "fast_noise": fast},
            )


def outliers(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    commanded = np.zeros(record.samples, dtype=bool)
    for u in record.u.T:
        # An impulse that was applied may well be seen at once in an acceleration, or one sample later.
        for lag in range(3):
            places = spikes(u) + lag
            commanded[places[places < record.samples]] = True
    for output in looked.moving:
        places = output.spikes[~commanded[output.spikes]]
        if places.size:
            yield RecordFinding(
                "outliers",
                output.name,
                f"Output {output.name} has {places.size} samples far off their neighbours, the first "
                f"at {record.time[places[0]]:.6g} s. Treat them as missing; look for loose contacts.",
                "warning",
                {"count": int(places.size), "indices": [int(k) for k in places]},
            )
