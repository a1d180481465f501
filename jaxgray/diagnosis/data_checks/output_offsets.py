"""Records whose sensors were switched on anew: each counts from a zero of its own.

An incremental encoder starts at an arbitrary number. Within one record that is a constant; between records the
constants differ, so that no model of one free-runs on the other, and no finding can be judged there.
"""

import dataclasses

import numpy as np

from ...mechanics.model import MechanicalModel
from ...mechanics.runs.simulate import initial_state
from ...numerics.text import listed
from ...records import Record
from .. import settings


def from_own_zeros(records: list[Record], model: MechanicalModel) -> tuple[list[Record], tuple[str, ...]]:
    """The records, each without its own zero where zeros are far apart.

    **Arguments:** `records` of one system; `model`: by whose free runs the zeros are found.

    **Returns:** the records, the same objects where nothing was taken off, and a warning for every output that has
    zeros of its own.
    """
    means = np.array([np.nanmean(r.y, axis=0) for r in records])
    motion = np.max([np.nanstd(r.y, axis=0) for r in records], axis=0)
    if not np.any(np.ptp(means, axis=0) > settings.MAX_OFFSET * motion):
        return records, ()
    zeros = np.array(
        [initial_state(model, r.u, r.y, r.sampling_time, hold=r.hold, scheduling=r.scheduling)[1] for r in records]
    )
    apart = np.ptp(zeros, axis=0) > settings.MAX_OFFSET * motion
    warnings = tuple(_warning(records[0], k, zeros[:, k]) for k in np.flatnonzero(apart))
    taken_off = [dataclasses.replace(r, y=r.y - np.where(apart, zero, 0.0)) for r, zero in zip(records, zeros)]
    return (taken_off, warnings) if warnings else (records, ())


def _warning(record: Record, output: int, zeros: np.ndarray) -> str:
    unit = record.output_units[output]
    values = listed(f"{value:.5g}" for value in zeros) + (f" {unit}" if unit else "")
    return f"{record.output_names[output]} counts from another zero in every record ({values}); taken off."
