"""Repetition: finding the period of a signal, and averaging over periods."""

import warnings

import numpy as np
from jaxtyping import Float


def find_period(u: Float[np.ndarray, "samples channels"], tolerance: float) -> int | None:
    """The smallest lag P at which all channels repeat,

        d(P) = mean_k ‖u_{k+P} − u_k‖² / (2 var u)  ≤  tolerance² / 2,

    where the mismatch must not grow from one period to the next, as it does for a lag that is merely near.

    **Arguments:**

    - `u`: the signals; constant channels are left out.
    - `tolerance`: largest RMS difference between repeats as a share of the signal's RMS about its mean.

    **Returns:** P in samples, None where nothing repeats at least twice.
    """
    spread = u.std(axis=0)
    moving = spread > 1e-12 * np.abs(u).max(axis=0, initial=0.0)
    if not moving.any() or len(u) < 4:
        return None
    x = (u[:, moving] - u[:, moving].mean(axis=0)) / spread[moving]
    mismatch = _mismatch(x)

    # A smooth signal hardly changes from one sample to the next: look beyond the first lag at which it has
    # become unlike itself.
    unlike = np.flatnonzero(mismatch > 0.5)
    if unlike.size == 0:
        return None
    search = np.arange(unlike[0] + 1, len(mismatch))
    if search.size == 0:
        return None
    limit = 0.5 * tolerance**2
    best = mismatch[search].min()
    # A fraction of a noisy period can look alike by chance, never as alike as the period itself; rounding of
    # the Fourier transform sets the floor.
    near = search[mismatch[search] <= min(limit, max(4.0 * best, 1e-10))]
    for period in near:
        if _keeps(x, int(period), limit):
            return int(period)
    return None


def _mismatch(x: np.ndarray) -> np.ndarray:
    """d(P) for P = 0 … samples // 2, through the autocorrelation."""
    n, lags = len(x), len(x) // 2 + 1
    spectrum = np.fft.rfft(x, 2 ** int(np.ceil(np.log2(2 * n))), axis=0)
    correlation = np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=1))[:lags]
    energy = np.concatenate(([0.0], np.cumsum(np.sum(x**2, axis=1))))
    lag = np.arange(lags)
    pairs = energy[n - lag] + (energy[n] - energy[lag]) - 2.0 * correlation
    return pairs / (2.0 * (n - lag) * x.shape[1])


def _keeps(x: np.ndarray, period: int, limit: float) -> bool:
    """Whether some periods on the signal is as like itself as one on; a near miss grows with the square."""

    def apart(lag):
        return float(np.mean((x[lag:] - x[:-lag]) ** 2) / 2.0)

    ahead = min(6, len(x) // period - 1)
    one, far = apart(period), apart(ahead * period)
    if one > limit:
        return False
    if ahead > 1:
        return far <= max(3.0, 0.3 * ahead**2) * one + 1e-18
    # With two periods only, what is left must look like noise and not like a shifted copy.
    rest = x[period:] - x[:-period]
    power = np.sum(rest**2)
    return bool(power <= 1e-18 * np.sum(x**2) or np.sum(rest[1:] * rest[:-1]) < 0.7 * power)


def between_periods(
    x: Float[np.ndarray, "rows channels"], periods: int
) -> tuple[Float[np.ndarray, "samples channels"], Float[np.ndarray, "samples channels"]]:
    """Mean and variance over consecutive periods, missing samples left out.

    **Arguments:**

    - `x`: whole periods, one after the other.
    - `periods`: their number.

    **Returns:** the mean period, NaN where no period has the sample, and the variance about it (divided by
    one less than the number of values), NaN where fewer than two have it.
    """
    stacked = x.reshape(periods, -1, x.shape[1])
    with warnings.catch_warnings():
        # An empty slice is a sample missing in every period; NaN is the wanted answer.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(stacked, axis=0), np.nanvar(stacked, axis=0, ddof=1)
