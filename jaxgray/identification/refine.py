"""Prediction-error refinement: Levenberg-Marquardt on Cholesky factors, then an honest end at the edge.

The Cholesky factors of M, D and K make every step physical, but they stand still at the edge of the cone,
where a model with a rigid-body mode or without damping lives. So the optimiser's answer is never the last
word: `conic` continues in the entries of the matrices, with the cone as a constraint.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..numerics.linear_algebra import triangle
from ..numerics.outcomes import RESULTS, ComputationError
from .conic import Normal, conic_steps, normal_equations
from .prediction import Batch, Nuisance, Setting, free_run, prediction_errors
from .structure import Structure

FLOOR = 1e-12
"""Smallest residual, relative to the outputs, that the weights resolve: below it is rounding."""

LIFTS = (1e-3, 1e-1)
"""How far a start is lifted off the edge, relative to its largest eigenvalue; the second only where it lies there:
a direction that starts hundreds of times too soft may never find its frequency again."""

_BOLDNESS = 30.0
"""The optimiser's first damping is 1: with Jacobian columns of this norm it is a thousandth of the curvature."""

INITIAL_FORCE_NOISE = 0.05
"""Start of the force noise relative to the output noise in the innovations form, both scaled."""


class Refinement(eqx.Module):
    """A refined model, in scaled coordinates, and its evidence.

    `mass`, `damping`, `stiffness`; `blocks`: the semidefinite blocks they are assembled from; `nuisance`;
    `whitening` of the output noise; `normal`: Gauss-Newton information in blocks and nuisance; `variance`: mean
    square of the whitened residual; `steps`: of the optimiser and of the conic iteration; `decrement`: what
    one more step would take off the sum of squares, in units of the noise variance; `result`.
    """

    mass: Float[Array, "dofs dofs"]
    damping: Float[Array, "dofs dofs"]
    stiffness: Float[Array, "dofs dofs"]
    blocks: list[Array]
    nuisance: Nuisance
    whitening: Float[Array, "outputs outputs"]
    normal: Normal
    variance: Float[Array, ""]
    steps: tuple[int, int]
    decrement: float
    result: RESULTS


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


@eqx.filter_jit
def levenberg_marquardt(
    blocks: list[Array],
    nuisance: Nuisance,
    whitening: Float[Array, "outputs outputs"],
    batch: Batch,
    setting: Setting,
    structure: Structure,
    max_steps: int = 60,
) -> tuple[list[Array], Nuisance, Array]:
    """One optimistix Levenberg-Marquardt run with given weights.

    Parameters are taken in units of their first Jacobian column, so that the damping treats all alike; the
    step solves the normal equations, which for a tall Jacobian costs a third of its QR.

    **Arguments:** `blocks` (positive definite) and `nuisance` to start from; `whitening`; `batch`; `setting`;
    `structure`; `max_steps`.

    **Returns:** blocks, nuisance, steps taken. Traceable and vmappable.
    """
    dofs = setting_dofs(setting)
    sizes = structure.sizes(dofs)
    logarithmic = tuple(owner == "mass" for owner in structure.owners(dofs))
    scales = [jnp.trace(block) / block.shape[0] for block in blocks]
    start, unravel = ravel_pytree((pack(blocks, scales, logarithmic), nuisance))

    def errors(theta):
        vectors, here = unravel(theta)
        matrices = structure.matrices(unpack(vectors, scales, logarithmic, sizes), dofs)
        return prediction_errors(setting.system(*matrices), batch, here, whitening).ravel()

    size = jnp.linalg.norm(jax.jacfwd(errors)(start), axis=0)
    size = jnp.where(size > 1e-12 * jnp.max(size), size, jnp.max(size)) / _BOLDNESS

    def scaled_errors(delta, _):
        return errors(start + delta / size)

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-2 / _BOLDNESS, linear_solver=lx.Normal(lx.Cholesky()))
    solution = optx.least_squares(
        scaled_errors, solver, jnp.zeros_like(start), max_steps=max_steps, throw=False, options={"jac": "fwd"}
    )
    value = jnp.where(jnp.all(jnp.isfinite(solution.value)), solution.value, 0.0)
    vectors, found = unravel(start + value / size)
    return unpack(vectors, scales, logarithmic, sizes), found, solution.stats["num_steps"]


def on_edge(blocks: list[Array]) -> bool:
    """Whether any block is closer to singular than the first lift."""
    values = [np.linalg.eigvalsh(np.asarray(block)) for block in blocks]
    return any(value[0] < LIFTS[0] * value[-1] for value in values)


def setting_dofs(setting: Setting) -> int:
    """Number of coordinates."""
    return len(setting.measured)


@eqx.filter_jit
def residual_whitening(
    blocks: list[Array],
    nuisance: Nuisance,
    batch: Batch,
    setting: Setting,
    structure: Structure,
    correlated: bool,
) -> Float[Array, "outputs outputs"]:
    """Lower triangular W with W Σ Wᵀ = I for the covariance Σ of the free-run residual.

    Reweighting with it until it rests minimises the determinant of Σ, the maximum likelihood for Gaussian
    output noise. With missing samples the outputs are weighted one by one.
    """
    system = setting.system(*structure.matrices(blocks, setting_dofs(setting)))
    quiet = eqx.tree_at(lambda n: n.noise, nuisance, None, is_leaf=lambda x: x is None)
    residual = (batch.y - free_run(system, batch, quiet)) * batch.kept
    flat = residual.reshape(-1, residual.shape[2])
    count = jnp.maximum(jnp.sum(batch.kept, axis=(0, 1)), 1.0)
    covariance = flat.T @ flat / jnp.sqrt(count[:, None] * count[None, :])
    if not correlated:
        covariance = jnp.diag(jnp.diag(covariance))
    covariance = covariance + FLOOR**2 * jnp.eye(covariance.shape[0])
    lower = jnp.linalg.cholesky(covariance)
    return jax.scipy.linalg.solve_triangular(lower, jnp.eye(lower.shape[0]), lower=True)


def begin_nuisance(batch: Batch, setting: Setting, *, offset: bool, innovations: bool) -> Nuisance:
    """Nuisance parameters to start from: at rest, no offset, little force noise."""
    records, _, outputs = batch.y.shape
    states = 2 * setting_dofs(setting)
    inputs = batch.u.shape[2]
    noise = jnp.concatenate([jnp.full(inputs, INITIAL_FORCE_NOISE), jnp.zeros(outputs - 1)])
    return Nuisance(
        jnp.zeros((records, states)),
        jnp.zeros((records, outputs)) if offset else None,
        noise if innovations else None,
    )


def refine(
    start: tuple[Array, Array, Array],
    batch: Batch,
    setting: Setting,
    *,
    structure: Structure | None = None,
    offset: bool = True,
    innovations: bool = False,
    fixed: Bool[np.ndarray, " entries"] | None = None,
    deviation: Float[Array, " outputs"] | None = None,
    rounds: int = 2,
) -> Refinement:
    """Refine M, D, K by prediction error, maximum likelihood over the outputs.

    **Arguments:** `start`: scaled M, D, K; `batch`; `setting`; `structure`: what is free, default all; `offset`:
    estimate an output offset of every record; `innovations`: noise enters at the forces too; `fixed`: entries of the
    stacked block vectors that keep their start value; `deviation`: mean square residual of the start per output, to
    weigh with at first; `rounds`: how often the weights are renewed before the conic iteration (which renews
    them at every step).

    **Returns:** a `Refinement`.

    **Raises:** `ComputationError` when no finite step was possible.

    **Reference:** Ljung, *System Identification*, §7.4 (determinant criterion) and §10.2.
    """
    structure = Structure() if structure is None else structure
    outputs = batch.y.shape[2]
    correlated = bool(jnp.all((jnp.sum(batch.kept, axis=2) % outputs) == 0))
    nuisance = begin_nuisance(batch, setting, offset=offset, innovations=False)
    if deviation is None or not bool(jnp.all(jnp.isfinite(deviation))):
        deviation = jnp.ones(outputs)
    whitening = jnp.diag(1 / jnp.sqrt(jnp.maximum(deviation, FLOOR**2)))
    free_start = fixed is None or not np.any(fixed)
    taken = 0
    if not free_start:
        blocks = structure.blocks(*start, lift=0.0)
    else:
        best = None
        for lift in LIFTS if on_edge(structure.blocks(*start, lift=0.0)) else LIFTS[:1]:
            here, around, W = structure.blocks(*start, lift=lift), nuisance, whitening
            for _ in range(rounds):
                here, around, steps = levenberg_marquardt(here, around, W, batch, setting, structure)
                W = residual_whitening(here, around, batch, setting, structure, correlated)
                taken += int(steps)
            likelihood = float(jnp.sum(jnp.log(jnp.diag(W))))
            if np.isfinite(likelihood) and (best is None or likelihood > best[0]):
                best = likelihood, here, around, W
        if best is None:
            best = -np.inf, structure.blocks(*start, lift=LIFTS[-1]), nuisance, whitening
        _, blocks, nuisance, whitening = best
        if innovations:
            noisy = begin_nuisance(batch, setting, offset=offset, innovations=True)
            nuisance = eqx.tree_at(lambda n: n.noise, nuisance, noisy.noise, is_leaf=lambda x: x is None)
            blocks, nuisance, steps = levenberg_marquardt(blocks, nuisance, whitening, batch, setting, structure)
            taken += int(steps)

    def reweigh(blocks, nuisance):
        return residual_whitening(blocks, nuisance, batch, setting, structure, correlated)

    def equations(blocks, nuisance, whitening):
        return normal_equations(blocks, nuisance, whitening, batch, setting, structure)

    samples = float(jnp.sum(batch.kept))
    owners = structure.owners(setting_dofs(setting))
    end = conic_steps(blocks, nuisance, whitening, equations, reweigh, owners=owners, count=samples, fixed=fixed)
    if not np.isfinite(end.normal.cost):
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement")
    M, D, K = structure.matrices(end.blocks, setting_dofs(setting))
    count = samples - end.normal.information.shape[0]
    return Refinement(
        M,
        D,
        K,
        end.blocks,
        end.nuisance,
        end.whitening,
        end.normal,
        jnp.asarray(end.normal.cost / max(count, 1.0)),
        (taken, end.steps),
        end.decrement,
        RESULTS.successful if end.converged else RESULTS.refinement_diverged,
    )
