"""Spectra of what was measured and of what is left before and after, beside the noise floor."""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float

from ...numerics.responses.filters import without_gaps
from ...records.periods import find_period
from ..findings import Curves
from ..result import Diagnosis

SEGMENTS = 12
"""Segments into which a record is cut at least, half overlapping, so that its spectrum is steady."""

LONGEST = 8192
REPEATS = 1e-3
"""Largest mismatch between periods of the input, as a share of its RMS, at which a record is periodic."""

EXCITED = 1e-6
"""Power of a line of the input, relative to its strongest, from which it is driven."""


@dataclass(frozen=True)
class Spectra:
    """Amplitude spectra of one record, one column an output.

    `frequency_hz`; `measured`, `before`, `after`: amplitude densities [unit/√Hz], or, where the input is periodic,
    amplitudes of its lines [unit]; `floor`: that of white noise as large as the noise floor; `driven`: which lines
    the input drives, None where it is not periodic; `period` in samples, None likewise.
    """

    frequency_hz: Float[np.ndarray, " frequencies"]
    measured: Float[np.ndarray, "frequencies outputs"]
    before: Float[np.ndarray, "frequencies outputs"]
    after: Float[np.ndarray, "frequencies outputs"]
    floor: Float[np.ndarray, " outputs"]
    driven: Bool[np.ndarray, " frequencies"] | None
    period: int | None
    held_out: bool


def spectra(diagnosis: Diagnosis) -> Spectra:
    """Spectra over the first held-out record, or that of the fit where there is none.

    **Arguments:** `diagnosis`.

    **Returns:** a `Spectra`: of the lines of a periodic input, averaged over its periods, otherwise by Welch's method.
    """
    curves = next((c for c in diagnosis.curves if c.held_out), diagnosis.curves[0])
    records = diagnosis.validation_records if curves.held_out else diagnosis.records
    names = diagnosis.baseline.model.output_names
    noise = np.array([diagnosis.noise_floor.get(name) or np.nan for name in names])
    h = float(np.median(np.diff(curves.time)))
    u = records[0].u[: len(curves.time)]
    signals = curves.measured, curves.measured - curves.baseline, curves.measured - curves.extended
    signals = [without_gaps(x) for x in signals]
    period = find_period(u, REPEATS)
    if period is not None and len(curves.time) // period >= 2:
        return _lines(u, signals, noise, period, h, curves)
    samples = len(curves.time)
    length = int(np.clip(2 * samples // SEGMENTS, min(samples, 64), LONGEST))
    frequency, parts = None, []
    for x in signals:
        frequency, power = scipy.signal.welch(x, 1 / h, nperseg=length, axis=0, detrend="linear")
        parts.append(np.sqrt(power[1:]))
    return Spectra(frequency[1:], *parts, noise * np.sqrt(2 * h), None, None, curves.held_out)


def _lines(u, signals, noise, period: int, h: float, curves: Curves) -> Spectra:
    """Amplitudes of the lines of a periodic input, from the last whole periods."""
    repeats = len(u) // period

    def lines(x):
        last = x[len(x) - repeats * period :].reshape(repeats, period, -1).mean(axis=0)
        return 2 * np.abs(np.fft.rfft(last, axis=0))[1:-1] / period

    power = np.sum(lines(u) ** 2, axis=1)
    frequency = np.fft.rfftfreq(period, h)[1:-1]
    floor = noise * 2 / np.sqrt(repeats * period)
    driven = power > EXCITED * power.max()
    return Spectra(frequency, *map(lines, signals), floor, driven, period, curves.held_out)
