"""From records to a model with coordinates that no output measures."""

from dataclasses import replace

import numpy as np

from ...mechanics.model import MechanicalModel
from ...numerics.progress import AbstractProgress
from ...records import Record
from ..hidden import Connections
from ..initialization.start import filled
from ..result import Identification
from ..setup.options import drive_of
from ..setup.preparation import prepare, scaling_of
from ..validation.reach import check_reach
from .canonical import canonical
from .request import HiddenRequest, example
from .start import realizations_of
from .structured import structured
from .structured_starts import consistent_models
from .task import Task, collocated, run_of


def identify_hidden(
    records: list[Record],
    held_out: list[Record],
    request: HiddenRequest,
    notes: list[str],
    progress: AbstractProgress,
) -> Identification:
    """A model with hidden coordinates: subspace realisation of higher order, closed form, then prediction error.

    **Arguments:** `records`, `held_out`: checked; `request`; `notes`: warnings so far; `progress`.

    **Returns:** an `Identification` with `hidden` evidence.

    **Raises:** `ValueError` where the request does not fit the record; `ComputationError` where no model is found.
    """
    task, found, connections = _begun(records, held_out, request, progress)
    if connections is None:
        return canonical(task, found, tuple(notes))
    return structured(task, found, connections, tuple(notes))


def other_models(records: list[Record], options: dict, progress: AbstractProgress) -> list[MechanicalModel]:
    """Models of a structure with hidden coordinates that some realisation of the records agrees with, not refined: what
    the structure lacks has bent them less than the one whose free run is nearest.

    **Arguments:** `records`; `options`: of `identify`, connections among them; `progress`.

    **Raises:** as `identify_hidden`.
    """
    request = HiddenRequest.of(options).named(options["hidden"], records[0].output_names)
    task, found, connections = _begun(records, [], request, progress)
    return [] if connections is None else consistent_models(task, found, connections)


def _begun(records: list[Record], held_out: list[Record], request: HiddenRequest, progress: AbstractProgress):
    """The task, realisations, and connections, None for the canonical form."""
    first = records[0]
    drive = drive_of(first, request.excitation, request.input_map, request.relative, request.names)
    connections = None
    if request.structure is not None:
        connections = Connections(request.structure, first.output_names + request.names)
    elif not collocated(drive, first.outputs):
        raise ValueError(
            f"hidden={len(request.names)} without a structure needs a force on every measured coordinate and on no "
            f"other; say how the coordinates are connected, such as structure='{example(first, request.names)}'."
        )
    progress.stage("preparing")
    scaling = scaling_of(records)
    signals = [prepare(r, scaling) for r in records]
    complete = filled(records, scaling, None) if any(r.has_missing for r in records) else signals
    check_reach(complete, first.input_names, first.output_names)
    middle = float(np.exp(np.mean(np.log(np.asarray(scaling.coordinates)))))
    task = Task(records, records, held_out, signals, complete, drive, scaling, request, progress).with_units(middle)
    found = realizations_of(task)
    if complete is not signals:
        runs = [run_of(found[0][0], task, s) for s in complete]
        task = replace(task, complete=filled(records, scaling, runs))
        found = realizations_of(task)
    return task, found, connections
