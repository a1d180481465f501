"""Samples that say nothing of the system, made missing: outliers, values that a logger repeats, cut-off extremes."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from .checks.defects import clipped, spikes, stuck
from .record import Record

MOST = 0.85
"""Share of a channel above which nothing is taken away: then the defect is the signal."""

BESIDE = 2
"""Samples taken away on each side of those that are cut off: noise decides there which of them the limit has met."""


def without_defects(record: Record) -> Record:
    """The record with spoilt output samples missing (NaN).

    **Arguments:** `record`: as measured.

    **Returns:** a `Record`; the same object where nothing is spoilt.
    """
    lost = np.stack([_spoilt(y) for y in record.y.T], axis=1)
    if not lost.any():
        return record
    return replace(record, y=np.where(lost, np.nan, record.y))


def _spoilt(y: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Which samples of a channel are spoilt."""
    lost = np.zeros(len(y), bool)
    there = y[~np.isnan(y)]
    if there.size == 0 or np.ptp(there) <= 1e-12 * np.abs(there).max():
        return lost
    lost[spikes(y)] = True
    rest = np.where(lost, np.nan, y)
    for first, last in stuck(rest):
        lost[first + 1 : last + 1] = True
    for upper in (False, True):
        at = clipped(rest, upper)
        for shift in range(-BESIDE, BESIDE + 1):
            lost[np.clip(at + shift, 0, len(y) - 1)] = True
    return lost if np.mean(lost) <= MOST else np.zeros(len(y), bool)
