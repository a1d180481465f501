"""Outliers among samples that move as far by themselves: they stand out of what the linear model leaves."""

import dataclasses

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ...identification import Identification
from ...records import Record
from .. import settings
from ..findings import Estimate, Finding

SIZES, NEAR, LONGEST = 8.0, 12, 2
"""How far an outlier stands out of the others, of so many on each side and of its neighbours, and samples it may last.
"""

SMOOTH = frozenset(("displacement", "velocity"))
"""Outputs that forces do not make jump there and back: an impact does so to an acceleration."""


def without_late_outliers(
    records: list[Record], held: list[Record], identification: Identification
) -> tuple[list[Record], list[Record], tuple[Finding, ...]]:
    """The records without samples that are far off their neighbours in the residual of the linear fit.

    **Returns:** `records` and `held`, the same objects where there are none, and the findings of the first record.
    """
    kept = [_without(r, fit.residual) for r, fit in zip(records, identification.estimation)]
    kept_held = [_without(r, fit.residual) for r, fit in zip(held, identification.validation)]
    counts = np.sum(np.isnan(kept[0].y) & ~np.isnan(records[0].y), axis=0)
    found = tuple(_finding(name, int(n)) for name, n in zip(records[0].output_names, counts) if n)
    return kept, kept_held + held[len(kept_held) :], found


def _without(record: Record, residual: np.ndarray) -> Record:
    y = record.y.copy()
    for k, kind in enumerate(record.measured):
        e = residual[:, k]
        places = standing_out(e) if kind in SMOOTH else np.zeros(0, int)
        if len(places) <= settings.MAX_OUTLIER_SHARE * record.samples:
            y[places, k] = np.nan
    return record if np.array_equal(y, record.y, equal_nan=True) else dataclasses.replace(record, y=y)


def standing_out(e: np.ndarray) -> np.ndarray:
    """Places of single samples, or two beside each other, far beyond what is usual and what is usual nearby; their
    neighbours are not.

    A residual is about zero, so a sample is judged by itself. `records.checks.defects.spikes` judges a moving signal by
    the line between neighbours: it needs five good ones on each side, which the ends and outliers close by do not have.
    """
    known = np.abs(e - np.nanmedian(e))
    usual = 1.4826 * np.nanmedian(known)
    windows = sliding_window_view(np.pad(known, NEAR, mode="reflect"), 2 * NEAR + 1)
    candidates = np.flatnonzero(known > SIZES * usual)
    nearby = 1.4826 * np.nanmedian(windows[candidates], axis=1)
    far = candidates[known[candidates] > SIZES * nearby]
    # What is missing says nothing against a sample beside it.
    size = np.nan_to_num(known)
    padded = np.pad(size, 2)
    found = []
    for run in np.split(far, np.flatnonzero(np.diff(far) > 1) + 1):
        beside = padded[[run[0] + 1, run[-1] + 3]] if len(run) else []
        if 0 < len(run) <= LONGEST and np.max(beside) < np.min(size[run]) / SIZES:
            found.extend(run)
    return np.array(found, int)


def _finding(name: str, count: int) -> Finding:
    who = f"1 sample of {name} is far off its" if count == 1 else f"{count} samples of {name} are far off their"
    text = f"{who} neighbours in the residual of the linear model: left out."
    return Finding(
        "outliers", name, "named", "record", (), {"count": Estimate(float(count), None, "")}, None, None, text
    )


def merged(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Findings, those of outliers at one output made one."""
    result: dict[tuple, Finding] = {}
    for k, finding in enumerate(findings):
        key = (finding.effect, finding.location) if finding.effect == "outliers" else (k,)
        if key in result:
            first = result[key]
            parts = [int(f.parameters["count"].value) for f in (first, finding)]
            late = [f.message == _finding(f.location, n).message for f, n in zip((first, finding), parts)]
            total = _finding(first.location, sum(parts))
            message = total.message if all(late) else f"{first.message} {finding.message}"
            finding = dataclasses.replace(first, parameters=total.parameters, message=message)
        result[key] = finding
    return tuple(result.values())
