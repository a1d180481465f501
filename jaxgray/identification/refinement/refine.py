"""Prediction-error refinement: Levenberg-Marquardt on Cholesky factors, then an honest end at the edge.

The Cholesky factors of M, D and K make every step physical, but they stand still at the edge of the cone,
where a model with a rigid-body mode or without damping lives. So the optimiser's answer is never the last
word: `conic` continues in the entries of the matrices, with the cone as a constraint. Where a start lies at the
edge, steps over the cone are tried before them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.stored_programs import stored
from ..setup.prediction import Batch, Nuisance, Setting
from ..setup.structure import Structure
from .cholesky import (
    NEAR,
    NEAR_EDGE,
    CholeskyEnd,
    at_start,
    cholesky_steps,
    likelihood_cost,
    pack,
    start_cost,
    start_deviation,
    unpack,
)
from .conic import ConicEnd, conic_steps
from .continuation import lengthened
from .innovations import information_beside_noise
from .normal_equations import FLOOR, Criterion, Iterate, Normal, Prior, Products

LIFTS = (1e-3, 1e-1)
"""How far a start is lifted off the edge, relative to its largest eigenvalue; the second only where it lies there:
a direction that starts hundreds of times too soft may never find its frequency again."""

_BOLDNESS = 30.0
"""The optimiser's first damping is 1: with Jacobian columns of this norm it is a thousandth of the curvature."""

STRAIGHT = 20
"""Most steps over the cone from beside its edge before those of Cholesky factors are taken, which need hundreds."""

POOR = 0.3
"""Share of any output's power left by the start from which it is brought nearer first."""

FAR = 0.5
"""Share of a start's squared error left by the best first states and offsets below which steps begin with these."""

SLACK = 1.0
"""Rise of −2 ln L over that of the start up to which a refinement counts as no worse: a prior, and rounding."""

INITIAL_FORCE_NOISE = 0.05
"""Start of the force noise relative to the output noise in the innovations form, both scaled."""


class StructurePrice(eqx.Module):
    """What a structure costs beside free M, D, K: `parameters` that it saves, and by how much −2 ln L rises."""

    parameters: int
    rise: float

    def delta_bic(self, count: float) -> float:
        """BIC with the structure minus without; negative where the structure is the better model.

        **Arguments:** `count` of output samples.
        """
        return self.rise - self.parameters * float(np.log(max(count, 2.0)))


class Refinement(eqx.Module):
    """A refined model, in scaled coordinates, and its evidence.

    `mass`, `damping`, `stiffness`; `blocks`: the semidefinite blocks they are assembled from; `nuisance`;
    `whitening` of the output noise; `normal`: Gauss-Newton information in blocks and nuisance; `variance`: mean
    square of the whitened residual; `steps`: of the optimiser and of the conic iteration; `decrement`: what
    one more step would take off the sum of squares, in units of the noise variance; `cost`: minus twice the logarithm
    of the likelihood, but for a constant; `result`; `prior` that `normal` holds; `price` of the structure;
    `noise_errors`: standard errors of the noise parameters in `nuisance`.
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
    cost: float
    result: RESULTS
    prior: Prior | None = None
    price: StructurePrice | None = None
    noise_errors: Float[Array, " ratios"] | None = None


@stored
def levenberg_marquardt(
    begin: Iterate, criterion: Criterion, max_steps: int = 60
) -> tuple[list[Array], Nuisance, Array]:
    """One optimistix Levenberg-Marquardt run with given weights, the noise parameters among what it moves.

    Parameters are taken in units of their first Jacobian column, so that the damping treats all alike, and errors in
    units of their first root mean square, so that the tolerances are those of any record; the step solves the normal
    equations, which for a tall Jacobian costs a third of its QR.

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

    J, first = jax.jacfwd(lambda theta: (errors(theta),) * 2, has_aux=True)(start)
    level = jnp.maximum(jnp.sqrt(jnp.sum(first**2) / jnp.sum(criterion.batch.kept)), FLOOR)
    size = jnp.linalg.norm(J, axis=0) / level
    size = jnp.where(size > 1e-12 * jnp.max(size), size, jnp.max(size)) / _BOLDNESS

    def scaled_errors(delta, _):
        return errors(start + delta / size) / level

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-2 / _BOLDNESS, linear_solver=lx.Normal(lx.Cholesky()))
    solution = optx.least_squares(
        scaled_errors, solver, jnp.zeros_like(start), max_steps=max_steps, throw=False, options={"jac": "fwd"}
    )
    value = jnp.where(jnp.all(jnp.isfinite(solution.value)), solution.value, 0.0)
    vectors, found = unravel(start + value / size)
    return unpack(vectors, scales, logarithmic, criterion.sizes), found, solution.stats["num_steps"]


def differ(blocks: list[Array], others: list[Array]) -> bool:
    """Whether lifting moved any block off the edge of the cone, rounding apart."""
    pairs = [(np.asarray(a), np.asarray(b)) for a, b in zip(blocks, others)]
    return any(np.max(np.abs(a - b)) > 1e-9 * np.max(np.abs(b)) for a, b in pairs)


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
    prior: Prior | None = None,
    near: bool = False,
) -> Refinement:
    """Refine M, D, K by prediction error, maximum likelihood over the outputs.

    **Arguments:** `start`: scaled M, D, K; `batch`; `setting`; `structure`: what is free, default all; `offset`:
    estimate an output offset of every record; `innovations`: noise enters at the forces too; `fixed`: entries of the
    stacked block vectors that keep their start value; `deviation`: mean square residual of the start per output, to
    weigh with at first; `prior`: what is assumed of entries that the experiment may leave open, default nothing;
    `near`: the start is next to its optimum, so that the steps over the cone begin there at once.

    **Returns:** a `Refinement`, never less likely than its start: where the steps end worse, the start itself with its
    best first states and offsets, and the result `RESULTS.not_improved`.

    **Raises:** `ComputationError` when no finite step was possible.

    Where the steps from a poor start do not settle, they are taken again from where fits over ever longer windows lead
    it, and the likelier end counts.

    **Reference:** Ljung, *System Identification*, §7.4 (determinant criterion) and §10.2.
    """
    structure = Structure() if structure is None else structure
    start = tuple(np.asarray(X) for X in start)
    options = {"offset": offset, "innovations": innovations, "deviation": deviation, "near": near}
    first = failure = None
    try:
        first = _refined(start, batch, setting, structure, fixed, prior, **options)
    except ComputationError as error:
        failure = error
    settled = first is not None and first.result == RESULTS.successful
    if settled or near or innovations or (deviation is not None and np.all(np.asarray(deviation) < POOR)):
        if first is None:
            raise failure
        return first
    nearer = lengthened(start, batch, setting, structure, fixed, prior)
    try:
        second = _refined(nearer, batch, setting, structure, fixed, prior, **options | {"deviation": None})
    except ComputationError:
        second = None
    ends = [end for end in (first, second) if end is not None]
    if not ends:
        raise failure
    return min(ends, key=lambda end: end.cost)


def _refined(start, batch, setting, structure, fixed, prior, *, offset, innovations, deviation, near) -> Refinement:
    """`refine` from one start, its arguments as there."""
    outputs = batch.y.shape[2]
    criterion = Criterion(batch, setting, structure, prior)
    nuisance = begin_nuisance(batch, setting, offset=offset, innovations=False)
    deviation = np.ones(outputs) if deviation is None else np.asarray(deviation)
    if not np.all(np.isfinite(deviation)):
        deviation = np.ones(outputs)
    whitening = np.diag(1 / np.sqrt(np.maximum(deviation, FLOOR**2)))

    def begun(lift):
        return Iterate(structure.blocks(*start, lift=lift), nuisance, whitening)

    begin = here = begun(0.0)
    at_begin = first = criterion.evaluate(here.blocks, nuisance)
    taken = 0
    if np.any(start_deviation(here, first) < FAR * np.diag(first.covariance(False))):
        # Not at rest: with first states of zero the first steps would bend M, D, K to what these explain.
        end = at_start(here, criterion, first)
        nuisance, whitening, first = end.at.nuisance, end.products.whitening(False), end.products
        here = begun(0.0)
    if near and not innovations:
        start_end = at_start(here, criterion, first)
        here, first = start_end.at, start_end.products
    elif fixed is None or not np.any(fixed):
        edge = differ(here.blocks, begun(LIFTS[0]).blocks)
        # At the edge the start itself may be better than what any steps make of it.
        ends = [at_start(here, criterion, first)] if edge else []
        straight = _straight(begun(LIFTS[0]), criterion) if edge and not innovations else None
        if straight is not None and straight.cost <= ends[0].cost + SLACK:
            ends.append(straight)
        else:
            for lift in LIFTS if edge else LIFTS[:1]:
                known = None if edge else first
                ends.append(cholesky_steps(begun(lift), criterion, first=known, near=NEAR_EDGE if edge else NEAR))
        taken = sum(end.steps for end in ends)
        best = min(ends, key=lambda end: end.cost)
        here, first = best.at, best.products
        if innovations:
            # Noise at the forces bends the free run, by which the steps until here went: from the start as well.
            ends = [_with_force_noise(at, criterion, batch, setting) for at in (begun(LIFTS[0] * edge), here)]
            taken += sum(steps for _, _, steps in ends)
            (here, first, _) = min(ends, key=lambda end: likelihood_cost(end[1], criterion))

    end = conic_steps(here, criterion, first=first, fixed=fixed)
    result = RESULTS.successful if end.converged else RESULTS.refinement_diverged
    if innovations:
        # With noise at the forces a free run is no measure of the likelihood: both by the same noise.
        products = criterion.evaluate(begin.blocks, end.at.nuisance)
        normal = criterion.normal(products, end.at.whitening, begin.blocks)
        if not end.normal.cost <= normal.cost * (1 + SLACK / criterion.count):
            at = Iterate(begin.blocks, end.at.nuisance, end.at.whitening)
            end, result = ConicEnd(at, products, normal, end.steps, np.inf, False), RESULTS.not_improved
    else:
        reached, at_first = likelihood_cost(end.products, criterion), start_cost(begin, criterion, at_begin)
        if not reached <= at_first + SLACK:
            end, result = _kept(begin, at_begin, criterion, end.steps), RESULTS.not_improved
    if not np.isfinite(end.normal.cost):
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement")
    return _refinement(end, criterion, taken, result)


def _straight(start: Iterate, criterion: Criterion) -> CholeskyEnd | None:
    """Where few steps over the cone end from beside its edge, along which those of `cholesky_steps` crawl; None where
    they do not settle, or nothing finite is left."""
    try:
        end = conic_steps(start, criterion, max_steps=STRAIGHT)
    except ComputationError:
        return None
    cost = likelihood_cost(end.products, criterion)
    return CholeskyEnd(end.at, end.products, cost, end.steps) if end.converged and np.isfinite(cost) else None


def _with_force_noise(at: Iterate, criterion: Criterion, batch: Batch, setting: Setting):
    """Steps in the innovations form: where they end, the products there, and how many there were."""
    offset = at.nuisance.offset is not None
    noise = begin_nuisance(batch, setting, offset=offset, innovations=True).noise
    blocks, nuisance, steps = levenberg_marquardt(
        Iterate(at.blocks, Nuisance(at.nuisance.x0, at.nuisance.offset, noise), at.whitening), criterion
    )
    return Iterate(blocks, nuisance, at.whitening), criterion.evaluate(blocks, nuisance), int(steps)


def start_kept(
    start: tuple[Array, Array, Array],
    batch: Batch,
    setting: Setting,
    *,
    structure: Structure,
    offset: bool,
    prior: Prior | None,
) -> Refinement:
    """The start, with its best first states and offsets and its own information, as the end of a refinement.

    **Arguments:** as of `refine`. **Returns:** a `Refinement` whose result is `RESULTS.not_improved`.
    """
    criterion = Criterion(batch, setting, structure, prior)
    nuisance = begin_nuisance(batch, setting, offset=offset, innovations=False)
    begin = Iterate(structure.blocks(*start, lift=0.0), nuisance, np.eye(batch.y.shape[2]))
    end = _kept(begin, criterion.evaluate(begin.blocks, nuisance), criterion, 0)
    return _refinement(end, criterion, 0, RESULTS.not_improved)


def _refinement(end: ConicEnd, criterion: Criterion, taken: int, result: RESULTS) -> Refinement:
    M, D, K = criterion.matrices(end.at.blocks)
    count = criterion.count - end.normal.information.shape[0]
    normal, variance, noise_errors = end.normal, end.normal.cost / max(count, 1.0), None
    if end.at.nuisance.noise is not None:
        information, noise_errors = information_beside_noise(end.at, criterion, float(variance))
        if criterion.prior is not None:
            information[np.diag_indices(len(criterion.prior.precision))] += criterion.prior.precision
        normal = Normal(normal.cost, normal.gradient, information)
    return Refinement(
        M,
        D,
        K,
        end.at.blocks,
        end.at.nuisance,
        end.at.whitening,
        normal,
        variance,
        (taken, end.steps),
        end.decrement,
        likelihood_cost(end.products, criterion),
        result,
        criterion.prior,
        noise_errors=noise_errors,
    )


def _kept(begin: Iterate, first: Products, criterion: Criterion, steps: int) -> ConicEnd:
    """The start as the end of a refinement that did not improve it."""
    start = at_start(begin, criterion, first)
    normal = criterion.normal(start.products, start.at.whitening, start.at.blocks)
    return ConicEnd(start.at, start.products, normal, steps, np.inf, False)
