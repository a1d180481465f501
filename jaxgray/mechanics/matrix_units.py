"""Units of mass, damping and stiffness, composed as text from the units of the channels."""

import numpy as np

from .model import MechanicalModel
from .systems.drives import Force
from .systems.units import as_factor, displacement_unit


def _quotient(over: str, under: str) -> str:
    return f"{over}/{as_factor(under)}"


def matrix_units(model: MechanicalModel) -> dict[str, list[list[str]]] | None:
    """Unit of every entry of mass, damping and stiffness, such as `N s^2/m`.

    Row r is a force on coordinate r: the unit of an input that acts there, or what makes the same work.

    **Arguments:** `model`.

    **Returns:** one text per entry; None where a unit is missing, the base is driven, which leaves the scale of the
    matrices open, or hidden coordinates may be of any of several units.
    """
    if not isinstance(model.drive, Force) or not all(model.input_units) or not all(model.output_units):
        return None
    place = [displacement_unit(unit, kind) for unit, kind in zip(model.output_units, model.measured)]
    if model.hidden and len(set(place)) != 1:
        return None
    # A hidden coordinate moves as the measured ones do.
    place += place[:1] * len(model.hidden)
    E = np.asarray(model.drive.input_map)
    force: list[str | None] = [None] * model.dofs
    for row, column in np.argwhere(E != 0):
        force[row] = force[row] or model.input_units[column]
    known = next(k for k, unit in enumerate(force) if unit is not None)

    def stiffness(r: int, c: int) -> tuple[str, str]:
        """Numerator and denominator; the matrix is symmetric, so that either row may give the force."""
        for row, column in ((r, c), (c, r)):
            if force[row] is not None:
                return force[row], place[column]
        if place[r] == place[known]:
            return force[known], place[c]
        return f"{force[known]} {place[known]}", f"{as_factor(place[r])} {as_factor(place[c])}"

    powers = {"mass": " s^2", "damping": " s", "stiffness": ""}
    return {
        name: [
            [_quotient(stiffness(r, c)[0] + power, stiffness(r, c)[1]) for c in range(model.dofs)]
            for r in range(model.dofs)
        ]
        for name, power in powers.items()
    }
