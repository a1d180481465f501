"""Laws and numbers where they stand still in the simulator itself."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...identification.refinement.conic import pseudo_inverse
from ...numerics.bounded import bounded
from ...numerics.outcomes import RESULTS, ComputationError
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.gauss_newton import Refit, refit
from ..model.candidate import Candidate, Data
from ..model.free_run import rms_of
from ..model.parameter_vector import Layout
from ..noise.whitening import white_noise_model
from ..screening.linearization import sampled_plant
from .gains import parts_of
from .numbers import NumbersSimulator
from .problem import Linear, Problem, Runs

SETTLING = 8
"""Runs at most until laws and numbers stand still in the simulator."""

CLOSED = 3
"""Runs that bring the forces of given laws along the simulator's own motion."""

STILL = 0.25
"""Change of every parameter, in standard errors, at which they do."""

FORESEEN = 0.1
"""Difference of a run from the motion that the linear plant foresaw, relative to what the run leaves of the record, at
which the force of a law is that along the simulator's own motion."""


@dataclass(frozen=True)
class Settled:
    """Laws and numbers in the simulator: `candidate`, its `fit` in the `linear` plant about the last runs, records
    for it (`wholes`, and of the fit `data`), what the sensors show of the runs (`y`), and whether laws and
    numbers stood still."""

    candidate: Candidate
    fit: Refit
    linear: NumbersSimulator
    wholes: Linear
    data: tuple[Data, ...]
    y: tuple[np.ndarray, ...]
    still: bool


def settle(problem: Problem, context: SearchContext, fit: Refit, wholes: Linear, *, beyond: float = np.inf) -> Settled:
    """Laws and numbers where they stand still in the simulator itself: run it with the forces that the laws make along
    its motion, refit in the linear plant about this run, and again.

    The force of a run is that along the motion which the linear plant foresaw; where the two agree, it is that along
    the simulator's own.

    **Arguments:** `problem`; `context` of a search in the linear plant, a `fit` there, and its whole records; `beyond`:
    what runs may leave, as `left_by` has it, for another one.

    **Raises:** `ComputationError` where the simulator does not run with what was found.
    """
    linear, noise_model, candidate = context.simulator, noise_model_of(context, fit), fit.candidate
    best, before = None, np.inf
    for turn in range(SETTLING):
        context.progress.unlimited.stage(f"settling in the simulator ({turn + 1})")
        calls, foreseen = problem.with_laws(linear, candidate, wholes) or (None, None)
        runs = problem.tried(calls if candidate.terms else problem.called(candidate.entries))
        if runs is None:
            break
        if turn == 0 and not candidate.terms:
            # Beside laws, numbers must move the linear plant as laws do: by the force that they take along the motion.
            runs = problem.with_slopes(runs, wholes)
        linear, wholes = problem.about(linear, candidate, wholes, runs)
        data = problem.fit_data(wholes)
        again = refit(linear, candidate, data, noise_model, held=context.held)
        if again is None:
            break
        size = np.sqrt(np.maximum(np.diag(again.covariance), 1e-300))
        layout = Layout(linear.setup, candidate)
        change = np.abs(layout.vector(again.candidate) - layout.vector(candidate)) / size
        largest = float(np.max(change[size > 1e-150], initial=0.0))
        # What the linear plant had left was no noise.
        noise_model = noise_model_of(dataclasses.replace(context, simulator=linear, data=data), again)
        y = problem.seen(linear, candidate, wholes, runs)
        left = left_by(problem, y)
        # Along a direction that the record hardly knows they may wander, and no run is any better.
        flat = largest < 1.0 and abs(left - before) * sum(d.samples for d in data) < 1.0
        still = turn > 0 and (largest < STILL or flat)
        still = still and (not candidate.terms or _as_foreseen(problem, runs, foreseen, y))
        candidate, before = again.candidate, left
        best = Settled(candidate, again, linear, wholes, tuple(data), y, still)
        if still or (turn > 0 and left > beyond):
            break
    if best is None:
        raise ComputationError(
            RESULTS.simulator_failed, stage="simulator", detail="it does not run with the laws that were found"
        )
    return dataclasses.replace(best, fit=_with_errors(problem, best))


def _with_errors(problem: Problem, settled: Settled) -> Refit:
    """The fit with the errors of its parameters in a plant that varies along the motion, as the simulator does: the
    fit's own are those of a plant that does not.

    **Reference:** White, *Maximum likelihood estimation of misspecified models*, Econometrica 50 (1982) 1-25.
    """
    fit, layout = settled.fit, Layout(settled.linear.setup, settled.candidate)
    moving = np.flatnonzero(np.diag(fit.covariance) > 0)
    own, across = np.zeros((2, layout.size, layout.size))
    spans = [span for span in problem.spans if span.fit is not None]
    for k, (span, y, e, J) in enumerate(zip(spans, settled.y, fit.residual, fit.jacobian)):
        n = min(len(J), span.fit.stop - span.fit.start)
        motion, J = y[span.fit], J[:n]
        made = np.array(J)
        states = slice(layout.entries, layout.entries + layout.states)
        for j in np.setdiff1d(np.arange(J.shape[2]), np.arange(states.start, states.stop)):
            made[:, :, j] = problem.plant.forces_of(J[:, :, j], span.record[span.fit])[0]
        made = problem.plant.varying.response(made, motion, span.record)
        made[:, :, states] = J[:, :, states]
        kept = np.isfinite(span.record.y[span.fit]) / np.sqrt(np.maximum(np.mean(e[:n] ** 2, axis=0), 1e-300))
        ours, theirs = (layout.widened(X * kept[:, :, None], k).reshape(-1, layout.size) for X in (J, made))
        own, across = own + ours.T @ ours, across + ours.T @ theirs
    if not bounded(own, across):
        return fit
    moving = moving[np.diag(own)[moving] > 0]
    inside = np.ix_(moving, moving)
    size = np.sqrt(np.diag(own[inside]))
    inverse = np.linalg.pinv(across[inside] / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
    spread = np.diag(inverse @ own[inside] @ inverse.T) / np.maximum(np.diag(pseudo_inverse(own[inside])), 1e-300)
    scale = np.ones(layout.size)
    scale[moving] = np.sqrt(np.maximum(spread, 1.0))
    return dataclasses.replace(fit, covariance=fit.covariance * np.outer(scale, scale))


def left_by(problem: Problem, y: tuple[np.ndarray, ...]) -> float:
    """Logarithm of the mean squares that runs leave of the outputs in the data of the fit."""
    return float(np.sum(np.log(rms_of(parts_of(problem, y)[0]) ** 2)))


def _as_foreseen(problem: Problem, runs: Runs, foreseen: list[np.ndarray], y: tuple[np.ndarray, ...]) -> bool:
    """Whether runs move as the linear plant foresaw, far below what they leave of the records."""
    for span, run, motion, shown in zip(problem.spans, runs.y, foreseen, y):
        left = np.nanmean((span.record.y - shown) ** 2, axis=0)
        if not np.all(np.mean((run - motion) ** 2, axis=0) <= FORESEEN**2 * left):
            return False
    return True


def with_numbers(problem: Problem, settled: Settled, entries: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """What the sensors show of the simulator with other numbers beside the laws that were found; None where it does not
    run with them."""
    linear, wholes, candidate = settled.linear, settled.wholes, settled.candidate.with_entries(entries)
    for _ in range(CLOSED if candidate.terms else 1):
        calls, _ = problem.with_laws(linear, candidate, wholes) or (None, None)
        runs = problem.tried(calls)
        if runs is None:
            return None
        linear, wholes = problem.about(linear, candidate, wholes, runs)
    return problem.seen(linear, candidate, wholes, runs)


def refit_of_numbers(context: SearchContext, candidate: Candidate) -> Refit:
    """The refit of a candidate as it is, under white noise."""
    linear, data = context.simulator, context.data[0]
    e = np.where(data.kept, data.y - linear.run(candidate, data), 0.0)
    white = white_noise_model(e, data.kept, sampled_plant(linear.plant(candidate), data, linear.setup.dofs))
    fit = refit(linear, candidate, context.data, white, held=context.held)
    if fit is None:
        detail = "the linear plant that stands for it about the record runs away"
        raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
    return fit
