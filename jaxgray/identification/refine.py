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

from ..numerics.outcomes import RESULTS, ComputationError
from .cholesky import NEAR, NEAR_EDGE, at_start, cholesky_steps, pack, unpack
from .conic import conic_steps
from .normal import FLOOR, Normal, products
from .prediction import Batch, Nuisance, Setting, prediction_errors
from .structure import Structure

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


def begin_nuisance(batch: Batch, setting: Setting, *, offset: bool, innovations: bool) -> Nuisance:
    """Nuisance parameters to start from: at rest, no offset, little force noise."""
    records, _, outputs = batch.y.shape
    states = 2 * setting_dofs(setting)
    inputs = batch.u.shape[2]
    noise = np.concatenate([np.full(inputs, INITIAL_FORCE_NOISE), np.zeros(outputs - 1)])
    return Nuisance(
        np.zeros((records, states)),
        np.zeros((records, outputs)) if offset else None,
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
) -> Refinement:
    """Refine M, D, K by prediction error, maximum likelihood over the outputs.

    **Arguments:** `start`: scaled M, D, K; `batch`; `setting`; `structure`: what is free, default all; `offset`:
    estimate an output offset of every record; `innovations`: noise enters at the forces too; `fixed`: entries of the
    stacked block vectors that keep their start value; `deviation`: mean square residual of the start per output, to
    weigh with at first.

    **Returns:** a `Refinement`.

    **Raises:** `ComputationError` when no finite step was possible.

    **Reference:** Ljung, *System Identification*, §7.4 (determinant criterion) and §10.2.
    """
    structure = Structure() if structure is None else structure
    start = tuple(np.asarray(X) for X in start)
    outputs = batch.y.shape[2]
    kept = np.asarray(batch.kept)
    correlated = bool(np.all(np.sum(kept, axis=2) % outputs == 0))
    owners = structure.owners(setting_dofs(setting))
    nuisance = begin_nuisance(batch, setting, offset=offset, innovations=False)
    deviation = np.ones(outputs) if deviation is None else np.asarray(deviation)
    if not np.all(np.isfinite(deviation)):
        deviation = np.ones(outputs)
    whitening = np.diag(1 / np.sqrt(np.maximum(deviation, FLOOR**2)))

    def evaluate(blocks, nuisance):
        return jax.device_get(products(blocks, nuisance, batch, setting, structure))

    taken, first, samples = 0, None, float(np.sum(kept))
    if fixed is not None and np.any(fixed):
        blocks = structure.blocks(*start, lift=0.0)
    else:
        begun = structure.blocks(*start, lift=0.0)
        edge = on_edge(begun)
        # At the edge the start itself may be better than what Cholesky factors make of it.
        ends = [at_start(begun, nuisance, whitening, evaluate, correlated=correlated)] if edge else []
        for lift in LIFTS if edge else LIFTS[:1]:
            lifted = structure.blocks(*start, lift=lift)
            end = cholesky_steps(
                lifted,
                nuisance,
                whitening,
                evaluate,
                owners=owners,
                correlated=correlated,
                count=samples,
                near=NEAR_EDGE if edge else NEAR,
            )
            ends.append(end)
        taken = sum(end.steps for end in ends)
        best = min(ends, key=lambda end: end.cost)
        blocks, nuisance, whitening, first = best.blocks, best.nuisance, best.whitening, best.products
        if innovations:
            noisy = begin_nuisance(batch, setting, offset=offset, innovations=True)
            nuisance = Nuisance(nuisance.x0, nuisance.offset, noisy.noise)
            blocks, nuisance, steps = levenberg_marquardt(blocks, nuisance, whitening, batch, setting, structure)
            taken, first = taken + int(steps), None

    end = conic_steps(
        blocks,
        nuisance,
        whitening,
        evaluate,
        owners=owners,
        correlated=correlated,
        count=samples,
        first=first,
        fixed=fixed,
    )
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
        end.normal.cost / max(count, 1.0),
        (taken, end.steps),
        end.decrement,
        RESULTS.successful if end.converged else RESULTS.refinement_diverged,
    )
