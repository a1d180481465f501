"""Numbers fitted by runs of the simulator itself, over parts of the records that grow.

Where a motion hangs sharply on the numbers (contact, backlash, an arm that turns over and over), a linear plant about
one run does not foretell another, and the sum of squares over a whole record has many minima. Over a short part it has
one, and from there the fit of a longer part begins. A part that numbers alone do not follow ends it. The simulator runs
no further than a part, and slopes are taken from its runs by differences where those of the steps before lead nowhere.

**Reference:** Bock, *Recent advances in parameter identification techniques for ODE* (1983), for windows in place of
the whole record; here one window grows. Broyden, *A class of methods for solving nonlinear simultaneous equations*,
Math. Comp. 19 (1965) 577-593, for slopes that learn from every step.
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
from .runs.problem import Outputs, Problem, Runs, Span

SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Parts of the data of the fit, one after the other."""

FEWEST = 100
"""Samples of the first part at least."""

TURNS = 40
"""Gauss-Newton steps a part at most."""

CHANGE = 1e-4
"""Change of an entry for its slope: the motion answers to it far above rounding and far below the motion itself."""

FIRST, MOVED, LARGEST = 2, 0.1, 1e6
"""Samples over which forces lead to a first state; by how much one moves a run, relative to it, and the most of them
in units of that."""

FLAT, CLOSE = 1.0, 0.01
"""Fall of N ln(mean square) up to which a step was the last; and the one foretold up to which it is worth no run."""

DAMPINGS, BY_OLD = 1e-3 * 10.0 ** np.arange(6), 2
"""Of steps that are tried, relative to the diagonal of the normal equations, where the one before did not go down; and
how many of them by slopes of steps before."""


@dataclass(frozen=True)
class Grown:
    """`entries` that follow all data of the fit, the `runs` with them, forces by which these were pushed into their
    first states, a span, and slopes of the runs by every entry, a record of the fit up to where that ends."""

    entries: Float[np.ndarray, " numbers"]
    runs: Runs
    pushed: tuple[Float[np.ndarray, "samples dofs"], ...]
    slopes: tuple[Float[np.ndarray, "samples outputs numbers"], ...]

    def fit(self, problem: Problem, fit: Refit) -> Refit:
        """A refit in the linear plant about these runs, with what the simulator itself says of residual and slopes in
        its place."""
        fitted = [(s, y) for s, y in zip(problem.spans, self.runs.y) if s.fit is not None]
        spans = [(s, y, S) for (s, y), S in zip(fitted, self.slopes)]
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
class _Window:
    """The first part of the data of every record of the fit, as large a `share` of them: the simulator runs no further.
    Its runs are the outputs of these records alone, up to there."""

    problem: Problem
    share: float

    @property
    def spans(self) -> list[Span]:
        """The records of the fit."""
        return [span for span in self.problem.spans if span.fit is not None]

    def samples(self, span: Span) -> int:
        """How many samples of the fit it holds of a record."""
        count = span.fit.stop - span.fit.start
        return min(max(round(self.share * count), FEWEST), count)

    def cut(self, calls: list[Call]) -> list[Call]:
        """Calls of all spans as those of this part."""
        pairs = [(span, call) for span, call in zip(self.problem.spans, calls) if span.fit is not None]
        ends = [span.fit.start + self.samples(span) for span, _ in pairs]
        return [dataclasses.replace(call, u=call.u[:end], w=call.w[:end]) for end, (_, call) in zip(ends, pairs)]

    def runs(self, calls: list[Call]) -> Outputs | None:
        """Runs of this part; None where one fails or runs away."""
        made = self.problem.simulator.runs(self.cut(calls))
        if any(isinstance(y, Failure) or span.far(y) for span, y in zip(self.spans, made)):
            return None
        return tuple(made)

    def seen(self, span: Span) -> slice:
        """The samples of a record in which it looks at runs."""
        return slice(span.fit.start, span.fit.start + self.samples(span))

    def parts(self, y: Outputs) -> list[FreeRun]:
        """Runs beside the records."""
        parts = []
        for span, one in zip(self.spans, y):
            run = span.run(one, self.seen(span))
            # What leads to a first state is no motion of the simulator's own.
            kept = run.kept & (np.arange(len(run.e)) >= FIRST)[:, None]
            parts.append(FreeRun(run.simulated, np.where(kept, run.e, 0.0), kept))
        return parts

    def left(self, y: Outputs) -> float:
        """N ln(mean square), summed over outputs, of what runs leave."""
        parts = self.parts(y)
        count = sum(part.kept.sum(axis=0) for part in parts)
        return float(np.sum(count * np.log(np.maximum(_mean_squares(parts), 1e-300))))

    def followed(self, y: Outputs) -> bool:
        """Whether runs leave no more than what no motion explains, its white part, about."""
        excess = settings.STAND_IN_EXCESS**2
        return all(np.all(part.rmse**2 <= excess * white_part(part.e, part.kept)) for part in self.parts(y))


@dataclass(frozen=True)
class _Unknowns:
    """What is fitted: a vector of the entries, of which some are `free`, then, where records begin in another state
    than the simulator does, for every record of the fit the forces over its first samples (in `units`) that lead it
    there."""

    problem: Problem
    free: Bool[np.ndarray, " numbers"]
    units: tuple[Float[np.ndarray, "first dofs"], ...]

    @classmethod
    def alone(cls, problem: Problem, free: Bool[np.ndarray, " numbers"]) -> "_Unknowns":
        """The numbers, with no forces beside them."""
        return cls(problem, free, tuple(np.zeros((0, span.record.outputs)) for span in problem.spans))

    def pushed(self, window: _Window, vector: Float[np.ndarray, " unknowns"]) -> "_Unknowns":
        """The same with forces, in units by which each moves runs of a part by `MOVED` of it."""
        calls, units = window.cut(self.calls(vector)), []
        runs = iter(zip(calls, self.problem.simulator.runs(calls)))
        for span in self.problem.spans:
            unit = np.zeros((FIRST if span.fit is not None else 0, span.record.outputs))
            call, one = next(runs) if len(unit) else (None, None)
            for k in np.ndindex(unit.shape):
                force, w = max(float(np.std(call.u)), 1e-300), call.w.copy()
                w[k] += force
                made = self.problem.simulator.tried(dataclasses.replace(call, w=w))
                if made is not None and not isinstance(one, Failure):
                    moved = float(np.sqrt(np.mean((made - one) ** 2))) / max(float(np.std(one)), 1e-300)
                    unit[k] = force * MOVED / moved if moved > 0.0 else 0.0
            units.append(unit)
        return _Unknowns(self.problem, self.free, tuple(units))

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return len(self.problem.units)

    def moving(self, size: int) -> Bool[np.ndarray, " unknowns"]:
        """Which unknowns are fitted."""
        return np.concatenate([self.free, np.ones(size - self.count, bool)])

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


@dataclass(frozen=True)
class _Fit:
    """Unknowns as far as they are fitted over a `window`: their `vector`, runs `y` with it, and slopes of these runs by
    every unknown (none with those that are not free), `fresh` where they were taken there."""

    window: _Window
    unknowns: _Unknowns
    vector: Float[np.ndarray, " unknowns"]
    y: Outputs
    slopes: tuple[Float[np.ndarray, "samples outputs unknowns"], ...] = ()
    fresh: bool = False

    @property
    def left(self) -> float:
        """What the runs leave."""
        return self.window.left(self.y)

    def sloped(self, known: int = 0) -> "_Fit | None":
        """With slopes by differences of runs, those of the first unknowns as they are `known`; None where one fails."""
        moving = self.unknowns.moving(len(self.vector)) & (np.arange(len(self.vector)) >= known)
        moved = [self.unknowns.calls(self.vector + CHANGE * unit) for unit in np.eye(len(self.vector))[moving]]
        made = self.window.problem.simulator.runs([call for calls in moved for call in self.window.cut(calls)])
        if any(isinstance(one, Failure) for one in made):
            return None
        slopes = tuple(np.zeros((*y.shape, len(self.vector))) for y in self.y)
        for k, (y, S) in enumerate(zip(self.y, slopes)):
            if known:
                S[:, :, :known] = self.slopes[k][:, :, :known]
            S[:, :, moving] = np.stack([(one - y) / CHANGE for one in made[k :: len(self.y)]], axis=2)
        return dataclasses.replace(self, slopes=slopes, fresh=True)

    def normal(self) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """The normal equations of a step, every output in units of what is left of it."""
        parts = self.window.parts(self.y)
        weight = 1 / np.sqrt(np.maximum(_mean_squares(parts), 1e-300))
        size = len(self.vector)
        H, g = np.zeros((size, size)), np.zeros(size)
        for span, part, S in zip(self.window.spans, parts, self.slopes):
            J = (S[self.window.seen(span)] * weight[:, None])[part.kept]
            H, g = H + J.T @ J, g + J.T @ (part.e * weight)[part.kept]
        return H, g

    def down(self) -> "_Fit | None":
        """A step that leaves less, with slopes that learned from it; None where none does, or none is worth a run."""
        solver, size = ClarabelSolver(), len(self.vector)
        H, g = self.normal()
        scale = np.diag(H)
        held = scale <= 0.0
        if foretold(H, g) < CLOSE:
            return None
        floors = self.unknowns.floors(size)
        for damping in DAMPINGS if self.fresh else DAMPINGS[:BY_OLD]:
            damped = H + np.diag(np.where(held, 1.0, damping * scale))
            step = step_inside(solver, damped, -g, self.vector, floors, (1,) * size, held)
            if step is None:
                continue
            ahead = np.maximum(self.vector + step, floors)
            made = self.window.runs(self.unknowns.calls(ahead))
            if made is not None and self.window.left(made) < self.left:
                step = ahead - self.vector
                along = scale * step / max(step @ (scale * step), 1e-300)
                learned = zip(self.slopes, made, self.y)
                slopes = tuple(S + (new - old - S @ step)[:, :, None] * along for S, new, old in learned)
                return dataclasses.replace(self, vector=ahead, y=made, slopes=slopes, fresh=False)
        return None

    def begins_elsewhere(self, first: _Window) -> bool:
        """Whether records begin in another state than the simulator does, where numbers alone do not follow them, or
        leave what forces over the `first` samples take."""
        if len(self.vector) > self.unknowns.count:
            return False
        if not self.window.followed(self.y):
            return True
        if not self.fresh:
            return False
        unknowns = self.unknowns.pushed(first, self.vector)
        size = len(self.vector) + sum(unit.size for unit in unknowns.units)
        vector = np.concatenate([self.vector, np.zeros(size - len(self.vector))])
        more = dataclasses.replace(self, unknowns=unknowns, vector=vector).sloped(known=len(self.vector))
        if more is None:
            return False
        (H, g), count = more.normal(), len(self.vector)
        fall = foretold(H, g) - foretold(H[:count, :count], g[:count])
        samples = sum(self.window.samples(span) for span in self.window.spans)
        return fall >= (size - count) * np.log(samples) + settings.MIN_DELTA_BIC

    def best(self, exact: bool) -> "_Fit | None":
        """Where no step leaves less, by fresh slopes there; or, if that need not be `exact`, where runs follow the
        records. None where a run fails, or steps do not come to an end."""
        now = self
        for _ in range(TURNS):
            if not exact and now.window.followed(now.y):
                break
            if not now.slopes:
                now = now.sloped()
                if now is None:
                    return None
            ahead = now.down()
            flat = ahead is None or ahead.left > now.left - FLAT
            if flat and now.fresh:
                # So short a step changes no slopes.
                return now if ahead is None else dataclasses.replace(ahead, slopes=now.slopes, fresh=True)
            now = ahead or now
            if flat:
                now = dataclasses.replace(now, slopes=())
        return None if exact else now


def foretold(H: Float[np.ndarray, "unknowns unknowns"], g: Float[np.ndarray, " unknowns"]) -> float:
    """By how much less a step leaves, to second order."""
    return float(g @ pseudo_inverse(H, NOTHING) @ g)


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
    first, unknowns = _Window(problem, SHARES[0]), _Unknowns.alone(problem, free)
    vector = np.array(entries, float)
    if any(np.any(w) for w in pushed):
        unknowns = unknowns.pushed(first, vector)
        vector = unknowns.start(entries, pushed)
    for share in shares:
        window = _Window(problem, share)
        if (y := window.runs(unknowns.calls(vector))) is None:
            return None
        fit = _Fit(window, unknowns, vector, y).best(exact=share == shares[-1])
        if fit is not None and fit.begins_elsewhere(first):
            unknowns = unknowns.pushed(first, fit.vector)
            vector = np.concatenate([fit.vector, np.zeros(sum(unit.size for unit in unknowns.units))])
            fit = _Fit(window, unknowns, vector, fit.y).best(exact=share == shares[-1])
        if fit is None or not window.followed(fit.y):
            return None
        vector = fit.vector
    if not fit.fresh and (fit := fit.sloped()) is None:
        return None
    calls, count = unknowns.calls(vector), unknowns.count
    runs = problem.tried(calls)
    if runs is None:
        return None
    # A first state is none of the forces that the simulator was given.
    runs = dataclasses.replace(runs, calls=tuple(problem.called(vector[:count])))
    return Grown(vector[:count], runs, tuple(call.w for call in calls), tuple(S[:, :, :count] for S in fit.slopes))


def _mean_squares(parts: list[FreeRun]) -> Float[np.ndarray, " outputs"]:
    return rms_of(parts) ** 2
