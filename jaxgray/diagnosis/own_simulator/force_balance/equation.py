"""The equation of motion of a simulator along a measured motion, by momenta: no acceleration is needed.

    d/dt p(q, q̇, θ) = f(q, q̇, θ) + e(q, q̇, u, θ) − Σ b φ(q, q̇)        p = M(q) q̇; e: of the actuators

Every term goes through one zero-phase filter. Momenta and forces are linear in the base parameters of a robot, and so
in its numbers θ, except in lengths: there to first order about those that were given.

**Reference:** Gautier & Khalil, *Direct calculation of minimum set of inertial parameters of serial robots*, IEEE
Trans. Robotics and Automation 6 (1990) 368-373; Slotine & Li, Int. J. Robotics Research 6 (1987) 49-59, for filtered
momenta.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from ....numerics.outcomes import RESULTS, ComputationError
from ....records import Record
from ... import settings
from ...equation_error.band import ABOVE_NOISE
from ...equation_error.regression import Equation, ForceFit, Weight
from ...equation_error.rows import Series
from ..runs.problem import SIZES

STEP = 1e-2
"""Change of a number for its column, in units of it."""

SEEN = 0.1
"""Force of a number that was given as 0, relative to the forces of the actuators, as it counts for one of size."""

IDLE = 1e-9
"""Force of a number, relative to those of the actuators, up to which it is rounding."""

REACH = 3.0
"""Periods of the end of the band over which the filter spreads what is wrong beside them."""

MEAN, HELD, STRAIGHT = 1 / 12, 1 / 2, 1 / 6
"""Shares of the sample before and after: of a force as the second difference of a motion sees it; of an input that is
held, before alone; of one that goes straight from sample to sample."""


@runtime_checkable
class Balanced(Protocol):
    """A simulator that says what its equation of motion is, and runs from any state. One whose steps let forces act
    early says by how much: `lead` [s]."""

    def momenta(self, q: np.ndarray, v: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
        """M(q) q̇ (samples × outputs; [kg m/s], [kg m²/s] of an angle) at positions and velocities of the outputs (the
        same)."""

    def forces(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, u: np.ndarray, numbers: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """What changes them: forces that go with the motion, and those of the actuators (each samples × outputs; [N],
        [N m] of an angle), under inputs `u` (samples × inputs); `a`: accelerations, known less well than the rest, for
        dry friction and stops that depend on them."""

    def windows(self, first: np.ndarray, u: np.ndarray, w: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
        """Outputs of runs of one length (windows × samples × outputs) under inputs `u` (windows × samples × inputs) and
        forces `w` (windows × samples × outputs), from states of their own (windows × positions, then velocities); NaN
        from where one goes astray."""


class BalanceEquation(Equation):
    """The rows of some records: what the simulator lacks on the left, its numbers and laws on the right.

    **Arguments:** `simulator`; `names` of its numbers, `given` values; `records`; `series`: the same in the band of the
    regression, displacements.

    `units` of the numbers; `known`: which of them the motion depends on; `free`: those that a fit may move.
    """

    def __init__(
        self,
        simulator: Balanced,
        names: tuple[str, ...],
        given: Float[np.ndarray, " numbers"],
        records: list[Record],
        series: list[Series],
    ):
        self.simulator, self.names, self.given = simulator, names, given
        self.records, self.series = records, [prepared(*one) for one in zip(records, series)]
        self.dofs, self.mass, self.entries, self._known = records[0].outputs, None, 1, {}
        self.input_map = np.eye(self.dofs)
        lacking, driven = zip(*(self._rows(given, k) for k in range(len(records))))
        self.force, self.driven = [-one for one in lacking], list(driven)
        size = np.sqrt(np.mean(np.concatenate(self.driven) ** 2, axis=0))
        self.size = np.where(size > 0, size, max(float(np.max(size)), 1e-300))
        self.units = np.abs(given)
        columns = [self._column(k) for k in range(len(names))]
        self.table = [
            np.stack([column[k] for column in columns], axis=2) if columns else np.zeros((*force.shape, 0))
            for k, force in enumerate(self.force)
        ]
        largest = [max(float(np.max(np.abs(t[:, :, k]) / self.size)) for t in self.table) for k in range(len(names))]
        self.known = np.array(largest) > IDLE
        self.free = self.known.copy()

    def numbers(self, fit: ForceFit) -> Float[np.ndarray, " numbers"]:
        """Values of the numbers in a fit."""
        return self.given + fit.matrices[0] * self.units

    def errors(self, fit: ForceFit) -> Float[np.ndarray, " numbers"]:
        """Standard errors of these values, 0 of those that were not moved. The noise of the motion in the columns makes
        a share of any number that is no more than its own in the power of the motion, at the end of the band."""
        own = fit.errors[0] * self.units
        return np.where(own > 0, np.hypot(own, self.numbers(fit) / ABOVE_NOISE), 0.0)

    def fit(self, terms, weight: Weight, *, whole: bool = False) -> ForceFit | None:
        """The numbers that are free, and all estimated values of the terms; a number that would change its sign stays
        where it is.

        **Returns:** a `ForceFit` whose matrices are one vector, the change of the numbers in their units; None where
        nothing finite is found.
        """
        free = self.free.copy()
        while True:
            best = self._fit(terms, weight, tuple(free))
            if best is None:
                return None
            wrong = free & (self.given * (self.given + best.matrices[0] * self.units) < 0)
            wrong |= free & (self.given == 0) & (best.matrices[0] < 0)
            if not wrong.any():
                return best
            free &= ~wrong

    def free_only(self, terms, weight: Weight) -> Bool[np.ndarray, " numbers"]:
        """The fewest numbers that have to be other: they stay as they were, the one first that the equation misses
        least, until every further one would be missed."""
        free = self.known.copy()
        while free.any():
            costs = {k: self.missed(terms, weight, free, k) for k in np.flatnonzero(free)}
            least = min(costs, key=costs.__getitem__)
            if costs[least] >= settings.MIN_DELTA_BIC:
                break
            free[least] = False
        return free

    def missed(self, terms, weight: Weight, free: Bool[np.ndarray, " numbers"], k: int, other: int = -1) -> float:
        """By how much the criterion grows where a number stays as it was, another free in its place if there is one."""
        less = free & (np.arange(len(free)) != k) | (np.arange(len(free)) == other)
        with_it, without = (self.with_free(one).fit(terms, weight) for one in (free, less))
        return np.inf if without is None or with_it is None else float(without.criterion - with_it.criterion)

    def with_free(self, free: Bool[np.ndarray, " numbers"]) -> "BalanceEquation":
        """The same equation with other numbers free."""
        made = object.__new__(BalanceEquation)
        vars(made).update(vars(self) | {"free": free})
        return made

    def unmoved(self) -> ForceFit:
        """The fit that moves nothing."""
        nothing = np.zeros(len(self.names))
        left = np.concatenate(self.force) / self.size
        cost, count = float(np.sum(left**2)), left.size
        return ForceFit(
            (nothing,), (nothing,), (), np.zeros((0, 0)), cost, count, 0, tuple(self.force), tuple(nothing > 0)
        )

    def relative_error(self, fit: ForceFit) -> float:
        """‖residual‖/‖forces of the actuators‖ over all rows and coordinates, every coordinate in units of its own."""
        left, whole = (np.concatenate(rows) / self.size for rows in (self.residual(fit), self.driven))
        return float(np.linalg.norm(left) / max(np.linalg.norm(whole), 1e-300))

    def mean_mass(self) -> Float[np.ndarray, "dofs dofs"]:
        """M(q), mean over the rows of the first record."""
        q = self.series[0].q[self.series[0].rows]
        numbers = dict(zip(self.names, self.given))
        units = [np.broadcast_to(e, q.shape) for e in np.eye(self.dofs)]
        M = np.stack([np.mean(self._momenta(q, e, numbers), axis=0) for e in units], axis=1)
        return (M + M.T) / 2

    def mean_input_map(self) -> Float[np.ndarray, "dofs inputs"]:
        """Forces of the actuators by input, means over the rows of the first record."""
        series, numbers = self.series[0], dict(zip(self.names, self.given))
        q, v = series.q[series.rows], series.v[series.rows]
        inputs = self.records[0].inputs
        units = [np.broadcast_to(e, (len(q), inputs)) for e in np.vstack([np.zeros(inputs), np.eye(inputs)])]
        none, *every = (np.mean(self._forces(q, v, 0.0 * v, e, numbers)[1], axis=0) for e in units)
        return np.stack([one - none for one in every], axis=1)

    def _matrices(self, entries):
        return (entries,)

    def _errors(self, spread):
        return (spread,)

    def _entries(self, matrices):
        return matrices[0]

    def windows(
        self,
        first: Float[np.ndarray, "windows states"],
        u: Float[np.ndarray, "windows samples inputs"],
        w: Float[np.ndarray, "windows samples dofs"],
        fit: ForceFit,
    ) -> Float[np.ndarray, "windows samples dofs"]:
        """Runs of the simulator with the numbers of a fit, from states of their own.

        **Raises:** `ComputationError` where it fails, or gives what has another shape.
        """
        numbers = dict(zip(self.names, map(float, self.numbers(fit))))
        return _given(self.simulator.windows, w.shape, first, u, w, numbers)

    def _momenta(self, q, v, numbers) -> np.ndarray:
        return _given(self.simulator.momenta, q.shape, q, v, numbers, finite=True)

    def _forces(self, q, v, a, u, numbers) -> np.ndarray:
        return _given(self.simulator.forces, (2, *q.shape), q, v, a, u, numbers, finite=True)

    def _rows(self, values: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Rate of the momenta less all forces, and the forces of the actuators, at the rows of a record."""
        series, record, numbers = self.series[k], self.records[k], dict(zip(self.names, map(float, values)))
        q, v, h = series.q, series.v, series.sampling_time
        between = self._momenta((q[1:] + q[:-1]) / 2, np.diff(q, axis=0) / h, numbers)
        rate = np.zeros_like(q)
        rate[1:-1] = np.diff(between, axis=0) / h
        u = _around(record, getattr(self.simulator, "lead", 0.0) / h)
        own, driven = self._forces(q, v, series.a, u, numbers)
        # The motion went through the filter already; and forces at the samples are what its differences see of them.
        driven = series.filtered(driven)
        return series.row_values(rate - _mean(own, MEAN) - driven), series.row_values(driven)

    def _column(self, k: int) -> list[np.ndarray]:
        """By how much more force a unit of a number takes, at the rows of every record; sets the unit of one that was
        given as 0."""
        sizes = [self.units[k]] if self.units[k] > 0 else SIZES
        for size in sizes:
            moved = self.given + STEP * size * (np.arange(len(self.names)) == k)
            rows = [(self._rows(moved, j)[0] + force) / STEP for j, force in enumerate(self.force)]
            self.units[k] = size
            if np.sqrt(np.mean((np.concatenate(rows) / self.size) ** 2)) >= SEEN:
                break
        return rows


def _given(function: Callable, shape: tuple[int, ...], *arguments, finite: bool = False) -> np.ndarray:
    """What a function of the user's simulator gives.

    **Raises:** `ComputationError` where it fails, or gives what has another shape or, where it must be, is not finite.
    """
    try:
        made = np.asarray(function(*arguments), dtype=float)
        detail = f"its {function.__name__} gave shape {made.shape}, not {shape}"
    except Exception as error:  # Whatever a user's function raises is what it says of these arguments.
        made, detail = np.zeros(0), f"its {function.__name__} raised {type(error).__name__}: {error}"
    if made.shape == shape and finite and not np.all(np.isfinite(made)):
        made, detail = np.zeros(0), f"its {function.__name__} gave what is not finite"
    if made.shape != shape:
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
    return made


def prepared(record: Record, series: Series) -> Series:
    """A record in the band with velocities that are exact to fourth order in the sampling time, without the rows that
    the filter reaches from an end or a gap."""
    q, h, v = series.q, series.sampling_time, series.v.copy()
    v[2:-2] = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / (12 * h)
    reach = int(np.ceil(REACH / (series.band.high * h)))
    known = np.concatenate([[False], np.isfinite(record.y).all(axis=1), [False]])
    lost = np.flatnonzero(~known) - 1
    after = np.searchsorted(lost, series.rows)
    far = np.minimum(series.rows - lost[after - 1], lost[after] - series.rows) > reach
    return dataclasses.replace(series, v=v, rows=series.rows[far])


def _around(record: Record, lead: float) -> Float[np.ndarray, "samples inputs"]:
    """Inputs as a second difference of the motion sees them, where they act `lead` samples early."""
    u = record.u
    if record.hold == "linear":
        return _mean(u, STRAIGHT) + lead * np.gradient(u, axis=0)
    return u + (HELD - lead) * (np.concatenate([u[:1], u[:-1]]) - u)


def _mean(x: Float[np.ndarray, "samples columns"], share: float) -> np.ndarray:
    """Every sample with a share of the one before and of the one after."""
    made = np.array(x, float)
    made[1:-1] += share * (x[2:] - 2 * x[1:-1] + x[:-2])
    return made
