"""Simulation of a linear mechanical system extended by effects.

The linear part is exact at every step; effects that are forces enter step by step (`trajectory`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.namespace import namespace
from ...numerics.responses.lifting import respond
from ..effects.base import (
    AbstractEffect,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Place,
    Term,
)
from ..systems.drives import AbstractDrive, Force
from ..systems.statespace import hold_matrices
from ..systems.step_rows import Plant, local_rows
from .trajectory import Sampler, Series, Slots, direct, first_state, trajectory


def with_coordinates(drive: AbstractDrive, dofs: int) -> AbstractDrive:
    """The drive of a model with more coordinates: no force there, carried along by a moving base."""
    name = "input_map" if isinstance(drive, Force) else "direction"
    matrix = getattr(drive, name)
    fill = 0.0 if isinstance(drive, Force) else 1.0
    padding = np.full((dofs - matrix.shape[0], matrix.shape[1]), fill)
    return eqx.tree_at(lambda d: getattr(d, name), drive, namespace(matrix).concatenate([matrix, padding]))


def input_matrix_of(drive: AbstractDrive) -> Float[Array, "dofs inputs"]:
    """Where the inputs act."""
    return drive.input_map if isinstance(drive, Force) else drive.direction


def plant_run(
    plant: Plant,
    x0: Float[Array, " states"],
    start: Float[Array, "samples inputs"],
    end: Float[Array, "samples inputs"],
    slots: Slots | None,
    sampling_time: float,
    *,
    laws: tuple[AbstractForceEffect, ...] = (),
    scheduling: Float[Array, " samples"] | None = None,
    substeps: int | Array = 1,
    seen: Float[Array, "samples inputs"] | None = None,
) -> Float[Array, "samples outputs"]:
    """Outputs of the plant with forces added.

    **Arguments:** `plant`; `x0`: (q, q̇) at the first sample; `start`, `end`: input at the beginning and end of every
    sample; `slots`: the forces, None without; `sampling_time` [s]; `laws`: table that `slots.law` points into;
    `scheduling`: channel some laws read; `substeps`: steps per sample; `seen`: input at the samples, where
    accelerations take it directly, None where that is `start`.

    **Returns:** the outputs, one row a sample.
    """
    if slots is None:
        system, (Ad, B, first, both) = _linear(plant, x0, start, end, sampling_time)
        feed = jnp.concatenate([system.D, jnp.zeros_like(system.D)], axis=1)
        y = respond(Ad, B, system.C, feed, both, first)
        return y if seen is None else y + (seen - start) @ system.D.T
    x, f, h = _forced(plant, x0, start, end, slots, sampling_time, laws, scheduling, substeps)
    return outputs_of(plant, slots, x, f, start if seen is None else seen, h)


def _linear(plant: Plant, x0, start, end, sampling_time):
    """The plant alone with time in samples; sampled for inputs at start and end, with its first state and these."""
    system = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, sampling_time)
    Ad, B0, B1 = hold_matrices(system.A, system.B, 1.0, "linear")
    first = first_state(plant, x0, start[0], sampling_time)
    return system, (Ad, jnp.concatenate([B0, B1], axis=1), first, jnp.concatenate([start, end], axis=1))


def _forced(plant: Plant, x0, start, end, slots: Slots, sampling_time, laws, scheduling, substeps):
    """States and forces at every sample, and the T [s] of the states."""
    h = sampling_time / substeps
    sampler = Sampler.of(plant, slots, sampling_time, laws, substeps)
    series = Series.of(start, end, scheduling, sampling_time)
    x, _, f = trajectory(sampler, first_state(plant, x0, start[0], h), series)
    return x, f, h


def output_rows(plant: Plant, slots: Slots | None, h) -> Float[Array, "outputs states+inputs+slots"]:
    """Outputs by the states (q, T q̇), inputs and forces of one sample; `h` [s]: the T of the states."""
    system = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, h)
    by_force = [] if slots is None else [direct(plant, slots.arms)]
    return jnp.concatenate([system.C, system.D, *by_force], axis=1)


def outputs_of(plant: Plant, slots: Slots | None, x, f, seen, h) -> Float[Array, "samples outputs"]:
    """Outputs from the states, forces and inputs at every sample, as `output_rows` has them."""
    forces = [] if slots is None else [f]
    return jnp.concatenate([x, seen, *forces], axis=1) @ output_rows(plant, slots, h).T


def plant_motion(
    plant: Plant, x0, start, end, slots: Slots | None, sampling_time, *, laws=(), scheduling=None, substeps=1, seen=None
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples dofs"], Float[Array, "samples dofs"]]:
    """Outputs, and displacements and velocities of all coordinates; arguments as for `plant_run`."""
    more = {"laws": laws, "scheduling": scheduling, "substeps": substeps}
    x, f, h = plant_states(plant, x0, start, end, slots, sampling_time, **more)
    C, D = local_rows(plant, jnp.eye(plant.mass.shape[0]), h)
    return (
        outputs_of(plant, slots, x, f, start if seen is None else seen, h),
        x @ C[0].T + start @ D[0].T,
        x @ C[1].T + start @ D[1].T,
    )


def plant_states(plant: Plant, x0, start, end, slots: Slots | None, sampling_time, *, laws, scheduling, substeps=1):
    """States (q, T q̇) and forces (None without) at every sample, and T [s]; arguments as for `plant_run`."""
    if slots is not None:
        return _forced(plant, x0, start, end, slots, sampling_time, laws, scheduling, substeps)
    _, (Ad, B, first, both) = _linear(plant, x0, start, end, sampling_time)
    x = respond(Ad, B, jnp.eye(len(first)), jnp.zeros((len(first), both.shape[1])), both, first)
    return x, None, sampling_time


def held_input(u: Float[Array, "samples inputs"], hold: str) -> tuple[Array, Array]:
    """Input at the start and at the end of every sample."""
    return u, u if hold == "zero" else namespace(u).concatenate([u[1:], u[-1:]])


def arm_along(effect: AbstractEffect, place: Place, input_map) -> Float[Array, " dofs"]:
    """Unit vector b along which a force acts: a coordinate, the difference of two, or where an input acts."""
    if effect.places == "input":
        return input_map[:, place.first]
    arm = np.zeros(len(input_map))
    arm[place.first] = 1.0
    if place.second >= 0 and effect.places in ("spring", "pair"):
        arm[place.second] = -1.0
    return arm


def arm_of(term: Term, plant: Plant) -> Float[Array, " dofs"]:
    """Unit vector b along which a term's force acts."""
    return arm_along(term.effect, term.place, input_matrix_of(plant.drive))


def slots_of(terms: tuple[Term, ...], plant: Plant, laws: tuple[AbstractForceEffect, ...]) -> Slots | None:
    """The forces among some terms, in their order, elements last, as rows of a table; None where there are none.

    **Arguments:** `terms`; `plant`; `laws`: the table, which must hold every force's law.
    """
    forces = [term for term in terms if isinstance(term.effect, AbstractForceEffect)]
    if not forces:
        return None
    plain = [term for term in forces if not term.effect.element]
    width = max((len(law.parameters) for law in laws), default=0)
    xp = namespace(*(t.values for t in plain), plant.drive.input_map if isinstance(plant.drive, Force) else None)
    values = [xp.pad(xp.asarray(t.values), (0, width - len(t.effect.parameters))) for t in plain]
    channels = [t.place.first if t.effect.places == "input" else -1 for t in plain]
    elements: list[dict] = []
    for term in (t for t in forces if t.effect.element):
        arm, kind = arm_of(term, plant), term.effect.element
        along = (one for one in elements if kind not in one and np.array_equal(one["arm"], arm))
        one = next(along, None) or {"arm": arm}
        elements += [one] if len(one) == 1 else []
        one[kind] = term.place.first
    by_element = [one.get(kind, -1) for kind in ("stiffness", "damping") for one in elements]
    return Slots(
        np.asarray([laws.index(t.effect) for t in plain], dtype=int),
        xp.stack([*(arm_of(t, plant) for t in plain), *(one["arm"] for one in elements)]),
        np.asarray(channels + by_element),
        xp.stack(values) if values else np.zeros((0, width)),
    )


def changed_plant(plant: Plant, terms: tuple[Term, ...]) -> Plant:
    """The plant with every term that changes its matrices."""
    for term in terms:
        if isinstance(term.effect, AbstractMatrixEffect):
            plant = _changed(plant, term)
    return plant


def _changed(plant: Plant, term: Term) -> Plant:
    dofs = plant.mass.shape[0]
    first = jnp.zeros(dofs).at[term.place.first].set(1.0)
    second = jnp.zeros(dofs)
    if term.place.second >= 0:
        second = second.at[term.place.second].set(1.0)
    matrices = term.effect.matrices(term.values, plant.mass, plant.damping, plant.stiffness, first, second)
    if not term.effect.extra:
        return Plant(*matrices, plant.drive, plant.measured)
    return Plant(*matrices, with_coordinates(plant.drive, dofs + 1), (*plant.measured, "displacement"))


def extended_run(
    plant: Plant,
    terms: tuple[Term, ...],
    x0: Float[Array, " states"],
    u: Float[Array, "samples inputs"],
    sampling_time: float,
    hold: str,
    *,
    scheduling: Float[Array, " samples"] | None = None,
    substeps: int = 1,
) -> Float[Array, "samples outputs"]:
    """Free run of a plant with all kinds of effects: inputs first, then the plant and its forces, then outputs.

    **Arguments:** `plant`; `terms`; `x0`: (q, q̇) of the coordinates, one that an effect adds being at rest;
    `u`; `sampling_time` [s]; `hold`; `scheduling`: channel some laws read; `substeps`: steps per sample of the forces.

    **Returns:** the outputs. Traceable and differentiable by every array.
    """
    start, end, seen = changed_input(terms, *held_input(u, hold), u, sampling_time)
    outputs = len(plant.measured)
    plant = changed_plant(plant, terms)
    laws = tuple(dict.fromkeys(t.effect for t in terms if isinstance(t.effect, AbstractForceEffect)))
    state = with_coordinates_at_rest(x0, plant.mass.shape[0])
    y = plant_run(
        plant,
        state,
        start,
        end,
        slots_of(terms, plant, laws),
        sampling_time,
        laws=laws,
        scheduling=scheduling,
        substeps=substeps if laws else 1,
        seen=seen,
    )[:, :outputs]
    for term in terms:
        if isinstance(term.effect, AbstractOutputEffect):
            y = sensed(term, y, u, sampling_time)
    return y


def changed_input(terms: tuple[Term, ...], start, end, seen, sampling_time) -> tuple[Array, Array, Array]:
    """Input at start and end of every sample and at the samples (samples × inputs), after all effects on it."""
    held = tuple(jnp.asarray(x) for x in (start, end, seen))
    on_input = [term for term in terms if isinstance(term.effect, AbstractInputEffect)]
    by_rank = sorted(on_input, key=lambda term: term.effect.rank)
    start, end, seen = _one_by_one(by_rank, held, sampling_time)
    # At the samples a delay knows what was recorded, but not what a limit makes of it within a sample.
    late_first = sorted(on_input, key=lambda term: (term.effect.rank > 0, -term.effect.rank))
    if any(one is not other for one, other in zip(late_first, by_rank)):
        seen = _one_by_one(late_first, held, sampling_time)[2]
    return start, end, seen


def _one_by_one(terms: list[Term], held: tuple[Array, Array, Array], sampling_time) -> tuple[Array, Array, Array]:
    """Inputs at start and end of every sample and at the samples after effects in their order."""
    start, end, seen = held
    for term in terms:
        j, p = term.place.first, term.values
        one = start[:, j], end[:, j]
        seen = seen.at[:, j].set(term.effect.at_samples(p, *one, seen[:, j], sampling_time))
        a, b = term.effect.apply(p, *one, sampling_time)
        start, end = start.at[:, j].set(a), end.at[:, j].set(b)
    return start, end, seen


def sensed(term: Term, y: Float[Array, "samples outputs"], u: Float[Array, "samples inputs"], sampling_time) -> Array:
    """Outputs after an effect on one of them, or on all where its place is the whole record."""
    source = source_of(term, y, u)
    for k in range(y.shape[1]) if term.place.first < 0 else (term.place.first,):
        y = y.at[:, k].set(term.effect.apply(term.values, y[:, k], source, sampling_time))
    return y


def source_of(term: Term, y: Float[Array, "samples outputs"], u: Float[Array, "samples inputs"]) -> Array:
    """The channel that a crosstalk comes from, zeros for any other effect."""
    if term.place.second < 0:
        return jnp.zeros(y.shape[0])
    return jnp.concatenate([y, u], axis=1)[:, term.place.second]


def with_coordinates_at_rest(x0: Float[Array, " states"], dofs: int) -> Array:
    """(q, q̇) of a model with more coordinates, those at rest."""
    q, v = jnp.split(x0, 2)
    rest = jnp.zeros(dofs - len(q))
    return jnp.concatenate([q, rest, v, rest])
