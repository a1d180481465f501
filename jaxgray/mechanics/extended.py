"""Simulation of a linear mechanical system extended by effects.

The linear part is exact at every step; effects that are forces enter by the exponential midpoint rule

    x_h = e^{A h/2} x + (input) + Γ(h/2) f(x),      x⁺ = e^{A h} x + (input) + Γ(h) f(x_h),

second order in the forces, with states of hysteresis advanced by exact steps of their own.

**Reference:** Hochbruck & Ostermann, *Exponential integrators* (Acta Numerica, 2010), §2.3.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.lifting import respond
from .drives import AbstractDrive, Force
from .effects.base import (
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Local,
    Term,
)
from .statespace import hold_matrices
from .step_rows import Plant, StepRows, local_rows


class Slots(eqx.Module):
    """Forces of a model, one row each, so that one compiled simulation serves all laws.

    `law`: position in the table of laws; `arms`: unit vectors b; `channel`: input that the law reads, −1 for none;
    `values`: parameters, padded.
    """

    law: Array
    arms: Float[Array, "slots dofs"]
    channel: Array
    values: Float[Array, "slots parameters"]


def with_coordinates(drive: AbstractDrive, dofs: int) -> AbstractDrive:
    """The drive of a model with more coordinates: no force there, carried along by a moving base."""
    name = "input_map" if isinstance(drive, Force) else "direction"
    matrix = getattr(drive, name)
    fill = 0.0 if isinstance(drive, Force) else 1.0
    padding = jnp.full((dofs - matrix.shape[0], matrix.shape[1]), fill)
    return eqx.tree_at(lambda d: getattr(d, name), drive, jnp.concatenate([matrix, padding]))


def input_matrix_of(drive: AbstractDrive) -> Float[Array, "dofs inputs"]:
    """Where the inputs act."""
    return drive.input_map if isinstance(drive, Force) else drive.direction


def _force_switch(laws, memory: int):
    """One force by its law's position in the table, and the same for the states it remembers."""

    def branch(law):
        return lambda p, here, z: jnp.asarray(law.force(p[: len(law.parameters)], here, z[: law.states]), dtype=float)

    def advancing(law):
        def advance(p, z, before, after, time):
            if law.states == 0:
                return z
            new = law.advance(p[: len(law.parameters)], z[: law.states], before, after, time)
            return z.at[: law.states].set(new)

        return advance

    forces, advances = [branch(law) for law in laws], [advancing(law) for law in laws]

    def force(index, p, here, z):
        return jax.lax.switch(index, forces, p, here, z)

    def advance(index, p, z, before, after, time):
        return jax.lax.switch(index, advances, p, z, before, after, time) if memory else z

    return force, advance


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
) -> Float[Array, "samples outputs"]:
    """Outputs of the plant with forces added.

    **Arguments:** `plant`; `x0`: (q, q̇) at the first sample; `start`, `end`: input at the beginning and end of every
    sample; `slots`: the forces, None without; `sampling_time` [s]; `laws`: table that `slots.law` points into;
    `scheduling`: channel some laws read; `substeps`: steps per sample.

    **Returns:** the outputs, one row a sample.
    """
    if slots is None:
        M, D, K = plant.mass, plant.damping, plant.stiffness
        system = plant.drive.state_space(M, D, K, plant.measured, sampling_time)
        Ad, B0, B1 = hold_matrices(system.A, system.B, 1.0, "linear")
        B = jnp.concatenate([B0, B1], axis=1)
        feed = jnp.concatenate([system.D, jnp.zeros_like(system.D)], axis=1)
        both = jnp.concatenate([start, end], axis=1)
        return respond(Ad, B, system.C, feed, both, _first_state(plant, x0, start[0], sampling_time))
    x, f = trajectory(plant, x0, start, end, slots, sampling_time, laws=laws, scheduling=scheduling, substeps=substeps)
    h = sampling_time / substeps
    system = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, h)
    return x @ system.C.T + start @ system.D.T + f @ _direct(plant, slots.arms).T


def _first_state(plant: Plant, x0, u0, h):
    """State of the linear part at the first sample: a measured base displacement takes part of the velocity out."""
    dofs = plant.mass.shape[0]
    speed = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, ("velocity",) * dofs, h)
    return jnp.concatenate([x0[:dofs], x0[dofs:] * h - speed.D @ u0 * h])


def motion_run(
    plant: Plant, x0, start, end, slots: Slots | None, sampling_time, *, laws=(), scheduling=None, substeps: int = 1
) -> tuple[Float[Array, "samples dofs"], Float[Array, "samples dofs"]]:
    """Displacements and velocities of all coordinates; arguments as for `plant_run`."""
    dofs = plant.mass.shape[0]
    if slots is None:
        system = plant.drive.state_space(
            plant.mass, plant.damping, plant.stiffness, ("displacement",) * dofs, sampling_time
        )
        Ad, B0, B1 = hold_matrices(system.A, system.B, 1.0, "linear")
        B = jnp.concatenate([B0, B1], axis=1)
        both = jnp.concatenate([start, end], axis=1)
        first = _first_state(plant, x0, start[0], sampling_time)
        x = respond(Ad, B, jnp.eye(2 * dofs), jnp.zeros((2 * dofs, both.shape[1])), both, first)
        substeps = 1
    else:
        x, _ = trajectory(
            plant, x0, start, end, slots, sampling_time, laws=laws, scheduling=scheduling, substeps=substeps
        )
    C, D = local_rows(plant, jnp.eye(dofs), sampling_time / substeps)
    return x @ C[0].T + start @ D[0].T, x @ C[1].T + start @ D[1].T


def trajectory(
    plant: Plant,
    x0: Float[Array, " states"],
    start: Float[Array, "samples inputs"],
    end: Float[Array, "samples inputs"],
    slots: Slots,
    sampling_time: float,
    *,
    laws: tuple[AbstractForceEffect, ...],
    scheduling: Float[Array, " samples"] | None = None,
    substeps: int | Array = 1,
) -> tuple[Float[Array, "samples states"], Float[Array, "samples slots"]]:
    """States (q, T q̇), T the time of one step, and added forces at every sample.

    **Arguments:** as for `plant_run`; `substeps` may be traced, and is then differentiable forwards only.
    """
    samples, count = start.shape[0], slots.arms.shape[0]
    h, share = sampling_time / substeps, 1.0 / substeps
    memory = max(law.states for law in laws)
    force, advance = _force_switch(laws, memory)
    rows = StepRows(plant, slots.arms, h)
    compliance = jnp.einsum("si,is->s", slots.arms, jnp.linalg.solve(plant.mass, slots.arms.T))
    yielding = -jnp.diag(rows.ending[count : 2 * count])

    def read(u):
        return jnp.where(slots.channel >= 0, u[:, jnp.maximum(slots.channel, 0)], 0.0)

    p = jnp.zeros(samples) if scheduling is None else scheduling
    rise = end - start
    series = (
        start @ rows.steady.T + share * (rise @ rows.rising.T),
        rise @ rows.steady.T,
        jnp.concatenate([read(start), p[:, None]], axis=1),
        jnp.concatenate([read(rise), jnp.diff(p, append=p[-1:])[:, None]], axis=1),
        jnp.arange(samples) * sampling_time,
    )

    def step(j, state, now):
        x, z, first = state
        base, slope, channels, change, t = now
        fraction = j * share
        row = jnp.sum(rows.states * x, axis=1) + base + fraction * slope
        begin, middle, final, after = rows.split(row)

        def local(s, motion, at, *within):
            u = channels + (fraction + at * share) * change
            return Local(
                *motion[:, s], compliance[s], u[s], t + (fraction + at * share) * sampling_time, u[-1], *within
            )

        def each(function, *arguments):
            return jnp.stack(
                [function(slots.law[s], slots.values[s], *(a[s] for a in arguments)) for s in range(count)]
            )

        here = [local(s, begin, 0.0) for s in range(count)]
        f0 = each(force, here, z)
        middle = middle + _by(rows.halfway, f0)
        free = final[1] + _by(rows.ending, f0)[1] + yielding * f0
        there = [local(s, middle, 0.5, begin[1, s], free[s], yielding[s]) for s in range(count)]
        zh = each(lambda k, v, z, a, b: advance(k, v, z, a, b, h / 2), z, here, there) if memory else z
        f1 = each(force, there, zh)
        if memory:
            final = final + _by(rows.ending, f1)
            beyond = [local(s, final, 1.0) for s in range(count)]
            z = each(lambda k, v, z, a, b: advance(k, v, z, a, b, h), z, here, beyond)
        return after + jnp.sum(rows.whole * f1, axis=1), z, jnp.where(j == 0, f0, first)

    def sample(state, now):
        x, z = state
        begun = (x, z, jnp.zeros(count))
        one = isinstance(substeps, int) and substeps == 1
        new, z, f = (
            step(0, begun, now) if one else jax.lax.fori_loop(0, substeps, lambda j, state: step(j, state, now), begun)
        )
        return (new, z), (x, f)

    state = _first_state(plant, x0, start[0], h)
    _, (x, f) = jax.lax.scan(sample, (state, jnp.zeros((count, memory))), series)
    return x, f


def _by(response, f):
    """Motion (quantities × slots) that forces make."""
    return jnp.sum(response * f, axis=1).reshape(3, -1)


def _direct(plant: Plant, arms: Float[Array, "slots dofs"]) -> Float[Array, "outputs slots"]:
    """What a force adds to measured accelerations at once."""
    added = -jnp.linalg.solve(plant.mass, arms.T)
    measured = jnp.asarray([kind == "acceleration" for kind in plant.measured])
    return jnp.where(measured[:, None], added, 0.0)


def held_input(u: Float[Array, "samples inputs"], hold: str) -> tuple[Array, Array]:
    """Input at the start and at the end of every sample."""
    return u, u if hold == "zero" else jnp.concatenate([u[1:], u[-1:]])


def arm_of(term: Term, plant: Plant) -> Float[Array, " dofs"]:
    """Unit vector b along which a force acts: a coordinate, the difference of two, or where an input acts."""
    dofs = plant.mass.shape[0]
    if term.effect.places == "input":
        return input_matrix_of(plant.drive)[:, term.place.first]
    arm = jnp.zeros(dofs).at[term.place.first].set(1.0)
    if term.place.second >= 0 and term.effect.places in ("spring", "pair"):
        arm = arm.at[term.place.second].set(-1.0)
    return arm


def slots_of(terms: tuple[Term, ...], plant: Plant, laws: tuple[AbstractForceEffect, ...]) -> Slots | None:
    """The forces among some terms, in their order, as rows of a table; None where there are none.

    **Arguments:** `terms`; `plant`; `laws`: the table, which must hold every force's law.
    """
    forces = [term for term in terms if isinstance(term.effect, AbstractForceEffect)]
    if not forces:
        return None
    width = max(len(law.parameters) for law in laws)
    values = [jnp.pad(jnp.asarray(t.values), (0, width - len(t.effect.parameters))) for t in forces]
    channels = [t.place.first if t.effect.places == "input" else -1 for t in forces]
    return Slots(
        jnp.asarray([laws.index(t.effect) for t in forces]),
        jnp.stack([arm_of(t, plant) for t in forces]),
        jnp.asarray(channels),
        jnp.stack(values),
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

    **Arguments:** `plant`; `terms`; `x0`: (q, q̇) of the coordinates that are measured, an added one being at rest;
    `u`; `sampling_time` [s]; `hold`; `scheduling`: channel some laws read; `substeps`: steps per sample of the forces.

    **Returns:** the outputs. Traceable and differentiable by every array.
    """
    start, end = held_input(u, hold)
    for term in terms:
        if isinstance(term.effect, AbstractInputEffect):
            j = term.place.first
            a, b = term.effect.apply(term.values, start[:, j], end[:, j], sampling_time)
            start, end = start.at[:, j].set(a), end.at[:, j].set(b)
    outputs = len(plant.measured)
    plant = changed_plant(plant, terms)
    laws = tuple(dict.fromkeys(t.effect for t in terms if isinstance(t.effect, AbstractForceEffect)))
    state = _widened(x0, outputs, plant.mass.shape[0])
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
    )[:, :outputs]
    for term in terms:
        if isinstance(term.effect, AbstractOutputEffect):
            y = sensed(term, y, u, sampling_time)
    return y


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


def _widened(x0, measured, dofs):
    q, v = x0[:measured], x0[measured:]
    rest = jnp.zeros(dofs - measured)
    return jnp.concatenate([q, rest, v, rest])
