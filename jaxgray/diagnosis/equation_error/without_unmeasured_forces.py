"""The search in the force equation, without the samples at which forces act that are not among the inputs."""

from collections.abc import Callable

import numpy as np

from ...mechanics.effects.base import AbstractEffect
from ...mechanics.systems.drives import AbstractDrive
from ...numerics.outcomes import ComputationError
from ...numerics.progress import AbstractProgress
from ...records import Record
from .rows import series_of
from .search import Search, Table, search_once
from .unmeasured_forces import BriefForce, acceleration_outliers, brief_forces_of

PASSES = 3
"""Times that forces beside the inputs are looked for in what is left."""


def search_forces(
    records: list[Record],
    held: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    *,
    rng: np.random.Generator,
    progress: AbstractProgress,
    table: Callable[[], Table] | None = None,
) -> Search:
    """Add laws to the force equation until nothing more is found, without what pushes besides the inputs.

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`: forces; `catalogue`; `max_effects`; `rng`: of the
    resampling; `progress`; `table`: as of `search_once`.

    **Returns:** a `Search`.

    **Raises:** `ComputationError` where the force equation has no solution of positive mass.
    """
    arguments = records, held, drive, catalogue, max_effects
    search = _without_brief_forces(*arguments, (), rng, progress, table)
    if search.taken or search.brief_forces:
        return search
    suspects = acceleration_outliers(search.windows.series)
    if suspects:
        # One among the data of the fit may spoil the fit in which it would show.
        try:
            without = search_once(*arguments, suspects, rng, progress)
        except ComputationError:
            return search
        found = _seen_by(without)
        if without.taken and found:
            return _without_brief_forces(*arguments, found, rng, progress, None)
    return search


def _without_brief_forces(records, held, drive, catalogue, max_effects, brief_forces, rng, progress, table) -> Search:
    """Search, look for pushes in what is left, and search again without them; some may be known."""
    for _ in range(PASSES):
        search = search_once(records, held, drive, catalogue, max_effects, brief_forces, rng, progress, table)
        # The largest hide the others.
        more = brief_forces_of(search.fit, search.windows.series, search.equation.input_map)
        if not more:
            break
        brief_forces += more
    return search


def _seen_by(search: Search) -> tuple[BriefForce, ...]:
    """Pushes that a fit sees in the whole of its records, what was left out included."""
    band = search.windows.series[0].band
    series = [series_of(r, band, at_rest=True) for r in search.records + search.held]
    return brief_forces_of(search.fit, series, search.equation.input_map)
