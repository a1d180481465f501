"""Whether records hold what a diagnosis needs at all."""

import numpy as np

from ...records import Record
from .. import settings
from ..noise.whitening import AR_ORDER, counted


def check_enough(records: list[Record], held: list[Record]) -> None:
    """Check that the noise of some records can be told, and that others are long enough to judge by.

    **Arguments:** `records` of the fit, `held`: for validation, both without spoilt samples.

    **Raises:** `ValueError` that names what is short and what to do.
    """
    for k, record in enumerate(held):
        if record.samples < settings.MIN_SAMPLES:
            raise ValueError(
                f"validation[{k}] has {record.samples} samples; give at least {settings.MIN_SAMPLES}, or no "
                "validation: then the last part of the record is held out."
            )
    known = sum(int(np.all(counted(np.isfinite(record.y)), axis=1).sum()) for record in records)
    if known < settings.MIN_SAMPLES:
        lost = 100 * np.mean(np.concatenate([np.isnan(record.y).ravel() for record in records]))
        raise ValueError(
            f"record: {lost:.0f} % of the outputs' samples are missing, and hardly anywhere are {AR_ORDER + 1} in "
            "a row known of all outputs, without which the noise cannot be told from what the model lacks. Sample "
            "all outputs at the same times, fill short gaps by interpolation, or leave an output out."
        )
