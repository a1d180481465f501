"""Forces that no input holds: a hand on the pendulum, a knock on the table.

No law explains them, and one of them outweighs all the rest of a record. They show as what the force equation leaves:
brief, far beyond what it leaves elsewhere, and more than the inputs ever apply.
"""

from dataclasses import dataclass

import numpy as np

from ...mechanics.model import MechanicalModel
from ...records import Record
from .. import settings
from .regression import Equation, ForceFit
from .rows import Series

PART = 2.0
"""Down to so many of them what is left belongs to the push."""


@dataclass(frozen=True)
class BriefForce:
    """A force on a coordinate that is not among the inputs: `record` (position), `first` and `last` sample, largest
    `force`, NaN where only the acceleration speaks for it, and the largest that was `applied`."""

    record: int
    first: int
    last: int
    dof: int
    force: float
    applied: float


def brief_forces_of(fit: ForceFit, series: list[Series], input_map: np.ndarray) -> tuple[BriefForce, ...]:
    """Pushes that a fit of the force equation leaves.

    **Arguments:** `fit`; `series`: records in its band, with their rows at rest; `input_map` (E).
    """
    equation = Equation(series, input_map)
    left = [np.abs(e) for e in equation.residual(fit)]
    usual = 1.4826 * np.median(np.concatenate(left), axis=0)
    applied = float(np.max([np.abs(force).max(initial=0.0) for force in equation.force]))
    return _brief(left, PART * usual, np.maximum(settings.PUSH_SIZE * usual, applied), series, left, applied)


def acceleration_outliers(series: list[Series]) -> tuple[BriefForce, ...]:
    """Accelerations apart from all others: what may be pushes that have spoilt the fit in which they would show.

    **Arguments:** as of `brief_forces_of`.
    """
    sizes = [np.abs(one.a[one.rows]) for one in series]
    ranked = np.sort(np.concatenate(sizes), axis=0)
    top = ranked[-max(int(settings.MAX_PUSH_SHARE * len(ranked)), 1) - 1 :]
    ratios = top[1:] / np.maximum(top[:-1], 1e-300)
    k, dofs = np.argmax(ratios, axis=0), np.arange(ranked.shape[1])
    apart = np.where(ratios[k, dofs] > settings.PUSH_GAP, np.sqrt(top[k, dofs] * top[k + 1, dofs]), np.inf)
    return _brief(sizes, apart, apart, series, [np.full_like(x, np.nan) for x in sizes], np.nan)


def _brief(sizes, near, far, series: list[Series], forces, applied: float) -> tuple[BriefForce, ...]:
    """Stretches of rows in which a size stays above `near` and passes `far`, none where they are too much of the
    records."""
    found, on = [], []
    for record, (size, one) in enumerate(zip(sizes, series)):
        step, samples = int(np.min(np.diff(one.rows), initial=len(one.q))), len(one.q)
        on.append(np.zeros(samples, bool))
        for dof in range(size.shape[1]):
            above = np.flatnonzero(size[:, dof] > near[dof])
            # Rows that are missing end a stretch.
            for run in np.split(above, np.flatnonzero(np.diff(one.rows[above]) > step) + 1):
                if np.any(size[run, dof] > far[dof]):
                    # It began after the row before, and ended before the next.
                    first, last = max(one.rows[run[0]] - step, 0), min(one.rows[run[-1]] + step, samples - 1)
                    force = float(forces[record][run, dof].max())
                    found.append(BriefForce(record, int(first), int(last), dof, force, applied))
                    on[record][first : last + 1] = True
    share = np.mean(np.concatenate(on)) if on else 0.0
    return tuple(found) if share <= settings.MAX_PUSH_SHARE else ()


def samples_of(brief_forces: tuple[BriefForce, ...], records: list[Record]) -> list[np.ndarray]:
    """Which samples of every record a push acts on."""
    masks = [np.zeros(record.samples, bool) for record in records]
    for push in brief_forces:
        masks[push.record][push.first : push.last + 1] = True
    return masks


def warnings_of(brief_forces: tuple[BriefForce, ...], records: list[Record], model: MechanicalModel) -> tuple[str, ...]:
    """What is said of pushes; `records`: those of the fit and those held out."""
    result = []
    for push in brief_forces:
        # Forces and torques together have no unit in common.
        units = set(model.input_units)
        name, unit = model.output_names[push.dof], units.pop() if len(units) == 1 else ""
        start, end = (records[push.record].time[k] for k in (push.first, push.last))
        unit = f" {unit}" if unit else ""
        result.append(
            f"From {start:.4g} to {end:.4g} s a force of up to {push.force:.2g}{unit} acts at {name} that is not among "
            f"the inputs, which never apply more than {push.applied:.2g}{unit}: left out of the fit and of all errors."
        )
    return tuple(result)
