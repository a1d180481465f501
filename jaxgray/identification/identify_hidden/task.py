"""What stays fixed while a model with hidden coordinates is looked for, and the stages that every form of it shares."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import numpy as np

from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import AbstractDrive, Force
from ...mechanics.systems.statespace import StateSpace, sampled
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress
from ...records import Record
from ..hidden import HigherOrder, canonical_gauge
from ..initialization.guard import lost
from ..initialization.rigid import DRIFT, TURNED, phases, rigid_modes, windows
from ..initialization.start import Start, model_run, total_deviation
from ..refinement.refine import Refinement, refine, start_kept
from ..result import Identification, assess
from ..setup.prediction import Batch, Setting, best_run
from ..setup.preparation import Signals, prepare
from ..setup.structure import Structure
from ..setup.units import Scaling
from ..subspace.grid import score
from ..validation.structure_test import coloured_cost
from .elements import at_zero
from .request import HiddenRequest


@dataclass(frozen=True)
class Task:
    """Records (`whole`, or pieces of them) and everything that stays fixed while models are looked for; scaled."""

    whole: list[Record]
    records: list[Record]
    held_out: list[Record]
    signals: list[Signals]
    complete: list[Signals]
    drive: AbstractDrive
    scaling: Scaling
    request: HiddenRequest
    progress: AbstractProgress

    @property
    def outputs(self) -> int:
        return self.records[0].outputs

    @property
    def dofs(self) -> int:
        return self.outputs + len(self.request.names)

    def with_units(self, size: float) -> "Task":
        """The same where hidden coordinates are counted in other units."""
        own = np.asarray(self.scaling.coordinates)[: self.outputs]
        coordinates = np.concatenate([own, np.full(len(self.request.names), size)])
        return replace(self, scaling=eqx.tree_at(lambda s: s.coordinates, self.scaling, coordinates))

    @property
    def setting(self) -> Setting:
        drive = jax.device_get(self.drive).scaled(
            np.asarray(self.scaling.coordinates), self.scaling.inputs, self.scaling.sampling_time
        )
        return Setting(drive, self.records[0].measured, self.records[0].hold, len(self.request.names))


def collocated(drive: AbstractDrive, outputs: int) -> bool:
    """Whether forces act on every measured coordinate and on no hidden one."""
    if not isinstance(drive, Force):
        return False
    E = np.asarray(drive.input_map)
    return bool(np.linalg.matrix_rank(E[:outputs]) == outputs and not np.any(E[outputs:]))


def run_of(model: HigherOrder, task: Task, signals: Signals) -> np.ndarray:
    """Free run of a realisation, scaled."""
    system = sampled(StateSpace(model.A, model.B, model.Cy, model.Dy), 1.0, task.records[0].hold)
    return np.asarray(best_run(system, signals)[0])


def start_of(task: Task, matrices, model: HigherOrder, tau: float, rows: int, method: str) -> Start:
    deviation = total_deviation(matrices, task.setting, task.complete)
    return Start(matrices, deviation, method, tau, rows, model.singular_values, None)


def merit(task: Task, start: Start) -> float:
    """Likelihood of a start's free run, over pieces of the record where it drifts."""
    pieces = in_windows(task, start)
    if pieces.records is task.whole:
        return start.score
    return float(score(total_deviation(start.matrices, pieces.setting, pieces.signals)))


def in_windows(task: Task, start: Start) -> Task:
    """The task on pieces of the records where a body free to move drifts in the free run over the whole."""
    longest = max(r.samples for r in task.records)
    if task.records is not task.whole or not rigid_modes(start, longest) or not np.max(start.deviation) > DRIFT:
        return task
    pieces = windows(task.records)
    return replace(task, records=pieces, signals=[prepare(r, task.scaling) for r in pieces])


def cost_in_colour(task: Task, end: Refinement) -> float:
    """−2 ln L of the free runs of a refinement under the colour that their residual has, output by output."""
    matrices, total = (end.mass, end.damping, end.stiffness), 0.0
    runs = [np.asarray(model_run(matrices, task.setting, s)[0]) for s in task.signals]
    for k in range(task.outputs):
        e = [(np.asarray(s.y) - run)[np.asarray(s.kept)[:, k] > 0, k] for s, run in zip(task.signals, runs)]
        total += coloured_cost(np.concatenate(e))
    return total if np.isfinite(total) else np.inf


def refined_from(task: Task, start: Start, form: Structure, held) -> Refinement:
    """Refinement by prediction error, kept only where it is no worse on held-out records."""
    batch, setting = Batch.of(task.signals), task.setting
    longest = max(r.samples for r in task.records)
    offset = bool(phases(start.matrices, longest)[0] > TURNED)
    options = {"structure": form, "offset": offset}
    innovations = task.request.noise == "innovations"

    def refined(near: bool) -> Refinement:
        return refine(
            start.matrices,
            batch,
            setting,
            fixed=held if np.any(held) else None,
            innovations=innovations,
            deviation=np.asarray(start.deviation),
            near=near,
            **options,
        )

    refinement = None
    if start.serves and not innovations:
        # Next to the optimum the steps over the cone alone are quicker, and exact.
        try:
            refinement = refined(near=True)
        except ComputationError:
            refinement = None
    if refinement is None or refinement.result != RESULTS.successful:
        other = refined(near=False)
        refinement = other if refinement is None or other.cost < refinement.cost else refinement
    end = refinement.mass, refinement.damping, refinement.stiffness
    held_out = [prepare(r, task.scaling) for r in task.held_out]
    if task.request.noise == "output-error" and lost(end, start.matrices, setting, held_out):
        return start_kept(start.matrices, batch, setting, prior=None, **options)
    return refinement


def model_of(task: Task, refinement, start, known) -> MechanicalModel:
    if isinstance(refinement, Refinement):
        scaled = refinement.mass, refinement.damping, refinement.stiffness
    else:
        scaled = start.matrices
    matrices = [np.array(X) for X in task.scaling.matrices_out(*(np.asarray(X) for X in jax.device_get(scaled)))]
    first = task.records[0]
    for (owner, k), value in known.items():
        if owner == "mass":
            matrices[0][k, k] = value
    if task.request.structure is None:
        p = task.outputs
        for matrix, own in zip(matrices, canonical_gauge(p, len(task.request.names))):
            matrix[own] = 0.0
        matrices[0][range(p, task.dofs), range(p, task.dofs)] = 1.0
    return MechanicalModel(
        *matrices,
        drive=task.drive,
        measured=first.measured,
        input_names=first.input_names,
        output_names=first.output_names,
        input_units=first.input_units,
        output_units=first.output_units,
        hidden=task.request.names,
    )


def assessed(task: Task, model, start, refinement, form, held, notes, evidence) -> Identification:
    extra = ()
    if evidence.rank < evidence.parameters or evidence.alternatives:
        extra = tuple(evidence.sentences())
    extra += tuple(
        f"{name} ends at zero, the edge of what is physical; its error bar is one-sided."
        for name in at_zero(model, task.request.structure)
    )
    result = assess(
        model,
        task.records,
        task.held_out,
        task.setting,
        task.scaling,
        task.signals,
        Batch.of(task.signals),
        form,
        held,
        start,
        refinement,
        notes + extra,
        evidence,
    )
    return result if task.records is task.whole else result.judged_on(task.whole)
