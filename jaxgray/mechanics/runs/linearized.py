"""A run with added forces, linearised about its own motion: what it answers to small further forces and inputs.

The linear plant alone answers otherwise: where dry friction holds, a small force moves nothing, and a hardening spring
is stiffer where it is bent. Exact in the steps of the run, as differentiating through it would be.

**Reference:** the variational equation, Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*
(Springer, 1993), §I.14.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import AbstractForceEffect
from ..systems.drives import Force
from ..systems.step_rows import Plant, StepRows
from .extended import output_rows
from .tangents import in_chunks
from .trajectory import Sampler, Series, Slots, direct, first_state, trajectory


class Linearized(eqx.Module):
    """Derivatives of every sample's step, samples first: of the state at its end and the forces at its beginning.

    `by_state`; `by_force`, `by_input`: by a force at every coordinate and by every input, held over the sample, then by
    their rise over it; `seen`: outputs by state and forces; `fed_force`, `fed_input`: outputs by what acts at once.
    States are (q, h q̇) of the plant, h [s] the time of one step, then what the forces remember.
    """

    by_state: Float[Array, "samples states+slots states"]
    by_force: Float[Array, "samples states+slots 2*dofs"]
    by_input: Float[Array, "samples states+slots 2*inputs"]
    seen: Float[Array, "outputs states+slots"]
    fed_force: Float[Array, "outputs dofs"]
    fed_input: Float[Array, "outputs inputs"]


def linearized(
    plant: Plant,
    x0: Float[Array, " states"],
    start: Float[Array, "samples inputs"],
    end: Float[Array, "samples inputs"],
    slots: Slots,
    sampling_time: Array,
    *,
    laws: tuple[AbstractForceEffect, ...],
    scheduling: Float[Array, " samples"] | None = None,
    substeps: int | Array = 1,
) -> Linearized:
    """Linearise a run.

    **Arguments:** as for `plant_run`; `slots`: at least one force.

    **Returns:** a `Linearized`; not finite where the run is not.
    """
    h, share = sampling_time / substeps, 1.0 / substeps
    dofs, inputs = plant.mass.shape[0], start.shape[1]
    sampler = Sampler.of(plant, slots, jnp.asarray(sampling_time), laws, substeps)
    pushed = StepRows.of(eqx.tree_at(lambda p: p.drive, plant, Force(jnp.eye(dofs))), slots.arms, h)
    series = Series.of(start, end, scheduling, sampling_time)
    x, z, _ = trajectory(sampler, first_state(plant, x0, start[0], h), series)
    size, memory = x.shape[1], z[0].size
    states = size + memory
    # What drives the steps of a sample is linear in it: in forces held and rising, and in inputs likewise.
    by_input = sampler.driven(Series(*_halves(inputs), *jnp.zeros((3, 2 * inputs))))[:4]
    by_force = pushed.steady @ _halves(dofs)[0].T + share * (pushed.rising @ _halves(dofs)[1].T)
    by_force = by_force, pushed.steady @ _halves(dofs)[1].T, *(jnp.zeros((len(X), 2 * dofs)) for X in by_input[2:])
    moves = [jnp.concatenate([jnp.zeros((len(X), states)), X, Y], axis=1).T for X, Y in zip(by_force, by_input)]
    along = jnp.pad(jnp.eye(states), ((0, 2 * (dofs + inputs)), (0, 0))), *moves

    def chunk(_, parts):
        xs, zs, here = parts
        xs, zs = (jnp.moveaxis(X, 0, -1) for X in (xs, zs))
        *driven, time = sampler.driven(here)

        def after(x, z, *driven):
            new, remembered, f = sampler(x, z, (*driven, time))
            return jnp.concatenate([new, remembered.reshape(memory, x.shape[-1]), f])

        def tangent(unit, *moves):
            at = xs, zs, *driven
            moves = unit[:size], unit[size:].reshape(zs.shape[:-1]), *moves
            return jax.jvp(after, at, tuple(jnp.broadcast_to(m[..., None], X.shape) for m, X in zip(moves, at)))[1]

        return None, jax.vmap(tangent)(*along).transpose(2, 1, 0)

    F = jax.lax.scan(chunk, None, jax.tree.map(in_chunks, (x, z, series)))[1]
    F = F.reshape(-1, *F.shape[2:])[: len(x)]
    rows = output_rows(plant, slots, h)
    by_state, fed_input, by_slot = jnp.split(rows, (size, size + inputs), axis=1)
    seen = jnp.concatenate([by_state, jnp.zeros((len(rows), memory)), by_slot], axis=1)
    ends = states, states + 2 * dofs
    return Linearized(*jnp.split(F, ends, axis=2), seen, -direct(plant, jnp.eye(dofs)), fed_input)


def _halves(count: int) -> tuple[Array, Array]:
    """A series of unit inputs: each held, then each rising."""
    return jnp.eye(2 * count)[:, :count], jnp.eye(2 * count)[:, count:]


def answers(
    run: Linearized,
    columns: Float[Array, " channels"],
    start: Float[Array, "series samples"],
    end: Float[Array, "series samples"],
    *,
    forced: bool,
) -> Float[Array, "series samples outputs"]:
    """Outputs that small forces or inputs add, from rest.

    **Arguments:** `run`; `columns`: by how much each coordinate is pushed, or each input moved; `start`, `end`: series
    at the beginning and at the end of every sample; `forced`: forces, else inputs. In the units of the inputs and
    outputs of the run.

    **Returns:** the outputs, not finite where they run away.
    """
    table, fed = (run.by_force, run.fed_force) if forced else (run.by_input, run.fed_input)
    held, rising = jnp.split(table, 2, axis=2)
    held, rising = held @ columns, rising @ columns
    states = run.by_state.shape[2]

    def step(d, parts):
        F, b, c, w, rise = parts
        reached = sum(F[:, k, None] * d[k] for k in range(states)) + b[:, None] * w + c[:, None] * rise
        return reached[:states], run.seen @ jnp.concatenate([d, reached[states:]]) + (fed @ columns)[:, None] * w

    parts = run.by_state, held, rising, start.T, (end - start).T
    made = jax.lax.scan(step, jnp.zeros((states, start.shape[0])), parts)[1]
    return jnp.moveaxis(made, 2, 0)
