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
from ..numerics.stored_programs import stored
from .cholesky import NEAR, NEAR_EDGE, at_start, cholesky_steps, pack, unpack
from .conic import conic_steps
from .normal import FLOOR, Criterion, Iterate, Normal
from .prediction import Batch, Nuisance, Setting
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


@stored
def levenberg_marquardt(
    begin: Iterate, criterion: Criterion, max_steps: int = 60
) -> tuple[list[Array], Nuisance, Array]:
    """One optimistix Levenberg-Marquardt run with given weights, the noise parameters among what it moves.

    Parameters are taken in units of their first Jacobian column, so that the damping treats all alike; the
    step solves the normal equations, which for a tall Jacobian costs a third of its QR.

    **Arguments:** `begin`, its blocks positive definite; `criterion`; `max_steps`.

    **Returns:** blocks, nuisance, steps taken. Traceable and vmappable.
    """
    logarithmic = criterion.logarithmic
    scales = [jnp.trace(block) / block.shape[0] for block in begin.blocks]
    start, unravel = ravel_pytree((pack(begin.blocks, scales, logarithmic), begin.nuisance))

    def errors(theta):
        vectors, nuisance = unravel(theta)
        blocks = unpack(vectors, scales, logarithmic, criterion.sizes)
        return criterion.errors(Iterate(blocks, nuisance, begin.whitening))[0].ravel()

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
    return unpack(vectors, scales, logarithmic, criterion.sizes), found, solution.stats["num_steps"]


def on_edge(blocks: list[Array]) -> bool:
    """Whether any block is closer to singular than the first lift."""
    values = [np.linalg.eigvalsh(np.asarray(block)) for block in blocks]
    return any(value[0] < LIFTS[0] * value[-1] for value in values)


def begin_nuisance(batch: Batch, setting: Setting, *, offset: bool, innovations: bool) -> Nuisance:
    """Nuisance parameters to start from: at rest, no offset, little force noise."""
    records, _, outputs = batch.y.shape
    states = 2 * setting.dofs
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
    criterion = Criterion(batch, setting, structure)
    nuisance = begin_nuisance(batch, setting, offset=offset, innovations=False)
    deviation = np.ones(outputs) if deviation is None else np.asarray(deviation)
    if not np.all(np.isfinite(deviation)):
        deviation = np.ones(outputs)
    whitening = np.diag(1 / np.sqrt(np.maximum(deviation, FLOOR**2)))

    def begun(lift):
        return Iterate(structure.blocks(*start, lift=lift), nuisance, whitening)

    here, taken, first = begun(0.0), 0, None
    if fixed is None or not np.any(fixed):
        edge = on_edge(here.blocks)
        # At the edge the start itself may be better than what Cholesky factors make of it.
        ends = [at_start(here, criterion)] if edge else []
        for lift in LIFTS if edge else LIFTS[:1]:
            ends.append(cholesky_steps(begun(lift), criterion, near=NEAR_EDGE if edge else NEAR))
        taken = sum(end.steps for end in ends)
        best = min(ends, key=lambda end: end.cost)
        here, first = best.at, best.products
        if innovations:
            noisy = begin_nuisance(batch, setting, offset=offset, innovations=True)
            nuisance = Nuisance(here.nuisance.x0, here.nuisance.offset, noisy.noise)
            here = Iterate(here.blocks, nuisance, here.whitening)
            blocks, nuisance, steps = levenberg_marquardt(here, criterion)
            here, taken, first = Iterate(blocks, nuisance, here.whitening), taken + int(steps), None

    end = conic_steps(here, criterion, first=first, fixed=fixed)
    if not np.isfinite(end.normal.cost):
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement")
    M, D, K = criterion.matrices(end.at.blocks)
    count = criterion.count - end.normal.information.shape[0]
    return Refinement(
        M,
        D,
        K,
        end.at.blocks,
        end.at.nuisance,
        end.at.whitening,
        end.normal,
        end.normal.cost / max(count, 1.0),
        (taken, end.steps),
        end.decrement,
        RESULTS.successful if end.converged else RESULTS.refinement_diverged,
    )
