"""Subspace realisations of the order that the hidden coordinates ask for."""

import equinox as eqx
import numpy as np

from ...numerics.outcomes import ComputationError
from ..hidden import MEMORIES, HigherOrder, block_row_choices, high_passed, in_units, realizations
from ..initialization.rigid import DRIFT
from ..setup.options import pick
from ..setup.preparation import Signals
from ..subspace.grid import default_time_constants
from ..subspace.projection import WEIGHTS
from ..subspace.realization import MAPS
from .task import Task

MOST_REALIZATIONS = 4
"""Realisations, the best first, that are turned into starting models."""


def realizations_of(task: Task) -> list[tuple[HigherOrder, float, int]]:
    """Realisations with their time constant and block rows, the best first; where their free runs drift, by turns with
    those of high-passed records."""
    task.progress.stage("subspace start")
    models = _realized(task, task.complete)
    if not np.any(models[0][0].deviation > DRIFT):
        return models
    families = [models, *high_passed_realizations(task)]
    # By turns from every family: their free runs are no measure of one another.
    return [family[k] for k in range(MOST_REALIZATIONS) for family in families if k < len(family)]


def high_passed_realizations(task: Task) -> list[list[tuple[HigherOrder, float, int]]]:
    """Realisations of high-passed records, a list for every memory of the filter: what acts slowly, such as dry
    friction, bends them little."""
    families = []
    for memory in MEMORIES:
        parts = [high_passed(s, memory) for s in task.complete]
        # Several records in the units of the longest.
        _, inputs, outputs = max(parts, key=lambda part: part[0].samples)
        signals = [
            eqx.tree_at(lambda s: (s.u, s.y), s, (s.u * own_u / inputs, s.y * own_y / outputs))
            for s, own_u, own_y in parts
        ]
        try:
            families.append([(in_units(m, inputs, outputs), tau, i) for m, tau, i in _realized(task, signals)])
        except ComputationError:
            continue
    return families


def _realized(task: Task, signals: list[Signals]) -> list[tuple[HigherOrder, float, int]]:
    request, record = task.request, max(task.records, key=lambda r: r.samples)
    order = 2 * task.dofs
    most = max(3, (record.samples // 3) // (2 * (record.inputs + record.outputs) + 2))
    rows = block_row_choices(record.outputs, order, most)
    if request.block_rows is not None:
        rows = tuple(int(i) for i in np.unique(np.atleast_1d(request.block_rows)))
    if (min(rows) - 1) * record.outputs < order:
        raise ValueError(
            f"block_rows={min(rows)} are too few for {order} states and {record.outputs} outputs; give at least "
            f"{-(-order // record.outputs) + 1}, or a longer record."
        )
    taus = default_time_constants(record) if request.time_constants is None else np.atleast_1d(request.time_constants)
    return realizations(
        signals,
        task.setting.drive,
        record.measured,
        record.hold,
        task.scaling.sampling_time,
        order,
        time_constants=np.asarray(taus, float),
        block_rows=rows,
        weight=pick("weight", request.weight, WEIGHTS),
        map=pick("map", request.map, MAPS),
    )
