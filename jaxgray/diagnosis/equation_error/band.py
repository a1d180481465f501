"""The frequencies in which measured motion stands above its noise, and motion by integrating accelerations."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from ...numerics.outcomes import RESULTS, ComputationError
from ...records import Record

ABOVE_NOISE = 100.0
"""The band ends where the power of the motion comes down to so many times that of its noise."""

MIN_PERIODS = 8.0
"""Periods of the lowest frequency of a band that a record must hold."""

MIN_WIDTH = 2.0
"""Ratio of the ends of a band of integrated motion, at least."""

MAX_DISPLACEMENT_NOISE = 0.01
"""Noise of an integrated displacement, relative to it (root mean squares), that sets the lower end of the band."""

PADDED_PERIODS = 4.0
"""Periods of the lowest frequency by which a record is padded at both ends before it is integrated."""

ORDER = 4
"""Of the filter."""


class Band(NamedTuple):
    """Frequencies [Hz] of a regression, `low` 0 where no motion is integrated twice."""

    low: float
    high: float


def band_of(records: list[Record]) -> Band:
    """The band in which the motion of all outputs of all records stands above its noise, missing samples left out.

    **Raises:** `ComputationError` where accelerations have no such band.
    """
    bands = [
        _band_of_column(column[np.isfinite(column)], kind, r.samples, r.sampling_time)
        for r in records
        for column, kind in zip(r.y.T, r.measured)
    ]
    band = Band(max(one.low for one in bands), min(one.high for one in bands))
    if band.high < MIN_WIDTH * band.low:
        detail = f"no band in which all accelerations stand above their noise ({band.low:.3g} to {band.high:.3g} Hz)"
        raise ComputationError(RESULTS.too_short, stage="force equation", detail=detail)
    return band


def _band_of_column(column: np.ndarray, kind: str, samples: int, sampling_time: float) -> Band:
    """Where the spectrum of one output stands above its noise, which is the median of the upper half.

    Of displacements and velocities, spectra are taken of second differences, so that slow large motion does not leak
    into the rest. An acceleration is integrated down to where its noise becomes too much of the displacement.
    """
    lowest, highest = MIN_PERIODS / (samples * sampling_time), 0.2 / sampling_time
    length = max(min(4096, len(column) // 4), min(len(column), 32))
    integrated = kind == "acceleration"
    x, window = (column, "blackmanharris") if integrated else (np.diff(column, 2), "hann")
    frequency, power = scipy.signal.welch(x, 1 / sampling_time, window, nperseg=length)
    frequency, power = frequency[1:], power[1:]
    if not integrated:
        power = power / np.maximum(2 * np.sin(np.pi * frequency * sampling_time), 1e-12) ** 4
    noise = np.median(power[len(power) // 2 :])
    if integrated:
        # Power of the displacement and of its noise, from every frequency on.
        displacement, its_noise = (
            np.cumsum(np.maximum(X, 0.0)[::-1])[::-1] for X in ((power - noise) / frequency**4, noise / frequency**4)
        )
        ratio = displacement / np.maximum(its_noise, np.finfo(float).tiny)
        best = int(np.argmax(ratio))
        noisy = np.flatnonzero(ratio[:best] < 1 / MAX_DISPLACEMENT_NOISE**2)
        low = max(float(frequency[noisy[-1] + 1 if len(noisy) else 0]), lowest)
        above = np.flatnonzero(power >= ABOVE_NOISE * noise)
        if noise > 0 and (not len(above) or ratio[best] < ABOVE_NOISE):
            return Band(highest, highest)
        high = frequency[above[-1]] if len(above) else highest
        return Band(low, float(min(high, highest)))
    below = np.flatnonzero(power < ABOVE_NOISE * noise)
    below = below[below > np.argmax(power)]
    high = float(frequency[below[0]]) if len(below) else highest
    return Band(0.0, float(np.clip(high, min(lowest, highest), highest)))


def integrals(a: Float[np.ndarray, " samples"], sampling_time: float, low: float):
    """Velocity and displacement by integration in the frequency domain, without what is far below a frequency.

    **Arguments:** `a`: acceleration, missing samples filled; `sampling_time` [s]; `low` [Hz]: at half of it, half of
    the motion is left.

    **Returns:** velocity and displacement in units of `a`, each of its length.
    """
    samples, around = len(a), int(np.ceil(PADDED_PERIODS / (low * sampling_time)))
    extended = np.concatenate([np.zeros(around), a - a.mean(), np.zeros(around)])
    frequency = np.fft.rfftfreq(len(extended), sampling_time)
    frequency[0] = frequency[1]
    kept = 1 / (1 + (low / (2 * frequency)) ** (2 * ORDER))
    kept[0] = 0.0
    slope, omega = np.fft.rfft(extended) * kept, 2j * np.pi * frequency
    v, q = (np.fft.irfft(X, len(extended)) for X in (slope / omega, slope / omega**2))
    return v[around : around + samples], q[around : around + samples]
