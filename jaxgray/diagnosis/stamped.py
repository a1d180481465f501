"""Records of rows at times of their own: diagnosed on equivalent uniform records, which are computed again about the
model that was found."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..identification import identify
from ..identification.stamped import change, note
from ..mechanics.at_stamps import at_own_times
from ..mechanics.model import MechanicalModel
from ..numerics.outcomes import ComputationError
from ..numerics.progress import AbstractProgress
from ..records import Record, on_one_grid
from ..records.cleaning import without_defects
from ..records.stamped import mended
from .data_checks.record_findings import record_findings
from .data_checks.residual_outliers import merged
from .result import Diagnosis

MOST_TURNS = 3
"""Diagnoses at most."""

CLOSE = 0.1
"""Change of the uniform records, in standard deviations of the noise, that is left: it changes no verdict."""


def diagnose_stamped(
    judge: Callable[[list[Record], list[Record]], Diagnosis],
    records: list[Record],
    held: list[Record],
    model: MechanicalModel | None,
    progress: AbstractProgress,
    options: dict,
) -> Diagnosis:
    """Diagnose records some of which have rows at times of their own.

    **Arguments:** `judge`: from uniform records, and those held out, to a `Diagnosis`; `records`, `held`; `model` of
    the user's own, None for the one that is identified; `progress`; `options` of `identify`.

    **Raises:** as `judge`.
    """
    given = on_one_grid(records + held)
    records, held = given[: len(records)], given[len(records) :]
    seen = record_findings(records[0].on_grid)
    # What is spoilt shows in the samples as they are.
    records, held = ([without_defects(r) for r in group] for group in (records, held))
    now, unseen = ([r.on_grid for r in group] for group in (records, held))
    clocks: list[str] = []
    try:
        found = None if model is not None else identify(records, progress=progress, **options)
        if found is not None and found.grid_kept:
            # The first of its warnings says that the grid explains the samples better.
            judged = judge(now, unseen)
            warnings = (found.warnings[0], *judged.warnings)
            return dataclasses.replace(judged, findings=merged(seen + judged.findings), warnings=warnings)
        begin = model if found is None else found.model
        for one in () if found is None else found.clocks:
            record = records[one.record]
            stamps = mended(record.stamps, record.start_time, one.clock, one.offset, one.rate)
            records[one.record] = dataclasses.replace(record, stamps=stamps)
            clocks.append(one.sentence(record.sampling_time))
        now, unseen = ([at_own_times(begin, r) for r in group] for group in (records, held))
    except ComputationError:
        pass
    for _ in range(MOST_TURNS):
        found = judge(now, unseen)
        about = found.baseline if found.extended is None else found.extended
        try:
            new, later = ([at_own_times(about.model, r) for r in group] for group in (records, held))
        except ComputationError:
            break
        floor = np.array([found.noise_floor[name] for name in records[0].output_names])
        moved = float(np.max(change(now, new) / floor))
        if moved <= CLOSE:
            break
        now, unseen = new, later
    said = dict.fromkeys([*(note(r, 0.0) for r in records if r.has_own_times), *clocks])
    return dataclasses.replace(found, findings=merged(seen + found.findings), warnings=(*said, *found.warnings))
