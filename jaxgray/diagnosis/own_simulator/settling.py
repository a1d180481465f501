"""Laws and numbers where they stand still in the simulator itself."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...numerics.outcomes import RESULTS, ComputationError
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.gauss_newton import Refit, refit
from ..model.candidate import Candidate, Data
from ..model.free_run import FreeRun, rms_of
from ..model.parameter_vector import Layout
from ..noise.whitening import white_noise_model
from ..screening.linearization import sampled_plant
from .runs.numbers import NumbersSimulator
from .runs.problem import Linear, Problem, Runs, parts_of
from .runs.tracking import is_white

LED = 2
"""Runs at most that a force leads along the records, where the laws alone lead elsewhere."""

SETTLING, PATIENCE, FLAT = 24, 4, 2
"""Runs at most until laws and numbers stand still in the simulator; runs in a row that come no nearer to the records
than one before, after which none does; and such runs that are as near, after which they stand still if none nearer is
foretold."""

NEARER, FALLING = 0.02, np.log(0.9)
"""Share of what is left by which a run must come nearer; and logarithm of the part of it that the next run must be
foretold to leave at most, for numbers that do not explain all to be moved on."""

WRONG = np.log(0.02)
"""Logarithm of the part of what a run leaves by which the linear plant about it may be wrong in what it foretells."""

CLOSED = 3
"""Runs that bring the forces of given laws along the simulator's own motion."""

STILL = 0.25
"""Change of every parameter, in standard errors, at which they do; and what the next run is foretold to leave less, in
units of the noise variance, at which they do as well."""

SAME_WAY, FURTHEST = 0.5, 5.0
"""Cosine between two steps in standard errors from which they go the same way, and how many times further than the last
one they may lead."""

FORESEEN = 0.3
"""Difference of a run from the motion that the linear plant foresaw, relative to what the run leaves of the record, at
which the force of a law is that along the simulator's own motion."""


@dataclass(frozen=True)
class Settled:
    """Laws and numbers in the simulator: `candidate`, its `fit` in the `linear` plant about the nearest runs, records
    for it (`wholes`, and of the fit `data`), what the sensors show of the runs (`y`), whether laws and numbers stood
    still, and forces by which the runs were `pushed` into their first states."""

    candidate: Candidate
    fit: Refit
    linear: NumbersSimulator
    wholes: Linear
    data: tuple[Data, ...]
    y: tuple[np.ndarray, ...]
    still: bool
    pushed: tuple[np.ndarray, ...] = ()


def settle(
    problem: Problem,
    context: SearchContext,
    fit: Refit,
    wholes: Linear,
    *,
    beyond: float = np.inf,
    nearly: bool = False,
    resumed: bool = False,
) -> Settled:
    """Laws and numbers where they stand still in the simulator itself: run it with the forces that the laws make along
    its motion, refit in the linear plant about this run, and again.

    The force of a run is that along the motion which the linear plant foresaw; where the two agree, it is that along
    the simulator's own.

    **Arguments:** `problem`; `context` of a search in the linear plant, a `fit` there, and its whole records; `beyond`:
    what the next runs may be expected to leave, as `left_by` has it, for another one; `nearly`: whether it is enough
    that the next run is foretold to come hardly nearer; `resumed`: whether the fit is in a plant about runs with
    these laws.

    **Raises:** `ComputationError` where the simulator does not run with what was found.
    """
    linear, noise_model, candidate = context.simulator, noise_model_of(context, fit), fit.candidate
    best, first, nearest, mark, before, since = None, (True, np.inf), np.inf, np.inf, np.inf, 0
    steps, ends, foretold = [], [], []
    samples = sum(span.fit.stop - span.fit.start for span in problem.spans if span.fit is not None)
    for turn in range(SETTLING):
        context.progress.unlimited.stage(f"settling in the simulator ({turn + 1})")
        calls, foreseen = problem.with_laws(linear, candidate, wholes) or (None, None)
        runs = problem.tried(calls if candidate.terms else problem.called(candidate.entries))
        if runs is None:
            break
        about = runs
        if candidate.terms and turn < LED and not problem.follow(runs.y):
            # The force of a law along a motion that the simulator leaves is none along its own.
            about = problem.led(runs)
        if not wholes.along and problem.follow(about.y):
            # What the numbers take, where no run was before.
            about = problem.with_forces(about)
        try:
            linear, wholes = problem.about(linear, candidate, wholes, about)
        except ComputationError:
            break
        data = problem.fit_data(wholes)
        again = refit(linear, candidate, data, noise_model, held=context.held)
        if again is None:
            break
        size = np.sqrt(np.maximum(np.diag(again.covariance), 1e-300))
        layout = Layout(linear.setup, candidate)
        begun, end = layout.vector(candidate), layout.vector(again.candidate)
        largest = float(np.max(np.abs(end - begun)[size > 1e-150] / size[size > 1e-150], initial=0.0))
        steps.append((begun, end))
        # What the linear plant had left was no noise.
        noise_model = noise_model_of(dataclasses.replace(context, simulator=linear, data=data), again)
        y = problem.seen(linear, candidate, wholes, runs)
        left = left_by(problem, y)
        if not np.isfinite(left):
            break
        since, mark = (0, left) if left < mark - NEARER else (since + 1, mark)
        closed = not candidate.terms or _as_foreseen(problem, runs, foreseen, y)
        # Each turn moves it less than the one before, and brings not more than the linear plant about this run says.
        there = foreseen_by(again, data)
        foretold.append(left_of(there))
        # A simulator in steps of its own answers in steps, and parameters wander where no run is any better, nor is one
        # foretold.
        flat = since >= FLAT and left < min(nearest, foretold[-1]) + NEARER
        stands = largest < STILL or samples * abs(left - foretold[-1]) < STILL or flat
        still = closed and (resumed or turn > 0) and stands and left < nearest + NEARER
        ends.append((left, end))
        if (not closed, left) < first:
            best, first = Settled(again.candidate, again, linear, wholes, tuple(data), y, still), (not closed, left)
        best, nearest = dataclasses.replace(best, still=still), min(left, nearest)
        known = foretold[-1] > left + problem.record.outputs * WRONG
        hopeless, before = max(nearest - abs(left - before), foretold[-1] if known else -np.inf) > beyond, left
        # What numbers alone do not explain in the linear plant is for a law to explain.
        lacking = not candidate.terms and turn > 0 and foretold[-1] > foretold[-2] + FALLING and not is_white(there)
        enough = nearly and closed and left < foretold[-1] + NEARER
        if still or enough or since == PATIENCE or hopeless or lacking:
            break
        ahead = layout.moved(end, layout.limited(_further(steps[-2:], size), end), again.candidate)
        # Numbers keep their sign.
        ahead[: layout.entries] = np.maximum(ahead[: layout.entries], end[: layout.entries] / 2)
        candidate = layout.candidate(ahead, again.candidate)
    if best is None:
        raise ComputationError(
            RESULTS.simulator_failed, stage="simulator", detail="it does not run with the laws that were found"
        )
    return dataclasses.replace(
        best, fit=_widened(best.fit, layout, [end for left, end in ends if left < nearest + NEARER])
    )


def settled_further(problem: Problem, context: SearchContext, settled: Settled) -> Settled:
    """What is nearly settled where it stands still, or as it is where further runs bring it no nearer."""
    if settled.still:
        return settled
    there = dataclasses.replace(context, simulator=settled.linear, data=list(settled.data))
    try:
        further = settle(problem, there, settled.fit, settled.wholes, resumed=True)
    except ComputationError:
        return settled
    return further if left_by(problem, further.y) <= left_by(problem, settled.y) else settled


def foreseen_by(fit: Refit, data: tuple[Data, ...] | list[Data]) -> list[FreeRun]:
    """Runs as a refit in the linear plant foresees them."""
    return [FreeRun(e, e, np.asarray(one.kept)) for e, one in zip(fit.residual, data)]


def _widened(fit: Refit, layout: Layout, ends: list[np.ndarray]) -> Refit:
    """A fit with errors of its parameters that hold the ends of others, whose runs are as near to the records."""
    spread = np.mean((np.array(ends) - layout.vector(fit.candidate)) ** 2, axis=0)
    variance = np.diag(fit.covariance)
    known = variance > 1e-300
    scale = np.sqrt(1 + np.where(known, spread / np.where(known, variance, 1.0), 0.0))
    return dataclasses.replace(fit, covariance=fit.covariance * np.outer(scale, scale))


def _further(steps: list[tuple[np.ndarray, np.ndarray]], size: np.ndarray) -> np.ndarray:
    """How much further the last of some steps (from, to) leads, where the step before went the same way: a plant that
    answers not quite as the simulator does comes nearer by a share at a time.

    **Reference:** Anderson, *Iterative procedures for nonlinear integral equations*, J. ACM 12 (1965) 547-560.
    """
    moved = np.where(size > 1e-150, size, np.inf)
    if len(steps) < 2:
        return 0.0 * size
    before, now = ((end - begun) / moved for begun, end in steps)
    if not before @ now > SAME_WAY * np.linalg.norm(before) * np.linalg.norm(now):
        return 0.0 * size
    change = now - before
    further = -(now @ change) / max(change @ change, 1e-300) * (steps[1][1] - steps[0][1])
    return further * min(1.0, FURTHEST * np.linalg.norm(now) / max(np.linalg.norm(further / moved), 1e-300))


def left_by(problem: Problem, y: tuple[np.ndarray, ...]) -> float:
    """Logarithm of the mean squares that runs leave of the outputs in the data of the fit."""
    return left_of(parts_of(problem, y)[0])


def left_of(runs: list[FreeRun]) -> float:
    """The same of runs over these data."""
    return float(np.sum(np.log(rms_of(runs) ** 2)))


def _as_foreseen(problem: Problem, runs: Runs, foreseen: list[np.ndarray], y: tuple[np.ndarray, ...]) -> bool:
    """Whether runs move as the linear plant foresaw, far below what they leave of the records."""
    for span, run, motion, shown in zip(problem.spans, runs.y, foreseen, y):
        left = np.nanmean((span.record.y - shown) ** 2, axis=0)
        if not np.all(np.mean((run - motion) ** 2, axis=0) <= FORESEEN**2 * left):
            return False
    return True


def shown_by(
    problem: Problem, settled: Settled, candidate: Candidate, without: Runs | None = None, hopeless=lambda y: False
) -> tuple[np.ndarray, ...] | None:
    """What the sensors show of the simulator with a candidate near what was settled; None where it does not run with
    it. `without`: runs with its numbers and no law, where they are known; `hopeless`: whether outputs are so far off
    that it does not matter whether the forces of the laws are those along the motion."""
    linear, wholes = settled.linear, settled.wholes
    for _ in range(CLOSED):
        calls, foreseen = problem.with_laws(linear, candidate, wholes) or (None, None)
        pushed = calls
        if calls is not None and settled.pushed:
            pushed = [dataclasses.replace(call, w=call.w + w) for call, w in zip(calls, settled.pushed)]
        runs = without if without is not None and not candidate.terms else problem.tried(pushed)
        if runs is None:
            return None
        runs = dataclasses.replace(runs, calls=tuple(calls or runs.calls))
        try:
            linear, wholes = problem.about(linear, candidate, wholes, runs)
        except ComputationError:
            return None
        y = problem.seen(linear, candidate, wholes, runs)
        if not candidate.terms or _as_foreseen(problem, runs, foreseen, y) or hopeless(y):
            break
    return y


def refit_of_numbers(context: SearchContext, candidate: Candidate) -> Refit:
    """The refit of a candidate as it is, under white noise."""
    linear, data = context.simulator, context.data[0]
    e = np.where(data.kept, data.y - linear.run(candidate, data), 0.0)
    white = white_noise_model(e, data.kept, sampled_plant(linear.plant(candidate), data, linear.setup.outputs))
    fit = refit(linear, candidate, context.data, white, held=context.held)
    if fit is None:
        detail = "the linear plant that stands for the simulator about the record diverges"
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
    return fit
