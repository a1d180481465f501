"""Whether a model could be a machine: what its laws do with energy, and whether its matrices are passive."""

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import AbstractForceEffect, AbstractMatrixEffect
from ...mechanics.energy import EnergyBalance, energy_balance
from ...mechanics.model import MechanicalModel
from ...mechanics.passivity import violations
from ...mechanics.runs.extended import changed_plant
from ...mechanics.systems.drives import BaseDisplacement
from ...mechanics.systems.step_rows import Plant
from ...numerics.outcomes import ComputationError
from ...records import Record
from ..words.titles import title_of

UNBALANCED = 0.01
"""Share of all energy that may be missing in the balance before it is said."""


def energy_of(model: MechanicalModel, record: Record, x0: Float[np.ndarray, " states"]) -> EnergyBalance | None:
    """Where the work of a record's inputs goes in a model with laws; None without laws, where D takes it all, and under
    a measured base displacement, whose work no record shows.

    **Arguments:** `model`; `record`; `x0`: (q, q̇) at its first sample.
    """
    laws = any(isinstance(term.effect, AbstractForceEffect | AbstractMatrixEffect) for term in model.effects)
    if not laws or isinstance(model.drive, BaseDisplacement):
        return None
    try:
        return energy_balance(model, record, x0=x0)
    except ComputationError:
        return None


def unphysical(model: MechanicalModel, balance: EnergyBalance | None) -> tuple[str, ...]:
    """A sentence for everything in a model that no passive machine does.

    What of M, D, K is not symmetric is a finding of its own, gyroscopic or circulatory coupling.
    """
    names = model.coordinates
    plant = Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
    changed = [term for term in model.effects if isinstance(term.effect, AbstractMatrixEffect)]
    plant = changed_plant(plant, tuple(changed)) if changed else plant
    told = [
        f"{one.matrix.capitalize()} is negative where mostly {_mover(one.at[0], names)} moves: {NEGATIVE[one.matrix]}"
        for one in violations(plant.mass, plant.damping, plant.stiffness)
        if one.kind == "negative"
    ]
    for law in () if balance is None else balance.laws:
        if law.creates:
            told.append(
                f"{title_of(law.effect, law.place, names).capitalize()} creates energy: over {law.cycles} cycles it "
                f"gives {-law.over_cycles:.3g} {balance.unit}".rstrip()
                + ". No passive part does: a drive or a controller acts there, or the cause is another."
            )
    if balance is not None and balance.error > UNBALANCED:
        told.append(
            f"The energy balance of the extended model misses {100 * balance.error:.2g} % of what came in: its laws "
            "change faster than the steps of the simulation. Record at a higher rate."
        )
    return tuple(told)


def _mover(coordinate: int, names: tuple[str, ...]) -> str:
    return names[coordinate] if coordinate < len(names) else "an added coordinate"


NEGATIVE = {
    "mass": "no body has a negative mass.",
    "damping": "motion gains energy there by itself, as in chatter or flutter, or the cause is another.",
    "stiffness": "without its laws the model is unstable there.",
}
