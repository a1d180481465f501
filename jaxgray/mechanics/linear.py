"""What of a model with effects is linear."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import MODEL_ERRORS
from .effects.base import AbstractMatrixEffect, Term
from .model import MechanicalModel
from .runs.extended import Plant, changed_plant
from .systems.abstract_model import effect_names
from .systems.statespace import StateSpace, hold_matrices, sampled


def corrected(model: MechanicalModel) -> MechanicalModel:
    """The same model with errors of its entries put into mass, damping and stiffness; other effects stay effects.

    **Arguments:** `model`.
    """
    errors = tuple(term for term in model.effects if term.effect in MODEL_ERRORS)
    if not errors:
        return model
    plant = changed_plant(_plant(model), errors)
    rest = tuple(term for term in model.effects if term.effect not in MODEL_ERRORS)
    changed = model.with_matrices(plant.mass, plant.damping, plant.stiffness)
    return dataclasses.replace(changed, effects=rest)


def linear_plant(model: MechanicalModel, *, linear: bool, known: tuple[str, ...] = ()) -> tuple[Plant, list[Term]]:
    """Matrices with every effect that is linear in them, be it with one more coordinate, and the effects that are not.

    **Arguments:** `model`; `linear`: whether effects that are not linear are left out; `known`: ids of those that the
    caller takes over.

    **Returns:** the `Plant`, its matrices perhaps not symmetric, and the effects among `known`.

    **Raises:** `ValueError` for other effects, unless they are left out.
    """
    matrix = tuple(term for term in model.effects if isinstance(term.effect, AbstractMatrixEffect))
    rest = [term for term in model.effects if not isinstance(term.effect, AbstractMatrixEffect)]
    taken = [term for term in rest if term.effect.id in known]
    if len(taken) < len(rest) and not linear:
        other = dataclasses.replace(model, effects=tuple(term for term in rest if term.effect.id not in known))
        raise ValueError(
            f"the model has effects that this format does not know ({effect_names(other)}); say linear (--linear) to "
            "leave them out, or write JSON."
        )
    return changed_plant(_plant(model), matrix), [] if linear else taken


def continuous_system(plant: Plant, outputs: int, time_unit: float = 1.0) -> StateSpace:
    """First-order form with the state (q, T q̇); of a measured base displacement (q, T (q̇ − M⁻¹ D r x)).

    **Arguments:** `plant`; `outputs`: how many of its outputs are those of the model; `time_unit` (T) [s], default 1.
    """
    drive = plant.drive
    system = drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, time_unit)
    return StateSpace(system.A, system.B, system.C[:outputs], system.D[:outputs])


def sampled_system(
    plant: Plant, outputs: int, sampling_time: float, hold: str
) -> tuple[StateSpace, Float[Array, "states inputs"]]:
    """The linear system at its sampling instants, and what its state holds: x = (q, q̇) − H u.

    Computed with time in units of the sampling time, since q and q̇ may be of very different size.

    **Arguments:** `plant`; `outputs`: how many coordinates are measured; `sampling_time` [s]; `hold`: "zero" or
    "linear".

    **Returns:** the sampled `StateSpace`, and H.
    """
    dofs = plant.mass.shape[0]
    continuous = continuous_system(plant, outputs, sampling_time)
    still = ("velocity",) * dofs
    speed = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, still, sampling_time)
    held = hold_matrices(continuous.A, continuous.B, 1.0, hold)[2]
    held = held + jnp.concatenate([jnp.zeros_like(speed.D), speed.D * sampling_time])
    system = sampled(continuous, 1.0, hold)
    scale = jnp.concatenate([jnp.ones(dofs), jnp.full(dofs, 1.0 / sampling_time)])
    A, B, C = scale[:, None] * system.A / scale, scale[:, None] * system.B, system.C / scale
    return StateSpace(A, B, C, system.D, sampling_time), scale[:, None] * held


def _plant(model: MechanicalModel) -> Plant:
    return Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
