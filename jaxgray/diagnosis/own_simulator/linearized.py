"""The linear plant M q̈ + D q̇ + K q = E u + w that a simulator is for small changes of its forces, and the forces that
give such a plant a motion.

The simulator is run with small, wide-band changes of its forces, then of its inputs. Its answers have no noise, so that
plain least squares on the force equation gives M, D, K, and E.
"""

from dataclasses import dataclass

import numpy as np
import scipy.signal
from jaxtyping import Float

from ...mechanics.drives import Force
from ...mechanics.extended import Plant, held_input
from ...mechanics.statespace import hold_matrices
from ...numerics.outcomes import RESULTS, ComputationError
from ...records import Record
from ..equation_error.band import band_of
from ..equation_error.regression import Equation
from ..equation_error.rows import around_samples, series_of
from ..model.candidate import Data
from ..screening.linearization import sampled_plant
from .calls import Call, Simulator

HIGHEST = 0.1
"""Highest frequency of the changes, per sample."""

ANSWER = 0.02
"""Size that an answer should have, relative to the motion."""

WITHIN = 10.0
"""How many times more or less than that it may be."""

ATTEMPTS = 4
"""Sizes of a change that are tried."""

REVERSAL = 0.1
"""Velocity about a reversal, relative to its root mean square, at which damping may be other."""

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
        return np.asarray(system.response(padded.u, first))[: len(w)]

    def forces_of(self, q: Float[np.ndarray, "samples dofs"], like: Record) -> tuple[np.ndarray, np.ndarray]:
        """Forces at the coordinates, and the first state, under which the plant makes a motion."""
        h = like.sampling_time
        x0 = np.concatenate([q[0], (-3 * q[0] + 4 * q[1] - q[2]) / (2 * h)])
        w = self._balance(q, h)
        for _ in range(STEPS):
            w = w + self._balance(q - self.response(w, like, x0), h)
        return w, x0

    def forces_beside(self, error: np.ndarray, motion: np.ndarray, like: Record) -> np.ndarray:
        """Forces that move the simulator by `error` beside a motion of its own, about."""
        return self.varying(error, motion, like.sampling_time)

    def _balance(self, q, h):
        """M q̈ + D q̇ + K q by central differences."""
        slope, second = _derivatives(q, h)
        return second @ self.mass.T + slope @ self.damping.T + q @ self.stiffness.T


@dataclass(frozen=True)
class Varying:
    """Forces of a small motion beside a large one: by M, D, K, by stiffness at every coordinate that goes with its
    displacement and the square of that, and by other damping near reversals.

    `table`: a row of coefficients for every coordinate; `q`, `v`: sizes of displacement and velocity.
    """

    table: Float[np.ndarray, "dofs columns"]
    q: Float[np.ndarray, " dofs"]
    v: Float[np.ndarray, " dofs"]

    def __call__(self, small: np.ndarray, large: np.ndarray, h: float) -> Float[np.ndarray, "samples dofs"]:
        made = [self._columns(small, large, h, i) @ row for i, row in enumerate(self.table)]
        return np.stack(made, axis=1)

    def _columns(self, small, large, h, i):
        slope, second = _derivatives(small, h)
        q = large[:, i] / self.q[i]
        near = np.exp(-((np.gradient(large[:, i], h) / (REVERSAL * self.v[i])) ** 2))
        own = [small[:, i] * q, small[:, i] * q**2, slope[:, i] * near]
        return np.concatenate([second, slope, small, np.stack(own, axis=1)], axis=1)

    @classmethod
    def of(cls, small: np.ndarray, large: np.ndarray, force: np.ndarray, h: float) -> "Varying":
        """That of an answer `small` to forces beside a motion `large`, by least squares."""
        q = np.maximum(np.sqrt(np.mean(large**2, axis=0)), 1e-300)
        v = np.maximum(np.sqrt(np.mean(np.gradient(large, h, axis=0) ** 2, axis=0)), 1e-300)
        empty, rows = cls(np.zeros((large.shape[1], 0)), q, v), []
        for i in range(large.shape[1]):
            X = empty._columns(small, large, h, i)
            size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
            rows.append(np.linalg.lstsq(X / size, force[:, i], rcond=1e-9)[0] / size)
        return cls(np.stack(rows), q, v)


def _derivatives(q: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    slope, second = np.gradient(q, h, axis=0), np.zeros_like(q)
    second[1:-1] = (q[2:] - 2 * q[1:-1] + q[:-2]) / h**2
    second[0], second[-1] = second[1], second[-2]
    return slope, second


def _ahead(plant: Plant, data: Data):
    """B_1 of the sampled plant: what the first input adds to its state under a linear hold."""
    continuous = plant.drive.state_space(plant.mass, plant.damping, plant.stiffness, plant.measured, data.sampling_time)
    return hold_matrices(continuous.A, continuous.B, 1.0, data.hold)[2]


def linearized(
    simulator: Simulator, record: Record, call: Call, y: Float[np.ndarray, "samples outputs"], rng: np.random.Generator
) -> Linearized:
    """The linear plant of a simulator about a run.

    **Arguments:** `simulator`; `record`: for sampling time, hold and names; `call` and its outputs `y`; `rng`.

    **Raises:** `ComputationError` where the outputs do not answer to forces as a mechanical system does.
    """
    dofs, h = record.outputs, record.sampling_time
    size = np.maximum(np.std(y, axis=0), 1e-12 * max(float(np.std(y)), 1e-300))
    # Where nothing acts, any force: its size is found by what answers.
    force = float(np.sqrt(np.mean(call.u**2))) or 1.0

    def by_forces(change):
        return Call(call.u, call.w + change, call.numbers)

    def by_inputs(change):
        return Call(call.u + change, call.w, call.numbers)

    shape = _wide_band(len(y), dofs, rng)
    w, answer = _answered(simulator, by_forces, force * shape, y, size)
    pushed = Record(w, answer, h, hold=record.hold)
    band = band_of([pushed])
    series = series_of(pushed, band, at_rest=True)
    equation = Equation([series], np.eye(dofs))
    fit = equation.fit((), equation.plain()) if np.all(np.ptp(answer, axis=0) > 0) else None
    if fit is None:
        detail = (
            "its outputs do not answer to the forces w as a system with mass does; w is a force (or torque) in the "
            "coordinate of every output, beside what acts there"
        )
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
    M, D, K = fit.matrices
    varying = Varying.of(answer, y, around(w, record.hold), h)
    inputs = np.std(call.u, axis=0)
    shape = _wide_band(len(y), record.inputs, rng) * np.where(inputs > 0, inputs, force)
    u, answer = _answered(simulator, by_inputs, shape, y, size)
    # What the same answer takes as forces, not for M, D, K alone, which are means over the motion.
    E = np.linalg.lstsq(around(u, record.hold), varying(answer, y, h), rcond=1e-10)[0].T
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
        tried = scale * change, made - y
        share = float(np.sqrt(np.mean((tried[1] / size) ** 2)))
        if ANSWER / WITHIN < share < ANSWER * WITHIN or share == 0.0:
            break
        scale *= ANSWER / share
    return tried if tried is not None else (scale * change, simulator.run(changed(scale * change)) - y)


def around(w: np.ndarray, hold: str) -> np.ndarray:
    """Held forces as they are about every sample."""
    return around_samples(*held_input(w, hold))


def _wide_band(samples: int, channels: int, rng: np.random.Generator) -> np.ndarray:
    sections = scipy.signal.butter(4, 2 * HIGHEST, output="sos")
    noise = scipy.signal.sosfilt(sections, rng.standard_normal((samples, channels)), axis=0)
    return noise / np.std(noise, axis=0)
