"""State-space models of more states than twice the outputs, from the compressed record, without a physical form.

Only the transfer function matters: A and C of the measured outputs by the projection, B by regression on simulated
responses. For forces it is kept mechanical: displacements that no force moves at once.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import ORDER, AbstractDrive, Force
from ...mechanics.systems.statespace import StateSpace, hold_matrices
from ...numerics.matrices.linear_algebra import least_squares, null_basis, triangular_factor
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.stored_programs import stored
from ...numerics.responses.lifting import respond, scaled_free_response
from ..setup.prediction import best_run
from ..setup.preparation import Signals
from ..subspace.filter_bank import pole
from ..subspace.grid import record_factors, score
from ..subspace.projection import AbstractWeight, arrange, project
from ..subspace.realization import AbstractMap

STEEPEST = 0.5
"""Growth rate of a pole [1/sample] from which a realisation is of no use."""


class HigherOrder(eqx.Module):
    """ẋ = A x + B u, displacements q = C x, outputs y = `Cy` x + `Dy` u; time in samples.

    `deviation`: mean square of what the free run leaves of every output; `singular_values` of the projection.
    """

    A: Float[Array, "states states"]
    B: Float[Array, "states inputs"]
    C: Float[Array, "outputs states"]
    Cy: Float[Array, "outputs states"]
    Dy: Float[Array, "outputs inputs"]
    deviation: Float[Array, " outputs"]
    singular_values: Float[Array, " values"]


def block_row_choices(outputs: int, order: int, most: int) -> tuple[int, ...]:
    """Numbers of block rows that a model of this order needs, a few of them, as the record allows.

    **Arguments:** `outputs`; `order`: number of states; `most`: what the record's length allows.
    """
    least = -(-order // outputs) + 1
    choices = sorted({max(least + more, 4) for more in (1, 3, 6, 10)})
    allowed = [i for i in choices if i <= most]
    return tuple(allowed) if allowed else (max(least, 3),)


def realized_order(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    block_rows: Float[Array, ""],
    *,
    inputs: int,
    padded: int,
    weight: AbstractWeight,
    order: int,
    map: AbstractMap,
    householder: bool,
) -> tuple[Array, Array, Array]:
    """A (continuous, time in samples) and C of the measured outputs, and the projection's singular values."""
    data = arrange(factor, a, block_rows, inputs, padded)
    projections = project(data, weight, order, householder=householder)
    targets = jnp.concatenate([projections.target_states, projections.target_outputs], axis=1)
    solution = least_squares(projections.regressor, targets).T
    return map.continuous(solution[:order], a), solution[order:], projections.singular_values


def input_basis(
    A: Float[Array, "states states"],
    Cy: Float[Array, "outputs states"],
    measured: tuple[str, ...],
    drive: AbstractDrive,
) -> tuple[Array, Array, Array, Array]:
    """Directions (b, d) in which a column of B and D may lie, and the rows of displacement and of what is measured.

    **Returns:** b (states × directions), d (outputs × directions), C of the displacements, C of the outputs.
    """
    order = np.array([ORDER[kind] for kind in measured])
    states = A.shape[0]
    if not isinstance(drive, Force):
        relative = drive.relative and bool(np.any(order == 2))
        b, d = jnp.eye(states), jnp.zeros((len(order), states))
        if relative:
            b = jnp.concatenate([b, jnp.zeros((states, len(order)))], axis=1)
            d = jnp.concatenate([d, jnp.eye(len(order))], axis=1)
        return b, d, Cy, Cy
    rows, C = [Cy], []
    for _ in range(int(np.max(order))):
        rows.append(jnp.linalg.solve(A.T, rows[-1].T).T)
    C = jnp.stack([rows[r][k] for k, r in enumerate(order)])
    # No force moves a displacement at once.
    b = null_basis(C)
    d = jnp.where((order == 2)[:, None], C @ A @ b, 0.0)
    return b, d, C, Cy


def fitted_input(
    A: Float[Array, "states states"],
    basis: tuple[Array, Array, Array, Array],
    signals: Signals,
    weights: Float[Array, " samples"] | None,
    hold: str,
) -> tuple[Array, Array]:
    """B and D within their directions, first state and offsets free, by regression on simulated responses."""
    b, d, _, Cy = basis
    Ad, B0, B1 = hold_matrices(A, b, 1.0, hold)
    Bd, Dd = Ad @ B1 + B0, d + Cy @ B1
    kept = signals.kept if weights is None else signals.kept * weights[:, None]

    def response(b, d, signal):
        return respond(Ad, b[:, None], Cy, d[:, None], signal[:, None])

    by_input = jax.vmap(response, (None, None, 1), -1)
    samples, outputs = signals.y.shape
    responses = jax.vmap(by_input, (1, 1, None), -2)(Bd, Dd, signals.u).reshape(samples, outputs, -1)
    free = scaled_free_response(Ad, Cy, samples)
    offsets = jnp.broadcast_to(jnp.eye(outputs), (samples, outputs, outputs))
    size = jnp.sqrt(jnp.mean(responses**2, axis=(0, 1)))
    size = jnp.where(size > 0, size, 1.0)
    table = jnp.concatenate([free, offsets, responses / size], axis=2) * kept[:, :, None]
    table, target = table.reshape(samples * outputs, -1), (signals.y * kept).reshape(-1)
    R = jax.lax.stop_gradient(triangular_factor(jnp.concatenate([table, target[:, None]], axis=1)))[:-1]
    first = least_squares(R[:, :-1], R[:, -1:])[:, 0]
    # One more step at the solution: it changes rounding alone, and its derivative is that of the least squares, which
    # the derivative of the factor, of the square of its condition, would lose.
    left = table.T @ (target - table @ first)
    step = jsl.solve_triangular(R[:, :-1], jsl.solve_triangular(R[:, :-1], left, trans=1))
    found = (first + step)[free.shape[2] + outputs :] / size
    found = found.reshape(b.shape[1], -1)
    return b @ found, d @ found


@stored
def _realized(factor_grid, poles, k, block_rows, **static):
    return jax.vmap(lambda i: realized_order(factor_grid[k], poles[k], i, **static))(block_rows)


@stored
def _with_input(A, Cy, singular_values, signals, drive, measured, hold):
    def one(A, Cy, values):
        basis = input_basis(A, Cy, measured, drive)
        B, D = fitted_input(A, basis, signals, None, hold)
        Ad, B0, B1 = hold_matrices(A, B, 1.0, hold)
        system = StateSpace(Ad, Ad @ B1 + B0, Cy, D + Cy @ B1)
        return HigherOrder(A, B, basis[2], Cy, D, best_run(system, signals)[1], values)

    return jax.vmap(one)(A, Cy, singular_values)


def realizations(
    signals: list[Signals],
    drive: AbstractDrive,
    measured: tuple[str, ...],
    hold: str,
    sampling_time: float,
    order: int,
    *,
    time_constants: Float[np.ndarray, " time_constants"],
    block_rows: tuple[int, ...],
    weight: AbstractWeight,
    map: AbstractMap,
) -> list[tuple[HigherOrder, float, int]]:
    """Models of an order from a grid of time constants and block rows, the best free run first.

    **Arguments:** `signals`: scaled records; `drive`: scaled; `measured`; `hold`; `sampling_time` [s]; `order`: number
    of states; `time_constants` [s]; `block_rows`; `weight`; `map`.

    **Returns:** models with their τ [s] and block rows.

    **Raises:** `ComputationError` where none is finite.
    """
    padded = max(block_rows)
    poles = pole(np.asarray(time_constants), sampling_time)
    factors, householder = record_factors(signals, poles, padded)
    longest = max(signals, key=lambda s: s.samples)
    static = {
        "inputs": longest.u.shape[1],
        "padded": padded,
        "weight": weight,
        "order": order,
        "map": map,
        "householder": householder,
    }
    found = []
    for k, tau in enumerate(np.asarray(time_constants, float)):
        A, Cy, values = jax.device_get(
            jax.block_until_ready(_realized(factors, poles, np.asarray(k), np.asarray(block_rows, float), **static))
        )
        usable = np.all(np.isfinite(A), axis=(1, 2)) & np.all(np.isfinite(Cy), axis=(1, 2))
        rate = np.array([np.max(np.linalg.eigvals(X).real) if good else np.inf for X, good in zip(A, usable)])
        usable &= rate < STEEPEST
        A = np.where(usable[:, None, None], A, -np.eye(order))
        models = jax.device_get(_with_input(A, Cy, values, longest, drive, measured, hold))
        for j, i in enumerate(block_rows):
            if usable[j]:
                found.append((jax.tree_util.tree_map(lambda leaf, j=j: np.asarray(leaf[j]), models), float(tau), i))
    found = [item for item in found if np.isfinite(score(item[0].deviation))]
    if not found:
        raise ComputationError(
            RESULTS.unstable_start, stage="subspace start", detail=f"no model of {order} states simulates the record"
        )
    return sorted(found, key=lambda item: -float(score(item[0].deviation)))
