"""Numbers fitted by runs of the simulator itself, over parts of the records that grow.

Where a motion hangs sharply on the numbers (contact, backlash, an arm that turns over and over), a linear plant about
one run does not foretell another, and the sum of squares over a whole record has many minima. Over a short part it has
one, and from there the fit of a longer part begins. A part that numbers alone do not follow ends it.

**Reference:** Bock, *Recent advances in parameter identification techniques for ODE* (1983), for windows in place of
the whole record; here one window grows.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse, step_inside
from ...numerics.matrices.positive import ClarabelSolver
from .. import settings
from ..estimation.gauss_newton import NOTHING, Refit
from ..model.free_run import FreeRun, rms_of
from ..noise.whitening import white_part
from .runs.calls import Call, Failure
from .runs.problem import Problem, Runs, parts_of

SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Parts of the data of the fit, one after the other."""

FEWEST = 100
"""Samples of the first part at least."""

TURNS = 10
"""Gauss-Newton steps a part at most."""

CHANGE = 1e-4
"""Change of an entry for its slope: the motion answers to it far above rounding and far below the motion itself."""

FIRST, MOVED, LARGEST = 2, 0.1, 1e6
"""Samples over which forces lead to a first state; by how much one moves a run, relative to it, and the most of them
in units of that."""

FLAT = 1.0
"""Fall of N ln(mean square) up to which a step was the last."""

DAMPINGS = 1e-3 * 10.0 ** np.arange(6)
"""Of steps that are tried, relative to the diagonal of the normal equations, where the one before did not go down."""


@dataclass(frozen=True)
class Grown:
    """`entries` that follow all data of the fit, the `runs` with them, forces by which these were pushed into their
    first states, a span, and slopes of the runs by every entry."""

    entries: Float[np.ndarray, " numbers"]
    runs: Runs
    pushed: tuple[Float[np.ndarray, "samples dofs"], ...]
    slopes: tuple[Float[np.ndarray, "samples outputs numbers"], ...]

    def fit(self, problem: Problem, fit: Refit) -> Refit:
        """A refit in the linear plant about these runs, with what the simulator itself says of residual and slopes in
        its place."""
        spans = [(s, y, S) for s, y, S in zip(problem.spans, self.runs.y, self.slopes) if s.fit is not None]
        count, residuals, jacobians = len(self.entries), [], []
        for (span, y, S), e, J in zip(spans, fit.residual, fit.jacobian):
            e, J, run = np.zeros_like(e), np.array(J), span.run(y, span.fit)
            e[: len(run.e)], J[: len(run.e), :, :count] = run.e, S[span.fit]
            residuals.append(e)
            jacobians.append(J)
        scale = np.sqrt(_mean_squares([span.run(y, span.fit) for span, y, _ in spans]))
        H, first = np.zeros_like(fit.covariance), count
        for (span, y, _), J in zip(spans, jacobians):
            kept = span.run(y, span.fit).kept
            table = np.zeros((int(kept.sum()), len(H)))
            columns = (J[: len(kept)] / scale[:, None])[kept]
            table[:, :count] = columns[:, :count]
            table[:, first : first + columns.shape[1] - count] = columns[:, count:]
            H, first = H + table.T @ table, first + columns.shape[1] - count
        covariance = pseudo_inverse(H, NOTHING)
        return dataclasses.replace(fit, residual=tuple(residuals), jacobian=tuple(jacobians), covariance=covariance)


@dataclass(frozen=True)
class _Unknowns:
    """What is fitted: a vector of the entries, of which some are `free`, then for every record of the fit the forces
    over its first samples (in `units`) that lead to its first state, with which the simulator cannot begin."""

    problem: Problem
    free: Bool[np.ndarray, " numbers"]
    units: tuple[Float[np.ndarray, "first dofs"], ...]

    @classmethod
    def of(cls, problem: Problem, runs: Runs, free: Bool[np.ndarray, " numbers"]) -> "_Unknowns":
        """With units by which every force moves a run by `MOVED` of it."""
        units = []
        for span, call, y in zip(problem.spans, runs.calls, runs.y):
            dofs = span.record.outputs
            unit = np.zeros((FIRST if span.fit is not None else 0, dofs))
            force, size = max(float(np.std(call.u)), 1e-300), max(float(np.std(y)), 1e-300)
            for k in np.ndindex(unit.shape):
                w = call.w.copy()
                w[k] += force
                made = problem.simulator.tried(dataclasses.replace(call, w=w))
                moved = 0.0 if made is None else float(np.sqrt(np.mean((made - y) ** 2))) / size
                unit[k] = force * MOVED / moved if moved > 0.0 else 0.0
            units.append(unit)
        return cls(problem, free, tuple(units))

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return len(self.problem.units)

    def floors(self, size: int) -> Float[np.ndarray, " unknowns"]:
        """The least of every unknown: numbers keep their sign."""
        return np.where(np.arange(size) < self.count, 0.0, -LARGEST)

    def start(
        self, entries: Float[np.ndarray, " numbers"], pushed: tuple[np.ndarray, ...]
    ) -> Float[np.ndarray, " unknowns"]:
        """Some entries, and forces of every span."""
        forces = [
            np.where(one > 0.0, w[: len(one)] / np.where(one > 0.0, one, 1.0), 0.0)
            for one, w in zip(self.units, pushed)
        ]
        return np.concatenate([entries, *(one.ravel() for one in forces)])

    def calls(self, vector: Float[np.ndarray, " unknowns"]) -> list[Call]:
        """Calls with some values of the unknowns."""
        ends = np.cumsum([self.count, *(unit.size for unit in self.units)])
        calls = self.problem.called(vector[: self.count])
        for call, unit, end in zip(calls, self.units, ends[1:]):
            call.w[: len(unit)] = vector[end - unit.size : end].reshape(unit.shape) * unit
        return calls

    def slopes(self, runs: Runs, vector: Float[np.ndarray, " unknowns"]) -> tuple[np.ndarray, ...] | None:
        """By how much the outputs of every span change with every unknown, nothing with those that are not free; None
        where a run fails."""
        moving = np.concatenate([self.free, np.ones(len(vector) - self.count, bool)])
        moved = [self.calls(vector + CHANGE * unit) for unit in np.eye(len(vector))[moving]]
        made = self.problem.simulator.runs([call for calls in moved for call in calls])
        if any(isinstance(one, Failure) for one in made):
            return None
        spans = len(self.problem.spans)
        slopes = tuple(np.zeros((*y.shape, len(vector))) for y in runs.y)
        for k, (y, S) in enumerate(zip(runs.y, slopes)):
            S[:, :, moving] = np.stack([(one - y) / CHANGE for one in made[k::spans]], axis=2)
        return slopes

    def down(
        self, runs: Runs, vector: Float[np.ndarray, " unknowns"], slopes: tuple[np.ndarray, ...], share: float
    ) -> tuple[np.ndarray, Runs] | None:
        """Unknowns that leave less of a part, and the runs with them; None where no step does."""
        parts, solver, size = _parts(self.problem, runs, share), ClarabelSolver(), len(vector)
        weight = 1 / np.sqrt(np.maximum(_mean_squares(parts), 1e-300))
        H, g = np.zeros((size, size)), np.zeros(size)
        of_fit = [S[span.fit] for S, span in zip(slopes, self.problem.spans) if span.fit is not None]
        for part, S in zip(parts, of_fit):
            J = (S[: len(part.e)] * weight[:, None])[part.kept]
            H, g = H + J.T @ J, g + J.T @ (part.e * weight)[part.kept]
        held = np.diag(H) <= 0.0
        if held.all():
            return None
        before, floors = _left(self.problem, runs, share), self.floors(size)
        for damping in DAMPINGS:
            damped = H + np.diag(np.where(held, 1.0, damping * np.diag(H)))
            step = step_inside(solver, damped, -g, vector, floors, (1,) * size, held)
            if step is None:
                continue
            ahead = np.maximum(vector + step, floors)
            made = self.problem.tried(self.calls(ahead))
            if made is not None and _left(self.problem, made, share) < before:
                return ahead, made
        return None


def grown(problem: Problem, entries: Float[np.ndarray, " numbers"]) -> Grown | None:
    """Numbers, from some entries on, that alone explain the data of the fit but for noise; None where none do."""
    return _grown(problem, entries, np.ones(len(entries), bool), (), SHARES)


def sharpened(
    problem: Problem,
    entries: Float[np.ndarray, " numbers"],
    free: Bool[np.ndarray, " numbers"],
    pushed: tuple[Float[np.ndarray, "samples dofs"], ...],
) -> Grown | None:
    """The same from where runs follow all data of the fit already, for some of the numbers."""
    return _grown(problem, entries, free, pushed, SHARES[-1:])


def _grown(problem: Problem, entries, free, pushed: tuple[np.ndarray, ...], shares: tuple[float, ...]) -> Grown | None:
    calls = problem.called(entries)
    pushed = pushed or tuple(call.w for call in calls)
    runs, slopes = problem.tried([dataclasses.replace(call, w=w) for call, w in zip(calls, pushed)]), None
    if runs is None:
        return None
    unknowns = _Unknowns.of(problem, runs, free)
    vector = unknowns.start(entries, pushed)
    for share in shares:
        for _ in range(TURNS):
            if (slopes := unknowns.slopes(runs, vector)) is None:
                return None
            before = _left(problem, runs, share)
            ahead = unknowns.down(runs, vector, slopes, share)
            if ahead is None:
                break
            vector, runs = ahead
            if _left(problem, runs, share) > before - FLAT:
                break
        if not all(map(_follows, _parts(problem, runs, share))):
            return None
    count = unknowns.count
    # A first state is none of the forces that the simulator was given.
    pushed = tuple(call.w for call in runs.calls)
    runs = dataclasses.replace(runs, calls=tuple(problem.called(vector[:count])))
    return Grown(vector[:count], runs, pushed, tuple(S[:, :, :count] for S in slopes))


def _parts(problem: Problem, runs: Runs, share: float) -> list[FreeRun]:
    """Runs over the first parts of the data of the fit."""
    parts = []
    for run in parts_of(problem, runs.y)[0]:
        samples = min(max(round(share * len(run.e)), FEWEST), len(run.e))
        # What leads to a first state is no motion of the simulator's own.
        kept = run.kept[:samples] & (np.arange(samples) >= FIRST)[:, None]
        parts.append(FreeRun(run.simulated[:samples], np.where(kept, run.e[:samples], 0.0), kept))
    return parts


def _mean_squares(parts: list[FreeRun]) -> Float[np.ndarray, " outputs"]:
    return rms_of(parts) ** 2


def _left(problem: Problem, runs: Runs, share: float) -> float:
    """N ln(mean square), summed over outputs, of what runs leave of the parts."""
    parts = _parts(problem, runs, share)
    count = sum(part.kept.sum(axis=0) for part in parts)
    return float(np.sum(count * np.log(np.maximum(_mean_squares(parts), 1e-300))))


def _follows(part: FreeRun) -> bool:
    """Whether a run leaves no more than what no motion explains, its white part, about."""
    return bool(np.all(part.rmse**2 <= settings.STAND_IN_EXCESS**2 * white_part(part.e, part.kept)))
