"""What a scattered quantity depends on: means over bins of a variable, and whether that variable decides it."""

import numpy as np

BINS = 40
"""Stretches of a variable over which a quantity is averaged."""

WITHIN = 0.08
"""Share of a quantity's variance within bins of a variable up to which the variable decides it."""


def binned(x, y, bins: int = BINS):
    """Means of y over stretches of x that hold equally many samples.

    **Returns:** middle of every stretch, mean there, standard error of the mean.
    """
    order = np.argsort(x, kind="stable")
    parts = [part for part in np.array_split(order, min(bins, max(len(x) // 8, 1))) if len(part)]
    centre = np.array([np.mean(x[part]) for part in parts])
    mean = np.array([np.mean(y[part]) for part in parts])
    spread = np.array([np.std(y[part]) / np.sqrt(len(part)) for part in parts])
    return centre, mean, spread


def decided_by(x, y) -> bool:
    """Whether y is nearly a function of x: hardly any of its variance lies within bins of x."""
    inside = binned(x, y)
    count = len(y) / max(len(inside[0]), 1)
    return float(np.mean(inside[2] ** 2) * count) < WITHIN * float(np.var(y))
