"""The force that brings a simulator to the record: iterative learning with the inverse of its linear plant.

**Reference:** Moore, *Iterative Learning Control for Deterministic Systems*, Springer 1993; the state of the error by
fixed-interval smoothing, so that noise is not followed.
"""

import numpy as np
from jaxtyping import Float

from ...records import Record
from ..model.candidate import Candidate, Data
from ..screening.linearization import measured_motion, stage_of
from .calls import Call, Failure, Simulator
from .linearized import Linearized
from .numbers import NumbersSimulator

ROUNDS = 6
"""Runs of the simulator at most."""

ENOUGH = 0.95
"""Share of the error that a round must leave at most, for another one."""

NUMBER = 0.02
"""Step of a number, in units of it, for the force that it takes."""

NUMBER_ROUNDS = 3
"""Runs for that force: each leaves half of the error or less, and mixed they leave less."""


def as_linear(
    record: Record,
    plant: Linearized,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
    by_number: Float[np.ndarray, "samples dofs numbers"],
) -> tuple[Record, np.ndarray]:
    """A record for the linear plant: behind its own inputs the forces under which the plant makes the simulator's
    motion, less what the call gave it, and by how much more force every number takes.

    **Arguments:** `record`; `plant`; `call` and its outputs `y`; `by_number`: as `forces_by_number` gives it.

    **Returns:** the record, and the first state of the plant.
    """
    made, x0 = plant.forces_of(y, record)
    columns = np.moveaxis(by_number, 2, 1).reshape(len(y), -1)
    names = [f"force at {name}" for name in record.output_names]
    names += [f"number {k + 1}" for k in range(columns.shape[1])]
    units = [record.input_units[0]] * record.outputs + [""] * columns.shape[1]
    u = np.concatenate([record.u, made - call.u @ plant.input_map.T - call.w, columns], axis=1)
    return Record(
        u,
        record.y,
        record.sampling_time,
        input_names=(*record.input_names, *names),
        output_names=record.output_names,
        input_units=(*record.input_units, *units),
        output_units=record.output_units,
        hold=record.hold,
        measured=record.measured,
        scheduling=record.scheduling,
        start_time=record.start_time,
    ), x0


class Follower:
    """Forces that lead to outputs that are wanted, from runs: each in the direction of the inverse of the linear plant,
    all mixed so that what they leave is least.

    **Reference:** Anderson, *Iterative procedures for nonlinear integral equations*, J. ACM 12 (1965) 547-560.
    """

    def __init__(self, plant: Linearized, record: Record):
        self.plant, self.record, self.size = plant, record, _motion(record)
        self.forces: list[np.ndarray] = []
        self.errors: list[np.ndarray] = []

    def next(self, force, error, y) -> Float[np.ndarray, "samples dofs"]:
        """Forces to try, after some forces, what is missing of the wanted outputs under them, and these outputs."""
        self.forces.append(force + self.plant.forces_beside(error, y, self.record))
        self.errors.append(error / self.size)
        last = self.errors[-1].ravel()
        if len(self.errors) == 1:
            return self.forces[-1]
        changes = np.stack([(last - e.ravel()) for e in self.errors[:-1]], axis=1)
        weights = np.linalg.lstsq(changes, last, rcond=1e-6)[0]
        steps = [w * (self.forces[-1] - f) for w, f in zip(weights, self.forces[:-1])]
        return self.forces[-1] - np.sum(steps, axis=0)


def tracked(
    simulator: Simulator,
    numbers: NumbersSimulator,
    plant: Linearized,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
) -> tuple[Call, np.ndarray]:
    """The call whose outputs follow the record as far as its noise allows, and those outputs.

    **Arguments:** `simulator`; `numbers`, of the same plant; `plant`; `record`; `call` to begin with and its outputs.
    """
    none = np.zeros((*y.shape, len(numbers.setup.here)))
    follower, best, size = Follower(plant, record), (call, y), _size(record, y)
    for _ in range(ROUNDS):
        linear, x0 = as_linear(record, plant, Call(call.u, np.zeros_like(call.w), call.numbers), y, none)
        data = Data.of(linear)
        stage = stage_of(numbers, Candidate(numbers.setup.here, (x0,)), data)
        error = measured_motion(stage, data).q[: len(y)] - stage.motion.q[: len(y)]
        call = Call(call.u, follower.next(call.w, error, y), call.numbers)
        y = simulator.tried(call)
        now = np.inf if y is None else _size(record, y)
        before, size = size, min(now, size)
        if now < before:
            best = call, y
        if now > ENOUGH * before:
            break
    return best


def forces_by_number(
    simulator: Simulator,
    plant: Linearized,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
    units: Float[np.ndarray, " numbers"],
) -> Float[np.ndarray, "samples dofs numbers"]:
    """By how much more force every number takes for the same motion, for each of its units.

    **Arguments:** `simulator`; `plant`; `record`; `call` and its outputs `y`; `units` of the numbers.
    """
    steps = NUMBER * np.diag(units)
    followers = [Follower(plant, record) for _ in units]
    forces, nearest, left = [call.w] * len(units), [call.w] * len(units), [np.inf] * len(units)
    ahead = list(forces)
    for _ in range(NUMBER_ROUNDS if len(units) else 0):
        calls = [Call(call.u, w, call.numbers + step) for w, step in zip(forces, steps)]
        for k, (one, there) in enumerate(zip(calls, simulator.runs(calls))):
            if isinstance(there, Failure) and left[k] == np.inf:
                simulator.finished(one, there)
            size = np.inf
            if not isinstance(there, Failure):
                error = y - there
                with np.errstate(over="ignore"):
                    size = float(np.sqrt(np.mean((error / _motion(record)) ** 2)))
            if size < left[k]:
                nearest[k], left[k] = one.w, size
                ahead[k] = followers[k].next(one.w, error, y)
            else:
                # No nearer, or run away: half way to where that was to lead.
                ahead[k] = (nearest[k] + ahead[k]) / 2
            forces[k] = ahead[k]
    # The last forces were not tried.
    found = [(w - call.w) / NUMBER for w in forces]
    return np.stack(found, axis=2) if found else np.zeros((*y.shape, 0))


def _size(record: Record, y: np.ndarray) -> float:
    """Root mean square error of a run, every output in units of its own motion."""
    e = np.where(np.isfinite(record.y), record.y - y, 0.0)
    with np.errstate(over="ignore"):
        # A run that runs away is infinitely far.
        return float(np.sqrt(np.mean((e / _motion(record)) ** 2)))


def _motion(record: Record) -> Float[np.ndarray, " dofs"]:
    """Size of the motion of every output."""
    return np.maximum(np.nanstd(record.y, axis=0), 1e-300)
