"""What the noise is like: a noise model for residual, sensitivities and features alike.

Innovations filter of the fitted plant (noise at the inputs), an AR model per output, and the inverse Cholesky
factor of the covariance of what is left:

    x̂⁺ = A x̂ + G ε,  ε = e − C x̂,      ν = a(z) ε,      w = L⁻¹ ν.

**Reference:** Ljung, *System Identification*, §4.3 (innovations form), §7.4 (likelihood).
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from ...identification.validation.residuals import AR_ORDER, ar_coefficients
from ...mechanics.systems.statespace import StateSpace
from ...numerics.matrices.bounded import bounded
from ...numerics.matrices.riccati import kalman_gain
from ...numerics.programs.side_by_side import side_by_side
from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.filters import filtered, white_part
from ...numerics.responses.lifting import respond, respond_many

RATIOS = np.concatenate([[0.0], np.geomspace(1e-8, 1e4, 25)])
"""Force noise relative to the inputs' mean square that is tried."""

SETTLING = 4 * AR_ORDER
"""Samples left out at the beginning, where the noise model has no past yet."""

AT_ONCE = 5
"""Parts of the grid of ratios that are tried beside one another: their number divides that of the ratios."""

_FLOOR = 1e-12

ROWS = 16
"""What is whitened at once: one number, so that little is compiled; more at a time would leave the cache."""


@dataclass(frozen=True)
class NoiseModel:
    """A noise model; see the module.

    `A`, `C`, `gain`: innovations filter; `coefficients`: 1, a_1, … per output; `lower`: L; `ratio` (ρ) of force noise;
    `cost`: N ln det of the covariance that is left, with what ρ cost; `level`: root mean square of what the noise model
    was estimated from; `worth`: by how much `cost` is less than with ρ = 0.
    """

    A: Float[np.ndarray, "states states"]
    C: Float[np.ndarray, "outputs states"]
    gain: Float[np.ndarray, "states outputs"]
    coefficients: Float[np.ndarray, "outputs coefficients"]
    lower: Float[np.ndarray, "outputs outputs"]
    ratio: float
    cost: float
    level: Float[np.ndarray, " outputs"]
    worth: float = 0.0

    def whiten_rows(
        self,
        X: Float[np.ndarray, "rows samples outputs"],
        kept: Bool[np.ndarray, "samples outputs"],
        used: Bool[np.ndarray, "samples outputs"],
    ) -> Float[np.ndarray, "rows samples outputs"]:
        """Residuals or features through the noise model, each a row of its own: what is not `kept` is zero before, what
        is not `used` zero after it."""
        if self.is_white:
            return (X @ np.linalg.inv(self.lower).T) * used
        result = np.empty(X.shape)
        arrays = (self.A, self.C, self.gain, self.coefficients, self.lower, kept, used)

        def whiten(k):
            part = X[k : k + ROWS]
            count = len(part)
            if count < ROWS:
                part = np.concatenate([part, np.zeros((ROWS - count, *X.shape[1:]))])
            result[k : k + count] = np.asarray(_whiten(*arrays, part))[:count]

        side_by_side(whiten, range(0, len(X), ROWS))
        return result

    @property
    def is_white(self) -> bool:
        """Whether it does not filter, but only scales."""
        return self.ratio == 0.0 and not np.any(self.coefficients[:, 1:]) and bool(np.all(self.coefficients[:, 0] == 1))


@stored
def _whiten(A, C, gain, coefficients, lower, kept, used, X):
    """The whole noise model as one recursion: the innovations filter, and the innovations that the AR models
    remember."""
    states, outputs, lags = A.shape[0], C.shape[0], coefficients.shape[1] - 1
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(outputs), lower=True)
    seen = jnp.concatenate([-C, jnp.zeros((outputs, lags * outputs))], axis=1)
    memory = jnp.eye(lags * outputs, k=-outputs)
    step = jnp.block(
        [[A - gain @ C, jnp.zeros((states, lags * outputs))], [jnp.zeros((lags * outputs, states)), memory]]
    )
    step = step.at[states : states + outputs].add(seen)
    enter = jnp.concatenate([gain, jnp.eye(outputs), jnp.zeros(((lags - 1) * outputs, outputs))])
    late = jnp.concatenate([jnp.zeros((outputs, states)), *(jnp.diag(c) for c in coefficients.T[1:])], axis=1)
    now = coefficients[:, :1]
    return respond_many(step, enter, inverse @ (now * seen + late), inverse * now.T, X * kept) * used


@stored
def _over_ratios(A, B, C, D, force, output, ratios, e, rows):
    """For every ρ: gain of the innovations filter, and Σ εεᵀ over the rows that count."""

    def one(ratio):
        push = ratio * force
        gain = kalman_gain(A, C, B * push @ B.T, B * push @ D.T, output + D * push @ D.T)[0]
        epsilon = _innovations(A, C, gain, e) * rows[:, None]
        return gain, epsilon.T @ epsilon

    return jax.lax.map(one, ratios)


def _innovations(A, C, gain, e):
    return respond(A - gain @ C, gain, -C, jnp.eye(C.shape[0]), e)


_filtered = stored(_innovations, level=ONCE)


_respond, _kalman_gain = stored(respond, level=ONCE), stored(kalman_gain, level=ONCE)


def counted(kept: Bool[np.ndarray, "samples outputs"]) -> Bool[np.ndarray, "samples outputs"]:
    """Samples that a test may count: measured, the noise model's past known, its beginning over."""
    whole = np.array(kept)
    for lag in range(1, AR_ORDER + 1):
        whole[lag:] &= kept[:-lag]
    whole[: min(SETTLING, len(kept) // 4)] = False
    return whole


def estimate_noise_model(
    e: Float[np.ndarray, "samples outputs"],
    kept: Bool[np.ndarray, "samples outputs"],
    system: StateSpace,
    force: Float[np.ndarray, " inputs"],
) -> NoiseModel:
    """The noise model of a residual from which every effect has been removed.

    ρ minimises N ln det(Σ wwᵀ/N) + 2·[ρ > 0], w after an AR(10) fitted to what its filter leaves, over the part of a
    logarithmic grid where ln det(Σ εεᵀ) of the filter alone is least.

    **Arguments:** `e`: residual, zero where missing; `kept`: what was measured; `system`: sampled plant with the
    columns of B and D through which noise enters; `force`: mean square of the input at each of them.

    **Returns:** a `NoiseModel`.
    """
    used = counted(kept)
    rows = np.all(used, axis=1)
    level = np.mean(e[rows] ** 2, axis=0) if rows.any() else np.ones(e.shape[1])
    V = np.maximum(white_part(e, kept), _FLOOR * np.maximum(level, 1e-300)) + 1e-300
    A, B, C, D = (np.asarray(X) for X in (system.A, system.B, system.C, system.D))

    def some(ratios):
        return jax.device_get(_over_ratios(A, B, C, D, force, np.diag(V), ratios, e, rows))

    gains, products = (np.concatenate(X) for X in zip(*side_by_side(some, np.split(RATIOS[1:], AT_ONCE))))
    sound = np.array([bounded(*pair) for pair in zip(gains, products)])
    costs = np.full(len(gains), np.inf)
    costs[sound] = np.linalg.slogdet(products[sound] / max(int(rows.sum()), 1) + 1e-300 * np.eye(len(C)))[1]
    tried = np.flatnonzero(np.isfinite(costs))
    plain = _with_colour(A, C, np.zeros((A.shape[0], C.shape[0])), 0.0, e, e, kept, rows)
    best = int(np.argmin(costs[tried])) if len(tried) else 0
    noise_model = plain
    # Coloured noise at the outputs may look like noise at the forces until its colour is allowed for, and then less.
    for k in [tried[k] for k in (best, best - 2, best - 4, best + 2) if 0 <= k < len(tried)]:
        epsilon = np.asarray(_filtered(A, C, gains[k], e))
        with_noise = _with_colour(A, C, gains[k], float(RATIOS[1:][k]), e, epsilon, kept, rows)
        noise_model = with_noise if with_noise.cost < noise_model.cost else noise_model
    return dataclasses.replace(noise_model, worth=plain.cost - noise_model.cost)


def _with_colour(A, C, gain, ratio, e, epsilon, kept, rows) -> NoiseModel:
    """The noise model with its AR models and covariance, from what the innovations filter leaves."""
    outputs, samples = e.shape[1], max(int(rows.sum()), 1)
    coefficients = np.stack([ar_coefficients(np.where(kept[:, k], epsilon[:, k], 0.0)) for k in range(outputs)])
    level = np.sqrt(np.mean(e[rows] ** 2, axis=0)) if rows.any() else np.ones(outputs)
    level = np.maximum(level, 1e-300)
    white = np.stack([filtered(a, [1.0], epsilon[:, k])[rows] for k, a in enumerate(coefficients)])
    covariance = white @ white.T / samples
    covariance = covariance + np.diag(_FLOOR * np.diag(covariance) + 1e-300)
    cost = samples * float(np.linalg.slogdet(covariance)[1]) + 2 * (ratio > 0)
    return NoiseModel(A, C, gain, coefficients, scipy.linalg.cholesky(covariance, lower=True), ratio, cost, level)


def white_noise_model(e: Float[np.ndarray, "samples outputs"], kept, system: StateSpace) -> NoiseModel:
    """The noise model of white output noise with the covariance of a residual: for first fits."""
    outputs, states = e.shape[1], system.A.shape[0]
    rows = np.all(counted(kept), axis=1)
    covariance = e[rows].T @ e[rows] / max(int(rows.sum()), 1)
    covariance = covariance + np.diag(_FLOOR * np.diag(covariance) + 1e-300)
    coefficients = np.zeros((outputs, AR_ORDER + 1))
    coefficients[:, 0] = 1.0
    lower = scipy.linalg.cholesky(covariance, lower=True)
    cost = rows.sum() * float(np.linalg.slogdet(covariance)[1])
    A, C = np.asarray(system.A), np.asarray(system.C)
    return NoiseModel(A, C, np.zeros((states, outputs)), coefficients, lower, 0.0, cost, np.sqrt(np.diag(covariance)))
