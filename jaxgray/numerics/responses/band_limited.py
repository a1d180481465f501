"""Straight lines between samples that move a plant as a band-limited signal does."""

import numpy as np

TAPS = 16
"""Samples on either side that the filter of a band-limited input reaches."""

BAND = 0.42
"""Frequency, in cycles a sample, up to which the filter is fitted; anti-alias filters pass little beyond."""


def _band_limiting() -> np.ndarray:
    """Symmetric filter of which straight lines between its samples give S(f) = 1 (least squares, within 1e−5 up to
    `BAND`), gain 1 at standstill."""
    f = np.linspace(0.0, BAND, 50 * TAPS)
    x = np.pi * f
    # Σ_k sinc²(f + k) f²/(f + k)².
    lines = (1.0 - 2.0 / 3.0 * np.sin(x) ** 2) / np.sinc(f) ** 2
    cosines = np.cos(2 * np.pi * np.outer(f, np.arange(TAPS + 1)))
    cosines[:, 1:] *= 2.0
    half = np.linalg.lstsq(cosines * lines[:, None], np.ones(len(f)), rcond=None)[0]
    taps = np.concatenate([half[:0:-1], half])
    return taps / taps.sum()


BAND_LIMITING = _band_limiting()


def band_limited(u, xp=np):
    """The samples between which straight lines give the plant a band-limited input.

    Straight lines between samples weaken a frequency f (in cycles a sample) by sinc²(f), and repeat it at f + k. A mass
    follows what is repeated by f²/(f + k)² of what it follows at f, and its sampled displacement shows the sum: the
    samples are raised by what that lacks.

    **Arguments:** `u` (samples,), at rest before its first and after its last; `xp`: `numpy` (default) or `jax.numpy`,
    which a record that is only read need not load.

    **Returns:** as many samples.

    **Reference:** Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    on band-limited measurement.
    """
    return xp.convolve(xp.pad(u, TAPS, mode="edge"), BAND_LIMITING, mode="valid")
