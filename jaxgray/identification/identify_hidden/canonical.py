"""The canonical form of inputs and outputs: every hidden coordinate an oscillator of unit mass."""

import numpy as np
from jaxtyping import Bool

from ...numerics.outcomes import RESULTS, ComputationError
from ..hidden import (
    HiddenEvidence,
    HigherOrder,
    canonical_count,
    canonical_gauge,
    canonical_structure,
    closed_form,
    physical_canonical,
)
from ..initialization.start import Start
from ..refinement.refine import Refinement
from ..result import Identification
from ..setup.structure import Structure
from .request import example
from .start import MOST_REALIZATIONS
from .task import Task, assessed, in_windows, merit, model_of, refined_from, start_of


def canonical(task: Task, found, notes: tuple[str, ...]) -> Identification:
    """The canonical form of the record's inputs and outputs."""
    task, start, refinement, form, held = canonical_fit(task, found)
    model = model_of(task, refinement, start, {})
    p, n = task.outputs, len(task.request.names)
    gauge = dict(zip(("mass", "damping", "stiffness"), canonical_gauge(p, n)))
    none = {name: np.zeros_like(X) for name, X in gauge.items()}
    count = canonical_count(p, n)
    evidence = HiddenEvidence(task.request.names, True, gauge, none, (), count, count, (), ())
    return assessed(task, model, start, refinement, form, held, notes, evidence)


def canonical_fit(task: Task, found) -> tuple[Task, Start, Refinement | None, Structure, Bool[np.ndarray, " entries"]]:
    """Closed form and refinement; the task with the units of the hidden coordinates that were chosen.

    **Raises:** `ComputationError` where no realisation has a canonical form.
    """
    p, n = task.outputs, len(task.request.names)
    if task.request.fix:
        raise ValueError(
            f"fix={task.request.fix!r} needs a structure: without one, entries are those of a canonical form; give "
            f"structure='{example(task.records[0], task.request.names)}' or the like."
        )
    starts, failure = [], None
    for model, tau, rows in found[: 2 * MOST_REALIZATIONS]:
        try:
            starts.append(_canonical_start(task, model, tau, rows))
        except (ComputationError, np.linalg.LinAlgError) as error:
            failure = error
    if not starts:
        detail = getattr(failure, "detail", None) or str(failure)
        raise ComputationError(RESULTS.unstable_start, stage="closed form", detail=detail)
    task, start = max(starts, key=lambda pair: merit(*pair))
    form = canonical_structure(*(np.asarray(X) for X in start.matrices), n)
    held = np.zeros(canonical_count(p, n), bool)
    if not task.request.refine:
        return task, start, None, form, held
    task = in_windows(task, start)
    task.progress.stage("refining")
    refinement = refined_from(task, start, form, held)
    return task, start, refinement, form, held


def _canonical_start(task: Task, model: HigherOrder, tau: float, rows: int) -> tuple[Task, Start]:
    p = task.outputs
    E = np.asarray(task.setting.drive.input_map)[:p]
    form = closed_form(model.A, model.B @ np.linalg.pinv(E), model.C)
    mean = np.trace(form.mass) / p
    if not mean > 0:
        raise ComputationError(RESULTS.semidefinite_solver, stage="closed form", detail="the mass is negative")
    # A unit mass of the record's units, counted so that it is as large as the measured ones.
    size = np.sqrt(mean)
    M, D, K = physical_canonical(form)
    units = np.concatenate([np.ones(p), np.full(form.hidden, size)])
    matrices = tuple(X * units[:, None] * units[None, :] for X in (M, D, K))
    task = task.with_units(float(task.scaling.sampling_time) * size)
    return task, start_of(task, matrices, model, tau, rows, "subspace")
