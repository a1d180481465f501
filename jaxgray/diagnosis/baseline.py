"""Where the diagnosis begins: the linear fit, or the user's own model, on the record."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..identification import Identification
from ..identification.physical import Scaling
from ..identification.preparation import scaling_of
from ..identification.structure import Structure
from ..mechanics.model import MechanicalModel, effect_names
from ..mechanics.simulate import initial_state
from ..records import Record
from .problem import Candidate, Data, Setup
from .residual import white_part

TRUSTED_PERIODS = 2
"""Whole periods needed for a noise floor from what does not repeat."""

ADOPTED = "residual of the final model"
"""Source of a noise floor where the record has none that owes nothing to a model."""


@dataclass(frozen=True)
class Baseline:
    """`model`; `setup`; `start`: the model with the first state of every record; `own`: whether it is the user's."""

    model: MechanicalModel
    setup: Setup
    start: Candidate
    own: bool


def baseline_of(
    records: list[Record], identification: Identification | None, model: MechanicalModel | None
) -> Baseline:
    """The baseline of an identification, whose fixed entries stay fixed, or of a model of the user's own, whose entries
    all do.

    The first states are those that go with a constant output offset; the offset itself stays in the residual, where
    it is a finding.

    **Arguments:** `records`; `identification` or `model`.

    **Raises:** `ValueError` when the user's model does not go with the record.
    """
    own = model is not None
    if own:
        if model.effects:
            raise ValueError(
                f"model has effects ({effect_names(model)}), and a diagnosis begins with a linear model; give "
                "dataclasses.replace(model, effects=())."
            )
        first = records[0]
        if (model.inputs, model.dofs) != (first.inputs, first.outputs):
            raise ValueError(
                f"model has {model.inputs} inputs and {model.dofs} coordinates, the record {first.inputs} inputs and "
                f"{first.outputs} outputs; give the model that belongs to the record."
            )
        scaling, structure = scaling_of(records), Structure()
    else:
        model, scaling, structure = identification.model, identification.scaling, identification.structure
    setup = _setup(model, scaling, structure, records[0])
    entries = setup.entries_of(model.mass, model.damping, model.stiffness)
    fixed = np.ones(len(entries), bool) if own else identification.fixed
    setup = _setup(model, scaling, structure, records[0], fixed)
    states = []
    for record in records:
        x0, _ = initial_state(model, record.u, record.y, record.sampling_time, hold=record.hold)
        states.append(x0)
    return Baseline(model, setup, Candidate(entries, tuple(states)), own)


def _setup(model: MechanicalModel, scaling: Scaling, structure: Structure, record: Record, held=None) -> Setup:
    return Setup(
        model.drive,
        model.measured,
        scaling,
        structure,
        np.zeros(0, bool) if held is None else np.asarray(held, bool),
        record.input_names,
        record.output_names,
    )


def independent_floor(record: Record) -> tuple[Float[np.ndarray, " outputs"] | None, str]:
    """Noise floor that owes nothing to any model, and where it comes from.

    From what does not repeat over the periods of a periodic record, or from a quiet head; None where neither is there.
    """
    period = record.detect_period()
    if period is not None and record.samples // period - 1 >= TRUSTED_PERIODS and not record.has_missing:
        average = record.average_periods(period, skip=1)
        floor = np.sqrt(np.nanmean(average.noise_variance, axis=0))
        if np.all(floor > 0):
            return floor, "repeated periods"
    still = np.flatnonzero(np.any(record.u != record.u[0], axis=1))
    quiet = int(still[0]) if len(still) else record.samples
    if quiet >= 200 and not np.any(record.u[0]) and not np.isnan(record.y[:quiet]).any():
        data = Data.of(record[:quiet])
        head = record.y[quiet // 2 : quiet]
        # Still ringing down from before the record it is no measure of noise.
        floor = head.std(axis=0)
        white = np.sqrt(white_part(data.y[:quiet], data.kept[:quiet]))
        if np.all(floor > 0) and np.all(floor < 1.5 * white):
            return floor, "quiet head"
    return None, ADOPTED
