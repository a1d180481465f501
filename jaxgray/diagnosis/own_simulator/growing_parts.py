"""Numbers fitted by runs of the simulator itself, over parts of the records that grow.

Where a motion depends sharply on the numbers (contact, backlash, an arm that turns over and over), a linear plant about
one run does not predict another, and the sum of squares over a whole record has many minima. Over a short part it has
one, and from there the fit of a longer part begins. The growth ends at the first part that numbers alone do not follow.
The simulator runs no further than a part; its Jacobian is taken by finite differences where that of the steps before
leads nowhere, and a run after too long a step gives the curvature of the path.

**Reference:** Bock, *Recent advances in parameter identification techniques for ODE* (1983), for windows in place of
the whole record; here one window grows. Broyden, *A class of methods for solving nonlinear simultaneous equations*,
Math. Comp. 19 (1965) 577-593, for slopes that learn from every step. Transtrum & Sethna, *Geodesic acceleration and the
small-curvature approximation for nonlinear least squares* (2012), for steps along a way that bends.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse, step_inside, undetermined
from ...numerics.matrices.positive import ClarabelSolver
from ...numerics.responses.filters import white_part
from .. import settings
from ..estimation.gauss_newton import NOTHING, Refit
from ..model.free_run import FreeRun, rms_of
from .runs.calls import Call, Failure
from .runs.problem import Outputs, Problem, Runs, Span
from .runs.tracking import near_until

BEGIN, LONGER, LITTLE = 1 / 16, 4.0, 1.5
"""The first part of the data of the fit; how many times longer the next one is; and how many times longer one may be in
which runs are not near the records before it is fitted."""

FEWEST = 100
"""Samples of the first part at least."""

SLOPES, STEPS, NEARLY = 4, 40, 2.0
"""Times that slopes are taken for a part, and Gauss-Newton steps, at most; and how many times more than those that
follow a record runs may leave that nearly do."""

CHANGE = 1e-4, 0.1
"""Change of an entry for its slope, to which the motion answers far above rounding and far below itself; and of a force
that leads to a first state, which friction may hold."""

FIRST, MOVED, LARGEST = 2, 0.1, 1e6
"""Samples over which forces lead to a first state; by how much one moves a run, relative to it, and the most of them
in units of that."""

FLAT, CLOSE, SLOW = 1.0, 0.06, 0.1
"""Fall of N ln(mean square) up to which a step was the last; the one foretold up to which it is worth no run; and the
part of the fall to runs that follow the records up to which a step leads nowhere."""

DAMPINGS, BY_OLD = (1e-3, 1e-1, 10.0), 1
"""Of steps that are tried, relative to the diagonal of the normal equations, where the one before did not go down; and
how many of them by slopes of steps before."""

STRAIGHT, TOLD, ACCELERATION, WAYS = 0.1, 0.8, 0.75, 0.8 ** np.arange(1, 15)
"""How far a step may end from where slopes foretold, relative to its length, for these to serve on; the part of the
fall that they foretold by which it must come down for them to tell where none leads; by how much a way may bend,
relative to its length; and shares of a step that are weighed."""


@dataclass(frozen=True)
class Grown:
    """`entries` that follow all data of the fit, the `runs` with them, forces by which these were pushed into their
    first states, a span, and slopes of the runs by every entry, a span."""

    entries: Float[np.ndarray, " numbers"]
    runs: Runs
    pushed: tuple[Float[np.ndarray, "samples dofs"], ...]
    slopes: tuple[Float[np.ndarray, "samples outputs numbers"], ...]

    def fit(self, problem: Problem, fit: Refit) -> Refit:
        """A refit in the linear plant about these runs, with what the simulator itself says of residual and slopes in
        its place."""
        spans = [one for one in zip(problem.spans, self.runs.y, self.slopes) if one[0].fit is not None]
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
        # Of numbers that were held, what was known before stays.
        loose, moved = np.array(fit.undetermined), np.flatnonzero(np.diag(H)[:count] > 0.0)
        loose[moved] = undetermined(H[np.ix_(moved, moved)], NOTHING)
        told = {"residual": tuple(residuals), "jacobian": tuple(jacobians), "undetermined": loose}
        return dataclasses.replace(fit, covariance=covariance, **told)


@dataclass(frozen=True)
class Ended:
    """Where parts ended to grow: `entries` that follow the longest one, and `runs` with these where they are near the
    whole records."""

    entries: Float[np.ndarray, " numbers"]
    runs: Runs | None = None


@dataclass(frozen=True)
class _Window:
    """The first part of the data of every record of the fit, as large a `share` of them: the simulator runs no further.
    Its runs are the outputs of these records alone, up to there; all of it are the whole records, those held out among
    them."""

    problem: Problem
    share: float

    @property
    def spans(self) -> list[Span]:
        """The records that are run."""
        return [span for span in self.problem.spans if self._runs(span)]

    def _runs(self, span: Span) -> bool:
        return span.fit is not None or self.share == 1.0

    def samples(self, span: Span) -> int:
        """How many samples of the fit it holds of a record."""
        count = span.fit.stop - span.fit.start
        return min(max(round(self.share * count), FEWEST), count)

    def made(self, *calls: list[Call]) -> list[list[np.ndarray | Failure]]:
        """What calls of all spans, once or several times, come to in this part."""
        spans, runs = self.spans, []
        for one in calls:
            runs += [call for span, call in zip(self.problem.spans, one) if self._runs(span)]
        ends = [None if self.share == 1.0 else self.seen(span).stop for span in spans]
        made = self.problem.simulator.runs(runs, ends * len(calls))
        return [made[k : k + len(spans)] for k in range(0, len(made), len(spans))]

    def runs(self, calls: list[Call]) -> Outputs | None:
        """Runs of this part; None where one fails or runs away."""
        (made,) = self.made(calls)
        if any(isinstance(y, Failure) or span.far(y) for span, y in zip(self.spans, made)):
            return None
        return tuple(made)

    def part_of(self, longer: "_Window", y: Outputs) -> Outputs:
        """What runs of a longer part, or of this one, are of this one."""
        made = dict(zip(map(id, longer.spans), y))
        ends = [None if self.share == 1.0 else self.seen(span).stop for span in self.spans]
        return tuple(made[id(span)][:end] for span, end in zip(self.spans, ends))

    def near(self, y: Outputs) -> bool:
        """Whether runs are near all that they are of the records."""
        pairs = zip(self.spans, y)
        return all(near_until(span.record[: len(one)], one) == len(one) for span, one in pairs)

    def seen(self, span: Span) -> slice:
        """The samples of a record in which it looks at runs."""
        return slice(span.fit.start, span.fit.start + self.samples(span))

    def parts(self, y: Outputs) -> list[FreeRun]:
        """Runs beside the records."""
        parts = []
        for span, one in zip(self.spans, y):
            if span.fit is None:
                continue
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

    def followed(self, y: Outputs, times: float = 1.0) -> bool:
        """Whether runs leave no more than what no motion explains, its white part, about; or so many times that."""
        return self.above(y, times) <= 0.0

    def above(self, y: Outputs, times: float = 1.0) -> float:
        """N ln(mean square), summed over outputs, that runs leave above that."""
        excess, above = (times * settings.STAND_IN_EXCESS) ** 2, 0.0
        for part in self.parts(y):
            ratio = part.rmse**2 / np.maximum(excess * white_part(part.e, part.kept), 1e-300)
            above += float(part.kept.sum(axis=0) @ np.log(np.maximum(ratio, 1.0)))
        return above


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
        calls, units = self.calls(vector), []
        (runs,) = window.made(calls)
        runs = iter(runs)
        for span, call in zip(self.problem.spans, calls):
            unit = np.zeros((FIRST if span.fit is not None else 0, span.record.outputs))
            one = next(runs) if len(unit) else None
            for k in np.ndindex(unit.shape):
                force, w = max(float(np.std(call.u)), 1e-300), call.w.copy()
                w[k] += force
                made = self.problem.simulator.tried(dataclasses.replace(call, w=w), window.seen(span).stop)
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
    every unknown (none with those that are not free), `fresh` where they were taken there; and whether they `told` what
    the last step left."""

    window: _Window
    unknowns: _Unknowns
    vector: Float[np.ndarray, " unknowns"]
    y: Outputs
    slopes: tuple[Float[np.ndarray, "samples outputs unknowns"], ...] = ()
    fresh: bool = False
    told: bool = False

    @property
    def left(self) -> float:
        """What the runs leave."""
        return self.window.left(self.y)

    def sloped(self, known: int = 0) -> "_Fit | None":
        """With slopes by differences of runs, those of the first unknowns as they are `known`; None where one fails."""
        moving = self.unknowns.moving(len(self.vector)) & (np.arange(len(self.vector)) >= known)
        change = np.where(np.arange(len(self.vector)) < self.unknowns.count, *CHANGE)
        moved = [self.unknowns.calls(self.vector + step) for step in np.diag(change)[moving]]
        made = self.window.made(*moved)
        if any(isinstance(one, Failure) for runs in made for one in runs):
            return None
        slopes = tuple(np.zeros((*y.shape, len(self.vector))) for y in self.y)
        for k, (y, S) in enumerate(zip(self.y, slopes)):
            if known:
                S[:, :, :known] = self.slopes[k][:, :, :known]
            for unknown, runs in zip(np.flatnonzero(moving), made):
                S[:, :, unknown] = (runs[k] - y) / change[unknown]
        return dataclasses.replace(self, slopes=slopes, fresh=True)

    def rows(self, values: tuple[np.ndarray, ...]) -> Float[np.ndarray, "rows *columns"]:
        """What is given along the runs, as rows of the fit, every output in units of what is left of it."""
        parts, stacked = self.window.parts(self.y), []
        weight = 1 / np.sqrt(np.maximum(_mean_squares(parts), 1e-300))
        spans = [(span, X) for span, X in zip(self.window.spans, values) if span.fit is not None]
        for (span, X), part in zip(spans, parts):
            X = X[self.window.seen(span)]
            stacked.append((X * weight.reshape(-1, *(1,) * (X.ndim - 2)))[part.kept])
        return np.concatenate(stacked)

    def normal(self) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """The normal equations of a step, every output in units of what is left of it."""
        J, e = self.rows(self.slopes), self.rows(self.errors)
        return J.T @ J, J.T @ e

    @property
    def errors(self) -> Outputs:
        """What runs leave, of every record that is run."""
        pairs = zip(self.window.spans, self.y)
        return tuple(np.nan_to_num(span.record.y[: len(one)] - one) for span, one in pairs)

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
            ahead, made = self._ahead(step, scale)
            if ahead is None and made is not None:
                ahead, _ = self._ahead(self._bent(step, made, damped, scale), scale)
            if ahead is not None:
                return ahead
        return None

    def _ahead(self, step: Float[np.ndarray, " unknowns"], scale: np.ndarray) -> tuple["_Fit | None", Outputs | None]:
        """The fit after a step, None where that leaves no less; and the runs there."""
        vector = np.maximum(self.vector + step, self.unknowns.floors(len(step)))
        made = self.window.runs(self.unknowns.calls(vector))
        if made is None or not self.window.left(made) < self.left:
            return None, made
        step = vector - self.vector
        along, missed = scale * step / max(step @ (scale * step), 1e-300), self._missed(step, made)
        slopes = tuple(S + one[:, :, None] * along for S, one in zip(self.slopes, missed))
        bent = np.linalg.norm(self.rows(missed)) / max(np.linalg.norm(self.rows(self.slopes) @ step), 1e-300)
        above, ahead, there = (self.window.above(y) for y in (self.y, self._foreseen(step), made))
        fit = dataclasses.replace(self, vector=vector, y=made, slopes=slopes, fresh=self.fresh and bent < STRAIGHT)
        return dataclasses.replace(fit, told=above - there >= TOLD * (above - ahead)), made

    def _missed(self, step: Float[np.ndarray, " unknowns"], made: Outputs) -> Outputs:
        """By what runs after a step are not where slopes foretold."""
        return tuple(new - old - S @ step for S, new, old in zip(self.slopes, made, self.y))

    def _bent(self, step: Float[np.ndarray, " unknowns"], made: Outputs, damped, scale) -> np.ndarray:
        """A part of a step that leaves most behind, along a way as bent as runs at its end say."""
        e, J, bend = (self.rows(x) for x in (self.errors, self.slopes, self._missed(step, made)))
        aside = np.linalg.solve(damped, J.T @ bend)
        length, bent = (np.sqrt(x @ (scale * x)) for x in (step, aside))
        ways = WAYS[WAYS * bent <= ACCELERATION * length]
        ways = ways if len(ways) else WAYS[-1:]
        along, beside = J @ step, bend - J @ aside
        left = [np.sum((e - t * along - t**2 * beside) ** 2) for t in ways]
        t = ways[int(np.argmin(left))]
        return t * step - t**2 * aside

    def begins_elsewhere(self, first: _Window) -> bool:
        """Whether records begin in another state than the simulator does: numbers alone leave what forces over the
        `first` samples take."""
        if len(self.vector) > self.unknowns.count or not (self.fresh or self.slopes and self.window.above(self.y)):
            return False
        unknowns = self.unknowns.pushed(first, self.vector)
        size = len(self.vector) + sum(unit.size for unit in unknowns.units)
        vector = np.concatenate([self.vector, np.zeros(size - len(self.vector))])
        more = dataclasses.replace(self, unknowns=unknowns, vector=vector).sloped(known=len(self.vector))
        if more is None or not more.leads():
            return False
        (H, g), count = more.normal(), len(self.vector)
        fall = foretold(H, g) - foretold(H[:count, :count], g[:count])
        samples = len(self.rows(self.errors))
        return fall >= (size - count) * np.log(samples) + settings.MIN_DELTA_BIC

    def best(self, exact: bool, led: bool = False) -> "_Fit | None":
        """Where no step leaves less, by fresh slopes there; or, if that need not be `exact`, where runs follow the
        records. None where a run fails, or steps do not come to an end. `led`: whether it began so near that slopes
        lead there, or nothing does."""
        now, taken = self, 0
        for _ in range(STEPS):
            if not exact and now.window.followed(now.y):
                return now
            if not now.slopes:
                now, taken = now.sloped() if taken < SLOPES else None, taken + 1
                if now is None:
                    return None
            sure = now.fresh or (now.told and not exact)
            if led and sure and not now.leads():
                return None if exact else now
            ahead = now.down()
            slow = ahead is not None and ahead.slower(now)
            if slow and sure:
                return None if exact else ahead
            flat = slow or ahead is None or ahead.left > now.left - FLAT
            if flat and sure:
                # So short a step changes no slopes.
                return now if ahead is None else dataclasses.replace(ahead, slopes=now.slopes, fresh=True)
            now = ahead or now
            if flat:
                now = dataclasses.replace(now, slopes=())
        return None if exact else now

    def begun(self, first: _Window, exact: bool, led: bool = False) -> "_Fit | None":
        """The best fit, with forces over the `first` samples where records begin elsewhere than the simulator does."""
        fit = self.best(exact, led)
        # A first state shows in the first part.
        ended = fit is None or (led and not fit.window.followed(fit.y))
        if ended or not fit.begins_elsewhere(first):
            return fit
        unknowns = fit.unknowns.pushed(first, fit.vector)
        vector = np.concatenate([fit.vector, np.zeros(sum(unit.size for unit in unknowns.units))])
        return _Fit(fit.window, unknowns, vector, fit.y).best(exact)

    def slower(self, before: "_Fit") -> bool:
        """Whether the step from a fit `before` leads nowhere: hardly nearer to the records than that, and with slopes
        that foretell no better."""
        return before.left - self.left < SLOW * self.window.above(self.y) and not self.leads()

    def leads(self) -> bool:
        """Whether slopes foretell runs that follow the records, or half the way there."""
        return self.window.above(self.foreseen()) <= self.window.above(self.y) / 2

    def promises(self) -> bool:
        """Whether slopes foretell runs that follow the records, about."""
        return self.window.followed(self.foreseen(), NEARLY)

    def foreseen(self) -> Outputs:
        """Runs after the best step, as slopes foretell them."""
        H, g = self.normal()
        return self._foreseen(pseudo_inverse(H, NOTHING) @ g)

    def _foreseen(self, step: Float[np.ndarray, " unknowns"]) -> Outputs:
        return tuple(y + S @ step for y, S in zip(self.y, self.slopes))


def foretold(H: Float[np.ndarray, "unknowns unknowns"], g: Float[np.ndarray, " unknowns"]) -> float:
    """By how much less a step leaves, to second order."""
    return float(g @ pseudo_inverse(H, NOTHING) @ g)


def grown(problem: Problem, entries: Float[np.ndarray, " numbers"]) -> Grown | Ended:
    """Numbers, from some entries on, that alone explain the data of the fit but for noise; or how far numbers alone
    follow them.

    Parts end to grow where runs are near the whole records: what else there is to know a linear plant about them tells.
    """
    return _grown(problem, entries, np.ones(len(entries), bool), (), BEGIN)


def nearly_followed(problem: Problem, y: Outputs) -> bool:
    """Whether runs leave not much more of the data of the fit than those that follow them do."""
    return _Window(problem, 1.0).followed(y, NEARLY)


def bettered(problem: Problem, entries: Float[np.ndarray, " numbers"], runs: Runs) -> Grown | Ended | None:
    """Numbers that follow all data of the fit but for noise, from some with which `runs` are near, or as they are where
    steps find none; None where slopes there foretell that none do, or lead hardly nearer."""
    unknowns = _Unknowns.alone(problem, np.ones(len(entries), bool))
    fit = _Fit(_Window(problem, 1.0), unknowns, np.array(entries, float), runs.y).sloped()
    if fit is not None and not (fit.promises() and fit.leads()):
        return None
    best = None if fit is None else fit.begun(_Window(problem, BEGIN), exact=True)
    return _finished(problem, best) or Ended(np.array(entries, float))


def sharpened(
    problem: Problem,
    entries: Float[np.ndarray, " numbers"],
    free: Bool[np.ndarray, " numbers"],
    pushed: tuple[Float[np.ndarray, "samples dofs"], ...],
) -> Grown | None:
    """The same from where runs follow all data of the fit already, for some of the numbers."""
    made = _grown(problem, entries, free, pushed, 1.0)
    return made if isinstance(made, Grown) else None


def _grown(problem: Problem, entries, free, pushed: tuple[np.ndarray, ...], share: float) -> Grown | Ended:
    first, unknowns = _Window(problem, BEGIN), _Unknowns.alone(problem, free)
    vector, followed = np.array(entries, float), 0.0
    if any(np.any(w) for w in pushed):
        unknowns = unknowns.pushed(first, vector)
        vector = unknowns.start(entries, pushed)

    run: tuple[np.ndarray, _Window, Outputs | None] | None = None
    while followed < 1.0:
        window = _Window(problem, share)
        if run is not None and run[2] is not None and run[1].share >= share and np.array_equal(run[0], vector):
            # What a longer run was up to there.
            y = window.part_of(run[1], run[2])
        else:
            y = window.runs(unknowns.calls(vector))
            run = vector, window, y
        if followed > 0.0:
            near = y is not None and window.near(y)
            if near and share == 1.0 and len(vector) == unknowns.count:
                return Ended(vector, Runs(tuple(unknowns.calls(vector)), y))
            if not near and share > LITTLE * followed:
                share = np.sqrt(share * followed)
                continue
        if y is None:
            break
        fit = _Fit(window, unknowns, vector, y).begun(first, exact=share == 1.0, led=followed > 0.0)
        if fit is None or not window.followed(fit.y):
            break
        unknowns, vector, followed, share = fit.unknowns, fit.vector, share, min(LONGER * share, 1.0)
    return (_finished(problem, fit) if followed == 1.0 else None) or Ended(vector[: unknowns.count])


def _finished(problem: Problem, fit: _Fit | None) -> Grown | None:
    """A fit of all data, None where it does not follow them or slopes fail."""
    if fit is None or not fit.window.followed(fit.y):
        return None
    fit = fit if fit.fresh else fit.sloped()
    if fit is None:
        return None
    count, calls = fit.unknowns.count, fit.unknowns.calls(fit.vector)
    # A first state is none of the forces that the simulator was given.
    runs = Runs(tuple(problem.called(fit.vector[:count])), fit.y)
    slopes = tuple(S[:, :, :count] for S in fit.slopes)
    return Grown(fit.vector[:count], runs, tuple(call.w for call in calls), slopes)


def _mean_squares(parts: list[FreeRun]) -> Float[np.ndarray, " outputs"]:
    return rms_of(parts) ** 2
