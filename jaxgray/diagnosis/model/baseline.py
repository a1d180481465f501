"""Where the diagnosis begins: the linear fit, or the user's own model, on the record."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...identification import Identification
from ...identification.setup.preparation import scaling_of
from ...identification.setup.structure import Structure
from ...identification.setup.units import Scaling
from ...mechanics.model import MechanicalModel
from ...mechanics.passivity import violations
from ...mechanics.runs.simulate import initial_state
from ...records import Record
from .candidate import Candidate, Setup
from .own_laws import laws_of

ADOPTED = "residual of the final model"
"""Source of a noise floor where the record has none that depends on no model."""


WRITTEN = 1e-5
"""Negative eigenvalue of a given matrix, relative to its largest entry, that comes from digits that were left out."""

MUCH_LIKE = 1.5
"""Ratio of masses and stiffnesses at their coordinates up to which two models are much like one another."""


@dataclass(frozen=True)
class Baseline:
    """`model`; `setup`; `start`: the model with the first state of every record; `own`: whether it is the user's;
    `left_out`: which of its laws are not taken, and why."""

    model: MechanicalModel
    setup: Setup
    start: Candidate
    own: bool
    left_out: tuple[str, ...] = ()


def baseline_of(
    records: list[Record], identification: Identification | None, model: MechanicalModel | None
) -> Baseline:
    """The baseline of an identification, whose fixed entries stay fixed, or of a model of the user's own, whose entries
    and laws all do.

    The first states are those that go with a constant output offset; the offset itself stays in the residual, where
    it is a finding (but of a body that nothing holds: `starts.first_states`).

    **Arguments:** `records`; `identification` or `model`.

    **Raises:** `ValueError` when the user's model does not go with the record.
    """
    own, laws, left_out, physical = model is not None, (), (), True
    if own:
        first = records[0]
        if model.hidden:
            raise ValueError(
                f"model has hidden coordinates ({', '.join(model.hidden)}), and a diagnosis judges models of measured "
                "ones; give a model with one coordinate per output."
            )
        if (model.inputs, model.outputs) != (first.inputs, first.outputs):
            raise ValueError(
                f"model has {model.inputs} inputs and {model.outputs} outputs, the record {first.inputs} inputs and "
                f"{first.outputs} outputs; give the model that belongs to the record."
            )
        _check_physical(model)
        laws, left_out = laws_of(model, first)
        model = dataclasses.replace(model, effects=laws)
        scaling, structure = scaling_of(records), Structure()
    else:
        model, scaling, structure = identification.model, identification.scaling, identification.structure
        physical = identification.hidden is None or not identification.hidden.canonical
    setup = _setup(model, scaling, structure, records[0])
    entries = setup.entries_of(model.mass, model.damping, model.stiffness)
    fixed = np.ones(len(entries), bool) if own else identification.fixed
    setup = dataclasses.replace(_setup(model, scaling, structure, records[0], fixed), own=laws, physical=physical)
    return Baseline(model, setup, _begun(model, entries, records), own, left_out)


def _check_physical(model: MechanicalModel) -> None:
    """Raise `ValueError` for matrices that the entries of a diagnosis cannot be: others would be judged in their
    place."""
    for one in violations(model.mass, model.damping, model.stiffness, rounding=WRITTEN):
        if one.kind == "negative":
            raise ValueError(
                f"model: {one.matrix} is negative where mostly {model.coordinates[one.at[0]]} moves (eigenvalue "
                f"{one.value:.3g} with the masses on the diagonal as units); give M > 0, D ≥ 0, K ≥ 0, and what "
                "pushes as an effect of the model."
            )
        (i, j), effects = one.at, {"damping": "gyroscopic_coupling", "stiffness": "circulatory_coupling"}
        rest = f", and the rest as {effects[one.matrix]} among its effects" if one.matrix in effects else ""
        raise ValueError(
            f"model: {one.matrix}[{i},{j}] and {one.matrix}[{j},{i}] differ by {one.value:.3g}; give a symmetric "
            f"matrix{rest}."
        )


def others_of(records: list[Record], baseline: Baseline, models: list[MechanicalModel]) -> tuple[Candidate, ...]:
    """Linear models other than the best one, with the first state of every record; those that are much like it are left
    out."""

    def unlike(model: MechanicalModel) -> bool:
        pairs = [(np.diag(getattr(m, n)) for m in (model, baseline.model)) for n in ("mass", "stiffness")]
        return any(np.any(np.maximum(a, b) > MUCH_LIKE * np.minimum(a, b)) for a, b in pairs)

    entries_of = baseline.setup.entries_of
    others = [one for one in models if unlike(one)]
    return tuple(_begun(one, entries_of(one.mass, one.damping, one.stiffness), records) for one in others)


def _begun(model: MechanicalModel, entries: np.ndarray, records: list[Record]) -> Candidate:
    """A model with the first states by which its free run comes nearest to the records."""
    states = []
    for record in records:
        more = {"hold": record.hold, "scheduling": record.scheduling}
        x0, _ = initial_state(model, record.u, record.y, record.sampling_time, **more)
        states.append(x0)
    return Candidate(entries, tuple(states))


def _setup(model: MechanicalModel, scaling: Scaling, structure: Structure, record: Record, held=None) -> Setup:
    return Setup(
        model.drive,
        model.measured,
        scaling,
        structure,
        np.zeros(0, bool) if held is None else np.asarray(held, bool),
        record.input_names,
        record.output_names,
        hidden=model.hidden,
    )
