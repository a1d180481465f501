"""Records and a simulator together: runs of all records and of their parts, forces by the numbers, and data for the
linear plant."""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ....mechanics.effects.base import AbstractForceEffect, AbstractOutputEffect, Term
from ....mechanics.model import MechanicalModel
from ....mechanics.runs.extended import changed_input, held_input, sensed
from ....mechanics.systems.drives import Force
from ....numerics.matrices.bounded import bounded
from ....numerics.outcomes import RESULTS, ComputationError
from ....records import Record
from ...model.candidate import Candidate, Data
from ...model.free_run import FreeRun, rms_of
from ...model.simulator import Steps
from .calls import Call, Failure, Simulator
from .linearized import Linearized, linearized
from .numbers import FixedMatrices, NumbersSetup, NumbersSimulator, OwnNumbers, over_time
from .tracking import (
    as_linear,
    forces_beside,
    forces_by_slopes,
    near_until,
    relative_error,
    relative_size,
    slopes_by_number,
    tracked,
    until,
)

SEEN = 0.1
"""Answer to a number that was given as 0, as it counts for one of size, relative to the motion."""

SIZES = 10.0 ** np.arange(-6, 7)
"""Sizes that a number given as 0 may have."""

IDLE = 1e-9
"""Force that a number takes, relative to the inputs, up to which it is rounding."""

EXACT, SHRUNK = 6, 0.5
"""Rounds at most in which the forces of a run are made exact for the steps of the linear plant, and the share of its
error that a round must leave at most, for another one."""

RUNS_AWAY = "the linear plant that stands for the simulator along its run diverges"

RUN_AWAY = 1e3
"""Motion relative to that of the record beyond which a run counts as none."""


Outputs = tuple[np.ndarray, ...]
"""What the sensors show of runs of all spans."""

Parts = tuple[list[FreeRun], list[FreeRun]]
"""Runs over the data of the fit, and over those held out."""


@dataclass(frozen=True)
class Span:
    """A whole record, which the simulator runs from its start, with the samples of the fit and those held out."""

    record: Record
    fit: slice | None
    held: slice | None

    def far(self, y: Float[np.ndarray, "samples outputs"]) -> bool:
        """Whether a run goes far beyond the motion of the record."""
        most = np.nanmax(np.abs(self.record.y), axis=0)
        return not np.all(np.max(np.abs(y), axis=0) <= RUN_AWAY * np.maximum(most, 1e-3 * np.max(most)))

    def run(self, y: Float[np.ndarray, "samples outputs"], part: slice) -> FreeRun:
        """A run of the whole record as one of a part of it."""
        measured, simulated = self.record.y[part], y[part]
        kept = np.isfinite(measured)
        return FreeRun(simulated, np.where(kept, measured - simulated, 0.0), kept)


@dataclass(frozen=True)
class Runs:
    """Runs of all spans: their `calls` and outputs `y`; by how much more force every number takes, and by how much it
    moves them (`slopes`); and whether that is so along the whole records (`along`)."""

    calls: tuple[Call, ...]
    y: tuple[np.ndarray, ...]
    by_number: tuple[np.ndarray, ...] = ()
    slopes: tuple[np.ndarray, ...] = ()
    along: bool = False


@dataclass
class Problem:
    """What a diagnosis works on: `simulator`, `spans`, `units` of the numbers (values of entry 1), `laws`: force laws
    of the catalogue; and, once they are known, the linear `plant`, how inputs act (`input_map`), which numbers are
    `idle`: they move no output, and whether a run with the numbers as they were given is far `away` from a record."""

    simulator: Simulator
    spans: tuple[Span, ...]
    units: Float[np.ndarray, " numbers"]
    laws: tuple[AbstractForceEffect, ...]
    plant: Linearized | None = None
    input_map: Float[np.ndarray, "dofs inputs"] | None = None
    idle: Bool[np.ndarray, " numbers"] | None = None
    away: bool = False

    @property
    def record(self) -> Record:
        """The first record."""
        return self.spans[0].record

    def parts(self) -> tuple[list[Record], list[Record]]:
        """The data of the fit, and those held out."""
        fit = [span.record[span.fit] for span in self.spans if span.fit is not None]
        return fit, [span.record[span.held] for span in self.spans if span.held is not None]

    def runs(self, calls: list[Call]) -> Runs:
        """Runs of all spans.

        **Raises:** `ComputationError` where one fails.
        """
        made = self.simulator.runs(calls)
        return Runs(tuple(calls), tuple(self.simulator.finished(call, y) for call, y in zip(calls, made)))

    def tried(self, calls: list[Call] | None) -> Runs | None:
        """Runs of all spans, None where there are no calls, or one fails or runs away."""
        if calls is None:
            return None
        made = self.simulator.runs(calls)
        if any(isinstance(y, Failure) for y in made):
            return None
        far = any(span.far(y) for span, y in zip(self.spans, made))
        return None if far else Runs(tuple(calls), tuple(made))

    def called(self, entries: Float[np.ndarray, " numbers"]) -> list[Call]:
        """Calls with these numbers, the records' inputs and no forces."""
        none = [np.zeros((span.record.samples, span.record.outputs)) for span in self.spans]
        return [Call(span.record.u, w, entries * self.units) for span, w in zip(self.spans, none)]

    def linearized(self, runs: Runs, rng: np.random.Generator, end: int | None = None) -> Linearized:
        """The linear plant about the first of some runs, up to a sample. How inputs act is asked once, of a run in
        which they do.

        **Raises:** `ComputationError` where the simulator does not answer to forces as a mechanical system does.
        """
        call = runs.calls[0]
        plant = linearized(self.simulator, self.record, call, runs.y[0], rng, end, self.input_map)
        if np.any(call.u):
            self.input_map = plant.input_map
        return plant

    def idle_by(self, forces: tuple[np.ndarray, ...]) -> Bool[np.ndarray, " numbers"]:
        """Which numbers take no force of their own, from the forces that they take."""
        size = max(float(np.max(np.abs(span.record.u @ self.plant.input_map.T))) for span in self.spans)
        return np.all([np.all(np.abs(S) <= IDLE * size, axis=(0, 1)) for S in forces], axis=0)

    def with_forces(self, runs: Runs, slopes: tuple[np.ndarray, ...] | None = None) -> Runs:
        """Runs with the forces that the numbers take along their motion, by slopes of these runs, or of others along
        the same motion, where they are known."""
        if slopes is None:
            made = zip(self.spans, runs.calls, runs.y)
            slopes = tuple(slopes_by_number(self.simulator, span.record, *one, self.units) for span, *one in made)
        forces = [forces_by_slopes(self.plant, span.record, y, S) for span, y, S in zip(self.spans, runs.y, slopes)]
        return dataclasses.replace(runs, by_number=tuple(forces), slopes=slopes, along=self.follow(runs.y))

    def led(self, runs: Runs) -> Runs:
        """Runs that forces beside those of their calls lead along the records, as far as they can."""
        spans = zip(self.spans, runs.calls, runs.y)
        found = [tracked(self.simulator, self.plant, span.record, call, y) for span, call, y in spans]
        return Runs(*(tuple(x) for x in zip(*found)))

    def followed_until(self, runs: Runs) -> int:
        """Samples in all until runs leave the records, none of one that is far off from the first."""
        ends = []
        for span, y in zip(self.spans, runs.y):
            end = near_until(span.record, y)
            ends.append(0 if end == len(y) and relative_error(span.record, y) >= 1.0 else end)
        return sum(ends)

    def follow(self, y: tuple[np.ndarray, ...]) -> bool:
        """Whether runs are near the whole records."""
        return all(near_until(span.record, one) == len(one) for span, one in zip(self.spans, y))

    def linear_simulator(self, entries: Float[np.ndarray, " numbers"], steps: Steps) -> NumbersSimulator:
        """The linear plant, with some entries as they are in the runs that it is about."""
        record, plant, count = self.record, self.plant, len(entries)
        known = np.eye(record.outputs)
        E = np.concatenate([plant.input_map, known, known, known, np.zeros((len(known), count * len(known)))], 1)
        setup = NumbersSetup(
            own=over_time(record.inputs, record.outputs),
            drive=Force(E),
            measured=record.measured,
            scaling=None,
            structure=OwnNumbers(count),
            held=np.zeros(count, bool) if self.idle is None else self.idle,
            input_names=record.input_names,
            output_names=record.output_names,
            plant=FixedMatrices(plant.mass, plant.damping, plant.stiffness),
            here=np.array(entries, float),
        )
        return NumbersSimulator(setup, self.laws, steps=steps)

    def linear_model(self, terms: tuple[Term, ...] = ()) -> MechanicalModel:
        """The linear plant as a model with the names of the record, and laws."""
        plant, record = self.plant, self.record
        return MechanicalModel(
            plant.mass,
            plant.damping,
            plant.stiffness,
            drive=Force(plant.input_map),
            measured=record.measured,
            input_names=record.input_names,
            output_names=record.output_names,
            input_units=record.input_units,
            output_units=record.output_units,
            effects=terms,
        )

    def linear_data(self, linear: NumbersSimulator, runs: Runs) -> "Linear":
        """Records for the linear plant about some runs."""
        records, states, rests = [], [], []
        for span, call, y, S in zip(self.spans, runs.calls, runs.y, runs.by_number):
            record, x0 = as_linear(span.record, self.plant, call, y, S)
            rest = self._rest(linear, span.record, call, y, record, x0)
            records.append(_pushed(record, span.record.inputs, rest))
            states.append(x0)
            rests.append(rest)
        data = tuple(Data.of(record) for record in records)
        return Linear(tuple(records), tuple(states), data, runs.by_number, runs.y, tuple(rests), runs.along)

    def _rest(
        self, linear: NumbersSimulator, measured: Record, call: Call, y: np.ndarray, record: Record, x0: np.ndarray
    ) -> Float[np.ndarray, "samples dofs"]:
        """Forces that the linear plant needs, beside those of its `record` and first state, to move as a run does in
        steps of its own.

        **Raises:** `ComputationError` where it runs away.
        """
        there, inputs = Candidate(linear.setup.here, (x0,)), measured.inputs
        given = (call.u - measured.u) @ self.plant.input_map.T + call.w
        varying = np.split(record.u[:, inputs:][:, : 2 * record.outputs], 2, axis=1)
        best, nearest, share, further = np.zeros_like(y), np.inf, 1.0, 0.0
        for _ in range(EXACT):
            rest = best + share * further
            error = y - linear.motion(there, Data.of(_pushed(record, inputs, given + rest)))[0][: len(y)]
            left = relative_size(measured, error) if bounded(error) else np.inf
            if not np.isfinite(min(left, nearest)):
                raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=RUNS_AWAY)
            if not left < nearest:
                # Near half the sampling rate a whole step may lead away.
                share /= 2
                continue
            hardly = left > SHRUNK * nearest
            best, nearest = rest, left
            if hardly:
                break
            further = self.plant.forces_of(error, measured)[0] + forces_beside(*varying, error, record)
        return best

    def about(
        self, linear: NumbersSimulator, candidate: Candidate, wholes: "Linear", runs: Runs
    ) -> tuple[NumbersSimulator, "Linear"]:
        """The linear plant, and its records, about runs with the numbers of a candidate; runs without forces by number
        have those of the records before."""
        if not runs.by_number:
            runs = dataclasses.replace(runs, by_number=wholes.by_number, along=wholes.along)
        linear = self.linear_simulator(candidate.entries, linear.steps)
        return linear, self.linear_data(linear, runs)

    def fit_data(self, wholes: "Linear") -> list[Data]:
        """The parts of records for the linear plant that the fit sees."""
        return [Data.of(r[span.fit]) for r, span in zip(wholes.records, self.spans) if span.fit is not None]

    def with_laws(
        self, linear: NumbersSimulator, candidate: Candidate, wholes: "Linear"
    ) -> tuple[list[Call], list[np.ndarray]] | None:
        """Calls with the laws of a candidate, and the motion of the linear plant: the changed inputs, and the forces
        that the laws make along that motion; None where it runs away."""
        candidate, calls, motions = wholes.extended(candidate), [], []
        for k, (span, data) in enumerate(zip(self.spans, wholes.data)):
            n, inputs, dofs = span.record.samples, span.record.inputs, span.record.outputs
            q = linear.motion(candidate, data, k)[0][:n, :dofs]
            if span.far(q):
                return None
            motions.append(q)
            start, _, _ = changed_input(candidate.terms, *held_input(data.u, data.hold), data.u, data.sampling_time)
            u = np.asarray(start)[:n, :inputs]
            # What the plant was given beside the laws.
            given = linear.forces(candidate, data)[:n] + u @ self.plant.input_map.T
            w = self.plant.forces_of(q, span.record)[0] + wholes.beside(k, q) - given
            calls.append(Call(u, w, np.asarray(candidate.entries) * self.units))
        # Without laws the forces are none, but for what their iteration leaves.
        return (calls if candidate.terms else self.called(candidate.entries)), motions

    def begun(self, y: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
        """Outputs of runs, each of a record of the fit with the first state that brings it nearest, to first order."""
        made = []
        for span, one in zip(self.spans, y):
            if span.fit is None:
                made.append(one)
                continue
            record, dofs = span.record, span.record.outputs
            none = np.zeros((record.samples, dofs))
            R = np.stack([self.plant.response(none, record, x0) for x0 in np.eye(2 * dofs)], axis=2)
            kept = np.isfinite(record.y) & (np.arange(record.samples)[:, None] < span.fit.stop)
            size = np.maximum(np.nanstd(record.y, axis=0), 1e-300)
            table, error = (R / size[:, None])[kept], ((record.y - one) / size)[kept]
            scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
            made.append(one + R @ (np.linalg.lstsq(table / scale, error, rcond=1e-10)[0] / scale))
        return tuple(made)

    def seen(
        self, linear: NumbersSimulator, candidate: Candidate, wholes: "Linear", runs: Runs
    ) -> tuple[np.ndarray, ...]:
        """What the sensors show of runs with the laws of a candidate, begun from its first states."""
        candidate, made = wholes.extended(candidate), []
        begun = dataclasses.replace(candidate, x0=wholes.states)
        sensors = [term for term in candidate.terms if isinstance(term.effect, AbstractOutputEffect)]
        for k, (span, data, y) in enumerate(zip(self.spans, wholes.data, runs.y)):
            moved = linear.motion(candidate, data, k)[0] - linear.motion(begun, data, k)[0]
            shown = jnp.asarray(y + moved[: len(y), : y.shape[1]])
            for term in sensors:
                shown = sensed(term, shown, jnp.asarray(span.record.u), span.record.sampling_time)
            made.append(np.asarray(shown))
        return tuple(made)


@dataclass(frozen=True)
class Linear:
    """Whole `records` for the linear plant about some runs, its first `states` there, the records as `data`, by how
    much more force every number takes; the `motions` of the runs, and what its steps add to their forces (`rests`);
    `along` as of `Runs`."""

    records: tuple[Record, ...]
    states: tuple[np.ndarray, ...]
    data: tuple[Data, ...]
    by_number: tuple[np.ndarray, ...]
    motions: tuple[np.ndarray, ...]
    rests: tuple[np.ndarray, ...]
    along: bool

    def series(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness and damping of a record over time, beside those of the linear plant, and the forces there."""
        u, dofs, numbers = self.records[k].u, self.motions[k].shape[1], self.by_number[k].shape[2]
        first = u.shape[1] - (3 + numbers) * dofs
        stiffness, damping, forces = np.split(u[:, first : first + 3 * dofs], 3, axis=1)
        return stiffness, damping, forces + stiffness + damping

    def beside(self, k: int, q: Float[np.ndarray, "samples dofs"]) -> Float[np.ndarray, "samples dofs"]:
        """Forces at the coordinates, beside those of M, D, K, that a motion of the varying plant takes."""
        stiffness, damping, _ = self.series(k)
        return forces_beside(stiffness, damping, q, self.records[k]) + self.rests[k]

    def near(self, y: tuple[np.ndarray, ...]) -> "Linear":
        """The same as far as runs are near the records: a linear plant says nothing of what is far from them."""
        records = tuple(until(record, near_until(record, one)) for record, one in zip(self.records, y))
        return dataclasses.replace(self, records=records, data=tuple(map(Data.of, records)))

    def extended(self, candidate: Candidate) -> Candidate:
        """A candidate with first states for all records, those of the fit its own."""
        return dataclasses.replace(candidate, x0=(*candidate.x0, *self.states[len(candidate.x0) :]))


def _pushed(record: Record, inputs: int, forces: np.ndarray) -> Record:
    """A record for the linear plant with more forces at its coordinates."""
    dofs, u = record.outputs, record.u.copy()
    first = inputs + 2 * dofs
    u[:, first : first + dofs] += forces
    return dataclasses.replace(record, u=u)


def sized(simulator: Simulator, call: Call, y: np.ndarray, end: int) -> np.ndarray:
    """Units of the numbers: their own sizes; of one that is 0 the size from which it shows in a run `y` up to its
    sample `end`, 1 where none does."""
    units, y = np.array(call.numbers, float), y[:end]
    moved = max(float(np.std(y)), 1e-300)
    for k in np.flatnonzero(units == 0.0):
        units[k] = 1.0
        for size in SIZES:
            changed = np.array(call.numbers, float)
            changed[k] = size
            made = simulator.tried(dataclasses.replace(call, numbers=changed), end)
            if made is not None and np.sqrt(np.mean((made - y) ** 2)) >= SEEN * moved:
                units[k] = size
                break
    return units


def parts_of(problem: Problem, y: Outputs) -> Parts:
    """Runs of the whole records as runs of their parts."""
    pairs = list(zip(problem.spans, y))
    fit = [span.run(one, span.fit) for span, one in pairs if span.fit is not None]
    return fit, [span.run(one, span.held) for span, one in pairs if span.held is not None]


def nearer(problem: Problem, one: Outputs, other: Outputs) -> Outputs:
    """The runs that leave less of held-out data, or of those of the fit where there are no others."""

    def left(y: Outputs) -> float:
        fit, held = parts_of(problem, y)
        return float(np.sum(np.log(rms_of(held or fit))))

    return one if left(one) <= left(other) else other
