"""First states of the model that a search begins with, where hardly anything holds a body.

They go with a constant offset of every output, which stays in the residual, where it is a finding. But a body that
nothing holds may stand anywhere: there an offset and a first position are one and the same, and what least squares call
an offset is nothing that the model leaves.
"""

import numpy as np

from ...numerics.matrices.bounded import bounded
from .. import settings
from ..estimation.context import SearchContext
from ..estimation.gauss_newton import refit
from ..model.candidate import Candidate, Data
from ..noise.floor import residual_rms
from ..noise.whitening import white_noise_model
from ..screening.linearization import sampled_plant


def without_free_offset(context: SearchContext, start: Candidate) -> Candidate:
    """The model that a search begins with, refitted without an offset of the outputs where its free runs are wrong
    mainly by a constant.

    Taken if it leaves less than twice what is left beside the constant, or if the constant is larger than any reading
    of its output: a spring that is stretched so far is a constant force.

    **Arguments:** `context`; `start`: entries and first states, no terms.

    **Returns:** the refitted candidate, or `start` itself, as where a run overflows.
    """
    simulator, data = context.simulator, context.data
    runs = [np.where(d.kept, d.y - simulator.run(start, d, k), 0.0) for k, d in enumerate(data)]
    if not bounded(*runs):
        return start
    constants = [np.sum(e, axis=0) / np.maximum(d.kept.sum(axis=0), 1) for e, d in zip(runs, data)]
    beside = [np.where(d.kept, e - one, 0.0) for e, one, d in zip(runs, constants, data)]
    if not _much_more(data, runs, beside):
        return start
    white = white_noise_model(
        beside[0], data[0].kept, sampled_plant(simulator.plant(start), data[0], simulator.setup.outputs)
    )
    fit = refit(simulator, start, data, white, held=np.ones_like(context.held))
    if fit is not None and not context.held.all():
        fit = refit(simulator, fit.candidate, data, white, held=context.held)
    if fit is None or (_much_more(data, fit.residual, beside) and not _beyond(data, constants)):
        return start
    return fit.candidate


def _much_more(data: list[Data], one, other) -> bool:
    """Whether some output of some record has more than twice as much left in `one` as in `other`; both: residuals
    (samples × outputs), one per record."""
    pairs = [[residual_rms(e, d) for e in both] for *both, d in zip(one, other, data)]
    return any(np.any(large * settings.MUCH_NEARER > small) for large, small in pairs)


def _beyond(data: list[Data], constants: list[np.ndarray]) -> bool:
    """Whether some constant, one per output of every record, is larger than any reading there."""
    most = [np.max(np.abs(d.y), axis=0) for d in data]
    return any(np.any((np.abs(one) > largest) & (largest > 0)) for one, largest in zip(constants, most))
