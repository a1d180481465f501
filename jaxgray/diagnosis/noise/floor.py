"""The noise floor that does not depend on a model, and the size of a residual."""

import numpy as np
from jaxtyping import Float

from ...numerics.responses.filters import white_part
from ...records import Record
from .. import settings
from ..model.baseline import ADOPTED
from ..model.candidate import Data

TRUSTED_PERIODS = 2
"""Whole periods needed for a noise floor from what does not repeat."""


def independent_floor(record: Record) -> tuple[Float[np.ndarray, " outputs"] | None, str]:
    """Noise floor that depends on no model, and where it comes from.

    From what does not repeat over the periods of a periodic record, or from a quiet head; None where neither is there.
    """
    period = record.detect_period()
    if period is not None and record.samples // period - 1 >= TRUSTED_PERIODS and not record.has_missing:
        average = record.average_periods(period, skip=1)
        floor = np.sqrt(np.nanmean(average.noise_variance, axis=0))
        if np.all(floor > 0):
            return floor, "repeated periods"
    still = np.flatnonzero(np.any(record.u != record.u[0], axis=1))
    quiet = int(still[0]) if len(still) else record.samples
    if quiet >= 200 and not np.any(record.u[0]) and not np.isnan(record.y[:quiet]).any():
        data = Data.of(record[:quiet])
        head = record.y[quiet // 2 : quiet]
        # Still ringing down from before the record it is no measure of noise.
        floor = head.std(axis=0)
        white = np.sqrt(white_part(data.y[:quiet], data.kept[:quiet]))
        if np.all(floor > 0) and np.all(floor < 1.5 * white):
            return floor, "quiet head"
    return None, ADOPTED


def more_than_noise(e: np.ndarray, data: Data) -> bool:
    """Whether a residual is more than what no motion explains, its white part."""
    white = np.sqrt(white_part(np.where(data.kept, e, 0.0), data.kept))
    return bool(np.any(residual_rms(e, data) > settings.STAND_IN_EXCESS * white))


def residual_rms(e: np.ndarray, data: Data) -> np.ndarray:
    """Root mean square of a residual per output over the samples that were measured."""
    power = np.sum(np.where(data.kept, e, 0.0) ** 2, axis=0) / np.maximum(data.kept.sum(axis=0), 1)
    return np.maximum(np.sqrt(power), 1e-300)
