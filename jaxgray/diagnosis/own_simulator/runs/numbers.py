"""The numbers of a simulator as what a refit moves, in the place of the entries of M, D, K, and its linear plant as it
varies along a motion.

Entry i is number i in units of its size, 1 as it was given. Along a given motion another number needs another force,
to first order linear in the numbers. The inputs of the data are u; stiffness, then
damping at every coordinate beside M, D, K; the forces at the coordinates; and their change number by number.
"""

import dataclasses
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ....mechanics.effects.base import AbstractForceEffect, Place, Term
from ....mechanics.runs.extended import held_input
from ....mechanics.systems.drives import Force
from ....mechanics.systems.step_rows import Plant
from ....numerics.matrices.bounded import bounded
from ...model import simulator as free_run
from ...model.candidate import Candidate, Data, Setup, of_record
from .linearized import moved_from_rest, over_samples, sampled_over_time


class StiffnessOverTime(AbstractForceEffect):
    """Stiffness beside that of the linear plant, a known series in the place of an input."""

    id = "stiffness_over_time"
    family = "linear plant"
    law = "f = k(t)·q"
    parameters = ()
    signature = "none: part of a linear plant"
    reference = ""
    places = "input"
    element = "stiffness"

    def shapes(self, scales):
        return []

    def force(self, p, here, z):
        return here.u * here.q


class DampingOverTime(StiffnessOverTime):
    """Damping beside that of the linear plant, likewise."""

    id = "damping_over_time"
    law = "f = d(t)·q̇"
    element = "damping"

    def force(self, p, here, z):
        return here.u * here.v


def over_time(inputs: int, dofs: int) -> tuple[Term, ...]:
    """The terms of a plant that varies, which stand behind so many inputs."""
    laws = [law for law in (StiffnessOverTime(), DampingOverTime()) for _ in range(dofs)]
    places = [Place(f"{law.id} {k % dofs + 1}", inputs + k) for k, law in enumerate(laws)]
    return tuple(Term(law, place, np.zeros(0)) for law, place in zip(laws, places))


class FixedMatrices(eqx.Module):
    """M, D, K that nothing moves."""

    mass: Float[Array, "dofs dofs"]
    damping: Float[Array, "dofs dofs"]
    stiffness: Float[Array, "dofs dofs"]

    def __call__(self, entries):
        return self.mass, self.damping, self.stiffness


@dataclass(frozen=True)
class OwnNumbers:
    """Entries that do not change their sign, in the place of a `Structure`."""

    count: int

    def sizes(self, dofs: int) -> tuple[int, ...]:
        """One block an entry."""
        return (1,) * self.count

    def floors(self, dofs: int) -> Float[np.ndarray, " numbers"]:
        """The least value of every entry."""
        return np.zeros(self.count)


@dataclass(frozen=True, kw_only=True)
class NumbersSetup(Setup):
    """What stays as it is while laws are tried in a linear plant: its matrices, and where the numbers are (`here`) at
    which the slopes were taken."""

    plant: FixedMatrices
    here: Float[np.ndarray, " numbers"]

    @property
    def matrices(self) -> FixedMatrices:
        """M, D, K whatever the numbers."""
        return self.plant

    def entries_of(self, mass, damping, stiffness):
        """The numbers as they are: no other matrices say anything of them."""
        return np.array(self.here)


class NumbersSimulator(free_run.Simulator):
    """Free runs of the linear plant with laws, under the forces that the numbers leave."""

    setup: NumbersSetup

    def run(self, candidate: Candidate, data: Data, record: int = 0):
        return super().run(candidate, self._moved(candidate.entries, data), record)

    def motion(self, candidate: Candidate, data: Data, record: int = 0):
        return super().motion(candidate, self._moved(candidate.entries, data), record)

    def _run_and_jacobian(self, candidate: Candidate, data: Data, record: int):
        if not all(of_record(candidate, record)):
            # Made of what acts alone, by this very function.
            return super()._run_and_jacobian(candidate, data, record)
        return super()._run_and_jacobian(candidate, self._moved(candidate.entries, data), record)

    def _parts(self, candidate: Candidate, data: Data, record: int):
        plant, x0, inputs, slots, table, dplant, dinput = super()._parts(candidate, data, record)
        # What the forces change by number is in them already.
        acting = data.u.shape[1] - len(self.setup.here) * self.setup.dofs
        plant = dataclasses.replace(plant, drive=Force(np.asarray(plant.drive.input_map)[:, :acting]))
        inputs = tuple(None if X is None else X[:, :acting] for X in inputs)
        dinput = None if dinput is None else tuple(None if X is None else X[:, :acting] for X in dinput)
        return plant, x0, inputs, slots, table, dplant, dinput

    def _inputs_by_entry(self, data: Data):
        dofs, count = self.setup.dofs, len(self.setup.here)
        first = data.u.shape[1] - (count + 1) * dofs
        change = np.zeros((count, len(data.u), first + dofs))
        change[:, :, first : first + dofs] = -np.moveaxis(data.u[:, first + dofs :].reshape(-1, count, dofs), 1, 0)
        starts, ends = zip(*(held_input(one, data.hold) for one in change))
        return np.stack(starts), np.stack(ends), None

    def answered(self, plant: Plant, responses: Float[np.ndarray, "columns samples outputs"], data: Data):
        stiffness, damping = self._over_time(data)
        if len(plant.mass) > self.setup.dofs:
            # Of a coordinate that was added nothing is known but its mean.
            return responses
        if data.hold == "linear":
            stiffness, damping = over_samples(stiffness), over_samples(damping)
        moved = np.moveaxis(responses, 0, 2)
        slope = np.gradient(moved, data.sampling_time, axis=0)
        # What the plant that does not vary leaves out.
        forces = -stiffness[:, :, None] * over_samples(moved) - damping[:, :, None] * over_samples(slope)
        D, K = (X + Y[:, :, None] * np.eye(len(X)) for X, Y in ((plant.damping, damping), (plant.stiffness, stiffness)))
        with np.errstate(over="ignore", invalid="ignore"):
            sampled = sampled_over_time(plant.mass, D, K, data.sampling_time)
            made = responses + np.moveaxis(moved_from_rest(*sampled, forces), 2, 0)
        # A plant that runs away says nothing of what it answers.
        return made if bounded(made) else responses

    def input_power(self, data: Data) -> Float[np.ndarray, " inputs"]:
        """Mean square of every input; series of the plant are none."""
        u, dofs = np.array(data.u[: data.samples]), self.setup.dofs
        first = u.shape[1] - (len(self.setup.here) + 3) * dofs
        u[:, first + 2 * dofs : first + 3 * dofs] += u[:, first : first + dofs] + u[:, first + dofs : first + 2 * dofs]
        u[:, first : first + 2 * dofs] = 0.0
        return np.maximum(np.mean(u**2, axis=0), 1e-300)

    def _over_time(self, data: Data) -> list[np.ndarray]:
        """Stiffness and damping beside those of the plant."""
        dofs = self.setup.dofs
        first = data.u.shape[1] - (len(self.setup.here) + 3) * dofs
        return np.split(data.u[:, first : first + 2 * dofs], 2, axis=1)

    def forces(self, candidate: Candidate, data: Data) -> Float[np.ndarray, "samples dofs"]:
        """Forces at the coordinates of the plant as it varies, which the numbers of a candidate leave."""
        dofs, count = self.setup.dofs, len(self.setup.here)
        first = data.u.shape[1] - (count + 1) * dofs
        forces = self._moved(candidate.entries, data).u[:, first : first + dofs]
        # Series of the plant act as inputs, too, and were taken off.
        stiffness, damping = self._over_time(data)
        return forces + stiffness + damping

    def _moved(self, entries: Float[np.ndarray, " numbers"], data: Data) -> Data:
        """The data with the forces that numbers leave."""
        dofs, count = self.setup.dofs, len(self.setup.here)
        first = data.u.shape[1] - (count + 1) * dofs
        forces, by_number = np.split(data.u[:, first:], [dofs], axis=1)
        change = by_number.reshape(len(data.u), count, dofs)
        forces = forces - np.tensordot(change, np.asarray(entries) - self.setup.here, (1, 0))
        u = np.concatenate([data.u[:, :first], forces, by_number], axis=1)
        return dataclasses.replace(data, u=u)
