"""Gauss-Newton in the entries of M, D, K with the cone as a constraint.

At the edge of the cone a Cholesky factor does not feel the gradient that would lead it off again, and a
singular truth is approached only at the speed of a square root. In the entries themselves every step is a
small semidefinite least squares, solved exactly: it leaves a wrong edge in one step, reaches a true one in a
few, and its optimality is that of the constrained problem, dual included.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..numerics.linear_algebra import from_symmetric_vector, symmetric_vector
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.positive import ClarabelSolver, PositiveLeastSquares
from .prediction import Batch, Nuisance, Setting, prediction_errors
from .structure import Structure

MASS_FLOOR = 1e-9
"""Smallest eigenvalue of a mass block, relative to its mean one: the model needs an inverse."""

DECREMENT = 1e-5
"""Stop when a step would change the sum of squares by less than this, in units of the noise variance."""


class Normal(eqx.Module):
    """Normal equations at a point, in the scaled block vectors followed by the nuisance parameters.

    `cost`: sum of squared whitened errors; `gradient` = Jᵀe; `information` = JᵀJ.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " parameters"]
    information: Float[Array, "parameters parameters"]


class ConicEnd(eqx.Module):
    """Where the iteration ended."""

    blocks: list[Array]
    nuisance: Nuisance
    whitening: Float[Array, "outputs outputs"]
    normal: Normal
    steps: int
    decrement: float
    converged: bool


def join(blocks: list[Array]) -> Float[Array, " entries"]:
    """Blocks as one vector of isometric triangle vectors."""
    return jnp.concatenate([symmetric_vector(block) for block in blocks])


def part(vector: Float[Array, " entries"], sizes: tuple[int, ...]) -> list[Array]:
    """Inverse of `join`."""
    ends = np.cumsum([n * (n + 1) // 2 for n in sizes])
    return [from_symmetric_vector(piece) for piece in jnp.split(vector, ends[:-1])]


@eqx.filter_jit
def sensitivities(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[Array, "outputs outputs"],
    batch: Batch,
    setting: Setting,
    structure: Structure,
) -> tuple[Float[Array, "records samples outputs"], Float[Array, "records samples outputs parameters"]]:
    """Whitened prediction errors, and their Jacobian by the entries of the blocks, first states and offsets.

    The noise parameters stay as they are: their information is, to first order, apart from that of the model.
    """
    sizes = tuple(block.shape[0] for block in blocks)
    dofs = len(setting.measured)
    start, unravel = ravel_pytree((join(blocks), without_noise(nuisance)))

    def errors(theta):
        vector, here = unravel(theta)
        here = Nuisance(here.x0, here.offset, nuisance.noise)
        system = setting.system(*structure.matrices(part(vector, sizes), dofs))
        e = prediction_errors(system, batch, here, whitening)
        return e, e

    J, e = jax.jacfwd(errors, has_aux=True)(start)
    return e, J


@jax.jit
def _products(e, J):
    e, J = e.ravel(), J.reshape(e.size, -1)
    return Normal(e @ e, J.T @ e, J.T @ J)


def normal_equations(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[Array, "outputs outputs"],
    batch: Batch,
    setting: Setting,
    structure: Structure,
) -> Normal:
    """Cost, gradient and Gauss-Newton information of `sensitivities`."""
    return _products(*sensitivities(blocks, nuisance, whitening, batch, setting, structure))


def without_noise(nuisance: Nuisance) -> Nuisance:
    """First states and offsets alone."""
    return Nuisance(nuisance.x0, nuisance.offset, None)


def pseudo_inverse(H: np.ndarray, threshold: float = 1e-13) -> np.ndarray:
    """Inverse of a positive semidefinite matrix, scaled to unit diagonal, without its null directions."""
    scale = np.sqrt(np.maximum(np.diag(H), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale[None, :])
    kept = values > threshold * max(values[-1], 1e-300) * len(values)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return inverse / scale[:, None] / scale[None, :]


def conic_steps(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[Array, "outputs outputs"],
    equations: Callable[[list[Array], Nuisance, Array], Normal],
    reweigh: Callable[[list[Array], Nuisance], Array],
    *,
    owners: tuple[str, ...],
    count: float,
    fixed: Bool[np.ndarray, " entries"] | None = None,
    max_steps: int = 60,
) -> ConicEnd:
    """Damped Gauss-Newton steps over the cone until none is worth taking.

    **Arguments:** `blocks`, `nuisance`, `whitening` to start from; `equations`: normal equations at a point;
    `reweigh`: whitening for the residual at a point (ignored in the innovations form); `owners`: the matrix to
    which each block belongs; `count`: number of output samples; `fixed`: entries of the joined block vectors
    that do not move; `max_steps`.

    **Returns:** a `ConicEnd`; `decrement` is in units of the noise variance.
    """
    sizes = tuple(block.shape[0] for block in blocks)
    entries = sum(n * (n + 1) // 2 for n in sizes)
    held = None if fixed is None else jnp.asarray(fixed, bool)
    z = np.asarray(join(blocks))
    unit = np.concatenate([np.full(n * (n + 1) // 2, np.trace(b) / n) for n, b in zip(sizes, blocks)])
    floors = jnp.array([MASS_FLOOR if owner == "mass" else 0.0 for owner in owners])
    solver = ClarabelSolver()
    damping, decrement, converged = 0.0, np.inf, False
    normal = equations(blocks, nuisance, whitening)
    if not np.all(np.isfinite(np.asarray(normal.information))):
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement", detail="its start is not finite")
    steps = 0
    while steps < max_steps and damping < 1e8 and not converged:
        steps += 1
        H, g = np.asarray(normal.information), np.asarray(normal.gradient)
        inner = pseudo_inverse(H[entries:, entries:])
        across = H[:entries, entries:] @ inner
        # In units of each block's size, so that the cone problem is well scaled.
        reduced = (H[:entries, :entries] - across @ H[entries:, :entries]) * unit[:, None] * unit[None, :]
        slope = (g[:entries] - across @ g[entries:]) * unit
        diagonal = np.maximum(np.diag(reduced), 1e-14 * np.max(np.diag(reduced)))
        reduced = (reduced + reduced.T) / 2 + np.diag((damping + 1e-14) * diagonal)
        here = z / unit
        problem = PositiveLeastSquares(
            jnp.asarray(reduced), jnp.asarray(slope - reduced @ here), floors, sizes, held, jnp.asarray(here)
        )
        try:
            dz = np.asarray(solver(problem)) - here
        except ComputationError:
            damping = max(10 * damping, 1e-3)
            continue
        dn = -inner @ (g[entries:] + H[entries:, :entries] @ (dz * unit))
        if not np.all(np.isfinite(dz)) or not np.all(np.isfinite(dn)):
            damping = max(10 * damping, 1e-3)
            continue
        variance = max(float(normal.cost) / count, 1e-300)
        decrement = float(-(2 * slope @ dz + dz @ reduced @ dz) + g[entries:] @ inner @ g[entries:]) / variance
        flat, unravel = ravel_pytree(without_noise(nuisance))
        moved = unravel(flat + jnp.asarray(dn))
        trial_nuisance = Nuisance(moved.x0, moved.offset, nuisance.noise)
        trial_blocks = part(jnp.asarray(z + dz * unit), sizes)
        trial = equations(trial_blocks, trial_nuisance, whitening)
        allowed = float(normal.cost) + DECREMENT * variance
        if not (np.isfinite(float(trial.cost)) and float(trial.cost) <= allowed):
            # Rounding is all that is left where the step itself promises next to nothing.
            converged = decrement < 100 * DECREMENT
            damping = max(10 * damping, 1e-4)
            continue
        z, nuisance, blocks, normal = z + dz * unit, trial_nuisance, trial_blocks, trial
        damping = damping / 10 if damping > 1e-7 else 0.0
        change = 0.0
        if nuisance.noise is None:
            renewed = reweigh(blocks, nuisance)
            ratio = np.linalg.solve(np.asarray(whitening).T, np.asarray(renewed).T).T
            change = float(np.max(np.abs(ratio - np.eye(len(ratio)))))
            if change > 1e-6:
                whitening = renewed
                normal = equations(blocks, nuisance, whitening)
        converged = damping == 0.0 and decrement < DECREMENT and change < 1e-3
    return ConicEnd(blocks, nuisance, whitening, normal, steps, decrement, converged)
