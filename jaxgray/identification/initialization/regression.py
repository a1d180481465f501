"""The other start: the equation of motion as a regression in the λ-domain.

With s = (1 − λ)/(τλ), s^j λ^k is a proper filter for j ≤ k, and

    M s²λ^k q + D sλ^k q + K λ^k q = E λ^k u

needs neither derivatives nor a stable simulation: it serves rigid bodies, integrators and closed loops. The
outputs are continuous, so that their filters are discretised under a linear hold, the input's under its own.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import ORDER
from ...mechanics.systems.statespace import StateSpace, sampled
from ...numerics.matrices.linear_algebra import duplication, from_symmetric_vector
from ...numerics.matrices.positive import ClarabelSolver, PositiveLeastSquares
from ...numerics.responses.lifting import free_response, respond
from ..setup.preparation import Signals
from ..subspace.physical import FLOOR


def derivative_filters(time_constant: Float[Array, ""], stages: int, orders: int, hold: str) -> StateSpace:
    """s^j λ^k for j = 0 … orders−1, k = `stages`, sampled under a hold; time in samples.

    **Arguments:** `time_constant` in samples; `stages` (k ≥ orders); `orders`; `hold`.

    **Returns:** a `StateSpace` with one input and `orders` outputs.
    """
    rate = 1.0 / time_constant
    A = jnp.diag(jnp.full(stages, -rate)) + jnp.diag(jnp.full(stages - 1, rate), -1)
    B = jnp.zeros((stages, 1)).at[0, 0].set(rate)
    # s of a state is its derivative: rows of the last state's derivatives.
    rows = [jnp.zeros((1, stages)).at[0, -1].set(1.0)]
    feeds = [jnp.zeros((1, 1))]
    for _ in range(orders - 1):
        feeds.append(rows[-1] @ B)
        rows.append(rows[-1] @ A)
    return sampled(StateSpace(A, B, jnp.concatenate(rows), jnp.concatenate(feeds)), 1.0, hold)


@functools.partial(jax.jit, static_argnames=("measured", "hold"))
def regression_table(
    signals: Signals,
    outputs: Float[Array, "samples outputs"],
    E: Float[Array, "dofs inputs"],
    time_constant: Float[Array, ""],
    *,
    measured: tuple[str, ...],
    hold: str,
) -> tuple[Float[Array, "dofs samples entries"], Float[Array, "dofs samples"]]:
    """Rows of the regression, initial filter states and a constant taken out.

    **Arguments:** `signals`: record; `outputs`: measured outputs, or simulated ones for instruments; `E`:
    scaled input map; `time_constant` in samples; `measured`; `hold`.

    **Returns:** per coordinate the rows over the isometric vectors of M, D, K, and the force.
    """
    highest = max(ORDER[kind] for kind in measured)
    stages = 3 + highest
    by_output = derivative_filters(time_constant, stages, 3 + highest, "linear")
    by_input = derivative_filters(time_constant, stages, 1 + highest, hold)

    def through(system, x):
        return respond(system.A, system.B, system.C, system.D, x[:, None])

    filtered = jax.vmap(through, (None, 1), 1)(by_output, outputs)
    # q_j = s^(−r_j) y_j; everything is multiplied by s^highest.
    motion = jnp.stack([filtered[:, k, highest - ORDER[kind] :][:, :3] for k, kind in enumerate(measured)], axis=1)
    force = jax.vmap(through, (None, 1), 1)(by_input, signals.u)[:, :, highest] @ E.T

    dofs = len(measured)
    basis = duplication(dofs).reshape(dofs, dofs, -1)
    tables = [jnp.einsum("ijb,nj->inb", basis, motion[:, :, order]) for order in (2, 1, 0)]
    table = jnp.concatenate(tables, axis=2)
    inside = signals.inside[:, None]
    start = free_response(by_output.A, jnp.eye(stages), signals.u.shape[0]).sum(axis=1)
    nuisance = jnp.concatenate([start, jnp.ones_like(inside)], axis=1) * inside
    Q = jnp.linalg.qr(nuisance / jnp.linalg.norm(nuisance, axis=0))[0]

    def off(X):
        X = X * inside
        return X - Q @ (Q.T @ X)

    return jax.vmap(off)(table), jax.vmap(off)(force.T[:, :, None])[..., 0]


def regress(
    signals: list[Signals],
    instruments: list[Float[Array, "samples outputs"]] | None,
    E: Float[Array, "dofs inputs"],
    time_constant: float,
    *,
    measured: tuple[str, ...],
    hold: str,
) -> tuple[Array, Array, Array]:
    """M, D, K (scaled) by semidefinite least squares, with instruments where they are given.

    **Arguments:** `signals`: records, without missing samples; `instruments`: simulated outputs per record, free
    of the measurement noise, or None for plain least squares (biased by noise: a first guess only); `E`: scaled
    input map; `time_constant` in samples; `measured`; `hold`.

    **Returns:** M, D, K.
    """
    dofs = len(measured)
    factor = target = 0.0
    for k, record in enumerate(signals):
        tau = jnp.asarray(time_constant)
        table, force = regression_table(record, record.y, E, tau, measured=measured, hold=hold)
        table, force = table.reshape(-1, table.shape[2]), force.reshape(-1)
        if instruments is None:
            Z = table
        else:
            Z, _ = regression_table(record, instruments[k], E, tau, measured=measured, hold=hold)
            Z = Z.reshape(-1, Z.shape[2])
        scale = jnp.linalg.norm(Z, axis=0)
        Q = jnp.linalg.qr(Z / jnp.where(scale > 0, scale, 1.0))[0]
        factor = jnp.concatenate([factor, Q.T @ table]) if k else Q.T @ table
        target = jnp.concatenate([target, Q.T @ force]) if k else Q.T @ force
    entries = dofs * (dofs + 1) // 2
    size = jnp.repeat(jnp.linalg.norm(factor.reshape(-1, 3, entries), axis=(0, 2)), entries)
    size = jnp.where(size > 0, size, 1.0)
    problem = PositiveLeastSquares.from_residual(factor / size, target, (dofs,) * 3, (0.0, 0.0, 0.0))
    free = problem.unconstrained()
    mean = jnp.abs(jnp.trace(problem.blocks(free)[0])) / dofs
    problem = PositiveLeastSquares.from_residual(factor / size, target, (dofs,) * 3, (1e3 * FLOOR * mean, 0.0, 0.0))
    found = jnp.asarray(ClarabelSolver()(problem)) / size
    return tuple(from_symmetric_vector(x) for x in jnp.split(found, 3))


def regression_time_constants(grid: Float[np.ndarray, " time_constants"], sampling_time: float) -> np.ndarray:
    """Time constants in samples for the regression: every other one of the subspace grid."""
    return np.asarray(grid)[1::2] / sampling_time
