"""Samples of an accelerometer that no simulation decides: the force of dry friction jumps there.

Whether a sample falls before or after a reversal of the velocity hangs on a fraction of an integration step. On the
wrong side of it, one sample is off by twice the friction, tens of standard deviations of the noise, while the motion is
right: such samples say nothing of the parameters, and least squares would follow them.
"""

import numpy as np
from jaxtyping import Bool, Float

from ...mechanics.runs.extended import arm_of
from ...numerics.matrices.bounded import bounded
from .. import settings
from .candidate import Candidate, Data
from .simulator import Simulator


def decided_residual(
    simulator: Simulator,
    candidate: Candidate,
    data: Data,
    y: Float[np.ndarray, "samples outputs"],
    J: Float[np.ndarray, "samples outputs parameters"] | None = None,
    record: int = 0,
) -> tuple[Float[np.ndarray, "samples outputs"], Float[np.ndarray, "samples outputs parameters"] | None]:
    """Residual of a free run, and its Jacobian, zero at the samples that are missing or undecided.

    **Arguments:** `simulator`; `candidate`; `data`; `y`: its free run there; `J`: Jacobian of `y`, None for none;
    `record`: which of the records of the fit.

    **Returns:** the residual, and the Jacobian.
    """
    e = np.where(data.kept, data.y - y, 0.0)
    left_out = undecided(simulator, candidate, data, e, record)
    if left_out is None:
        return e, J
    return np.where(left_out, 0.0, e), None if J is None else np.where(left_out[:, :, None], 0.0, J)


def undecided(
    simulator: Simulator, candidate: Candidate, data: Data, e: Float[np.ndarray, "samples outputs"], record: int = 0
) -> Bool[np.ndarray, "samples outputs"] | None:
    """Which samples of accelerations lie beside a reversal, or nearly, and are far off; None where there are none, and
    where they are so many that not the steps but the model is wrong.

    **Arguments:** as for `decided_residual`; `e`: residual, zero where missing.
    """
    near = beside_reversals(simulator, candidate, data, record) if bounded(e) else None
    if near is None:
        return None
    accelerated = accelerations(simulator)
    away = data.kept & ~near[:, None]
    level = np.sqrt(np.sum(np.where(away, e, 0.0) ** 2, axis=0) / np.maximum(away.sum(axis=0), 1))
    left_out = near[:, None] & accelerated & (np.abs(e) > settings.OUTLYING_RESIDUAL * level)
    share = np.mean(left_out[: data.samples].any(axis=1))
    return left_out if 0.0 < share <= settings.MAX_UNDECIDED_SHARE else None


def accelerations(simulator: Simulator) -> Bool[np.ndarray, " outputs"]:
    """Which outputs are accelerations."""
    return np.array([kind == "acceleration" for kind in simulator.setup.measured])


def beside_reversals(
    simulator: Simulator, candidate: Candidate, data: Data, record: int = 0
) -> Bool[np.ndarray, " samples"] | None:
    """Which samples lie beside a reversal of dry friction, or nearly; None where accelerations are not measured, or
    nothing rubs."""
    jumping = [term for term in simulator.completed(candidate).terms if term.effect.jumps]
    if not jumping or not accelerations(simulator).any():
        return None
    v, plant = simulator.motion(candidate, data, record)[1], simulator.plant(candidate)
    if not bounded(v):
        return None
    near = np.zeros(len(v), bool)
    for term in jumping:
        along = v @ np.asarray(arm_of(term, plant))
        near |= np.abs(along) < settings.SLOW_VELOCITY * np.sqrt(np.mean(along[: data.samples] ** 2))
        turned = np.sign(along[1:]) != np.sign(along[:-1])
        near[:-1] |= turned
        near[1:] |= turned
    return near
