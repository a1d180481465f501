"""The linear plant M q̈ + D q̇ + K q = E u + w that a simulator is for small changes of its forces, and the forces that
give such a plant a motion.

The simulator is run with small, wide-band changes of its forces, then of its inputs. Its responses have no noise, so
that plain least squares on the force equation gives M, D, K, and E; with forces that are held the second difference of
a motion is its acceleration, averaged around the sample as the forces are.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.signal
from jaxtyping import Float

from ....mechanics.runs.extended import Plant, held_input
from ....mechanics.systems.drives import Force
from ....mechanics.systems.statespace import hold_matrices
from ....numerics.outcomes import RESULTS, ComputationError
from ....numerics.programs.stored_programs import ONCE, stored
from ....records import Record
from ...equation_error.rows import around_samples
from ...model.candidate import Data
from ...screening.linearization import sampled_plant
from .calls import Call, Simulator

HIGHEST = 0.1
"""Highest frequency of the changes, per sample."""

ANSWER = 2e-3
"""Size that an answer should have, relative to the motion."""

WITHIN = 10.0
"""How many times more or less than that it may be."""

MAX_ANSWER = 50.0
"""How many times more, at a sample, an answer is no longer to first order."""

AT_REST = 1e-6
"""Motion of a simulator, relative to that of the record, up to which it is at rest."""

ATTEMPTS = 4
"""Sizes of a change that are tried."""

PIECES = 25
"""Knots of a stiffness that goes with the displacement."""

DRY = 0.05
"""Share of a force near reversals that nothing else may explain where there is no dry friction."""

ROWS, PART = 10, 4
"""Samples in motion that there should be, for every unknown; and the part of a motion, one in so many, over which it is
asked how inputs act, which is the same along all of it."""

REVERSAL = 0.1
"""Velocity about a reversal, relative to its root mean square, at which damping may be other."""

TURN = 0.3
"""Width of the turn of dry friction, relative to the velocity near a reversal."""

WAY = 4
"""Steps on the way from one motion to another."""

STICKS = 0.5
"""Largest damping, in units of mass over sampling time: what sticks needs no more."""

STEPS = 12
"""Of the iteration for the forces of a motion; what is near half the sampling rate never comes."""


@dataclass(frozen=True)
class Linearized:
    """M, D, K and E (coordinates × inputs) of a simulator; `varying`: the same as they vary along its motion."""

    mass: Float[np.ndarray, "dofs dofs"]
    damping: Float[np.ndarray, "dofs dofs"]
    stiffness: Float[np.ndarray, "dofs dofs"]
    input_map: Float[np.ndarray, "dofs inputs"]
    varying: "Varying"

    def response(self, w: Float[np.ndarray, "samples dofs"], like: Record, x0=None) -> np.ndarray:
        """Displacements under forces at the coordinates, held as the inputs of a record are, from `x0` (q, q̇)."""
        dofs, h = len(self.mass), like.sampling_time
        plant = Plant(self.mass, self.damping, self.stiffness, Force(np.eye(dofs)), ("displacement",) * dofs)
        padded = Data.of(Record(w, np.zeros((len(w), dofs)), h, hold=like.hold))
        system = sampled_plant(plant, padded, dofs)
        first = np.zeros(2 * dofs) if x0 is None else np.concatenate([x0[:dofs], h * x0[dofs:]])
        if like.hold == "linear":
            # The sampled state under a linear hold is x less what the first input adds.
            first = first - np.asarray(_ahead(plant, padded)) @ padded.u[0]
        return np.asarray(_respond(system, padded.u, first))[: len(w)]

    def forces_of(self, q: Float[np.ndarray, "samples dofs"], like: Record) -> tuple[np.ndarray, np.ndarray]:
        """Forces at the coordinates, and the first state, under which the plant makes a motion."""
        h = like.sampling_time
        x0 = np.concatenate([q[0], (-3 * q[0] + 4 * q[1] - q[2]) / (2 * h)])
        balance = self._balance(like)
        w = balance(q)
        # A record does not begin at rest: its first force is that after it, about.
        w[0] = w[1] if like.hold == "linear" else 2 * w[1] - w[2]
        for _ in range(STEPS):
            w = w + balance(q - self.response(w, like, x0))
        return w, x0

    def forces_beside(self, error: np.ndarray, motion: np.ndarray, like: Record) -> np.ndarray:
        """Forces that move the simulator by `error` beside a motion of its own, about."""
        f = self.varying(error, motion, like.sampling_time)
        # Held from sample to sample, forces act half a sample later: so that none comes late, the mean of two.
        return f if like.hold == "linear" else np.concatenate([(f[:-1] + f[1:]) / 2, f[-1:]])

    def beside(
        self, motion: Float[np.ndarray, "samples dofs"], other: Float[np.ndarray, "samples dofs"], like: Record
    ) -> tuple[Float[np.ndarray, "samples dofs"], Float[np.ndarray, "samples dofs"]]:
        """Stiffness and damping at every coordinate, beside those of this plant, that lead from one motion of the
        simulator to another (NaN where it is not known)."""
        dofs, table = len(self.mass), self.varying.table
        stiffness, damping = self.varying.beside(motion, other, like.sampling_time, like.hold)
        D, K = (np.diag(table[:, k * dofs : (k + 1) * dofs]) for k in (1, 2))
        return stiffness + K - np.diag(self.stiffness), damping + D - np.diag(self.damping)

    def _balance(self, like: Record) -> Callable[[np.ndarray], np.ndarray]:
        """From a motion that begins at rest (samples × dofs) to the forces under it (the same), held as the inputs of a
        record are, by what the sampled plant makes of three samples in a row: wrong to second order in the frequency,
        and at a resonance no more than beside it."""
        dofs, D, K = len(self.mass), self.damping[None], self.stiffness[None]
        A, B = (X[0] for X in sampled_over_time(self.mass, D, K, like.sampling_time))
        into = A[:dofs, dofs:]
        back = into @ A[dofs:, dofs:] @ np.linalg.inv(into)
        first, last = into @ A[dofs:, :dofs] - back @ A[:dofs, :dofs], A[:dofs, :dofs] + back
        given = B[:dofs] + into @ B[dofs:] - back @ B[:dofs]

        def balance(q):
            padded = np.concatenate([np.zeros((1, dofs)), q])
            # What acts over two samples, from the middle one.
            taken = padded[2:] - padded[1:-1] @ last.T - padded[:-2] @ first.T
            made = np.linalg.solve(given, taken.T).T
            made = np.concatenate([made, made[-1:]])
            # Held forces act half a sample later than where they are given: a mean of what is before and after.
            return made if like.hold == "linear" else over_samples(made)

        return balance


@dataclass(frozen=True)
class Varying:
    """Forces of a small motion beside a large one: by M, D, K, by stiffness at every coordinate that goes with its
    displacement, in straight pieces, and by other damping near reversals.

    `table`: a row of coefficients for every coordinate; `knots` of the pieces, a row a coordinate; `mean`: of every
    piece along the motion; `v`: velocity [1/s] below which a coordinate is near a reversal that dry friction makes, 0
    where none does.
    """

    table: Float[np.ndarray, "dofs columns"]
    knots: Float[np.ndarray, "dofs knots"]
    mean: Float[np.ndarray, "dofs knots"]
    v: Float[np.ndarray, " dofs"]

    def __call__(self, small: np.ndarray, large: np.ndarray, h: float) -> Float[np.ndarray, "samples dofs"]:
        made = [self._columns(small, large, h, i) @ row for i, row in enumerate(self.table)]
        return np.stack(made, axis=1)

    def _columns(self, small, large, h, i):
        slope, second = _derivatives(small, h)
        near = self._near(np.gradient(large[:, i], h), i)
        near = np.concatenate([near[:1], (near[:-1] + near[1:]) / 2])
        # As they are about the sample, like the force.
        small = small + second * h**2 / 12
        pieces = small[:, i, None] * (knot_shares(large[:, i], self.knots[i]) - self.mean[i])
        return np.concatenate([second, slope, small, pieces, (slope[:, i] * near)[:, None]], axis=1)

    @classmethod
    def of(cls, small: np.ndarray, large: np.ndarray, force: np.ndarray, h: float) -> "Varying":
        """That of an answer `small` to forces beside a motion `large`, by least squares."""
        dofs = large.shape[1]
        knots = np.stack([np.linspace(q.min(), max(q.max(), q.min() + 1e-300), PIECES) for q in large.T])
        mean = np.stack([np.mean(knot_shares(q, k), axis=0) for q, k in zip(large.T, knots)])
        v = REVERSAL * np.maximum(np.sqrt(np.mean(np.gradient(large, h, axis=0) ** 2, axis=0)), 1e-300)
        empty, rows = cls(np.zeros((dofs, 0)), knots, mean, v), []
        for i in range(dofs):
            X, moving = empty._columns(small, large, h, i), empty.in_motion(large, h)[i]
            # Derivatives at the ends see one side alone.
            inner = (np.arange(len(X)) > 1) & (np.arange(len(X)) < len(X) - 2)
            moving, turning, row = inner & moving, inner & ~moving, np.zeros(X.shape[1])
            row[:-1] = _least_squares(X[moving, :-1], force[moving, i])
            beyond = force[:, i] - X @ row
            if np.any(turning) and np.mean(beyond[turning] ** 2) > DRY**2 * np.mean(force[turning, i] ** 2):
                row[-1] = max(_least_squares(X[turning, -1:], beyond[turning])[0], 0.0)
            else:
                v[i] = 0.0
            rows.append(row)
        return cls(np.stack(rows), knots, mean, v)

    def _near(self, slope: np.ndarray, i: int) -> np.ndarray:
        """Slope of a friction of size 1 over the velocity [s], from sample to sample."""
        if self.v[i] == 0.0:
            return 0.0 * slope
        turn = TURN * self.v[i]
        force, rise = np.tanh(slope / turn), np.diff(slope)
        at_once, still = (1 - force[:-1] ** 2) / turn, np.abs(rise) < 1e-3 * turn
        secant = np.where(still, at_once, np.diff(force) / np.where(still, 1.0, rise))
        return np.concatenate([secant, secant[-1:]])

    def in_motion(self, large: np.ndarray, h: float) -> list[np.ndarray]:
        """Samples that are not near a reversal of a coordinate, where dry friction takes the force and nothing answers;
        all samples where there are few others."""
        moving = [(np.abs(slope) > v) | (v == 0) for slope, v in zip(np.gradient(large, h, axis=0).T, self.v)]
        return [rows if np.sum(rows) >= ROWS * PIECES else np.ones(len(rows), bool) for rows in moving]

    def sampled(self, large: Float[np.ndarray, "samples dofs"], h: float) -> tuple[np.ndarray, np.ndarray]:
        """What (q, q̇) of a small motion become over each sample beside a large one, and what held forces add:
        (samples × 2 dofs × 2 dofs) and (samples × 2 dofs × dofs)."""
        samples, dofs = large.shape
        M, D, K = (self.table[:, k * dofs : (k + 1) * dofs] for k in range(3))
        stiffness, damping = np.tile(K, (samples, 1, 1)), np.tile(D, (samples, 1, 1))
        speed = np.gradient(large, h, axis=0)
        for i in range(dofs):
            pieces = over_samples(knot_shares(large[:, i], self.knots[i])) - self.mean[i]
            stiffness[:, i, i] += pieces @ self.table[i, 3 * dofs : -1]
            damping[:, i, i] += self.table[i, -1] * self._near(speed[:, i], i)
        return sampled_over_time(M, damping, stiffness, h)

    def response(self, forces: Float[np.ndarray, "samples dofs *many"], large: np.ndarray, like: Record) -> np.ndarray:
        """The small motion that forces, held as the inputs of a record are, make from rest beside a large one; or many,
        side by side."""
        # Under a linear hold over each sample their mean.
        forces = over_samples(forces) if like.hold == "linear" else forces
        return moved_from_rest(*self.sampled(large, like.sampling_time), forces)

    def beside(self, large: np.ndarray, other: np.ndarray, h: float, hold: str) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness and damping at every coordinate, beside M, D, K, held as inputs are, on the way from one large
        motion to another (NaN where it is not known): a mean stiffness leads from the one to the other; damping is that
        along the first."""
        dofs = large.shape[1]
        stiffness, damping = np.zeros_like(large), np.zeros_like(large)
        speed, other = np.gradient(large, h, axis=0), np.where(np.isfinite(other), other, large)
        over = over_samples if hold == "zero" else np.asarray
        shares = (np.arange(WAY) + 0.5) / WAY
        for i in range(dofs):
            for share in shares:
                q = large[:, i] + share * (other[:, i] - large[:, i])
                pieces = over(knot_shares(q, self.knots[i])) - self.mean[i]
                stiffness[:, i] += pieces @ self.table[i, 3 * dofs : -1] / WAY
            most = STICKS * self.table[i, i] / h
            near = self._near(speed[:, i], i)
            if hold == "linear":
                near = np.concatenate([near[:1], (near[:-1] + near[1:]) / 2])
            damping[:, i] = np.minimum(self.table[i, -1] * near, most)
        return stiffness, damping

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, D, K, means along the motion."""
        dofs = len(self.table)
        parts = (self.table[:, k * dofs : (k + 1) * dofs] for k in range(3))
        M, D, K = ((X + X.T) / 2 for X in parts)
        return M, _semidefinite(D), _semidefinite(K)


def sampled_over_time(M, damping, stiffness, h: float) -> tuple[np.ndarray, np.ndarray]:
    """What (q, q̇) become over each sample, and what held forces add: (samples × 2 dofs × 2 dofs) and (samples × 2 dofs
    × dofs); `damping`, `stiffness` (samples × dofs × dofs) over time, held."""
    dofs, inverse = len(M), np.linalg.inv(M)
    system = np.zeros((len(stiffness), 3 * dofs, 3 * dofs))
    system[:, :dofs, dofs : 2 * dofs] = np.eye(dofs)
    system[:, dofs : 2 * dofs, :dofs] = -inverse @ stiffness
    system[:, dofs : 2 * dofs, dofs : 2 * dofs] = -inverse @ damping
    system[:, dofs : 2 * dofs, 2 * dofs :] = inverse
    made = scipy.linalg.expm(h * system)
    return made[:, : 2 * dofs, : 2 * dofs], made[:, : 2 * dofs, 2 * dofs :]


def moved_from_rest(A, B, forces: Float[np.ndarray, "samples dofs *many"]) -> Float[np.ndarray, "samples dofs *many"]:
    """Displacements that forces make from rest, sample by sample as `sampled_over_time` has them."""
    dofs = forces.shape[1]
    x, made = np.zeros((2 * dofs, *forces.shape[2:])), np.empty(forces.shape)
    for k, w in enumerate(forces):
        made[k] = x[:dofs]
        x = A[k] @ x + B[k] @ w
    return made


def _least_squares(X: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Weights of the columns, no row counting for more than half of all: what grew large is no longer small."""
    size = np.linalg.norm(X, axis=0)
    known, found = size > 1e-12 * np.max(size, initial=1e-288), np.zeros(X.shape[1])
    X = X[:, known] / size[known]
    rows = np.linalg.norm(X, axis=1)
    weight = 1 / np.maximum(rows, np.median(rows) + 1e-300)
    found[known] = np.linalg.lstsq(weight[:, None] * X, weight * y, rcond=1e-6)[0] / size[known]
    return found


def _semidefinite(X: np.ndarray) -> np.ndarray:
    """The nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(X)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def knot_shares(q: Float[np.ndarray, " samples"], knots: Float[np.ndarray, " knots"]) -> np.ndarray:
    """Shares of the knots in a curve of straight pieces at q, constant beyond the last."""
    return np.stack([np.interp(q, knots, one) for one in np.eye(len(knots))], axis=1)


def over_samples(X: np.ndarray) -> np.ndarray:
    """Means over every sample of what is given at its beginning."""
    return np.concatenate([(X[:-1] + X[1:]) / 2, X[-1:]])


def _derivatives(q: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    slope, second = np.gradient(q, h, axis=0), np.zeros_like(q)
    second[1:-1] = (q[2:] - 2 * q[1:-1] + q[:-2]) / h**2
    second[0], second[-1] = second[1], second[-2]
    return slope, second


@stored(level=ONCE)
def _respond(system, u, first):
    return system.response(u, first)


def _ahead(plant: Plant, data: Data):
    """B_1 of the sampled plant: what the first input adds to its state under a linear hold."""
    continuous = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, data.sampling_time)
    return hold_matrices(continuous.A, continuous.B, 1.0, data.hold)[2]


def linearized(
    simulator: Simulator,
    record: Record,
    call: Call,
    y: Float[np.ndarray, "samples outputs"],
    rng: np.random.Generator,
    end: int | None = None,
    input_map: Float[np.ndarray, "dofs inputs"] | None = None,
) -> Linearized:
    """The linear plant of a simulator about a run.

    **Arguments:** `simulator`; `record`: for sampling time, hold and names; `call` and its outputs `y`; `rng`; `end`:
    the sample up to which the run counts; `input_map`: E, where it is known of another run.

    **Raises:** `ComputationError` where the outputs do not answer to forces as a mechanical system does.
    """
    # Fewer would not determine it.
    dofs, h, y = record.outputs, record.sampling_time, y[: None if end is None else max(end, ROWS * PIECES)]
    call = call.until(len(y)) if simulator.stops else call
    # Of a simulator at rest, answers are small relative to the motion of the record.
    moved, measured = np.std(y, axis=0), np.nanstd(record.y, axis=0)
    moved = moved if np.any(moved > AT_REST * measured) else measured
    size = np.maximum(moved, 1e-3 * max(float(np.max(moved)), 1e-300))
    # Where nothing acts, any force: its size is found by what answers.
    force = float(np.sqrt(np.mean(call.u**2))) or 1.0

    def by_forces(change):
        return Call(call.u, call.w + change, call.numbers)

    def by_inputs(change):
        return Call(call.u + change, call.w, call.numbers)

    shape = _wide_band(len(call.u), dofs, rng)
    w, answer = _answered(simulator, by_forces, force * shape, y, size)
    small = _small(answer, size)
    w, answer, y = w[:small], answer[:small], y[:small]
    answers = bool(np.all(np.ptp(answer, axis=0) > 0))
    varying = Varying.of(answer, y, around(w, record.hold), h) if answers else None
    M, D, K = varying.matrices if answers else np.zeros((3, dofs, dofs))
    if not np.all(np.linalg.eigvalsh(M) > 0):
        detail = (
            "its outputs do not answer to the forces w as those of a system with mass do; w is a force (or torque) at "
            "the coordinate of every output, added to what acts there"
        )
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
    if input_map is not None:
        return Linearized(M, D, K, input_map, varying)
    inputs = np.std(call.u, axis=0)
    moved = np.cumsum(np.sum((np.gradient(y, axis=0) / size) ** 2, axis=1))
    y = y[: max(int(np.searchsorted(moved, moved[-1] / PART)) + 1, 2 * ROWS * PIECES)]
    call = call.until(len(y)) if simulator.stops else call
    shape = _wide_band(len(call.u), record.inputs, rng) * np.where(inputs > 0, inputs, force)
    u, answer = _answered(simulator, by_inputs, shape, y, size)
    small = _small(answer, size)
    u, answer, y = u[:small], answer[:small], y[:small]
    # What the same answer takes as forces, not for M, D, K alone, which are means over the motion.
    U, taken = around(u, record.hold), varying(answer, y, h)
    E = np.stack([_least_squares(U[rows], taken[rows, i]) for i, rows in enumerate(varying.in_motion(y, h))])
    return Linearized(M, D, K, E, varying)


def _answered(simulator: Simulator, changed, change, y, size) -> tuple[np.ndarray, np.ndarray]:
    """A change of fit size, and the answer to it."""
    scale, tried = ANSWER, None
    for _ in range(ATTEMPTS):
        call = changed(scale * change)
        made = simulator.tried(call)
        if made is None:
            # Too much for it, maybe.
            scale /= WITHIN**2
            continue
        tried = scale * change, made[: len(y)] - y
        share = float(np.sqrt(np.mean((tried[1] / size) ** 2)))
        if ANSWER / WITHIN < share < ANSWER * WITHIN or share == 0.0:
            break
        scale *= ANSWER / share
    return tried if tried is not None else (scale * change, simulator.run(changed(scale * change))[: len(y)] - y)


def _small(answer: np.ndarray, size: np.ndarray) -> int:
    """The sample up to which an answer is to first order; all where too few would be left."""
    far = np.any(np.abs(answer) > MAX_ANSWER * ANSWER * size, axis=1)
    end = int(np.argmax(far)) if np.any(far) else len(answer)
    return end if end >= ROWS * PIECES else len(answer)


def around(w: np.ndarray, hold: str) -> np.ndarray:
    """Held forces as they are about every sample."""
    return around_samples(*held_input(w, hold))


def _wide_band(samples: int, channels: int, rng: np.random.Generator) -> np.ndarray:
    sections = scipy.signal.butter(4, 2 * HIGHEST, output="sos")
    noise = scipy.signal.sosfilt(sections, rng.standard_normal((samples, channels)), axis=0)
    return noise / np.std(noise, axis=0)
