"""What a scattered quantity depends on: means over bins of a variable, and whether that variable decides it."""

import numpy as np

BINS = 50
"""Stretches of a variable over which a quantity is averaged, at most."""

LEAST = 5
"""Samples of a stretch at least."""

WITHIN = 0.08
"""Share of a quantity's variance within bins of a variable up to which the variable decides it."""


def binned(x, y, bins: int = BINS):
    """Means of y over stretches of x.

    **Returns:** middle of every stretch, mean there, standard error of the mean.
    """
    parts = _bins(x, bins)
    centre = np.array([np.mean(x[part]) for part in parts])
    mean = np.array([np.mean(y[part]) for part in parts])
    spread = np.array([np.std(y[part]) / np.sqrt(len(part)) for part in parts])
    return centre, mean, spread


def decided_by(x, y) -> bool:
    """Whether y is nearly a function of x: hardly any of its variance lies about straight lines within bins of x."""
    left = 0.0
    for part in _bins(x, BINS):
        table = np.stack([np.ones(len(part)), x[part] - np.mean(x[part])], axis=1)
        left += float(np.sum((y[part] - table @ np.linalg.lstsq(table, y[part], rcond=None)[0]) ** 2))
    return left < WITHIN * len(y) * float(np.var(y))


def _bins(x, bins: int) -> list[np.ndarray]:
    """Positions of the samples in every stretch: half of the edges hold equally many between them, half are equally far
    apart, so that both what is frequent and what is fast is seen; a stretch with too few samples joins the next."""
    order = np.argsort(x, kind="stable")
    sorted_x = x[order]
    counts = np.linspace(0, len(x), bins // 2 + 1)
    widths = np.searchsorted(sorted_x, np.linspace(sorted_x[0], sorted_x[-1], bins // 2 + 1)[1:-1])
    edges = [0]
    for edge in np.unique(np.concatenate([counts, widths]).astype(int)):
        if edge - edges[-1] >= LEAST and len(x) - edge >= LEAST:
            edges.append(int(edge))
    return [order[first:last] for first, last in zip(edges, [*edges[1:], len(x)])]
