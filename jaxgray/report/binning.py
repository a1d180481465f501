"""What a scattered quantity depends on: means over bins of a variable, and whether that variable decides it."""

import numpy as np

BINS = 40
"""Stretches of a variable over which a quantity is averaged."""

FINE = 200
"""Stretches by which a law without noise is drawn."""

WITHIN = 0.08
"""Share of a quantity's variance within bins of a variable up to which the variable decides it."""


def binned(x, y, bins: int = BINS, *, least: int = 8):
    """Means of y over stretches of x that hold equally many samples, at least so many each.

    **Returns:** middle of every stretch, mean there, standard error of the mean.
    """
    parts = _bins(x, bins, least)
    centre = np.array([np.mean(x[part]) for part in parts])
    mean = np.array([np.mean(y[part]) for part in parts])
    spread = np.array([np.std(y[part]) / np.sqrt(len(part)) for part in parts])
    return centre, mean, spread


def decided_by(x, y) -> bool:
    """Whether y is nearly a function of x: hardly any of its variance lies about straight lines within bins of x."""
    left = 0.0
    for part in _bins(x, BINS, 8):
        table = np.stack([np.ones(len(part)), x[part] - np.mean(x[part])], axis=1)
        left += float(np.sum((y[part] - table @ np.linalg.lstsq(table, y[part], rcond=None)[0]) ** 2))
    return left < WITHIN * len(y) * float(np.var(y))


def _bins(x, bins: int, least: int) -> list[np.ndarray]:
    """Positions of the samples in every stretch."""
    order = np.argsort(x, kind="stable")
    return [part for part in np.array_split(order, min(bins, max(len(x) // least, 1))) if len(part)]
