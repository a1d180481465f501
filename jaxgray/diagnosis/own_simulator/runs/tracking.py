"""The force that brings a simulator to the record: iterative learning, every force the most likely one in its linear
plant as it varies along the last run.

**Reference:** Moore, *Iterative Learning Control for Deterministic Systems*, Springer 1993.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ....numerics.matrices.bounded import bounded
from ....numerics.responses.filters import white_part
from ....records import Record
from ... import settings
from ...model.free_run import FreeRun
from .calls import Call, Failure, Simulator
from .forecast import forecast
from .linearized import Linearized

ROUNDS = 6
"""Runs of the simulator at most."""

APPROACHES = 16
"""Runs at most until none is far from the record."""

NEAR, NEAREST = 0.25, 0.02
"""Error, relative to the motion, up to which a linear plant leads to the record; and the least that is tried for it."""

CORRELATED = 50.0
"""Samples over which a force that is looked for stays about as it is."""

FORCES = np.array([1.0, 0.3, 0.1, 0.03, 0.01])
"""Sizes of that force that are tried, relative to those of the inputs."""

ROUNDING = 1e-6
"""Least noise, relative to the motion."""

SMALL = 0.1
"""Largest difference of a run with a little more of a number, relative to the motion, for a force to first order."""

BEYOND = 5.0
"""Standard deviations of the noise, beside its share of the motion, within which a run is near a record."""

IN_A_ROW, FEWEST, AHEAD = 5, 50, (2.0, 1.25)
"""Samples that a run is far from a record to have left it; fewest of a record that say anything by themselves; and how
many times further than it was led a run goes on, where the one before stayed near all the way and where it did not."""

ENOUGH = 0.95
"""Share of the error that a round must leave at most, for another one."""

NUMBER = 1e-2
"""Step of a number, in units of it, for the force that it takes."""


def as_linear(
    record: Record,
    plant: Linearized,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
    by_number: Float[np.ndarray, "samples dofs numbers"],
) -> tuple[Record, np.ndarray]:
    """A record for the linear plant: behind its own inputs the stiffness and damping by which it varies, the forces
    under which it makes the simulator's motion, less what the call gave it, and by how much more force every number
    takes.

    **Arguments:** `record`; `plant`; `call` and its outputs `y`; `by_number`: as `forces_by_slopes` gives it.

    **Returns:** the record, and the first state of the plant.
    """
    stiffness, damping = plant.beside(y, record.y, record)
    made, x0 = plant.forces_of(y, record)
    made = made + forces_beside(stiffness, damping, y, record)
    columns = np.moveaxis(by_number, 2, 1).reshape(len(y), -1)
    names = [f"{kind} at {name}" for kind in ("stiffness", "damping", "force") for name in record.output_names]
    names += [f"number {k + 1}" for k in range(columns.shape[1])]
    units = [""] * (2 * record.outputs) + [record.input_units[0]] * record.outputs + [""] * columns.shape[1]
    # As inputs the series of the plant act, too.
    forces = made - call.u @ plant.input_map.T - call.w - stiffness - damping
    u = np.concatenate([record.u, stiffness, damping, forces, columns], axis=1)
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


def forces_beside(
    stiffness: Float[np.ndarray, "samples dofs"],
    damping: Float[np.ndarray, "samples dofs"],
    q: Float[np.ndarray, "samples dofs"],
    like: Record,
) -> Float[np.ndarray, "samples dofs"]:
    """Forces that stiffness and damping over time take along a motion, held as the inputs of a record are."""
    h, v = like.sampling_time, np.gradient(q, like.sampling_time, axis=0)
    if like.hold == "linear":
        return stiffness * q + damping * v
    # Over every sample, with a curvature like that at its ends.
    middle, rise = q.copy(), v * h
    rise[:-1] = np.diff(q, axis=0)
    middle[:-1] = (q[:-1] + q[1:]) / 2 - h / 8 * np.diff(v, axis=0)
    return stiffness * middle + damping * rise / h


def tracked(
    simulator: Simulator,
    plant: Linearized,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
) -> tuple[Call, np.ndarray]:
    """The call whose outputs follow the record as far as its noise allows, and those outputs; up to where they leave
    it, where more runs would be needed.

    **Arguments:** `simulator`; `plant`; `record`; `call` to begin with and its outputs `y`.
    """
    begun = _led(simulator, plant, record, call, y)
    if near_until(record, begun[1]) == len(y):
        return begun
    call, y = approached(simulator, plant, record, *begun)
    end = near_until(record, y)
    # No further than it ran.
    call, y = _led(simulator, plant, record if end == len(y) else until(record, max(end, FEWEST)), call, y)
    if not bounded(y):
        # It ran as far as it was led.
        y = simulator.tried(call)
    return begun if y is None else (call, y)


def _led(simulator: Simulator, plant: Linearized, record: Record, call: Call, y: np.ndarray):
    """The call that brings the outputs nearest to what is known of a record, from one on; and those outputs, infinite
    where it did not run."""
    best, size, end = (call, y), relative_error(record, y), _known_until(record)
    for _ in range(ROUNDS):
        call = Call(call.u, following_force(plant, record, call.w, y), call.numbers)
        y = _tried(simulator, call, end)
        if y is None:
            break
        now = relative_error(record, y)
        before, size = size, min(now, size)
        if now < before:
            best = call, y
        kept = np.isfinite(record.y)
        if now > ENOUGH * before or is_white([FreeRun(y, np.where(kept, record.y - y, 0.0), kept)]):
            break
    return best


def is_white(runs: list[FreeRun]) -> bool:
    """Whether runs leave about as much as the white part of it."""
    return all(np.all(run.rmse**2 <= settings.MIN_EXCESS**2 * white_part(run.e, run.kept)) for run in runs)


def _tried(simulator: Simulator, call: Call, end: int) -> Float[np.ndarray, "samples dofs"] | None:
    """The outputs of a call up to a sample, infinite beyond; None where it fails."""
    y = simulator.tried(call, end) if bounded(call.w) else None
    return None if y is None else np.concatenate([y, np.full((len(call.u) - len(y), y.shape[1]), np.inf)])


def _known_until(record: Record) -> int:
    """The sample from which on nothing is known of the outputs of a record."""
    return int(np.max(np.flatnonzero(np.isfinite(record.y).any(axis=1)), initial=1)) + 1


def approached(
    simulator: Simulator,
    plant: Linearized,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
) -> tuple[Call, np.ndarray]:
    """The call whose outputs are near a record for longest, and those outputs, infinite where it did not run.

    A linear plant leads to what is near, so that a run is led to the record up to where it leaves it; what comes after
    begins where the record is, and stays near it for longer, under the force that what is known foretells. It need not
    run much further than that.

    **Arguments:** as `tracked`.
    """
    limit, end, ahead = NEAR, near_until(record, y), AHEAD[0]
    for _ in range(APPROACHES):
        if end == len(y) or limit < NEAREST:
            break
        end = min(end, near_until(record, y, limit))
        known = max(end, FEWEST)
        force = following_force(plant, until(record, known), call.w, y)
        force[known:] = forecast(record, call.u, force[:known], force[known:])
        trial = Call(call.u, force, call.numbers)
        further = int(ahead * known)
        further = further if further < len(y) - IN_A_ROW else len(y)
        there = _tried(simulator, trial, further)
        reached = -1 if there is None else near_until(record, there, limit)
        ahead = AHEAD[reached < further]
        if reached > end:
            call, y, end = trial, there, near_until(record, there, NEAR)
        else:
            limit /= 2
    return call, y


def until(record: Record, end: int) -> Record:
    """A record of whose outputs nothing is known from a sample on; whole where too few would be left."""
    if end < min(FEWEST, record.samples):
        return record
    return dataclasses.replace(record, y=np.where(np.arange(record.samples)[:, None] < end, record.y, np.nan))


def near_until(record: Record, y: np.ndarray, limit: float = NEAR) -> int:
    """The sample at which a run leaves a record for some samples, more than its noise does; as many as there are where
    it does not, or is far from it at once, which is another first state."""
    e, kept = record.y - y, np.isfinite(record.y)
    # Of the record alone: what a run leaves may be no noise.
    noise = np.sqrt(np.maximum(white_part(np.nan_to_num(record.y), kept), 0.0))
    far = np.any(np.abs(np.where(kept, e, 0.0)) > limit * _motion(record) + BEYOND * noise, axis=1)
    left = np.convolve(far, np.ones(IN_A_ROW), mode="valid") == IN_A_ROW
    end = int(np.argmax(left)) if np.any(left) else len(y)
    return end if end >= IN_A_ROW else len(y)


def following_force(
    plant: Linearized, record: Record, w: Float[np.ndarray, "samples dofs"], y: Float[np.ndarray, "samples dofs"]
) -> Float[np.ndarray, "samples dofs"]:
    """The force under which a simulator follows a record as far as its noise allows: the most likely one of limited
    size and speed, in the plant as it varies along a run.

    **Arguments:** `plant`; `record`: NaN where it is not to be followed; `w`, `y`: forces and outputs of the run.

    **Reference:** Rauch, Tung & Striebel, AIAA J. 3 (1965) 1445-1450.
    """
    dofs, motion, whole = y.shape[1], _motion(record), w.copy()
    last = _known_until(record)
    w, y, known = w[:last], y[:last], record.y[:last]
    e, kept = known - y, np.isfinite(known)
    A, B = plant.varying.sampled(y, record.sampling_time)
    noise = np.maximum(white_part(np.where(kept, e, 0.0), kept), (ROUNDING * motion) ** 2)
    # Of the inputs, and of what the motion takes where none acts.
    force = np.mean((record.u[:last] @ plant.input_map.T) ** 2, axis=0)
    force = np.maximum(force, np.mean(plant.varying(y, y, record.sampling_time) ** 2, axis=0)) + 1e-300
    stays = np.exp(-1.0 / CORRELATED)
    F = np.concatenate([np.concatenate([A, B], axis=2), np.zeros((last, dofs, 3 * dofs))], axis=1)
    F[:, 2 * dofs :, 2 * dofs :] = stays * np.eye(dofs)
    # The run has its own forces already.
    less = np.concatenate([np.einsum("kij,kj->ki", -B, w), np.zeros_like(w)], axis=1)
    C, states = np.eye(3 * dofs)[:dofs], np.concatenate([motion, motion / (CORRELATED * record.sampling_time)]) ** 2

    def filtered(size: float, begins: float) -> _Filtered:
        Q = np.diag(np.concatenate([0.0 * states, (1 - stays**2) * size**2 * force]))
        return _filtered(F, less, Q, np.diag(np.concatenate([begins * states, size**2 * force])), C, noise, e)

    tried = {size: filtered(size, 0.0) for size in FORCES}
    best = max(tried, key=lambda size: tried[size].likelihood)
    other = filtered(best, 1.0)
    # A record that begins in another state than the run does: no force mends that.
    elsewhere = other.likelihood > tried[best].likelihood + dofs * np.log(len(y))
    found = (other if elsewhere else tried[best]).smoothed(F)[:, 2 * dofs :]
    whole[:last] = found
    # What is not known stays as it was for a while, and is no more.
    whole[last:] = found[-1] * stays ** np.arange(1, len(whole) - last + 1)[:, None]
    return whole


@dataclass(frozen=True)
class _Filtered:
    """States before (`ahead`) and after every sample was seen, and their covariances; the log-likelihood of it all."""

    ahead: np.ndarray
    after: np.ndarray
    spread_ahead: np.ndarray
    spread_after: np.ndarray
    likelihood: float

    def smoothed(self, F: np.ndarray) -> np.ndarray:
        """The most likely states given all samples."""
        size = np.sqrt(np.maximum(np.einsum("kii->ki", self.spread_ahead[1:]), 1e-300))
        # A first state that is known has no spread.
        scaled = self.spread_ahead[1:] / size[:, :, None] / size[:, None] + 1e-12 * np.eye(size.shape[1])
        across = F[:-1] @ self.spread_after[:-1] / size[:, :, None]
        back = np.swapaxes(np.linalg.solve(scaled, across), 1, 2) / size[:, None]
        x = self.after.copy()
        for k in range(len(x) - 2, -1, -1):
            x[k] += back[k] @ (x[k + 1] - self.ahead[k + 1])
        return x


def _filtered(F, known, Q, P, C, noise, e) -> _Filtered:
    """The Kalman filter of x⁺ = F x + known + noise of covariance Q, from covariance P about 0, seen as C x with noise
    in e, NaN where it is not seen."""
    samples, x, likelihood = len(e), np.zeros(len(P)), 0.0
    seen = np.isfinite(e)
    ahead, after = np.empty((2, samples, len(P)))
    spread_ahead, spread_after = np.empty((2, samples, *P.shape))
    for k in range(samples):
        ahead[k], spread_ahead[k] = x, P
        rows = C[seen[k]]
        if len(rows):
            S = rows @ P @ rows.T + np.diag(noise[seen[k]])
            error = e[k, seen[k]] - rows @ x
            gain = np.linalg.solve(S, rows @ P).T
            likelihood -= 0.5 * (np.linalg.slogdet(S)[1] + error @ np.linalg.solve(S, error))
            x = x + gain @ error
            P = P - gain @ rows @ P
            P = (P + P.T) / 2
        after[k], spread_after[k] = x, P
        x, P = F[k] @ x + known[k], F[k] @ P @ F[k].T + Q
    # A plant that runs away where nothing is seen ends beyond numbers, and is not likely.
    likelihood = float(likelihood) if bounded(likelihood, after, spread_after) else -np.inf
    return _Filtered(ahead, after, spread_ahead, spread_after, likelihood)


def slopes_by_number(
    simulator: Simulator,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples dofs"],
    units: Float[np.ndarray, " numbers"],
) -> Float[np.ndarray, "samples dofs numbers"]:
    """By how much a run moves with a little more of every number, for each of its units, to first order.

    **Arguments:** `simulator`; `record`; `call` and its outputs `y`; `units` of the numbers.

    **Raises:** `ComputationError` where the simulator runs neither with more nor with less of a number.
    """

    def stepped(unit: np.ndarray, step: float) -> Call:
        return Call(call.u, call.w, call.numbers + step * unit)

    found, steps = [], np.diag(units)
    for unit, there in zip(steps, simulator.runs([stepped(unit, NUMBER) for unit in steps])):
        step = NUMBER
        if isinstance(there, Failure):
            # What more of a number is too much for, as of an efficiency of one, less may not be.
            more, step = there, -NUMBER
            there = simulator.runs([stepped(unit, step)])[0]
            if isinstance(there, Failure):
                simulator.finished(stepped(unit, NUMBER), more)
        while np.any(np.max(np.abs(there - y), axis=0) > SMALL * _motion(record)) and abs(step) > NUMBER / 50:
            step /= 10
            there = simulator.run(stepped(unit, step))
        found.append((there - y) / step)
    return np.stack(found, axis=2) if found else np.zeros((*y.shape, 0))


def forces_by_slopes(
    plant: Linearized,
    record: Record,
    y: Float[np.ndarray, "samples dofs"],
    slopes: Float[np.ndarray, "samples dofs numbers"],
) -> Float[np.ndarray, "samples dofs numbers"]:
    """By how much more force every number takes for the same motion, for each of its units, to first order: what brings
    a run with a little more of it back.

    **Arguments:** `plant`; `record`; outputs `y` of a run; their `slopes` by every number, for one of its units.
    """
    found = [plant.forces_beside(-one, y, record) for one in np.moveaxis(slopes, 2, 0)]
    return np.stack(found, axis=2) if found else np.zeros((*y.shape, 0))


def relative_error(record: Record, y: np.ndarray) -> float:
    """Root mean square error of a run, every output in units of its own motion."""
    return relative_size(record, np.where(np.isfinite(record.y), record.y - y, 0.0))


def relative_size(record: Record, error: Float[np.ndarray, "samples dofs"]) -> float:
    """Root mean square of an error, every output in units of its motion in a record; infinite where that overflows."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean((error / _motion(record)) ** 2)))


def _motion(record: Record) -> Float[np.ndarray, " dofs"]:
    """Size of the motion of every output, of one that hardly moves a share of the largest."""
    size = np.nanstd(record.y, axis=0)
    return np.maximum(size, 1e-3 * np.max(size)) + 1e-300
