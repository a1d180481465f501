"""How good the model is, on data it has seen and on data it has not, and whether its form is right."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float

from ...numerics.responses.filters import correlation, filtered

LAGS = 25
AR_ORDER = 10


@dataclass(frozen=True)
class Fit:
    """Free run of a model against one record, initial state (and offset) estimated on it.

    `simulated`: outputs of the free run; `residual` = measured − simulated, NaN where missing; `fit_percent` =
    100(1 − ‖y−ŷ‖/‖y−ȳ‖) and `rmse` per output, in the record's units.
    """

    simulated: Float[np.ndarray, "samples outputs"]
    residual: Float[np.ndarray, "samples outputs"]
    fit_percent: Float[np.ndarray, " outputs"]
    rmse: Float[np.ndarray, " outputs"]


FEEDBACK = 1e-4
"""Probability at which a correlation with future inputs is said: most records are open loop, and a fit that bends to
the colour of the noise leaves a little of the kind."""

FAR = (0.13, 0.29, 0.41, 0.57, 0.71, 0.87)
"""Shares of the record by which an input is shifted until it has nothing to do with a residual."""

NEAR = 3
"""Samples within which a controller answers most; a weak loop would drown among all lags."""

STANDS_OUT = 1.5
"""How much more than with inputs so shifted a residual must agree with future ones."""


def fit_of(measured: Float[np.ndarray, "samples outputs"], simulated: Float[np.ndarray, "samples outputs"]) -> Fit:
    """`Fit` of simulated to measured outputs; missing samples do not count."""
    residual = measured - simulated
    centred = measured - np.nanmean(measured, axis=0)
    rmse = np.sqrt(np.nanmean(residual**2, axis=0))
    size = np.sqrt(np.nanmean(np.where(np.isnan(residual), np.nan, centred) ** 2, axis=0))
    return Fit(simulated, residual, 100 * (1 - rmse / np.where(size > 0, size, np.nan)), rmse)


@dataclass(frozen=True)
class ResidualTest:
    """Residual autocorrelation and cross-correlation with the inputs, with 99 % bands.

    `autocorrelation`: lags 1 … per output; `cross_correlation`: lags −L … L per output and input (positive lags:
    the residual after the input); `band` and `cross_band`: half-widths of the 99 % bands; `white`: whether the
    portmanteau test accepts whiteness at 1 %; `input_explained`: whether past inputs still explain some of the
    residual at 1 %; `feedback`: whether future inputs do (a sign of closed loop), or inputs at the same sample alone;
    `followed`: whether future ones do.
    """

    autocorrelation: Float[np.ndarray, "lags outputs"]
    cross_correlation: Float[np.ndarray, "lags outputs inputs"]
    band: float
    cross_band: Float[np.ndarray, "outputs inputs"]
    white: bool
    input_explained: bool
    feedback: bool
    followed: bool


def _correlation(a: np.ndarray, b: np.ndarray, lags: int) -> np.ndarray:
    """Correlation of a(k + lag) with b(k) for lag −lags … lags, both without mean."""
    return correlation(a, b, lags) / len(a)


def _statistic(c: np.ndarray, own: np.ndarray, samples: int) -> tuple[float, int]:
    """Sum of squares of correlations with a signal whose own correlation is `own`, in units of their variance, and
    how many it counts."""
    values, vectors = np.linalg.eigh(scipy.linalg.toeplitz(own[: len(c)]) / samples)
    kept = values > 1e-2 * values[-1]
    return float(np.sum((vectors[:, kept].T @ c) ** 2 / values[kept])), int(kept.sum())


def _chance(c: np.ndarray, own: np.ndarray, samples: int) -> float:
    """Probability of correlations as large as `c` with a signal whose own correlation is `own`."""
    statistic, count = _statistic(c, own, samples)
    return float(scipy.special.chdtrc(count, statistic)) if count else 1.0


def _follows(e: np.ndarray, u: np.ndarray, own: np.ndarray, lags: range, pairs: int) -> bool:
    """Whether correlations of a residual with an input at some lags are no chance, and stand out from those with the
    input shifted far away: a periodic input and a residual of some colour agree at any lag."""
    n, most = len(u), max(map(abs, lags))
    chosen = [lag + most for lag in lags]
    c = _correlation(e, u, most)[chosen]
    if _chance(c, own, n) * pairs >= FEEDBACK:
        return False
    far = (_correlation(e, np.roll(u, int(part * n)), most)[chosen] for part in FAR)
    return _statistic(c, own, n)[0] > STANDS_OUT * max(_statistic(x, own, n)[0] for x in far)


def _without_jumps(x: np.ndarray) -> np.ndarray:
    """A signal limited to four standard deviations of its usual samples, of unit mean square."""
    usual = 4 * 1.48 * np.median(np.abs(x))
    calm = np.clip(x, -usual, usual) if usual > 0 else x
    return calm / max(np.sqrt(np.mean(calm**2)), 1e-300)


def residual_test(
    residual: Float[np.ndarray, "samples outputs"],
    u: Float[np.ndarray, "samples inputs"],
    *,
    lags: int = LAGS,
) -> ResidualTest:
    """Whiteness and independence of the residual from the inputs.

    The band of the cross-correlation allows for the colour of both (Bartlett's formula); inputs are whitened by an AR
    model first, so that a slow input does not spread one correlation over many lags. Correlation with past or future
    inputs is judged over all lags at once, both whitened, with the covariance that the input's own correlation gives.
    An input at the same sample, alone or with the one after, speaks for feedback where those before explain nothing.

    **Arguments:** `residual`: missing samples NaN (taken as zero); `u`; `lags`.

    **Returns:** a `ResidualTest`.

    **Reference:** Ljung, *System Identification*, §16.6.
    """
    e = np.nan_to_num(residual - np.nanmean(residual, axis=0))
    n, outputs = e.shape
    size = np.sqrt(np.mean(e**2, axis=0))
    e = e / np.where(size > 0, size, 1.0)
    lags = min(lags, n // 4)
    auto = np.stack([_correlation(e[:, k], e[:, k], lags) for k in range(outputs)], axis=1)
    quantile = float(scipy.special.ndtri(0.995))
    portmanteau = n * np.sum(auto[lags + 1 :] ** 2, axis=0)
    white = bool(np.all(portmanteau < scipy.special.chdtri(lags, 0.01 / outputs)))
    cross = np.zeros((2 * lags + 1, outputs, u.shape[1]))
    bands = np.zeros((outputs, u.shape[1]))
    late = early = at_once = False
    innovations = np.stack([whiten_by_ar(e[:, k]) for k in range(outputs)], axis=1)
    innovations = innovations / np.maximum(np.sqrt(np.mean(innovations**2, axis=0)), 1e-300)
    # One outlier that is left agrees by chance with whatever an input did just then.
    steady = np.stack([_without_jumps(innovations[:, k]) for k in range(outputs)], axis=1)
    for j in range(u.shape[1]):
        centred = u[:, j] - np.mean(u[:, j])
        w = whiten_by_ar(centred)
        w = w / max(np.sqrt(np.mean(w**2)), 1e-300)
        own = _correlation(w, w, lags)
        # Without the rare jumps of a reference, in which what is fed back would drown.
        calm = _without_jumps(w)
        calm_own = _correlation(calm, calm, lags)
        for k in range(outputs):
            c = _correlation(e[:, k], w, lags)
            spread = np.sqrt(max(np.sum(own * auto[:, k]), 0.1) / n)
            cross[:, k, j] = c
            bands[k, j] = quantile * spread
        for k in range(outputs):
            c = _correlation(innovations[:, k], w, lags)
            pairs = outputs * u.shape[1]
            late |= _chance(c[lags + 1 :], own[lags:], n) * pairs < 0.01
            for reach in (lags, NEAR):
                early |= _follows(steady[:, k], calm, calm_own[lags:], range(-reach, 0), pairs)
            for first in (0, -1):
                at_once |= _follows(steady[:, k], calm, calm_own[lags:], range(first, 1), pairs)
    feedback = early or (at_once and not late)
    return ResidualTest(auto[lags + 1 :], cross, quantile / np.sqrt(n), bands, white, late, feedback, early)


def ar_coefficients(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " coefficients"]:
    """1, −a_1, … of the AR model of order 10 fitted by Yule-Walker; 1, 0, … for a signal of zeros."""
    n = len(x)
    order = min(AR_ORDER, n // 4)
    r = np.array([np.dot(x[lag:], x[: n - lag]) / n for lag in range(order + 1)])
    if not r[0] > 0:
        return np.eye(order + 1)[0]
    solution = scipy.linalg.solve_toeplitz(np.concatenate([[r[0] * (1 + 1e-9)], r[1:-1]]), r[1:])
    return np.concatenate([[1.0], -solution])


def whiten_by_ar(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Prediction errors of that AR model."""
    return filtered(ar_coefficients(x), [1.0], x)


def noise_floor(residual: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Standard deviation of the residual's unpredictable part, per output (AR whitening); over gaps from what was
    measured before them."""
    known = [column[np.isfinite(column)] for column in np.asarray(residual).T]
    return np.array([np.std(whiten_by_ar(e - e.mean())[AR_ORDER:]) for e in known])


def information_criteria(cost: float, count: int, parameters: int) -> tuple[float, float]:
    """AIC and BIC of a Gaussian likelihood with ln-determinant `cost` per sample row times rows.

    **Arguments:** `cost`: rows · ln det Σ; `count`: number of output samples; `parameters` estimated.
    """
    return cost + 2 * parameters, cost + parameters * float(np.log(max(count, 1)))
