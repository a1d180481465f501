"""First states of the model that a search begins with, where hardly anything holds a body.

They go with a constant offset of every output, which stays in the residual, where it is a finding. But a body that
nothing holds may stand anywhere: there an offset and a first position are one and the same, and what least squares call
an offset is nothing that the model leaves.
"""

import numpy as np

from .. import settings
from ..estimation.context import SearchContext
from ..estimation.gauss_newton import refit
from ..model.candidate import Candidate
from ..model.free_run import overall
from ..noise.floor import residual_rms
from ..noise.whitening import white_noise_model
from ..screening.linearization import stage_of


def without_free_offset(context: SearchContext, start: Candidate) -> Candidate:
    """A linear model whose free runs are off by a constant above all, refitted without one where that leaves hardly
    more than what is left beside the constant, or this is more than any sensor shows: a spring that is stretched so
    far is a constant force. Else as it is.

    **Arguments:** `context`; `start`: entries and first states, no terms.
    """
    stage = stage_of(context.simulator, start, context.data[0])
    runs = [stage.e, *(_left(context, start, k) for k in range(1, len(context.data)))]
    constants = [np.sum(e, axis=0) / np.maximum(d.kept.sum(axis=0), 1) for e, d in zip(runs, context.data)]
    beside = [np.where(d.kept, e - one, 0.0) for e, one, d in zip(runs, constants, context.data)]
    if not _much_more(context, runs, beside):
        return start
    beyond = any(np.any(np.abs(one) > np.max(np.abs(d.y), axis=0)) for one, d in zip(constants, context.data))
    white = white_noise_model(stage.e, context.data[0].kept, stage.system)
    fit = refit(context.simulator, start, context.data, white, held=np.ones_like(context.held))
    fit = fit and refit(context.simulator, fit.candidate, context.data, white, held=context.held)
    if fit is None or (_much_more(context, fit.residual, beside) and not beyond):
        return start
    return fit.candidate


def _left(context: SearchContext, start: Candidate, k: int) -> np.ndarray:
    """What the free run of a model leaves of the k-th record."""
    data = context.data[k]
    return np.where(data.kept, data.y - context.simulator.run(start, data, k), 0.0)


def _much_more(context: SearchContext, one, other) -> bool:
    """Whether some record has much more left of it in one place than in another."""
    pairs = [[residual_rms(e, d) for e in both] for *both, d in zip(one, other, context.data)]
    return any(overall(old, new) * settings.MUCH_NEARER > 1.0 for old, new in pairs)
