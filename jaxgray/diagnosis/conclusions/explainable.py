"""The share of a residual that any smooth force would explain."""

import dataclasses

import numpy as np

from ..estimation.context import SearchContext
from ..estimation.multistart import first_fit
from ..model.free_run import free_run, on_the_same, overall
from ..screening.flexible_force import FlexibleForce


def explainable_share(context: SearchContext, state, floor: np.ndarray) -> float | None:
    """Share of the baseline's excess on held-out data that the model with a flexible force explains, η.

    **Arguments:** `context`; `state`: how far the loop got, its last look included; `floor`: noise per output.

    **Returns:** η, or None where there is no held-out data or no excess on it.
    """
    score = state.screening.best_by_effect().get(FlexibleForce.id)
    if score is None or not context.validation:
        return None
    # A share needs no steps whose error is below the noise.
    context = dataclasses.replace(context, simulator=context.simulator.coarse)
    fit = first_fit(context, state.stage, score, state.screening.noise_model, np.inf)
    if fit is None:
        return None

    def excess(runs):
        return float(np.mean([overall(run.rmse, floor) ** 2 for run in runs])) - 1.0

    runs = [free_run(context.simulator, fit.candidate, d) for d in context.validation]
    before, after = map(excess, on_the_same(state.baseline_runs, runs))
    if not (np.isfinite(after) and before > 0):
        return None
    return float(np.clip((before - after) / before, 0.0, 1.0))
