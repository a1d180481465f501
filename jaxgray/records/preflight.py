"""Findings on the raw record, before any model."""

import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxgray.records.defects import clipped, fast_noise, grid_step, spikes, stuck
from jaxgray.records.record import Record

SEVERITIES = ("note", "warning", "error")


@dataclass(frozen=True)
class RecordFinding:
    """One thing that is wrong with a record as it was measured.

    **Arguments:**

    - `effect`: id of the finding, such as `sensor_clipping`.
    - `location`: the channel's name, or `record`.
    - `message`: one sentence on what was seen, one on what to do.
    - `severity`: `"note"`, `"warning"`, or `"error"` where nothing can be identified from that channel.
    - `values`: the figures behind the message.
    """

    effect: str
    location: str
    message: str
    severity: str = "warning"
    values: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self):
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity is {self.severity!r}; give one of {', '.join(SEVERITIES)}.")


@dataclass(frozen=True)
class _Output:
    """An output that moves.

    Spikes are looked for once and made missing for the other detectors: one beyond a limit hides the limit,
    and rest between two of them looks like a stuck sensor.
    """

    name: str
    y: np.ndarray
    spikes: np.ndarray
    without_spikes: np.ndarray


def preflight(record: Record) -> list[RecordFinding]:
    """Look at a record before any model: clipping, quantisation, outliers, gaps, dead and doubled channels.

    Inputs are looked at only for being constant, doubled or missing: steps and binary sequences rest at their
    extremes by design.

    **Arguments:**

    - `record`: the `Record` as measured.

    **Returns:** the `RecordFinding`s, worst first; empty for a clean record.
    """
    # Asked at every stage of a diagnosis.
    if record not in _seen:
        _seen[record] = tuple(_findings(record))
    return list(_seen[record])


_seen: weakref.WeakKeyDictionary[Record, tuple[RecordFinding, ...]] = weakref.WeakKeyDictionary()


def _findings(record: Record) -> list[RecordFinding]:
    moving = [
        _Output(name, y, places, _with_gaps(y, places))
        for name, y in zip(record.output_names, record.y.T)
        if not _is_constant(y)
        for places in [spikes(y)]
    ]
    findings = [finding for check in CHECKS for finding in check(record, moving)]
    return sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity))


def _too_short(record: Record, _: list[_Output]) -> Iterator[RecordFinding]:
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


def _constant(record: Record, _: list[_Output]) -> Iterator[RecordFinding]:
    for name, x in zip(record.input_names, record.u.T):
        if _is_constant(x):
            yield RecordFinding(
                "constant_input",
                name,
                f"Input {name} is constant at {x[0]:.4g}: it excites nothing. Leave it out or move it.",
                "error",
                {"value": float(x[0])},
            )
    for name, x in zip(record.output_names, record.y.T):
        if _is_constant(x):
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


def _doubled(record: Record, _: list[_Output]) -> Iterator[RecordFinding]:
    for kind, names, channels in (
        ("input", record.input_names, record.u.T),
        ("output", record.output_names, record.y.T),
    ):
        for k in range(len(names)):
            for j in range(k):
                factor = _proportion(channels[j], channels[k])
                if factor is not None:
                    yield RecordFinding(
                        f"identical_{kind}s",
                        names[k],
                        f"{kind.capitalize()} {names[k]} is {factor:.6g} times {names[j]}, up to an "
                        "offset. Leave one of them out.",
                        "error",
                        {"other": names[j], "factor": factor},
                    )


def _missing(record: Record, _: list[_Output]) -> Iterator[RecordFinding]:
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


def _stuck(record: Record, moving: list[_Output]) -> Iterator[RecordFinding]:
    for output in moving:
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


def _clipping(record: Record, moving: list[_Output]) -> Iterator[RecordFinding]:
    for output in moving:
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


def _quantization(record: Record, moving: list[_Output]) -> Iterator[RecordFinding]:
    for output in moving:
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


def _outliers(record: Record, moving: list[_Output]) -> Iterator[RecordFinding]:
    commanded = np.zeros(record.samples, dtype=bool)
    for u in record.u.T:
        # An impulse that was applied may well be seen at once in an acceleration, or one sample later.
        for lag in range(3):
            places = spikes(u) + lag
            commanded[places[places < record.samples]] = True
    for output in moving:
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


# A new finding is one function and one row.
CHECKS: tuple[Callable[[Record, list[_Output]], Iterator[RecordFinding]], ...] = (
    _too_short,
    _constant,
    _doubled,
    _missing,
    _stuck,
    _clipping,
    _quantization,
    _outliers,
)


def _with_gaps(y: np.ndarray, places: np.ndarray) -> np.ndarray:
    x = y.copy()
    x[places] = np.nan
    return x


def _is_constant(x: np.ndarray) -> bool:
    there = x[~np.isnan(x)]
    return there.size == 0 or bool(np.ptp(there) <= 1e-12 * np.abs(there).max())


def _proportion(a: np.ndarray, b: np.ndarray) -> float | None:
    """The factor c for which b − c a is constant, None where there is none."""
    there = ~(np.isnan(a) | np.isnan(b))
    if there.sum() < 10 or _is_constant(a[there]) or _is_constant(b[there]):
        return None
    x, z = a[there] - a[there].mean(), b[there] - b[there].mean()
    # Scaled, because squares of very small values vanish.
    x_scale, z_scale = np.abs(x).max(), np.abs(z).max()
    x, z = x / x_scale, z / z_scale
    factor = float(x @ z / (x @ x))
    if np.linalg.norm(z - factor * x) > 1e-6 * np.linalg.norm(z):
        return None
    return factor * float(z_scale / x_scale)
