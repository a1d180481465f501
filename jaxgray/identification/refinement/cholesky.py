"""Levenberg-Marquardt on the Cholesky factors of M, D, K, driven from the host.

Every evaluation is the one compiled function of `normal`; the factors enter by the chain rule. Products of errors and
sensitivities serve any weights, so that renewing these on the way costs nothing.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl
from jaxtyping import Array, Float

from ...numerics.matrices.linear_algebra import from_triangle, symmetric_vector, triangle, triangle_vector
from ...numerics.matrices.namespace import namespace
from .conic import pseudo_inverse
from .normal_equations import Criterion, Iterate, Normal, Products, moved

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
CANCELLED = 1e-6
"""Share of a sum of squares below which a difference of such sums is all rounding."""
LONGEST = 20.0
"""Most by which one step changes the logarithm of a factor's diagonal: beyond it lies overflow."""


def upper_factor(vector: Float[Array, " entries"], as_logarithm: bool, n: int) -> Float[Array, "n n"]:
    """The upper triangular U that a vector stands for; `as_logarithm`: its diagonal is given as a logarithm."""
    xp = namespace(vector)
    rows, columns = triangle(n)
    diagonal = (rows == columns) & as_logarithm
    return xp.triu(from_triangle(xp.where(diagonal, xp.exp(xp.where(diagonal, vector, 0.0)), vector)))


def pack(blocks: list[Array], scales: list[Array], logarithmic: tuple[bool, ...]) -> list[Array]:
    """Cholesky factors U of X = scale · UᵀU as vectors, upper triangle by columns.

    The mass has the logarithm of its diagonal, so that it can never become singular.
    """
    vectors = []
    for block, scale, as_logarithm in zip(blocks, scales, logarithmic):
        xp = namespace(block)
        rows, columns = triangle(block.shape[0])
        entries = triangle_vector(xp.linalg.cholesky(block / scale).T)
        diagonal = (rows == columns) & as_logarithm
        vectors.append(xp.where(diagonal, xp.log(xp.where(diagonal, entries, 1.0)), entries))
    return vectors


def unpack(vectors: list[Array], scales: list[Array], logarithmic: tuple[bool, ...], sizes) -> list[Array]:
    """Inverse of `pack`."""
    uppers = [upper_factor(*each) for each in zip(vectors, logarithmic, sizes)]
    return [upper.T @ upper * scale for upper, scale in zip(uppers, scales)]


class CholeskyEnd(NamedTuple):
    """Where the steps ended: the iterate, its `products`, minus twice its log-likelihood, and evaluations taken.

    `cost` is ∞ where nothing was finite.
    """

    at: Iterate
    products: Products
    cost: float
    steps: int


@dataclass(frozen=True)
class _Factors:
    """The blocks as `pack` writes them, on the host."""

    vectors: list[np.ndarray]
    scales: list[float]
    logarithmic: tuple[bool, ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, blocks: list[Array], criterion: Criterion) -> "_Factors":
        blocks = [np.asarray(block) for block in blocks]
        scales = [np.trace(block) / len(block) for block in blocks]
        logarithmic = criterion.logarithmic
        return cls(pack(blocks, scales, logarithmic), scales, logarithmic, criterion.sizes)

    @property
    def blocks(self) -> list[np.ndarray]:
        # What overflows is no block, and refused by who asks.
        with np.errstate(over="ignore", invalid="ignore"):
            return unpack(self.vectors, self.scales, self.logarithmic, self.sizes)

    @property
    def entries(self) -> int:
        """Number of entries of all blocks."""
        return sum(len(vector) for vector in self.vectors)

    @property
    def finite(self) -> bool:
        """Whether the blocks are."""
        return all(np.all(np.isfinite(block)) for block in self.blocks)

    def stepped(self, step: np.ndarray) -> "_Factors":
        """The factors after a step of their vectors."""
        moves = np.split(step, np.cumsum([len(vector) for vector in self.vectors])[:-1])
        vectors = []
        for vector, move, as_logarithm, n in zip(self.vectors, moves, self.logarithmic, self.sizes):
            rows, columns = triangle(n)
            vectors.append(vector + np.where((rows == columns) & as_logarithm, np.clip(move, -LONGEST, LONGEST), move))
        return replace(self, vectors=vectors)

    def normal(self, products: Products, whitening: np.ndarray, criterion: Criterion) -> Normal:
        """Normal equations by the vectors of the factors, then the nuisance; infinitely costly after an overflow."""
        by_blocks = criterion.normal(products, whitening, self.blocks)
        if not np.isfinite(by_blocks.cost):
            return by_blocks
        charts = [_chart(*each) for each in zip(self.vectors, self.scales, self.logarithmic, self.sizes)]
        T = sl.block_diag(*charts, np.eye(len(by_blocks.gradient) - self.entries))
        return Normal(by_blocks.cost, T.T @ by_blocks.gradient, T.T @ by_blocks.information @ T)


def _chart(vector, scale, as_logarithm, n) -> np.ndarray:
    """Derivative of a block's symmetric vector by the vector of its factor."""
    upper = upper_factor(vector, as_logarithm, n)
    columns = []
    for r, c in zip(*triangle(n)):
        unit = np.zeros_like(upper)
        unit[c] = upper[r] * (upper[r, r] if as_logarithm and r == c else 1.0)
        columns.append(symmetric_vector(scale * (unit + unit.T)))
    return np.stack(columns, axis=1)


def cholesky_steps(
    start: Iterate,
    criterion: Criterion,
    *,
    first: Products | None = None,
    near: float = NEAR,
    max_steps: int = 120,
) -> CholeskyEnd:
    """Damped Gauss-Newton steps until none promises more than `near`.

    **Arguments:** `start`, its blocks positive definite, its whitening that of the first step; `criterion`; `first`:
    the products at the start where they are known; `near`: the decrement to stop at, in units of the noise variance;
    `max_steps`: most evaluations.

    **Returns:** a `CholeskyEnd`.

    **Reference:** Nocedal & Wright, *Numerical Optimization*, §10.3.
    """
    nuisance, whitening, count = start.nuisance, start.whitening, criterion.count
    factors = _Factors.of(start.blocks, criterion)
    here = criterion.evaluate(factors.blocks, nuisance) if first is None else first
    normal, damping, steps = factors.normal(here, whitening, criterion), FIRST_DAMPING, 1
    unit, rested = _size(normal), False
    while steps < max_steps and damping < MOST_DAMPING and np.isfinite(normal.cost):
        step, decrement = _step(normal, damping, unit)
        if not np.isfinite(decrement):
            break
        # The steps over the cone take this one, and renew the weights as they go.
        if rested and damping <= FIRST_DAMPING and decrement < near * normal.cost / count:
            break
        trial_factors = factors.stepped(step[: factors.entries])
        trial_nuisance = moved(nuisance, step[factors.entries :])
        if not trial_factors.finite:
            damping = max(4 * damping, 1e-4)
            continue
        trial = criterion.evaluate(trial_factors.blocks, trial_nuisance)
        steps += 1
        trial_normal = trial_factors.normal(trial, whitening, criterion)
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
        done, rested = done and damping <= FIRST_DAMPING, settling
        if settling:
            # What a wrong model leaves is no noise: its correlations would lead astray, its sizes do not.
            renewed = here.whitening(False)
            done = done and np.max(np.abs(np.diag(renewed) / np.diag(whitening) - 1)) < 0.1
            whitening, normal = renewed, factors.normal(here, renewed, criterion)
        if done or here.exact:
            break
        damping = less * damping if damping > 1e-7 else 0.0
    return _end(factors.blocks, nuisance, here, criterion, steps)


def at_start(start: Iterate, criterion: Criterion, first: Products) -> CholeskyEnd:
    """The blocks of the start as they are, also where no factor of theirs moves, with the best first states and
    offsets; an end beside those of `cholesky_steps`.

    **Arguments:** `start`; `criterion`; `first`: the products there.
    """
    blocks = [np.asarray(block) for block in start.blocks]
    nuisance = moved(start.nuisance, _nuisance_step(blocks, first, start.whitening))
    return _end(blocks, nuisance, criterion.evaluate(blocks, nuisance), criterion, 1)


def start_cost(start: Iterate, criterion: Criterion, first: Products) -> float:
    """`at_start(…).cost`, without another evaluation where rounding allows it."""
    if not first.finite:
        return np.inf
    there = _with_best_nuisance(start, first)
    before, after = (np.diagonal(products.table[:, :, -1, -1]) for products in (first, there))
    if np.any(after < CANCELLED * before):
        return at_start(start, criterion, first).cost
    return likelihood_cost(there, criterion)


def start_deviation(start: Iterate, first: Products) -> Float[np.ndarray, " outputs"]:
    """Mean square error per output with the best first states and offsets, infinite after an overflow."""
    if not first.finite:
        return np.full(len(first.counts), np.inf)
    return np.diagonal(_with_best_nuisance(start, first).table[:, :, -1, -1]) / np.asarray(first.counts)


def _with_best_nuisance(start: Iterate, first: Products) -> Products:
    """Products where first states and offsets, which are linear in the errors, are best for the start's weights."""
    change = np.eye(first.table.shape[-1])
    step = _nuisance_step([np.asarray(block) for block in start.blocks], first, start.whitening)
    change[-1 - len(step) : -1, -1] = step
    return Products(np.einsum("ca,opcd,db->opab", change, first.table, change), first.counts)


def _nuisance_step(blocks, first: Products, whitening: np.ndarray) -> np.ndarray:
    """The step to the best first states and offsets, none where the start is not finite."""
    entries = sum(len(block) * (len(block) + 1) // 2 for block in blocks)
    normal = first.normal(whitening)
    if not np.isfinite(normal.cost):
        return np.zeros(len(normal.gradient) - entries)
    return -pseudo_inverse(normal.information[entries:, entries:]) @ normal.gradient[entries:]


def likelihood_cost(products: Products, criterion: Criterion) -> float:
    """Minus twice the logarithm of the likelihood of the errors, their covariance concentrated out; ∞ after an
    overflow."""
    whitening = products.whitening(criterion.correlated)
    cost = float(-2 * np.sum(products.counts * np.log(np.diag(whitening))))
    return cost if np.isfinite(cost) else np.inf


def _end(blocks, nuisance, here: Products, criterion: Criterion, steps: int) -> CholeskyEnd:
    """The end at these blocks: weights and likelihood from the errors that are left there."""
    whitening = here.whitening(criterion.correlated)
    return CholeskyEnd(Iterate(blocks, nuisance, whitening), here, likelihood_cost(here, criterion), steps)


def _size(normal: Normal) -> np.ndarray:
    """Norms of the sensitivities."""
    size = np.sqrt(np.maximum(np.diag(normal.information), 0.0))
    return np.where(size > 1e-12 * np.max(size), size, max(np.max(size), 1e-300))


def _step(normal: Normal, damping: float, unit: np.ndarray) -> tuple[np.ndarray, float]:
    """The damped step, and the decrement that it promises; `unit`: what damps all parameters alike."""
    H, g = normal.information + np.diag(damping * unit**2), normal.gradient
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    with np.errstate(over="ignore"):
        # Where rounding has left nothing of two entries of the diagonal, out of range, and refused below.
        H = H / scale[:, None] / scale[None, :] + 1e-13 * np.eye(len(scale))
    if not np.all(np.isfinite(H)) or not np.all(np.isfinite(g)):
        return g, np.nan
    try:
        step = -np.linalg.solve(H, g / scale)
    except np.linalg.LinAlgError:
        return g, np.nan
    return step / scale, float(-step @ (g / scale))
