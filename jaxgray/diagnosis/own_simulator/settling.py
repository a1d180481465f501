"""Laws and numbers where they stand still in the simulator itself."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...numerics.outcomes import RESULTS, ComputationError
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.gauss_newton import Refit, refit
from ..model.candidate import Candidate, Data
from ..model.parameter_vector import Layout
from ..noise.whitening import white_noise_model
from ..screening.linearization import sampled_plant
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


def settle(problem: Problem, context: SearchContext, fit: Refit, wholes: Linear) -> Settled:
    """Laws and numbers where they stand still in the simulator itself: run it with the forces that the laws make along
    its motion, refit in the linear plant about this run, and again.

    The force of a run is that along the motion which the linear plant foresaw; where the two agree, it is that along
    the simulator's own.

    **Arguments:** `problem`; `context` of a search in the linear plant, a `fit` there, and its whole records.

    **Raises:** `ComputationError` where the simulator does not run with what was found.
    """
    linear, noise_model, candidate = context.simulator, noise_model_of(context, fit), fit.candidate
    best = None
    for turn in range(SETTLING):
        context.progress.unlimited.stage(f"settling in the simulator ({turn + 1})")
        calls, foreseen = problem.with_laws(linear, candidate, wholes) or (None, None)
        # Without laws there is no other run to fall back on.
        runs = problem.tried(calls) if candidate.terms else problem.runs(calls)
        if runs is None:
            break
        if turn == 0 and not candidate.terms:
            # Beside laws, numbers must move the linear plant as laws do: by the force that they take along the motion.
            runs = problem.with_slopes(runs, candidate.entries)
        linear, wholes = problem.about(linear, candidate, wholes, runs)
        data = problem.fit_data(wholes)
        again = refit(linear, candidate, data, noise_model, held=context.held)
        if again is None:
            break
        size = np.sqrt(np.maximum(np.diag(again.covariance), 1e-300))
        layout = Layout(linear.setup, candidate)
        change = np.abs(layout.vector(again.candidate) - layout.vector(candidate)) / size
        still = turn > 0 and bool(np.max(change[size > 1e-150], initial=0.0) < STILL)
        # What the linear plant had left was no noise.
        noise_model = noise_model_of(dataclasses.replace(context, simulator=linear, data=data), again)
        y = problem.seen(linear, candidate, wholes, runs)
        still = still and (not candidate.terms or _as_foreseen(problem, runs, foreseen, y))
        candidate = again.candidate
        best = Settled(candidate, again, linear, wholes, tuple(data), y, still)
        if still:
            break
    if best is None:
        raise ComputationError(
            RESULTS.simulator_failed, stage="simulator", detail="it does not run with the laws that were found"
        )
    return best


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
