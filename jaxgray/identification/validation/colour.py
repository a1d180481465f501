"""What a coloured residual means for error bars: its spectrum, and the covariance of the scores."""

import numpy as np
from jaxtyping import Float

MOST_LAGS = 40
"""Longest autoregression that is tried."""

MOST_ROWS = 2**15
"""Samples from which it is estimated; more would say nothing new about its order."""

ROWS_A_COEFFICIENT = 8
"""Samples per coefficient that an autoregression must have at least."""

PIECE = 2**15
"""Samples that are looked at together."""


def autoregression(
    residuals: list[Float[np.ndarray, "samples outputs"]],
) -> tuple[Float[np.ndarray, "lags outputs outputs"], Float[np.ndarray, "outputs outputs"]]:
    """Vector autoregression e(k) = Σ A_j e(k − j) + ε(k) of residuals, by least squares, its length by BIC.

    **Arguments:** `residuals`: of every record; rows with missing samples (NaN), and those soon after, do not count.

    **Returns:** A_1, …, and the covariance of ε; no lags where the residual is white or too short.

    **Reference:** Lütkepohl, *New Introduction to Multiple Time Series Analysis* (2005), §3.2 and §4.3.
    """
    outputs = residuals[0].shape[1]
    for lags in range(MOST_LAGS, -1, -1):
        parts = [_windows(e, lags) for e in residuals if len(e) > lags]
        rows = np.concatenate(parts) if parts else np.zeros((0, (lags + 1) * outputs))
        if len(rows) >= ROWS_A_COEFFICIENT * (lags * outputs + 1):
            break
    rows = rows[:: -(-len(rows) // MOST_ROWS)]
    n = len(rows)
    if not n:
        return np.zeros((0, outputs, outputs)), np.zeros((outputs, outputs))
    gram = rows.T @ rows / n
    best, criterion = None, np.inf
    for order in range(lags + 1):
        now, before = slice(0, outputs), slice(outputs, (order + 1) * outputs)
        inner = gram[before, before]
        ridge = 1e-12 * np.trace(inner) / max(len(inner), 1) * np.eye(len(inner))
        solution = np.linalg.solve(inner + ridge, gram[before, now])
        covariance = gram[now, now] - gram[now, before] @ solution
        sign, logdet = np.linalg.slogdet(covariance)
        price = n * logdet + order * outputs**2 * np.log(n)
        if sign > 0 and price < criterion:
            criterion = price
            spread = covariance * n / max(n - order * outputs, 1)
            best = solution.reshape(order, outputs, outputs).transpose(0, 2, 1), spread
    return (np.zeros((0, outputs, outputs)), gram[:outputs, :outputs]) if best is None else best


def _windows(e: np.ndarray, lags: int) -> np.ndarray:
    """Every complete stretch of lags + 1 samples as a row, the latest first."""
    n = len(e) - lags
    rows = np.concatenate([e[lags - lag : lags - lag + n] for lag in range(lags + 1)], axis=1)
    return rows[np.all(np.isfinite(rows), axis=1)]


def score_covariance(
    sensitivities: list[Float[np.ndarray, "samples outputs parameters"]],
    residuals: list[Float[np.ndarray, "samples outputs"]],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance JᵀRJ of the scores Jᵀe, where R is that of a residual of this colour.

    R follows from an autoregression of the residual, so that noise counts at the frequencies at which J is sensitive to
    it, however narrow these are: averages of the scores over lags would blur them.

    **Arguments:** `sensitivities` J of every record, zero where a sample is missing; `residuals` likewise, NaN there.

    **Returns:** the sum over the records.

    **Reference:** Ljung, *System Identification*, §9.4; Andrews & Monahan (1992) for the autoregression.
    """
    coefficients, covariance = autoregression(residuals)
    lower = np.linalg.cholesky(covariance + 1e-300 * np.eye(len(covariance)))
    total = 0.0
    for J in [rows[first : first + PIECE] for rows in sensitivities for first in range(0, len(rows), PIECE)]:
        # Zeros behind it, so that its end does not meet its beginning in the Fourier transform.
        length = smooth_length(2 * len(J))
        turn = np.exp(-2j * np.pi * np.arange(length // 2 + 1) / length)[:, None, None]
        whitening = np.eye(len(lower)) - sum(turn**lag * A for lag, A in enumerate(coefficients, 1))
        # The spectrum is F Fᴴ.
        F = np.linalg.solve(np.broadcast_to(whitening, (len(turn), *lower.shape)), lower.astype(complex))
        weights = np.full(len(turn), 2.0)
        weights[0] = 1.0
        weights[-1] = 2.0 if length % 2 else 1.0
        rows = F.conj().transpose(0, 2, 1) @ np.fft.rfft(J, length, axis=0)
        rows = (rows * np.sqrt(weights / length)[:, None, None]).reshape(-1, J.shape[2])
        total = total + rows.real.T @ rows.real + rows.imag.T @ rows.imag
    return total


def smooth_length(n: int) -> int:
    """A length not less, by a sixteenth at most more, without large prime factors."""
    step = 2 ** max(int(np.log2(n)) - 4, 0)
    return -(-n // step) * step
