"""Digital filters, correlations and gaps of signals on the host.

`scipy.signal` has both, but its import alone takes as long as an identification.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg import lapack


def filtered(
    numerator, denominator, x: Float[np.ndarray, "*channels"], axis: int = -1
) -> Float[np.ndarray, "*channels"]:
    """Output, from rest, of b₀ + b₁z⁻¹ + … over a₀ + a₁z⁻¹ + … for the input x along `axis`.

    The recursion is a triangular system with the denominator's few bands, which LAPACK solves by substitution.

    **Arguments:** `numerator`, `denominator`: b and a, real, a₀ ≠ 0; `x`: one signal or many; `axis`: default last.

    **Returns:** an array of the shape of `x`.
    """
    b, a = np.atleast_1d(np.asarray(numerator, float)), np.atleast_1d(np.asarray(denominator, float))
    b, a = b / a[0], a / a[0]
    moved = np.moveaxis(np.asarray(x, float), axis, -1)
    rows, samples = moved.reshape(-1, moved.shape[-1]), moved.shape[-1]
    driven = rows * b[0] if len(b) == 1 else np.stack([np.convolve(row, b)[:samples] for row in rows])
    if len(a) > 1:
        bands = np.repeat(a[:, None], samples, axis=1)
        driven = lapack.dtbtrs(bands, driven.T, uplo="L", diag="U")[0].T
    return np.moveaxis(driven.reshape(moved.shape), -1, axis)


def correlation(a: Float[np.ndarray, " samples"], b: Float[np.ndarray, " samples"], lags: int) -> np.ndarray:
    """Σ_k a(k + lag) b(k) for lag −lags … lags (fewer than samples), by the fast Fourier transform."""
    length = 2 ** int(np.ceil(np.log2(len(a) + len(b))))
    around = np.fft.irfft(np.fft.rfft(a, length) * np.conj(np.fft.rfft(b, length)), length)
    return np.concatenate([around[length - lags :], around[: lags + 1]])


def without_gaps(x: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, "samples outputs"]:
    """Missing samples bridged by straight lines; 0 where nothing is known of an output."""
    at, filled = np.arange(len(x)), np.array(x)
    for column in filled.T:
        known = np.isfinite(column)
        column[:] = np.interp(at, at[known], column[known]) if known.any() else 0.0
    return filled


def white_part(e: Float[np.ndarray, "samples outputs"], kept) -> Float[np.ndarray, " outputs"]:
    """Variance of the white part of a residual, from its second differences, in squares of its units.

    All of white noise, and next to nothing of what is slow; what has few samples a period counts as white, too.

    **Arguments:** residual `e`; `kept`: which of its samples count.
    """
    second = np.diff(e, n=2, axis=0) ** 2
    known = kept[2:] & kept[1:-1] & kept[:-2]
    return np.sum(np.where(known, second, 0.0), axis=0) / (6 * np.maximum(known.sum(axis=0), 1))
