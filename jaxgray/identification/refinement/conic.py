"""Gauss-Newton in the entries of M, D, K with the cone as a constraint.

At the edge of the cone a Cholesky factor does not feel the gradient that would lead it off again, and a
singular truth is approached only at the speed of a square root. In the entries themselves every step is a
small semidefinite least squares, solved exactly: it leaves a wrong edge in one step, reaches a true one in a
few, and its optimality is that of the constrained problem, dual included.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ...numerics.matrices.bounded import bounded
from ...numerics.matrices.positive import ClarabelSolver, PositiveLeastSquares, inside_cone
from ...numerics.outcomes import RESULTS, ComputationError
from .normal_equations import Criterion, Iterate, Normal, Products, join, moved, part

DECREMENT = 1e-5
"""Stop when a step would change the sum of squares by less than this, in units of the noise variance."""

NOTHING = 1e-7
"""The same for a step that is not even taken: it would move no parameter by a thousandth of its standard error."""


NO_SIZE = 1e-6
"""Standard errors below which a block counts as having no size of its own."""

LARGEST = 1e200
"""Variance, but for that of the noise, above which nothing is told apart: its products are still numbers."""

SHARED = 0.01
"""Squared part of a variable in null directions from which these move it."""


class ConicEnd(eqx.Module):
    """Where the iteration ended; `products` and `normal` are those of that place."""

    at: Iterate
    products: Products
    normal: Normal
    steps: int
    decrement: float
    converged: bool


def pseudo_inverse(H: np.ndarray, threshold: float = 1e-13) -> np.ndarray:
    """Inverse of a positive semidefinite matrix, scaled to unit diagonal, without its null directions; entries up to
    `LARGEST`, for what moves nothing."""
    scale, values, vectors, kept = _directions(H, threshold)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    scale = np.maximum(scale, LARGEST**-0.5)
    return inverse / scale[:, None] / scale[None, :]


def undetermined(H: np.ndarray, threshold: float = 1e-13) -> np.ndarray:
    """Variables that a null direction moves, one that `pseudo_inverse` leaves out: nothing says where they are."""
    _, _, vectors, kept = _directions(H, threshold)
    return np.sum(vectors[:, ~kept] ** 2, axis=1) > SHARED


def _directions(H: np.ndarray, threshold: float):
    """Scale to unit diagonal, eigenvalues and eigenvectors of the scaled matrix, and which are no null directions."""
    scale = np.sqrt(np.maximum(np.diag(H), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale[None, :])
    return scale, values, vectors, values > threshold * max(np.max(values, initial=0.0), 1e-300) * len(values)


def sizes_of(curvature: np.ndarray) -> np.ndarray:
    """Square roots of what every variable is divided by: of its curvature, or of one that rounding would swallow beside
    the largest."""
    least = max(np.finfo(float).eps ** 2 * float(np.max(curvature, initial=0.0)), np.finfo(float).tiny)
    return np.sqrt(np.maximum(curvature, least))


def step_inside(
    solver: ClarabelSolver,
    quadratic: Float[np.ndarray, "variables variables"],
    slope: Float[np.ndarray, " variables"],
    here: Float[np.ndarray, " variables"],
    floors: Float[np.ndarray, " blocks"],
    sizes: tuple[int, ...],
    held: Bool[np.ndarray, " variables"] | None,
) -> Float[np.ndarray, " variables"] | None:
    """The step dz that minimises dzᵀ Q dz + 2 dzᵀ s with every block of `here` + dz above its floor.

    **Arguments:** `solver` of semidefinite least squares; `quadratic` Q; `slope` s; `here`; `floors`: least eigenvalue
    of each block; `sizes` of the blocks; `held`: entries that do not move, None for none.

    **Returns:** the step, by linear equations where no block but single numbers ends at its floor; None where none was
    found.
    """
    if not bounded(quadratic, slope):
        return None
    free = np.ones(len(here), bool) if held is None else ~held
    if free.any() and not np.max(np.diag(quadratic)[free]) > 0.0:
        # All rounding: what other parameters take away is as large as what there is.
        return None
    plain = _at_bounds(quadratic, slope, here, floors, sizes, free)
    if plain is not None:
        return plain
    problem = PositiveLeastSquares(
        quadratic, slope - quadratic @ here, floors, sizes, held if held is not None and held.any() else None, here
    )
    try:
        return np.asarray(solver(problem)) - here
    except ComputationError:
        return None


def _at_bounds(quadratic, slope, here, floors, sizes, free) -> np.ndarray | None:
    """The step with single numbers at their floors where they would fall below; None unless it is the optimum."""
    if np.any(np.diag(quadratic)[free] < 0.0):
        return None
    scale = sizes_of(np.diag(quadratic))
    scaled = quadratic / scale[:, None] / scale[None, :]
    ends = np.cumsum([n * (n + 1) // 2 for n in sizes]) - 1
    # Where single numbers stand, their floors, and by how much each may fall.
    numbers = np.array(sizes) == 1
    single, least = ends[numbers], floors[numbers]
    room = here[single] - least
    stopped = np.zeros(len(here), bool)
    for _ in range(len(single) + 1):
        step = np.zeros(len(here))
        step[single] = np.where(stopped[single], -room, 0.0) * scale[single]
        moving = free & ~stopped
        try:
            right = (slope / scale + scaled @ step)[moving]
            step[moving] = -np.linalg.solve(scaled[np.ix_(moving, moving)], right)
        except np.linalg.LinAlgError:
            return None
        if not np.all(np.isfinite(step)):
            return None
        below = free[single] & ~stopped[single] & (step[single] / scale[single] < -room)
        if not below.any():
            break
        stopped[single[below]] = True
    # What is stopped must press against its floor.
    pressed = np.all((slope / scale + scaled @ step)[stopped] >= 0.0)
    end = here + step / scale
    end[single] = np.where(stopped[single], least, end[single])
    return end - here if pressed and inside_cone(end, sizes, floors) else None


def conic_steps(
    start: Iterate,
    criterion: Criterion,
    *,
    first: Products | None = None,
    fixed: Bool[np.ndarray, " entries"] | None = None,
    max_steps: int = 60,
) -> ConicEnd:
    """Damped Gauss-Newton steps over the cone until none is worth taking.

    **Arguments:** `start`; `criterion`; `first`: the products at the start where they are known; `fixed`: entries of
    the joined block vectors that do not move; `max_steps`.

    **Returns:** a `ConicEnd`; `decrement` is in units of the noise variance.

    **Raises:** `ComputationError` when the start is not finite.
    """
    blocks, nuisance = [np.asarray(block) for block in start.blocks], start.nuisance
    whitening = np.eye(len(start.whitening)) if nuisance.noise is not None else np.asarray(start.whitening)
    count, correlated = criterion.count, criterion.correlated
    sizes = criterion.sizes
    entries = sum(n * (n + 1) // 2 for n in sizes)
    held = None if fixed is None else np.asarray(fixed, bool)
    z = join(blocks)
    floors = np.array(criterion.structure.floors(criterion.setting.dofs))
    solver = ClarabelSolver()
    damping, decrement, converged, settled = 0.0, np.inf, False, False
    found = criterion.evaluate(blocks, nuisance) if first is None else first
    normal = criterion.normal(found, whitening, blocks)
    if not np.all(np.isfinite(normal.information)):
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement", detail="its start is not finite")
    unit = block_units(blocks, np.diag(normal.information))
    steps = 0
    while steps < max_steps and damping < 1e8 and not converged:
        steps += 1
        H, g = normal.information, normal.gradient
        inner = pseudo_inverse(H[entries:, entries:])
        across = H[:entries, entries:] @ inner
        # In units of each block's size, so that the cone problem is well scaled.
        reduced = (H[:entries, :entries] - across @ H[entries:, :entries]) * unit[:, None] * unit[None, :]
        slope = (g[:entries] - across @ g[entries:]) * unit
        diagonal = np.maximum(np.diag(reduced), 1e-14 * np.max(np.diag(reduced)))
        reduced = (reduced + reduced.T) / 2 + np.diag((damping + 1e-14) * diagonal)
        dz = step_inside(solver, reduced, slope, z / unit, floors, sizes, held)
        if dz is None:
            damping = max(10 * damping, 1e-3)
            continue
        dn = -inner @ (g[entries:] + H[entries:, :entries] @ (dz * unit))
        if not np.all(np.isfinite(dz)) or not np.all(np.isfinite(dn)):
            damping = max(10 * damping, 1e-3)
            continue
        variance = max(float(normal.cost) / count, 1e-300)
        decrement = float(-(2 * slope @ dz + dz @ reduced @ dz) + g[entries:] @ inner @ g[entries:]) / variance
        if settled and damping == 0.0 and abs(decrement) < NOTHING:
            converged = True
            break
        trial_nuisance = moved(nuisance, dn)
        trial_blocks = part(z + dz * unit, sizes)
        trial = criterion.evaluate(trial_blocks, trial_nuisance)
        trial_normal = criterion.normal(trial, whitening, trial_blocks)
        allowed = float(normal.cost) + DECREMENT * variance
        if not (np.isfinite(float(trial_normal.cost)) and float(trial_normal.cost) <= allowed):
            # Rounding is all that is left where the step itself promises next to nothing.
            converged = abs(decrement) < 100 * DECREMENT
            damping = max(10 * damping, 1e-4)
            continue
        z, nuisance, blocks, found, normal = z + dz * unit, trial_nuisance, trial_blocks, trial, trial_normal
        damping = damping / 10 if damping > 1e-7 else 0.0
        change = 0.0
        if nuisance.noise is None:
            renewed = trial.whitening(correlated)
            ratio = np.linalg.solve(whitening.T, renewed.T).T
            change = float(np.max(np.abs(ratio - np.eye(len(ratio)))))
            if change > 1e-6:
                whitening, normal = renewed, criterion.normal(trial, renewed, blocks)
        settled = change < 1e-3
        converged = (damping == 0.0 and decrement < DECREMENT and settled) or trial.exact
    return ConicEnd(Iterate(blocks, nuisance, whitening), found, normal, steps, decrement, converged)


def block_units(blocks: list[np.ndarray], curvature: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " entries"]:
    """Units of the entries in which a step over the cone is well scaled: the mean eigenvalue of the block, or what one
    standard deviation of the noise moves it by where it has none (a spring that is not there).

    **Arguments:** `blocks`; `curvature`: diagonal of the information, of the entries first.
    """
    units, at = [], 0
    for block in blocks:
        n = len(block)
        count = n * (n + 1) // 2
        size, known = np.trace(block) / n, np.max(curvature[at : at + count])
        spread = 1 / np.sqrt(known) if known > 0 else 1.0
        units.append(np.full(count, size if size > NO_SIZE * spread else spread))
        at += count
    return np.concatenate(units)
