"""Realisations of a record whose slow drift outweighs its vibration: input and output through one high-pass filter.

A filter of the samples commutes with the system, so that the transfer function stays what it is.
"""

import jax
import numpy as np

from ...numerics.responses.filters import filtered
from ..setup.preparation import Signals
from .realizations import HigherOrder

MEMORIES = (0.95, 0.8)
"""Poles ρ of the filters (1 − z⁻¹)/(1 − ρ z⁻¹)."""


def high_passed(signals: Signals, memory: float) -> tuple[Signals, np.ndarray, np.ndarray]:
    """A record through a high-pass filter, every channel of unit size again.

    **Arguments:** `signals`: without gaps; `memory` (ρ) of the filter.

    **Returns:** the record, and the sizes of its inputs and outputs.
    """
    n = signals.samples

    def through(x):
        x = np.asarray(x)
        y = np.zeros_like(x)
        y[:n] = filtered([1.0, -1.0], [1.0, -memory], x[:n] - x[0], axis=0)
        size = np.sqrt(np.mean(y[:n] ** 2, axis=0))
        return y / np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0)

    (u, inputs), (y, outputs) = through(signals.u), through(signals.y)
    return Signals(*(jax.device_put(x) for x in (u, y, np.asarray(signals.kept))), n), inputs, outputs


def in_units(model: HigherOrder, inputs: np.ndarray, outputs: np.ndarray) -> HigherOrder:
    """The same where input j is counted in `inputs` and output k in `outputs` of the units that it was found in."""
    C, Cy = (X * outputs[:, None] for X in (model.C, model.Cy))
    Dy = model.Dy * outputs[:, None] / inputs
    return HigherOrder(model.A, model.B / inputs, C, Cy, Dy, model.deviation, model.singular_values)
