"""Uniform records that stand for rows at times of their own, about the model that is identified from them."""

from ..mechanics.at_stamps import at_own_times
from ..numerics.progress import AbstractProgress
from ..records import Record, on_one_grid
from .identify import identify


def uniform_records(
    records: list[Record], held_out: list[Record], progress: AbstractProgress, **asked
) -> tuple[list[Record], list[Record]]:
    """Records for what takes uniform ones alone: those that are so are left as they are.

    **Arguments:** `records`, `held_out`; `progress`; `asked`: further keywords of `identify`.

    **Returns:** the records, and those held out.

    **Raises:** as `identify`.
    """
    given = on_one_grid(records + held_out)
    if not any(record.has_own_times for record in given):
        return records, held_out
    records, held_out = given[: len(records)], given[len(records) :]
    found = identify(records, progress=progress, **asked)
    return list(found.records), [at_own_times(found.model, record) for record in held_out]
