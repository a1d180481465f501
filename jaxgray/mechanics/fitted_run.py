"""Free run of a model against a record, with what the model does not say found from the record."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics.matrices.bounded import bounded
from ..numerics.outcomes import RESULTS, ComputationError
from ..records import Record
from .effects.base import AbstractForceEffect
from .model import MechanicalModel
from .runs.simulate import free_run, initial_state, simulate

MOST_STEPS = 16
"""Steps per sample up to which added forces are followed."""

TOLERABLE = 0.03
"""Change of the run by steps half as long, relative to what it leaves of the record, that is left."""


@dataclass(frozen=True)
class FittedRun:
    """`simulated`: outputs; `x0`: displacements, then velocities at the first sample; `offset` per output;
    `substeps`: steps per sample in which added forces were followed."""

    simulated: Float[np.ndarray, "samples outputs"]
    x0: Float[np.ndarray, " states"]
    offset: Float[np.ndarray, " outputs"]
    substeps: int


def fitted_run(model: MechanicalModel, record: Record) -> FittedRun:
    """Free run of the whole model, its effects included, from the first state and with the output offsets by which it
    comes nearest to the record; forces that effects add are followed in steps whose error does not count.

    **Arguments:** `model`; `record`, with the model's channels in its order.

    **Returns:** a `FittedRun`.

    **Raises:** `ValueError` where model and record do not fit; `ComputationError` where the motion is not finite.
    """
    options = {"hold": record.hold, "scheduling": record.scheduling}

    def found(substeps):
        return initial_state(model, record.u, record.y, record.sampling_time, substeps=substeps, **options)

    x0, offset = found(1)
    if not any(isinstance(term.effect, AbstractForceEffect) for term in model.effects):
        run = simulate(model, record.u, record.sampling_time, x0=x0, offset=offset, **options)
        return FittedRun(run, x0, offset, 1)
    arrays = [jnp.asarray(part) for part in (record.u, record.sampling_time)]
    scheduling = None if record.scheduling is None else jnp.asarray(record.scheduling)

    def run_of(substeps):
        # The number of steps as an array, so that all share one compiled program.
        steps, start = jnp.asarray(substeps), jnp.asarray(x0)
        return offset + np.asarray(free_run(model, *arrays, record.hold, start, scheduling=scheduling, substeps=steps))

    substeps, run = 1, run_of(1)
    while substeps < MOST_STEPS:
        finer = run_of(2 * substeps)
        substeps, before, run = 2 * substeps, run, finer
        if bounded(before, finer):
            change, left = (np.sqrt(np.nanmean(part**2, axis=0)) for part in (finer - before, record.y - finer))
            if np.all(change <= TOLERABLE * left):
                break
        x0, offset = found(substeps)
        run = run_of(substeps)
    if not bounded(run):
        raise ComputationError(RESULTS.nonfinite, stage="simulation", detail="the outputs grow without bound")
    return FittedRun(run, x0, offset, substeps)
