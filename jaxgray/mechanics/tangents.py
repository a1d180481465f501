"""Derivatives of a run with added forces: the run first, then the derivative of every sample's step at the states that
are known by then, all side by side, and one linear recursion through them.

Exact, as differentiating through the run would be, but only the run itself goes sample by sample.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.varying import varying_response
from .effects.base import AbstractForceEffect
from .extended import outputs_of, plant_run
from .step_rows import Plant
from .trajectory import Sampler, Series, Slots, first_state, trajectory

CHUNK = 256
"""Samples whose steps are differentiated side by side: as many as stay in cache."""


class Directions(eqx.Module):
    """Along what a run is differentiated, one direction a row.

    Changes of `mass`, `damping`, `stiffness`, of the first state `x0` (q, q̇), of the forces' `values` (None without
    forces), and of the input at `start` and `end` of every sample and at the samples as accelerations see it (`seen`),
    None where it does not change.
    """

    mass: Float[Array, "directions dofs dofs"]
    damping: Float[Array, "directions dofs dofs"]
    stiffness: Float[Array, "directions dofs dofs"]
    x0: Float[Array, "directions states"]
    values: Float[Array, "directions slots parameters"] | None
    start: Float[Array, "directions samples inputs"] | None = None
    end: Float[Array, "directions samples inputs"] | None = None
    seen: Float[Array, "directions samples inputs"] | None = None

    def moved(self, plant: Plant) -> Plant:
        """The plant after one direction's change."""
        return Plant(
            plant.mass + self.mass,
            plant.damping + self.damping,
            plant.stiffness + self.stiffness,
            plant.drive,
            plant.measured,
        )


def run_and_tangents(
    plant: Plant,
    x0: Float[Array, " states"],
    start: Float[Array, "samples inputs"],
    end: Float[Array, "samples inputs"],
    slots: Slots | None,
    along: Directions,
    sampling_time: Array,
    *,
    laws: tuple[AbstractForceEffect, ...] = (),
    scheduling: Float[Array, " samples"] | None = None,
    substeps: int | Array = 1,
    seen: Float[Array, "samples inputs"] | None = None,
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples outputs directions"]]:
    """Outputs of the plant with forces added, and their derivatives.

    **Arguments:** as for `plant_run`; `along`: the directions.

    **Returns:** the outputs, and their derivative along every direction.
    """
    if slots is None:

        def run(change):
            first = start if change.start is None else start + change.start
            second = end if change.end is None else end + change.end
            third = seen if seen is None or change.seen is None else seen + change.seen
            return plant_run(change.moved(plant), x0 + change.x0, first, second, None, sampling_time, seen=third)

        return _along(run, along)
    T = jnp.asarray(sampling_time)
    h = T / substeps

    def begun(change):
        here = _with_values(slots, slots.values + change.values)
        sampler = Sampler.of(change.moved(plant), here, T, laws, substeps)
        u0 = start[0] if change.start is None else start[0] + change.start[0]
        return sampler.rows, sampler.slots.values, first_state(change.moved(plant), x0 + change.x0, u0, h)

    (rows, values, first), (drows, dvalues, dfirst) = _along(begun, along, axis=0)
    sampler, series = Sampler(rows, slots, T, substeps, laws), Series.of(start, end, scheduling, T)
    x, z, f = trajectory(sampler, first, series)
    size, states = x.shape[1], x.shape[1] + z[0].size
    F, G = _steps(sampler, series, x, z, (drows, dvalues), along)
    remembered = jnp.zeros((dfirst.shape[0], states - size))
    d = varying_response(F[:, :states], G[:, :states], jnp.concatenate([dfirst, remembered], axis=1).T)
    df = jnp.einsum("kij,kjp->kip", F[:, states:], d) + G[:, states:]

    def outputs(change, x, f):
        now, moves = (start, change.start) if seen is None else (seen, change.seen)
        return outputs_of(change.moved(plant), slots, x, f, now if moves is None else now + moves, h)

    still = _zero(along)
    y = outputs(still, x, f)
    J = jax.vmap(
        lambda change, dx, df: jax.jvp(outputs, (still, x, f), (change, dx, df))[1], in_axes=(0, -1, -1), out_axes=-1
    )(along, d[:, :size], df)
    return y, J


def _steps(sampler: Sampler, series: Series, x, z, dsampler, along: Directions):
    """Derivatives of every sample's (x⁺, z⁺, f) by its (x, z), and along the directions with (x, z) held."""
    samples, (size, memory, slots) = len(x), (x.shape[1], z[0].size, z.shape[1])
    moving = along.start is not None

    def in_chunks(X, axis=0):
        X = jnp.moveaxis(X, axis, 0)
        X = jnp.pad(X, ((0, -samples % CHUNK), *((0, 0),) * (X.ndim - 1)), mode="edge")
        return X.reshape(X.shape[0] // CHUNK, CHUNK, *X.shape[1:])

    count, states = along.x0.shape[0], size + memory
    # States first, then the directions; what does not move has no tangent.
    unit = jnp.pad(jnp.eye(states), ((0, count), (0, 0)))
    dsampler = jax.tree.map(lambda d: jnp.concatenate([jnp.zeros((states, *d.shape[1:])), d]), dsampler)
    changes = (along.start, along.end - along.start) if moving else ()
    changes = tuple(in_chunks(d, 1) for d in changes)

    def chunk(parts):
        xs, zs, here, changes = parts

        def after(moved, xs, zs, start, rise):
            rows, values = moved
            one = Sampler(
                rows, _with_values(sampler.slots, values), sampler.sampling_time, sampler.substeps, sampler.laws
            )
            driven = one.driven(Series(start, rise, here.scheduling, here.change, here.time))
            new, remembered, f = one(xs, zs, driven)
            return jnp.concatenate([new, remembered.reshape(memory, CHUNK), f])

        xs, zs = (jnp.moveaxis(X, 0, -1) for X in (xs, zs))
        at = ((sampler.rows, sampler.slots.values), xs, zs, here.start, here.rise)

        def tangent(moved, unit, du):
            dx = jnp.broadcast_to(unit[:size, None], xs.shape)
            dz = jnp.broadcast_to(unit[size:].reshape(*zs.shape[:-1], 1), zs.shape)
            du = du or (jnp.zeros_like(here.start), jnp.zeros_like(here.rise))
            return jax.jvp(after, at, (moved, dx, dz, *du))[1]

        du = tuple(jnp.pad(jnp.moveaxis(d, 1, 0), ((states, 0), (0, 0), (0, 0))) for d in changes)
        # The direction first, then what is reached, then samples.
        return jax.vmap(tangent)(dsampler, unit, du)

    T = jax.lax.map(chunk, (in_chunks(x), in_chunks(z), jax.tree.map(in_chunks, series), changes))
    T = T.transpose(0, 3, 2, 1).reshape(-1, states + slots, states + count)[:samples]
    return T[:, :, :states], T[:, :, states:]


def _with_values(slots: Slots, values) -> Slots:
    return Slots(slots.law, slots.arms, slots.channel, values)


def _zero(along: Directions) -> Directions:
    return jax.tree.map(lambda X: jnp.zeros(X.shape[1:]), along)


def _along(function, along: Directions, axis: int = -1):
    """Value of a function of one change at none, and its derivatives along all."""
    still = _zero(along)
    return jax.vmap(lambda change: jax.jvp(function, (still,), (change,)), out_axes=(None, axis))(along)
