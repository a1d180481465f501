"""Refits to windows of a record together: over a few periods no wrong frequency makes a phase error to speak of.

**Reference:** Bock, Numerical treatment of inverse problems in chemical reaction kinetics, Springer 1981.
"""

import dataclasses

import numpy as np

from ...numerics.matrices.bounded import bounded
from ..equation_error.rows import Series
from ..estimation.context import SearchContext
from ..estimation.continuation import ROUGH
from ..estimation.gauss_newton import refit
from ..model.candidate import Candidate, Data
from ..model.simulator import natural_frequencies_hz
from ..noise.whitening import NoiseModel

WINDOWS = 8
"""Windows that a record is divided into; others lie across their borders."""

PERIODS = 3.0
"""Of the slowest mode that a window must hold."""

ROWS = 4
"""Samples of a window for every number that is fitted to it."""

RIGID = 1e-4
"""Frequency, relative to the highest, up to which a mode is that of a rigid body."""

STEPS = 25
"""Of the refit."""


def over_windows(context: SearchContext, candidate: Candidate, series: Series, noise_model: NoiseModel) -> Candidate:
    """A candidate refitted to windows of the first record together, each with a first state of its own.

    **Arguments:** `context`; `candidate`; `series`: the first record in the band of the force equation, whose q and q̇
    begin the first states; `noise_model`.

    **Returns:** a `Candidate`; the one given where the windows are too short, or the run over the whole record is no
    nearer.
    """
    data = context.data[0]
    size, numbers = data.samples // WINDOWS, len(candidate.entries) + len(candidate.x0[0])
    hz = natural_frequencies_hz(context.simulator.plant(candidate))
    begins = [k * size for k in range(WINDOWS) if np.all(np.any(data.kept[k * size : (k + 1) * size], axis=0))]
    if not begins or not long_enough(hz, data, size, numbers):
        return candidate
    parts = [data.part(begin, size, padded=True) for begin in begins]
    states = tuple(np.concatenate([series.q[begin], series.v[begin]]) for begin in begins)
    begun = dataclasses.replace(candidate, x0=states)
    fit = refit(context.simulator, begun, parts, noise_model, held=context.held, max_steps=STEPS, tolerance=ROUGH)
    if fit is None:
        return candidate
    first = fit.candidate.x0[0] if begins[0] == 0 else candidate.x0[0]
    found = dataclasses.replace(fit.candidate, x0=(first, *candidate.x0[1:]))
    return min((found, candidate), key=lambda one: squares_left(context, one, noise_model))


def long_enough(hz: np.ndarray, data: Data, size: int, numbers: int) -> bool:
    """Whether a part of a record holds periods enough of a model's slowest mode, and samples enough to fit so many
    numbers to.

    **Arguments:** `hz`: natural frequencies, lowest first; `data`; `size` of the part [samples]; `numbers`.
    """
    slowest = float(next(iter(hz[hz > RIGID * hz[-1]]), 0.0))
    return size * data.sampling_time * slowest >= PERIODS and size >= ROWS * numbers


def squares_left(context: SearchContext, candidate: Candidate, noise_model: NoiseModel) -> float:
    """Squares that the free run of a candidate leaves of the first record, in units of a noise; infinite where it
    overflows."""
    data = context.data[0]
    e = np.where(data.kept, data.y - context.simulator.run(candidate, data), 0.0) / noise_model.level
    return float(np.sum(e**2)) if bounded(e) else np.inf
