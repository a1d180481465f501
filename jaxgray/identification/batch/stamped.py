"""Batches of records with rows at times of their own: fitted on the uniform records that stand for them, made anew
until they rest."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ...mechanics.at_stamps import at_own_times
from ...numerics.outcomes import RESULTS, ComputationError
from ...records import Record
from ..stamped import CLEAR, LEAST, LOGGED, MOST_TURNS, at_rest, change, note
from .result import Identifications


def fit_stamped(fit: Callable[[list[Record]], Identifications], records: list[Record]) -> Identifications:
    """Models of records some of which have rows at times of their own, as `identify_stamped` finds them one by one.

    **Arguments:** `fit`: of uniform records side by side; `records`, compatible.

    **Returns:** the `Identifications`. A record that does not rest, or has a clock besides that of its inputs, is
    marked as failed.

    **Raises:** as `fit`.
    """
    own = [k for k, record in enumerate(records) if record.has_own_times]
    now = [record.on_grid for record in records]
    found = uniform = fit(now)
    moving = set(own)
    for _ in range(MOST_TURNS):
        for k in list(moving):
            new = _about(found, k, records[k])
            if new is None:
                moving.remove(k)
                continue
            if at_rest(change([now[k]], [new]), found.rmse[k], [new]):
                moving.remove(k)
            else:
                now[k] = new
        if not moving:
            break
        found = fit(now)
    # A law that is missing says nothing of times.
    white = [k for k in own if uniform.white[k]]
    logged = [k for k in white if _left(uniform, k, records[k]) + CLEAR < _left(found, k, records[k])]
    if logged:
        found = fit([records[k].on_grid if k in logged else record for k, record in enumerate(now)])
    results, details = list(found.results), list(found.details)
    for k in own:
        if results[k] != RESULTS.successful:
            continue
        details[k] = LOGGED if k in logged else note(records[k], 0.0)
        if k in moving and k not in logged:
            results[k], details[k] = RESULTS.refinement_diverged, "did not settle at the times of its rows"
        if records[k].stamps.other_clocks:
            results[k], details[k] = RESULTS.refinement_diverged, "rows of several clocks, which a batch cannot correct"
    return dataclasses.replace(found, results=tuple(results), details=tuple(details))


def _about(found: Identifications, k: int, record: Record) -> Record | None:
    """The uniform record that stands for a record about its model; None where there is none."""
    if not found.successful[k]:
        return None
    try:
        return at_own_times(found.model(k), record)
    except ComputationError:
        return None


def _left(found: Identifications, k: int, record: Record) -> float:
    """Minus the logarithm of the likelihood but for a constant."""
    counts = np.isfinite(record.y).sum(axis=0)
    return float(np.log(np.maximum(found.rmse[k], LEAST)) @ counts) if found.successful[k] else np.inf
