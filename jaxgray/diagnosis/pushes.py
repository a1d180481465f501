"""Forces that no input holds: a hand on the pendulum, a knock on the table.

No law explains them, and one of them outweighs all the rest of a record. They show as what the force equation leaves:
brief, far beyond what it leaves elsewhere, and more than the inputs ever apply.
"""

from dataclasses import dataclass

import numpy as np

from ..mechanics.model import MechanicalModel
from ..records import Record
from .force_fit import Equation, ForceFit
from .force_rows import Series

SIZES = 8.0
"""How far a push stands out of what is left elsewhere, in robust standard deviations."""

PART = 2.0
"""Down to so many of them what is left belongs to the push."""

MOST = 0.05
"""Share of the samples above which it is the model that is wrong."""


@dataclass(frozen=True)
class Push:
    """A force on a coordinate that is not among the inputs: `record` (position), `first` and `last` sample, largest
    `force`, and the largest that was `applied`."""

    record: int
    first: int
    last: int
    dof: int
    force: float
    applied: float


def pushes_of(fit: ForceFit, series: list[Series], input_map: np.ndarray) -> tuple[Push, ...]:
    """Pushes that a fit of the force equation leaves.

    **Arguments:** `fit`; `series`: records in its band, with their rows at rest; `input_map` (E).
    """
    equation = Equation(series, input_map)
    left = [np.abs(e) for e in equation.residual(fit)]
    usual = 1.4826 * np.median(np.concatenate(left), axis=0)
    applied = float(np.max([np.abs(force).max(initial=0.0) for force in equation.force]))
    found = []
    for record, (e, one) in enumerate(zip(left, series)):
        for dof in range(equation.dofs):
            far = (e[:, dof] > SIZES * usual[dof]) & (e[:, dof] > applied)
            near = np.flatnonzero(e[:, dof] > PART * usual[dof])
            for run in np.split(near, np.flatnonzero(np.diff(near) > 1) + 1):
                if far[run].any():
                    # It began after the row before, and ended before the next.
                    first, last = one.rows[[max(run[0] - 1, 0), min(run[-1] + 1, len(e) - 1)]]
                    found.append(Push(record, int(first), int(last), dof, float(e[run, dof].max()), applied))
    lasts = sum(push.last - push.first + 1 for push in found)
    return tuple(found) if lasts <= MOST * sum(len(one.q) for one in series) else ()


def samples_of(pushes: tuple[Push, ...], records: list[Record]) -> list[np.ndarray]:
    """Which samples of every record a push acts on."""
    masks = [np.zeros(record.samples, bool) for record in records]
    for push in pushes:
        masks[push.record][push.first : push.last + 1] = True
    return masks


def warnings_of(pushes: tuple[Push, ...], records: list[Record], model: MechanicalModel) -> tuple[str, ...]:
    """What is said of pushes; `records`: those of the fit and those held out."""
    result = []
    for push in pushes:
        name, unit = model.output_names[push.dof], model.input_units[0] if model.input_units else ""
        start, end = (records[push.record].time[k] for k in (push.first, push.last))
        unit = f" {unit}" if unit else ""
        result.append(
            f"From {start:.4g} to {end:.4g} s a force of up to {push.force:.2g}{unit} acts at {name} that is not among "
            f"the inputs, which never apply more than {push.applied:.2g}{unit}: left out of the fit and of all errors."
        )
    return tuple(result)
