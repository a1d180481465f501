"""Held-out data that move where the data of the fit never were."""

import numpy as np

from ...records import Record
from .. import settings


def beyond_the_fit(records: list[Record], held: list[Record]) -> tuple[str, ...]:
    """A warning for every output that held-out data take well out of the range of the fit.

    There a law that is right as far as the fit knows it may fail, and a wrong one may seem right.

    **Arguments:** `records` of the fit; `held`: those held out.
    """
    if not held:
        return ()
    (low, high), (lowest, highest) = _range(records), _range(held)
    far = np.maximum(low - lowest, highest - high) > settings.BEYOND_RANGE * (high - low)
    result = []
    for k in np.flatnonzero(far):
        end = lowest[k] if low[k] - lowest[k] > highest[k] - high[k] else highest[k]
        unit = f" {records[0].output_units[k]}" if records[0].output_units[k] else ""
        result.append(
            f"The held-out data take {records[0].output_names[k]} to {end:.4g}{unit}, the data of the fit only from "
            f"{low[k]:.4g} to {high[k]:.4g}{unit}: laws are judged where none was fitted. Hold out less, or validate "
            "on a record that moves no farther."
        )
    return tuple(result)


def _range(records: list[Record]) -> tuple[np.ndarray, np.ndarray]:
    y = np.concatenate([record.y for record in records])
    return np.nanmin(y, axis=0), np.nanmax(y, axis=0)
