"""States of the linear plant with added forces, sample by sample, by the exponential midpoint rule

    x_h = e^{A h/2} x + (input) + Γ(h/2) f(x),      x⁺ = e^{A h} x + (input) + Γ(h) f(x_h),

second order in the forces, with states of hysteresis advanced by exact steps of their own.

**Reference:** Hochbruck & Ostermann, *Exponential integrators* (Acta Numerica, 2010), §2.3.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import AbstractForceEffect, Local
from ..systems.step_rows import Plant, StepRows
from .dry_friction import Rubbing


class Slots(eqx.Module):
    """Forces of a model, one row each, so that one compiled simulation serves all laws; those of laws first, then those
    of elements whose stiffness and damping are inputs.

    `law`: position in the table of laws; `arms`: unit vectors b; `channel`: inputs that the laws read, then those that
    are the stiffness of every element, then the damping, −1 for none; `values`: parameters of the laws, padded.
    """

    law: Array
    arms: Float[Array, "slots+elements dofs"]
    channel: Array
    values: Float[Array, "slots parameters"]


class Series(eqx.Module):
    """What drives every sample: input at its start and its rise, the scheduling channel likewise, and the time [s]."""

    start: Float[Array, "samples inputs"]
    rise: Float[Array, "samples inputs"]
    scheduling: Float[Array, " samples"]
    change: Float[Array, " samples"]
    time: Float[Array, " samples"]

    @classmethod
    def of(cls, start, end, scheduling, sampling_time) -> "Series":
        """From inputs at start and end of every sample; `scheduling`: None for none."""
        p = jnp.zeros(len(start)) if scheduling is None else scheduling
        return cls(start, end - start, p, jnp.diff(p, append=p[-1:]), jnp.arange(len(start)) * sampling_time)


class Sampler(eqx.Module):
    """One sample of the simulation: (x, z) at its beginning to (x, z) at its end; or many side by side, along a last
    axis of everything, so that the compiler's loops run along it.

    x is the state (q, T q̇) of the plant, T the time of one step; z what the forces remember, slots × memory.

    `rows`; `slots`; `sampling_time` [s]; `substeps`: steps per sample, may be traced; `laws`: table that `slots.law`
    points into.
    """

    rows: StepRows
    slots: Slots
    sampling_time: Array
    substeps: int | Array
    laws: tuple[AbstractForceEffect, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, plant: Plant, slots: Slots, sampling_time, laws, substeps) -> "Sampler":
        """The sampler of a plant with forces."""
        rows = StepRows.of(plant, slots.arms, sampling_time / substeps)
        return cls(rows, slots, jnp.asarray(sampling_time), substeps, laws)

    @property
    def memory(self) -> int:
        """States that a force of the table remembers at most."""
        return max((law.states for law in self.laws), default=0)

    @property
    def rest(self) -> Float[Array, "slots memory"]:
        """What the forces remember at the first sample."""
        return jnp.zeros((len(self.slots.law), self.memory))

    def driven(self, series: Series) -> tuple[Array, ...]:
        """What the steps of every sample take from the series, samples last."""
        share = 1.0 / self.substeps

        def read(u):
            return jnp.where(self.slots.channel[:, None] >= 0, u.T[jnp.maximum(self.slots.channel, 0)], 0.0)

        return (
            self.rows.steady @ series.start.T + share * (self.rows.rising @ series.rise.T),
            self.rows.steady @ series.rise.T,
            jnp.concatenate([read(series.start), series.scheduling[None]]),
            jnp.concatenate([read(series.rise), series.change[None]]),
            series.time,
        )

    def __call__(self, x, z, driven):
        """New x and z, and the forces at the beginning."""
        begun = (x, z, jnp.zeros((self.slots.arms.shape[0], *x.shape[1:])))
        if isinstance(self.substeps, int) and self.substeps == 1:
            return self._step(0, begun, driven)
        return jax.lax.fori_loop(0, self.substeps, lambda j, state: self._step(j, state, driven), begun)

    def _step(self, j, state, driven):
        x, z, first = state
        base, slope, channels, change, t = driven
        rows, count, share = self.rows, len(self.slots.law), 1.0 / self.substeps
        h, fraction = self.sampling_time * share, j * share
        begin, middle, final, after, rate = rows.split(_product(rows.states, x) + base + fraction * slope)

        def local(s, motion, at):
            u = channels + (fraction + at * share) * change
            now = t + (fraction + at * share) * self.sampling_time
            here = (*motion[:, s], rows.compliance[s, s], u[s], now, u[-1])
            return Local(*(jnp.broadcast_to(X, x.shape[1:]) for X in here))

        def of_elements(motion, at):
            now = (channels + (fraction + at * share) * change)[count:-1]
            stiffness, damping = jnp.split(now, 2)
            return stiffness * motion[0, count:] + damping * motion[1, count:]

        here = [local(s, begin, 0.0) for s in range(count)]
        smooth, rubbing = self._forces(here, z, x)
        others = of_elements(begin, 0.0)
        f0 = smooth
        if rubbing is not None:
            f0 = smooth + rubbing.at_an_instant(begin[1, :count], rate[:count], rows.compliance[:count, :count])
        f0 = jnp.concatenate([f0, others])
        middle = middle + _by(rows.halfway, f0)
        there = [local(s, middle, 0.5) for s in range(count)]
        f1, rubbing = self._forces(there, self._advanced(z, here, there, h / 2), x)
        if rubbing is not None:
            free = final[1] + _by(rows.ending, jnp.concatenate([smooth, others]))[1]
            f1 = f1 + rubbing.over_a_step(begin[1, :count], free[:count], rows.yielding[:count, :count])
        f1 = jnp.concatenate([f1, of_elements(middle, 0.5)])
        if self.memory:
            final = final + _by(rows.ending, f1)
            z = self._advanced(z, here, [local(s, final, 1.0) for s in range(count)], h)
        return after + _product(rows.whole, f1), z, jnp.where(j == 0, f0, first)

    def _forces(self, here: list[Local], z, x) -> tuple[Array, Rubbing | None]:
        """Forces of the laws without dry friction, and that; None where no law of the table has any."""
        slots = self.slots
        if not here:
            return jnp.zeros((0, *x.shape[1:])), None

        def force(law, values, z, here):
            return _each(lambda here, z: _force(self.laws, law, values, here, z), here, z)

        parts = _slot_by_slot(force, slots.law, slots.values, z, _stacked(here))
        if not rubbing(self.laws):
            return parts, None
        smooth, size, eps = jnp.moveaxis(parts, 1, 0)
        return smooth, Rubbing.of(size, eps, slots.arms[: len(slots.law)])

    def _advanced(self, z, before: list[Local], after: list[Local], time):
        if not self.memory:
            return z
        slots = self.slots

        def advanced(law, values, z, before, after):
            return _each(
                lambda z, before, after: _advance(self.laws, law, values, z, before, after, time), z, before, after
            )

        return _slot_by_slot(advanced, slots.law, slots.values, z, _stacked(before), _stacked(after))


def _stacked(here: list[Local]) -> Local:
    return jax.tree.map(lambda *X: jnp.stack(X), *here)


def _slot_by_slot(function, *arguments):
    """A function of every slot's arguments, as a loop: compiled once for any number of slots."""
    if len(arguments[0]) == 1:
        return function(*jax.tree.map(lambda X: X[0], arguments))[None]
    return jax.lax.map(lambda one: function(*one), arguments)


def _each(function, *arguments):
    """A function of scalars and vectors, at every sample where samples are the last axis of its arguments."""
    side_by_side = any(isinstance(X, Local) and jnp.ndim(X.q) for X in arguments)
    return jax.vmap(function, in_axes=-1, out_axes=-1)(*arguments) if side_by_side else function(*arguments)


def _widened(X, like):
    """With as many last axes of one more as another array has."""
    return X.reshape(*X.shape, *(1,) * (jnp.ndim(like) - 1))


def _product(A, x):
    """A x, samples last, as sums that the compiler fuses."""
    return sum(_widened(A[:, k], x) * x[k] for k in range(A.shape[1]))


# Functions of their own, so that the laws are traced once and not at every place of the step that asks for a force.
@functools.partial(jax.jit, static_argnums=0)
def _force(laws, number, p, here: Local, z):
    """Force of one law of a table; where some rub: that without dry friction, its size and the width of its turn."""
    some_rub = rubbing(laws)

    def branch(law):
        def parts(p, here, z):
            values, own = p[: len(law.parameters)], z[: law.states]
            if not some_rub:
                return jnp.asarray(law.force(values, here, own), dtype=float)
            smooth = law.force(values, dataclasses.replace(here, turn=jnp.zeros_like(here.v)), own)
            return jnp.stack(jnp.broadcast_arrays(smooth, *law.rubbing(values, here), here.v))[:3]

        return parts

    return jax.lax.switch(number, [branch(law) for law in laws], p, here, z)


def rubbing(laws: tuple[AbstractForceEffect, ...]) -> bool:
    """Whether some of the laws have dry friction."""
    return any(law.jumps for law in laws)


@functools.partial(jax.jit, static_argnums=0)
def _advance(laws, number, p, z, before: Local, after: Local, time):
    def branch(law):
        def advance(p, z, before, after):
            if law.states == 0:
                return z
            new = law.advance(p[: len(law.parameters)], z[: law.states], before, after, time)
            return z.at[: law.states].set(new)

        return advance

    return jax.lax.switch(number, [branch(law) for law in laws], p, z, before, after)


def _by(response, f):
    """Motion (quantities × slots) that forces make."""
    return _product(response, f).reshape(3, -1, *f.shape[1:])


def first_state(plant: Plant, x0, u0, h):
    """State of the linear part at the first sample: a measured base displacement takes part of the velocity out."""
    dofs = plant.mass.shape[0]
    speed = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, ("velocity",) * dofs, h)
    return jnp.concatenate([x0[:dofs], x0[dofs:] * h - speed.D @ u0 * h])


def trajectory(
    sampler: Sampler, x0: Float[Array, " states"], series: Series
) -> tuple[Float[Array, "samples states"], Float[Array, "samples slots memory"], Float[Array, "samples slots"]]:
    """States x and z and added forces at every sample, from x0 = (q, T q̇); see `Sampler`."""

    def sample(state, driven):
        x, z = state
        new, remembered, f = sampler(x, z, driven)
        return (new, remembered), (x, z, f)

    driven = jax.tree.map(lambda X: jnp.moveaxis(X, -1, 0), sampler.driven(series))
    return jax.lax.scan(sample, (x0, sampler.rest), driven)[1]


def direct(plant: Plant, arms: Float[Array, "slots dofs"]) -> Float[Array, "outputs slots"]:
    """What a force adds to measured accelerations at once."""
    added = -jnp.linalg.solve(plant.mass, arms.T)[: len(plant.measured)]
    measured = jnp.asarray([kind == "acceleration" for kind in plant.measured])
    return jnp.where(measured[:, None], added, 0.0)
