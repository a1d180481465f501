"""The state space of a model as NumPy arrays, for the formats that hold one."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...mechanics.linear import continuous_system, corrected, linear_plant, sampled_system
from ...mechanics.model import MechanicalModel


@dataclass(frozen=True)
class Arrays:
    """`A`, `B`, `C`, `D`; `H`: what the state x = (q, q̇) − H u holds of the input; `states`: names."""

    A: Float[np.ndarray, "states states"]
    B: Float[np.ndarray, "states inputs"]
    C: Float[np.ndarray, "outputs states"]
    D: Float[np.ndarray, "outputs inputs"]
    H: Float[np.ndarray, "states inputs"] | None
    states: tuple[str, ...]


def arrays_of(model: MechanicalModel, sampling_time: float | None, hold: str, linear: bool) -> Arrays:
    """The linear model in continuous time, or sampled where there is a sampling time.

    **Arguments:** `model`; `sampling_time` [s], None for continuous time; `hold` of the sampled system; `linear`:
    whether effects that are not linear are left out.

    **Raises:** `ValueError` for such effects, unless they are left out.
    """
    plant, _ = linear_plant(model, linear=linear)
    if sampling_time is None:
        system, H = continuous_system(plant, model.outputs), None
    else:
        system, H = sampled_system(plant, model.outputs, sampling_time, hold)
        H = np.asarray(H)
    names = coordinate_names(model, plant.mass.shape[0])
    states = (*names, *(f"d({name})/dt" for name in names))
    return Arrays(*(np.asarray(X) for X in (system.A, system.B, system.C, system.D)), H, states)


def coordinate_names(model: MechanicalModel, dofs: int) -> tuple[str, ...]:
    """Coordinates bear the names of their outputs, hidden ones their own; those that effects add are counted."""
    return *model.coordinates, *(f"unmeasured{k + 1}" for k in range(dofs - model.dofs))


def linear_part(model: MechanicalModel) -> MechanicalModel:
    """Mass, damping and stiffness, errors of their entries put in, and no effect."""
    return dataclasses.replace(corrected(model), effects=())
