"""Whether a refinement lost on data that it did not see."""

import numpy as np

from ..setup.preparation import Signals
from .start import model_run

BLOCKS = 20
"""Blocks of the held-out data between which the loss is compared with its spread."""

SURE = 3.0
"""Standard errors by which the squared error on held-out data must have risen."""

SLIGHT = 0.01
"""Rise of the squared error on held-out data, as a share of the start's, that does not count."""


def lost(end, start, setting, held_out: list[Signals]) -> bool:
    """Whether a model simulates held-out records surely worse than the one that its refinement began with.

    The squared errors of both free runs, output by output in units of the start's, compared block by block.

    **Arguments:** `end`, `start`: scaled M, D, K (coordinates × coordinates each); `setting`: drive, sensors and hold;
    `held_out`: prepared records (samples × channels), none of them in the fit.

    **Returns:** True where the end runs away and the start does not, or where its error is larger by more than
    `SLIGHT` and `SURE` standard errors; False without held-out records.
    """
    if not held_out:
        return False
    rises, lengths = [], []
    for signals in held_out:
        kept, measured = np.asarray(signals.kept), np.asarray(signals.y)
        errors = [(measured - np.asarray(model_run(m, setting, signals)[0])) ** 2 * kept for m in (end, start)]
        if not np.all(np.isfinite(errors[0])):
            return bool(np.all(np.isfinite(errors[1])))
        level = np.sum(errors[1], axis=0) / np.maximum(np.sum(kept, axis=0), 1)
        rise = np.mean((errors[0] - errors[1]) / np.maximum(level, 1e-300), axis=1)
        blocks = np.array_split(rise, max(BLOCKS // len(held_out), 2))
        rises += [np.mean(block) for block in blocks]
        lengths += [len(block) for block in blocks]
    rises, lengths = np.asarray(rises), np.asarray(lengths)
    mean = np.average(rises, weights=lengths)
    spread = np.sqrt(np.sum(lengths**2 * (rises - mean) ** 2)) / np.sum(lengths)
    return bool(mean > SLIGHT and mean > SURE * spread)
