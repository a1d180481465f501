"""First state of a model with effects: the linear part's estimate, carried on with the whole free run."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...numerics.matrices.bounded import bounded
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.stored_programs import stored

MOST_STEPS = 30
"""Steps of the damped Gauss-Newton iteration."""

ENOUGH = 1e-9
"""Decrease of the sum of squares, relative to it, that a step must promise to be tried."""

RANK_TOLERANCE = 1e-10
"""Relative singular value below which a direction of first state and offset is left where it is."""

DAMPINGS = (0.0, 1e-4, 1e-2, 1.0, 100.0)
"""Damping of a step, in units of the slopes' own squares: the first with which the sum of squares falls is taken."""


State = tuple[Float[np.ndarray, " states"], Float[np.ndarray, " outputs"]]
"""A first state, and the offset of every output."""


def linear_state(
    free: Float[np.ndarray, "samples outputs states"],
    left: Float[np.ndarray, "samples outputs"],
    weight: Float[np.ndarray, "samples outputs"],
    offset: bool,
) -> State:
    """min Σ (weight (left − free x0 − offset))², the smallest solution where some direction moves nothing.

    **Arguments:** `free`: outputs by the first state; `left`: outputs without what the inputs do; `weight` of every
    sample, 0 where it does not count; `offset`: whether outputs may have one.

    **Returns:** first state and offset.
    """
    samples, outputs, states = free.shape
    known = weight > 0
    table = free
    if offset:
        table = np.concatenate([free, np.broadcast_to(np.eye(outputs), (samples, outputs, outputs))], axis=2)
    table = (table * weight[:, :, None])[known]
    norm = np.linalg.norm(table, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    solution = np.linalg.lstsq(table / norm, (left * weight)[known], rcond=RANK_TOLERANCE)[0] / norm
    return solution[:states], solution[states:] if offset else np.zeros(outputs)


@stored
def _run_and_slopes(run, x0):
    return run(x0), jax.jacfwd(run)(x0)


@stored
def _run(run, x0):
    return run(x0)


def refined_state(
    run: eqx.Partial,
    starts: list[State],
    measured: Float[np.ndarray, "samples outputs"],
    weight: Float[np.ndarray, "samples outputs"],
    offset: bool,
) -> State:
    """min Σ (weight (y − ŷ(x0) − offset))² by Gauss-Newton steps, damped where they overshoot.

    **Arguments:** `run`: outputs from the first state, traceable, its arrays bound to it; `starts`: the best is
    taken; `measured`: outputs; `weight` of every sample, 0 where it does not count; `offset`: whether outputs may
    have one.

    **Returns:** first state and offset.

    **Raises:** `ComputationError` where the motion is not finite from any start.
    """

    def squares(x0, shift):
        with np.errstate(over="ignore", invalid="ignore"):
            return np.sum(left(_run(run, jnp.asarray(x0)), shift) ** 2)

    def left(simulated, shift):
        return np.where(weight > 0, weight * (measured - np.asarray(simulated) - shift), 0.0)

    begun = [(squares(*start), k) for k, start in enumerate(starts)]
    cost, best = min((pair for pair in begun if np.isfinite(pair[0])), default=(np.inf, 0))
    if not np.isfinite(cost):
        raise ComputationError(
            RESULTS.nonfinite, stage="initial state", detail="the model's motion grows without bound"
        )
    x0, shift = (np.array(part, dtype=float) for part in starts[best])
    states, outputs = len(x0), measured.shape[1]
    for _ in range(MOST_STEPS):
        simulated, slopes = (np.asarray(part) for part in _run_and_slopes(run, jnp.asarray(x0)))
        if offset:
            slopes = np.concatenate([slopes, np.broadcast_to(np.eye(outputs), (*measured.shape, outputs))], axis=2)
        table = (slopes * weight[:, :, None]).reshape(-1, slopes.shape[2])
        if not bounded(table):
            break
        norm = np.linalg.norm(table, axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        Q, R = np.linalg.qr(table / norm)
        target = Q.T @ left(simulated, shift).ravel()
        taken = False
        for damping in DAMPINGS:
            step = _step(R, target, damping)
            promised = target @ target - np.sum((target - R @ step) ** 2)
            if promised <= ENOUGH * cost:
                break
            change = step / norm
            there, moved = x0 + change[:states], shift + change[states:] if offset else shift
            new = squares(there, moved)
            if new < cost:
                x0, shift, cost, taken = there, moved, new, True
                break
        if not taken:
            break
    return x0, shift


def _step(R: np.ndarray, target: np.ndarray, damping: float) -> np.ndarray:
    table = np.vstack([R, np.sqrt(damping) * np.eye(R.shape[1])])
    return np.linalg.lstsq(table, np.concatenate([target, np.zeros(R.shape[1])]), rcond=RANK_TOLERANCE)[0]
