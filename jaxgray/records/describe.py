"""A record on one screen."""

import warnings

import numpy as np


def describe(record) -> str:
    """Samples, duration and rate, and one line per channel with unit, RMS, range and missing samples.

    **Arguments:**

    - `record`: the `Record`.

    **Returns:** the text, not ending in a newline.
    """
    head = (
        f"Record: {record.samples} samples, {record.duration:.6g} s at {record.sampling_rate_hz:.6g} Hz, "
        f"{record.hold} hold"
    )
    if record.start_time:
        head += f", from {record.start_time:.6g} s"
    if record.stamps is not None:
        head += (
            f", from {len(record.stamps.time)} rows at times of their own, up to {record.stamps.jitter:.3g} samples off"
        )
    rows = [("", "name", "unit", "rms", "min", "max", "missing", "")]
    for k, name in enumerate(record.input_names):
        rows.append(("input", name, record.input_units[k], *_numbers(record.u[:, k]), ""))
    for k, name in enumerate(record.output_names):
        rows.append(("output", name, record.output_units[k], *_numbers(record.y[:, k]), record.measured[k]))
    if record.scheduling is not None:
        rows.append(("scheduling", record.scheduling_name, "", *_numbers(record.scheduling), ""))
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(w) for text, w in zip(row, width)).rstrip() for row in rows]
    return "\n".join([head, *("  " + line for line in lines)])


def _numbers(x: np.ndarray) -> tuple[str, str, str, str]:
    with warnings.catch_warnings():
        # A channel without a single value is described as nan.
        warnings.simplefilter("ignore", RuntimeWarning)
        numbers = (np.sqrt(np.nanmean(x**2)), np.nanmin(x), np.nanmax(x))
    return (*(f"{number:.4g}" for number in numbers), str(int(np.isnan(x).sum())))
