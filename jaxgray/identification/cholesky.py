"""Levenberg-Marquardt on the Cholesky factors of M, D, K, driven from the host.

Every evaluation is the one compiled function of `normal`; the factors enter by the chain rule. Products of errors and
sensitivities serve any weights, so that renewing these on the way costs nothing.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.linear_algebra import symmetric_vector, triangle
from .conic import pseudo_inverse
from .normal import Normal, Products, moved
from .prediction import Nuisance

FIRST_DAMPING = 1e-3
MOST_DAMPING = 1e8
FAITHFUL = 0.99
"""Share of the promised decrease above which the next step may be bolder."""
SETTLING = 1e-4
"""The weights are renewed when a step promises less than this share of the sum of squares."""
NEAR = 0.1
"""Stop when a step would change the sum of squares by less than this, in units of the noise variance: the steps over
the cone that follow are exact."""
NEAR_EDGE = 1e-6
"""The same for a start at the edge of the cone, from where those steps are ill-conditioned."""


def pack(blocks: list[Array], scales: list[Array], logarithmic: tuple[bool, ...]) -> list[Array]:
    """Cholesky factors as vectors, upper triangle by columns of Lᵀ, in units of √scale.

    The mass has the logarithm of its diagonal, so that it can never become singular.
    """
    vectors = []
    for block, scale, as_logarithm in zip(blocks, scales, logarithmic):
        lower = jnp.linalg.cholesky(block / scale)
        rows, columns = triangle(block.shape[0])
        entries = lower.T[rows, columns]
        vectors.append(jnp.where((rows == columns) & as_logarithm, jnp.log(jnp.abs(entries)), entries))
    return vectors


def unpack(vectors: list[Array], scales: list[Array], logarithmic: tuple[bool, ...], sizes) -> list[Array]:
    """Inverse of `pack`."""
    blocks = []
    for vector, scale, as_logarithm, n in zip(vectors, scales, logarithmic, sizes):
        rows, columns = triangle(n)
        diagonal = (rows == columns) & as_logarithm
        entries = jnp.where(diagonal, jnp.exp(jnp.where(diagonal, vector, 0.0)), vector)
        upper = jnp.zeros((n, n)).at[rows, columns].set(entries)
        blocks.append(upper.T @ upper * scale)
    return blocks


class CholeskyEnd(NamedTuple):
    """Where the steps ended.

    `whitening` and `products` there; `cost`: minus twice the log-likelihood, ∞ where nothing was finite; `steps`:
    evaluations taken.
    """

    blocks: list[np.ndarray]
    nuisance: Nuisance
    whitening: np.ndarray
    products: Products
    cost: float
    steps: int


class _Factor:
    """One block, X = scale · UᵀU, on the host: the parameters are the entries of U, as in `pack`."""

    def __init__(self, block: np.ndarray, as_logarithm: bool):
        self.scale = np.trace(block) / len(block)
        self.places = list(zip(*triangle(len(block))))
        self.upper = np.linalg.cholesky(block / self.scale).T
        self.as_logarithm = as_logarithm

    def chart(self) -> np.ndarray:
        """Derivative of the block's symmetric vector by the parameters."""
        columns = []
        for r, c in self.places:
            unit = np.zeros_like(self.upper)
            unit[c] = self.upper[r] * (self.upper[r, r] if self.as_logarithm and r == c else 1.0)
            columns.append(symmetric_vector(self.scale * (unit + unit.T)))
        return np.stack(columns, axis=1)

    def stepped(self, step: np.ndarray) -> "_Factor":
        """The factor after a step of the parameters."""
        new = object.__new__(_Factor)
        new.scale, new.places, new.as_logarithm = self.scale, self.places, self.as_logarithm
        new.upper = self.upper.copy()
        for (r, c), change in zip(self.places, step):
            if self.as_logarithm and r == c:
                new.upper[r, c] *= np.exp(np.clip(change, -20.0, 20.0))
            else:
                new.upper[r, c] += change
        return new

    @property
    def block(self) -> np.ndarray:
        return self.scale * self.upper.T @ self.upper


def cholesky_steps(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[np.ndarray, "outputs outputs"],
    evaluate: Callable[[list[Array], Nuisance], Products],
    *,
    owners: tuple[str, ...],
    correlated: bool,
    count: float,
    near: float = NEAR,
    max_steps: int = 120,
) -> CholeskyEnd:
    """Damped Gauss-Newton steps until none promises more than a tenth of the noise variance.

    **Arguments:** `blocks` (positive definite) and `nuisance` to start from; `whitening` for the first step;
    `evaluate`: products of errors and sensitivities at a point; `owners`: the matrix of each block; `correlated`:
    whether the noise of different outputs may be; `count`: number of output samples; `near`: the
    decrement to stop at, in units of the noise variance; `max_steps`.

    **Returns:** a `CholeskyEnd`.
    """
    sizes = tuple(block.shape[0] for block in blocks)
    factors = [_Factor(np.asarray(block), owner == "mass") for block, owner in zip(blocks, owners)]
    ends = np.cumsum([n * (n + 1) // 2 for n in sizes])
    entries = int(ends[-1])
    here = evaluate([factor.block for factor in factors], nuisance)
    normal, damping, steps = here.normal(whitening), FIRST_DAMPING, 1
    unit = _size(normal, factors, ends)
    while steps < max_steps and damping < MOST_DAMPING and np.isfinite(normal.cost):
        step, decrement = _step(normal, factors, ends, damping, unit)
        if not np.isfinite(decrement):
            break
        trial_factors = [f.stepped(s) for f, s in zip(factors, np.split(step[:entries], ends[:-1]))]
        trial_nuisance = moved(nuisance, step[entries:])
        trial = evaluate([factor.block for factor in trial_factors], trial_nuisance)
        steps += 1
        trial_normal = trial.normal(whitening)
        done = decrement < near * normal.cost / count
        if not (np.isfinite(trial_normal.cost) and trial_normal.cost <= normal.cost):
            if done:
                break
            damping = max(4 * damping, 1e-4)
            continue
        settling = decrement < SETTLING * normal.cost and damping <= FIRST_DAMPING
        # Less damping only for steps that kept what they promised: a bold one may leave for another minimum.
        less = 0.25 if normal.cost - trial_normal.cost > FAITHFUL * decrement else 1.0
        factors, nuisance, here, normal = trial_factors, trial_nuisance, trial, trial_normal
        done = done and damping <= FIRST_DAMPING
        if settling:
            # What a wrong model leaves is no noise: its correlations would lead astray, its sizes do not.
            renewed = here.whitening(False)
            done = done and np.max(np.abs(np.diag(renewed) / np.diag(whitening) - 1)) < 0.1
            whitening, normal = renewed, here.normal(renewed)
        if done or here.exact:
            break
        damping = less * damping if damping > 1e-7 else 0.0
    return _end([factor.block for factor in factors], nuisance, here, correlated, steps)


def at_start(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[np.ndarray, "outputs outputs"],
    evaluate: Callable[[list[Array], Nuisance], Products],
    *,
    correlated: bool,
) -> CholeskyEnd:
    """The blocks as they are, with the best first states and offsets; see `cholesky_steps`."""
    blocks = [np.asarray(block) for block in blocks]
    entries = sum(len(block) * (len(block) + 1) // 2 for block in blocks)
    normal = evaluate(blocks, nuisance).normal(whitening)
    if np.all(np.isfinite(normal.information)) and np.all(np.isfinite(normal.gradient)):
        inner = pseudo_inverse(normal.information[entries:, entries:])
        nuisance = moved(nuisance, -inner @ normal.gradient[entries:])
    return _end(blocks, nuisance, evaluate(blocks, nuisance), correlated, 2)


def _end(blocks: list[np.ndarray], nuisance: Nuisance, here: Products, correlated: bool, steps: int) -> CholeskyEnd:
    whitening = here.whitening(correlated)
    cost = float(-2 * np.sum(here.counts * np.log(np.diag(whitening))))
    return CholeskyEnd(blocks, nuisance, whitening, here, cost if np.isfinite(cost) else np.inf, steps)


def _charted(normal: Normal, factors: list[_Factor], ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient by the parameters of the factors, then the nuisance."""
    H, g = np.array(normal.information), np.array(normal.gradient)
    entries = int(ends[-1])
    T = np.zeros((entries, entries))
    for factor, end in zip(factors, ends):
        width = len(factor.places)
        T[end - width : end, end - width : end] = factor.chart()
    H[:entries] = T.T @ H[:entries]
    H[:, :entries] = H[:, :entries] @ T
    g[:entries] = T.T @ g[:entries]
    return H, g


def _size(normal: Normal, factors: list[_Factor], ends: np.ndarray) -> np.ndarray:
    """Norms of the sensitivities."""
    H, _ = _charted(normal, factors, ends)
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    return np.where(size > 1e-12 * np.max(size), size, max(np.max(size), 1e-300))


def _step(
    normal: Normal, factors: list[_Factor], ends: np.ndarray, damping: float, unit: np.ndarray
) -> tuple[np.ndarray, float]:
    """The damped step in factors and nuisance, and the decrement that it promises; `unit`: what damps equally."""
    H, g = _charted(normal, factors, ends)
    H = H + np.diag(damping * unit**2)
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    H = H / scale[:, None] / scale[None, :] + 1e-13 * np.eye(len(scale))
    if not np.all(np.isfinite(H)) or not np.all(np.isfinite(g)):
        return g, np.nan
    try:
        step = -np.linalg.solve(H, g / scale)
    except np.linalg.LinAlgError:
        return g, np.nan
    return step / scale, float(-step @ (g / scale))
