"""The strongest lines in the spectrum of a residual."""

import numpy as np
from jaxtyping import Float

from ..model.candidate import Data

LINES = 4
"""Strongest lines of the residual's spectrum that are tried as frequencies."""


def lines_of(e: Float[np.ndarray, "samples outputs"], data: Data, count: int = LINES) -> tuple[float, ...]:
    """Frequencies [Hz] of the strongest peaks of a residual's spectrum, interpolated between bins."""
    n = data.samples
    size = max(float(np.sqrt(np.mean(e[:n] ** 2))), 1e-300)
    window = np.hanning(n)[:, None]
    centred = (e[:n] - e[:n].mean(axis=0)) / size
    padded = 4 * n
    power = np.sum(np.abs(np.fft.rfft(centred * window, padded, axis=0)) ** 2, axis=1)
    frequency = np.fft.rfftfreq(padded, data.sampling_time)
    power[:8] = 0.0
    found = []
    for _ in range(count):
        k = int(np.argmax(power))
        if not power[k] > 0 or k >= len(power) - 1:
            break
        left, here, right = np.log(np.maximum(power[[k - 1, k, k + 1]], 1e-300))
        bend = left - 2 * here + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        found.append(float(frequency[k] + np.clip(shift, -1, 1) * frequency[1]))
        power[max(0, k - 16) : k + 17] = 0.0
    while len(found) < count:
        found.append(found[-1] if found else 1.0 / (10 * data.sampling_time))
    return tuple(found)
