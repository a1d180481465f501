"""Free run of an extended model and its derivatives by everything that a refit moves.

The derivative is taken stage by stage (matrices, inputs, plant with its forces, outputs), so that the expensive
stage is compiled once for all laws that remember as much.
"""

import bisect
import dataclasses
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.effects.base import (
    AbstractEffect,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Place,
    Term,
)
from ...mechanics.model import MechanicalModel
from ...mechanics.runs.extended import Plant, changed_input, changed_plant, held_input, plant_motion, sensed, slots_of
from ...mechanics.runs.linearized import Linearized, linearized
from ...mechanics.runs.tangents import Directions, run_and_tangents
from ...numerics.programs.stored_programs import OFTEN, ONCE, stored
from .candidate import Candidate, Data, Setup, estimated, of_record
from .own_laws import columns_of, completed

RUN_AWAY = 1e3
"""Motion in the padding, relative to that in the record, beyond which it counts as none."""

DIRECTIONS = 8
"""Without forces, derivatives are taken in a multiple of so many directions, so that little is compiled."""


MEMORIES = (0, 2)
"""Laws that remember no state, at most so many, or more are compiled apart: every state is one more derivative."""


def law_table(terms: tuple[Term, ...], laws: tuple[AbstractForceEffect, ...]) -> tuple[AbstractForceEffect, ...]:
    """The force laws to compile for some terms, so that one program serves the rivals of a round: all that remember
    as much as any of theirs, then what is in no catalogue.

    **Arguments:** `terms`; `laws`: all force laws of the catalogue.
    """
    used = [term.effect for term in terms if isinstance(term.effect, AbstractForceEffect) and not term.effect.element]

    def kind(law):
        return bisect.bisect_left(MEMORIES, law.states)

    kinds = {kind(effect) for effect in used if effect in laws}
    table = tuple(law for law in laws if kind(law) in kinds)
    return table + tuple(dict.fromkeys(effect for effect in used if effect not in table))


def _only(terms, kind):
    return tuple(term for term in terms if isinstance(term.effect, kind))


def _filled(terms, flat: Array) -> tuple[Term, ...]:
    """Terms with their values taken from one vector."""
    result, at = [], 0
    for term in terms:
        count = len(term.effect.parameters)
        result.append(Term(term.effect, term.place, flat[at : at + count]))
        at += count
    return tuple(result)


def _values(terms: tuple[Term, ...]) -> np.ndarray:
    return np.concatenate([np.asarray(t.values, dtype=float) for t in terms]) if terms else np.zeros(0)


@stored(level=ONCE)
def _plant_stage(entries, flat, matrices, drive, measured, terms):
    """Plant from entries and matrix terms, and its derivative by both."""

    def build(vector):
        plant = Plant(*matrices(vector[: len(entries)]), drive, measured)
        plant = changed_plant(plant, _filled(terms, vector[len(entries) :]))
        return plant.mass, plant.damping, plant.stiffness

    both = jnp.concatenate([entries, flat])
    plant = Plant(*matrices(entries), drive, measured)
    plant = changed_plant(plant, _filled(terms, flat))
    return plant, jax.jacfwd(build)(both)


@stored(level=ONCE)
def _input_stage(flat, u, end, sampling_time, terms, count):
    """Input at start and end of every sample and, where `count` is 3, at the samples, after the input terms, and its
    derivative by their values."""

    def build(vector):
        return changed_input(_filled(terms, vector), u, end, u, sampling_time)[:count]

    return build(flat), jax.jacfwd(build)(flat)


# Most of a search's time goes into these two: compiled with full optimisation whatever `XLA_FLAGS` asks of all else.
@stored(level=OFTEN)
def _run(plant, x0, start, end, seen, slots, sampling_time, laws, scheduling, substeps):
    return plant_motion(
        plant, x0, start, end, slots, sampling_time, laws=laws, scheduling=scheduling, substeps=substeps, seen=seen
    )


@stored(level=OFTEN)
def _run_and_derivative(plant, x0, start, end, seen, slots, along, sampling_time, laws, scheduling, substeps):
    more = {"laws": laws, "scheduling": scheduling, "substeps": substeps, "seen": seen}
    return run_and_tangents(plant, x0, start, end, slots, along, sampling_time, **more)


@stored(level=ONCE)
def _linearized(plant, x0, start, end, slots, sampling_time, laws, scheduling, substeps):
    return linearized(plant, x0, start, end, slots, sampling_time, laws=laws, scheduling=scheduling, substeps=substeps)


@stored(level=ONCE)
def _output_stage(flat, y, u, dy, sampling_time, terms):
    """Outputs after the output terms, derivatives carried through, and those by the terms' own values."""

    def build(vector, clean):
        for term in _filled(terms, vector):
            clean = sensed(term, clean, u, sampling_time)
        return clean

    carried = jax.vmap(lambda t: jax.jvp(lambda c: build(flat, c), (y,), (t,))[1], in_axes=-1, out_axes=-1)(dy)
    return build(flat, y), carried, jax.jacfwd(build)(flat, y)


@stored(level=ONCE)
def _output_only(flat, y, u, sampling_time, terms):
    for term in _filled(terms, flat):
        y = sensed(term, y, u, sampling_time)
    return y


FOLLOWED = 0.5
"""Angle that the fastest mode may turn within a step of an added force."""

FOLLOWED_BY_ACCELEROMETERS = 0.1
"""The same where accelerations are measured, which see at once when a force jumps."""

MOST_TO_BEGIN = 8
"""Steps per sample up to which a search begins with."""


@dataclass(frozen=True)
class Steps:
    """The steps of a simulation: `count` of them per sample; `extrapolated`: from runs in so many and in half as many
    to steps that are infinitely short, which mends what goes with their square (Richardson).

    **Reference:** Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I* (Springer, 1993), §II.9.
    """

    count: int = 1
    extrapolated: bool = False

    @property
    def cost(self) -> float:
        """Steps per sample of all runs together."""
        return 1.5 * self.count if self.extrapolated else self.count

    @property
    def halved(self) -> "Steps":
        """Steps half as long."""
        return Steps(2 * self.count, self.extrapolated)


class Form(eqx.Module):
    """A law at a place without values: what is static about a term."""

    effect: AbstractEffect
    place: Place


def forms(terms: tuple[Term, ...]) -> tuple[Form, ...]:
    """What is static about some terms."""
    return tuple(Form(term.effect, term.place) for term in terms)


def natural_frequencies_hz(plant: MechanicalModel | Plant) -> Float[np.ndarray, " modes"]:
    """Undamped natural frequencies [Hz], lowest first, 0 for rigid bodies; M and K need not be symmetric."""
    values = np.linalg.eigvals(np.linalg.solve(np.asarray(plant.mass), np.asarray(plant.stiffness)))
    return np.sort(np.sqrt(np.maximum(values.real, 0.0))) / (2 * np.pi)


def steps_of(model: MechanicalModel | Plant, sampling_time: float) -> Steps:
    """Steps that follow added forces where the fastest mode has few samples in a period.

    **Arguments:** `model`; `sampling_time` [s].

    **Returns:** steps whose number is a power of two, from 1 to `MOST_TO_BEGIN`.
    """
    turned = 2 * np.pi * float(natural_frequencies_hz(model)[-1]) * sampling_time
    followed = FOLLOWED_BY_ACCELEROMETERS if "acceleration" in model.measured else FOLLOWED
    return Steps(int(np.clip(2 ** np.ceil(np.log2(max(turned / followed, 1.0))), 1, MOST_TO_BEGIN)))


class Simulator:
    """Free runs of candidates on records, with derivatives; holds nothing but what is static.

    **Arguments:** `setup`; `laws`: force laws of the catalogue; `steps`: of added forces.
    """

    def __init__(self, setup: Setup, laws: tuple[AbstractForceEffect, ...], *, steps: Steps = Steps()):
        self.setup = setup
        self.laws = laws
        self.steps = steps

    def in_steps(self, steps: Steps) -> "Simulator":
        """The same in other steps."""
        return type(self)(self.setup, self.laws, steps=steps)

    def _plant(self, candidate: Candidate):
        terms = _only(candidate.terms, AbstractMatrixEffect)
        stage = _plant_stage(
            np.asarray(candidate.entries),
            _values(terms),
            self.setup.matrices,
            self.setup.drive,
            self.setup.measured,
            forms(terms),
        )
        return jax.device_get(stage)

    def plant(self, candidate: Candidate) -> Plant:
        """The plant of a candidate, with its matrix terms."""
        return self._plant(self.completed(candidate))[0]

    def completed(self, candidate: Candidate) -> Candidate:
        """A candidate with the laws of the user's own model among its terms."""
        return completed(candidate, self.setup.own)

    def input_power(self, data: Data) -> Float[np.ndarray, " inputs"]:
        """Mean square of every input of the plant."""
        return np.maximum(np.mean(data.u[: data.samples] ** 2, axis=0), 1e-300)

    def answered(
        self, plant: Plant, responses: Float[np.ndarray, "columns samples outputs"], data: Data
    ) -> Float[np.ndarray, "columns samples outputs"]:
        """Responses of the linear plant to forces and inputs, as what it stands for answers: the same."""
        return responses

    def linearized(self, candidate: Candidate, data: Data, record: int = 0) -> Linearized | None:
        """The free run of a candidate linearised about itself, None where no force of a law is in it."""
        plant, x0, (start, end, _), slots, table = self._parts(
            _acting(self.completed(candidate), record), data, record
        )[:5]
        if slots is None:
            return None
        steps = np.asarray(self.steps.count)
        return _linearized(plant, x0, start, end, slots, data.traced_sampling_time, table, data.scheduling, steps)

    def without_forces(self, candidate: Candidate) -> tuple["Simulator", Candidate] | None:
        """What simulates a candidate without the forces of its laws, and that candidate; None where it has none."""
        full = self.completed(candidate)
        plain = full.with_terms(t for t in full.terms if not isinstance(t.effect, AbstractForceEffect))
        if len(plain.terms) == len(full.terms):
            return None
        setup = dataclasses.replace(self.setup, own=())
        return type(self)(setup, self.laws, steps=self.steps), plain

    def _inputs(self, candidate: Candidate, data: Data):
        terms = _only(candidate.terms, AbstractInputEffect)
        start, end = held_input(data.u, data.hold)
        if not terms:
            return (start, end, None), None
        # Nothing but an accelerometer sees the input itself.
        count = 3 if "acceleration" in self.setup.measured else 2
        now, slopes = _input_stage(_values(terms), start, end, data.traced_sampling_time, forms(terms), count)
        return (*now, None)[:3], (*slopes, None)[:3]

    def run(self, candidate: Candidate, data: Data, record: int = 0) -> Float[np.ndarray, "samples outputs"]:
        """Outputs of a candidate on one record, and on in the padding unless they run away there."""
        return self._outputs(_acting(self.completed(candidate), record), data, record)

    def _outputs(self, candidate: Candidate, data: Data, record: int) -> Float[np.ndarray, "samples outputs"]:
        y = self._run(candidate, data, record)[0][:, : self.setup.outputs]
        terms = _only(candidate.terms, AbstractOutputEffect)
        if terms:
            y = _output_only(_values(terms), y, data.u, data.traced_sampling_time, forms(terms))
        return ended(data, y)

    def motion(self, candidate: Candidate, data: Data, record: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Displacements and velocities of all coordinates on one record, and on in the padding likewise."""
        candidate = _acting(self.completed(candidate), record)
        q, v = self._run(candidate, data, record)[1:]
        return ended(data, q), ended(data, v)

    def _run(self, candidate: Candidate, data: Data, record: int):
        plant, x0, inputs, slots, table = self._parts(candidate, data, record)[:5]

        def run(count):
            made = _run(plant, x0, *inputs, slots, data.traced_sampling_time, table, data.scheduling, count)
            return jax.device_get(made)

        return self._extrapolated(run, slots)

    def _extrapolated(self, run, slots):
        """What a function of the steps per sample gives in this simulator's steps."""
        # As arrays, so that one program serves any number.
        made = run(np.asarray(self.steps.count))
        if slots is None or not self.steps.extrapolated:
            return made
        return jax.tree.map(
            lambda fine, coarse: fine + (fine - coarse) / 3, made, run(np.asarray(self.steps.count // 2))
        )

    def _parts(self, candidate, data, record):
        plant, dplant = self._plant(candidate)
        inputs, dinput = self._inputs(candidate, data)
        table = law_table(candidate.terms, self.laws)
        slots = slots_of(candidate.terms, plant, table)
        dofs, total = self.setup.dofs, plant.mass.shape[0]
        x0 = np.zeros(2 * total)
        x0[:dofs], x0[total : total + dofs] = np.split(candidate.x0[record], 2)
        return plant, x0, inputs, slots, table, dplant, dinput

    def run_and_jacobian(
        self, candidate: Candidate, data: Data, record: int = 0
    ) -> tuple[Float[np.ndarray, "samples outputs"], Float[np.ndarray, "samples outputs parameters"]]:
        """Outputs, and their Jacobian by entries, this record's first state and the estimated values of all terms."""
        return self.run_and_slopes(candidate, data, record)[:2]

    def run_and_slopes(
        self, candidate: Candidate, data: Data, record: int = 0
    ) -> tuple[
        Float[np.ndarray, "samples outputs"],
        Float[np.ndarray, "samples outputs parameters"],
        Float[np.ndarray, "samples outputs numbers"],
    ]:
        """As `run_and_jacobian`, and the Jacobian by the numbers of the laws of the user's own model, in the order of
        `own_laws.parameter_errors`."""
        y, J = self._run_and_jacobian(self.completed(candidate), data, record)
        if not self.setup.own:
            return y, J, J[:, :, :0]
        mine, own = columns_of(candidate, self.setup.own)
        first = len(candidate.entries) + 2 * self.setup.dofs
        before, by_terms = J[:, :, :first], J[:, :, first:]
        return y, np.concatenate([before, by_terms[:, :, mine]], axis=2), by_terms[:, :, own]

    @property
    def coarse(self) -> "Simulator":
        """The same in steps as a search begins with, whatever the noise: itself where its own are as long."""
        return self if self.steps.cost <= MOST_TO_BEGIN else self.in_steps(Steps(MOST_TO_BEGIN))

    def in_first_steps(self, plant: Plant, data: Data) -> "Simulator":
        """The same in the steps that a plant alone asks for, where only a start is wanted: itself where its own are as
        long or longer."""
        first = steps_of(plant, data.sampling_time)
        return self if self.steps.cost <= first.cost else self.in_steps(first)

    def _inputs_by_entry(self, data: Data) -> tuple | None:
        """By how much the entries change the inputs at start and end of every sample and, where they are seen, at the
        samples; None where they change the plant."""
        return None

    def _run_and_jacobian(self, candidate: Candidate, data: Data, record: int) -> tuple[np.ndarray, np.ndarray]:
        acting = of_record(candidate, record)
        if not all(acting):
            y, J = self._run_and_jacobian(_acting(candidate, record), data, record)
            counts = [len(estimated(term)) for term in candidate.terms]
            linear = J.shape[2] - sum(count for count, on in zip(counts, acting) if on)
            moves = np.repeat([True, *acting], [linear, *counts])
            wide = np.zeros((*J.shape[:2], len(moves)))
            wide[:, :, moves] = J
            return y, wide
        plant, x0, inputs, slots, table, dplant, dinput = self._parts(candidate, data, record)
        dofs, outputs, total = self.setup.dofs, self.setup.outputs, plant.mass.shape[0]
        entries = len(candidate.entries)
        columns, series = [], []
        # Columns in the order of the parameters: entries, first state, then the values term by term.
        zero = {
            "matrix": np.zeros((total, total)),
            "x0": np.zeros(2 * total),
            "slots": None if slots is None else np.zeros(slots.values.shape),
        }

        def column(matrices=None, x0=None, slots=None):
            M, D, K = (zero["matrix"],) * 3 if matrices is None else matrices
            return (M, D, K, zero["x0"] if x0 is None else x0, zero["slots"] if slots is None else slots)

        dM, dD, dK = (np.asarray(d) for d in dplant)
        order: list[tuple[str, int]] = []
        by_entry = self._inputs_by_entry(data)
        if by_entry is None:
            columns += [column((dM[..., k], dD[..., k], dK[..., k])) for k in range(entries)]
            order += [("plant", k) for k in range(entries)]
        else:
            order += [("series", k) for k in range(entries)]
        for k in range(2 * dofs):
            unit = np.zeros(2 * total)
            unit[k if k < dofs else total + k - dofs] = 1.0
            order.append(("plant", len(columns)))
            columns.append(column(x0=unit))
        at = {"matrix": entries, "input": 0, "output": 0, "slot": 0}
        for term in candidate.terms:
            count = len(term.effect.parameters)
            for j in estimated(term):
                if isinstance(term.effect, AbstractMatrixEffect):
                    k = at["matrix"] + j
                    columns.append(column((dM[..., k], dD[..., k], dK[..., k])))
                    order.append(("plant", len(columns) - 1))
                elif isinstance(term.effect, AbstractForceEffect):
                    unit = np.zeros(slots.values.shape)
                    unit[at["slot"], j] = 1.0
                    columns.append(column(slots=unit))
                    order.append(("plant", len(columns) - 1))
                elif isinstance(term.effect, AbstractInputEffect):
                    order.append(("series", len(series) + (0 if by_entry is None else entries)))
                    series.append(at["input"] + j)
                else:
                    order.append(("output", at["output"] + j))
            if isinstance(term.effect, AbstractMatrixEffect):
                at["matrix"] += count
            elif isinstance(term.effect, AbstractForceEffect):
                at["slot"] += not term.effect.element
            elif isinstance(term.effect, AbstractInputEffect):
                at["input"] += count
            else:
                at["output"] += count

        def derivative(columns, changes, count):
            rows = []
            for parts in zip(*columns):
                rows.append(None if parts[0] is None else np.stack(parts))
            along = Directions(*rows, *changes)
            along = jax.tree.map(lambda X: _pad(X, count), along)
            given, T = (plant, x0, *inputs, slots, along), data.traced_sampling_time
            return self._extrapolated(
                lambda steps: jax.device_get(_run_and_derivative(*given, T, table, data.scheduling, steps)), slots
            )

        if slots is None:
            count = _rounded(len(columns))
        else:
            # As if every parameter of the table's laws were estimated, so that one program serves them all.
            forces = _only(candidate.terms, AbstractForceEffect)
            count = len(columns) - sum(len(estimated(term)) for term in forces) + slots.values.size
        changes = [] if by_entry is None else [by_entry]
        if series:
            changes.append([None if d is None else np.moveaxis(np.asarray(d)[..., series], -1, 0) for d in dinput])
        along = [None if any(d is None for d in one) else np.concatenate(one) for one in zip(*changes)]
        still = [column() for _ in along[0]] if along else []
        if by_entry is None:
            y, J = derivative(columns, (), count)
            parts = [np.asarray(J)[:, :outputs, : len(columns)]]
            if still:
                _, J = derivative(still, along, _rounded(len(still)))
                parts.append(np.asarray(J)[:, :outputs, : len(still)])
        else:
            # Every candidate has columns that follow the inputs: one run takes them along with the others.
            along = [None if d is None else np.pad(d, ((len(columns), 0), (0, 0), (0, 0))) for d in along]
            y, J = derivative(columns + still, along, count + _rounded(len(still)))
            parts = [np.asarray(J)[:, :outputs, : len(columns) + len(still)]]
        y, J = np.asarray(y)[:, :outputs], np.concatenate(parts, axis=2)
        terms = _only(candidate.terms, AbstractOutputEffect)
        extra = None
        if terms:
            width = _rounded(J.shape[2])
            wide = np.pad(J, ((0, 0), (0, 0), (0, width - J.shape[2])))
            flat = _values(terms)
            y, carried, extra = _output_stage(flat, y, data.u, wide, data.traced_sampling_time, forms(terms))
            y, J, extra = np.asarray(y), np.asarray(carried)[:, :, : J.shape[2]], np.asarray(extra)
        # Series stand behind the columns of the plant, and outputs' own parameters behind both.
        behind = {"plant": 0, "series": len(columns), "output": J.shape[2]}
        J = J if extra is None else np.concatenate([J, extra], axis=2)
        picked = [behind[kind] + k for kind, k in order]
        return ended(data, y), ended(data, J if picked == list(range(J.shape[2])) else J[:, :, picked])


def _acting(candidate: Candidate, record: int) -> Candidate:
    """A candidate with the terms that act in a record."""
    acting = of_record(candidate, record)
    return candidate if all(acting) else candidate.with_terms(t for t, on in zip(candidate.terms, acting) if on)


def ended(data: Data, X) -> np.ndarray:
    """A series that ends with the record where it runs away in the padding; else what follows is kept, for effects that
    bring it early."""
    X = np.asarray(X)
    beyond = np.abs(X[data.samples :])
    if beyond.size and not np.max(beyond) / RUN_AWAY <= np.max(np.abs(X[: data.samples])):
        X = X.copy()
        X[data.samples :] = 0.0
    return X


def _rounded(count: int) -> int:
    return -(-count // DIRECTIONS) * DIRECTIONS


def _pad(X, count: int) -> np.ndarray:
    return np.concatenate([X, np.zeros((count - X.shape[0], *X.shape[1:]))])
