"""The band of integrated accelerations, by how well measured motion explains itself there.

Too low, and the noise of the integrals grows; too high, and the motion that a law sees is not in the band. Sudden
forces have power at all frequencies and pass for noise of a sensor, so that spectra alone set the lower end too high.
So the accelerations of all outputs are regressed on their own motion, the inputs and straight lines that stand in for
laws, and the lower end is where this leaves the least of them.
"""

import itertools

import numpy as np
from jaxtyping import Float

from ...records import Record
from .band import MIN_PERIODS, Band, band_of
from .rows import Series, series_of

ROWS_PER_COEFFICIENT = 3
"""Rows of the regression for every coefficient, at least."""

KNEES = (0.4, 0.6, 0.75, 0.85, 0.93, 0.98)
"""Quantiles of a displacement from which straight lines begin that stand in for laws; its size and the sign of its
velocity do so as well."""

LOWER_ENDS = 2.0 ** np.arange(-0.5, -4.5, -0.5)
"""Lower ends that are tried, relative to that by spectra, which take what acts at once for noise."""

KEPT = 0.8
"""Power of the motion that the rows of a lower end must keep of each record: the ends of a record and its gaps spoil
more of longer periods."""

CLEAR = 0.8
"""What another lower end must come down to, relative to what that by spectra leaves."""


def integrated_band(records: list[Record]) -> Band:
    """The band of a regression, its lower end where the measured motion explains itself clearly best; that by spectra
    where nothing is integrated, or rows are too few to tell.

    **Raises:** as `band_of`.
    """
    own = band_of(records)
    lowest = MIN_PERIODS / min(r.samples * r.sampling_time for r in records)
    lows = [low for low in own.low * LOWER_ENDS if low >= lowest]
    if not lows:
        return own
    first = [series_of(one, own) for one in records]
    tried = [(own, first)]
    for low in lows:
        band = Band(float(low), own.high)
        lower = [series_of(one, band) for one in records]
        if all(_power(one, other.rows) >= KEPT * _power(one, one.rows) for one, other in zip(first, lower)):
            tried.append((band, lower))
    left = [_left(same) for _, same in tried]
    best = int(np.argmin(left))
    return tried[best][0] if left[best] < CLEAR * left[0] else own


def _power(series: Series, rows: np.ndarray) -> float:
    """Sum of squares of the accelerations at some rows, every output in units of its own."""
    return float(np.sum(series.a[rows] ** 2 / np.maximum(np.mean(series.a**2, axis=0), np.finfo(float).tiny)))


def motion_and_lines(series: list[Series]) -> Float[np.ndarray, "rows columns"]:
    """Displacements, velocities, and straight lines of every displacement and every difference of two, at the rows of
    all records."""
    dofs = series[0].q.shape[1]
    arms = [*np.eye(dofs), *(np.eye(dofs)[i] - np.eye(dofs)[j] for i, j in itertools.combinations(range(dofs), 2))]
    arms = np.stack(arms, axis=1)
    knees = np.quantile(np.abs(np.concatenate([one.q @ arms for one in series])), KNEES, axis=0)
    tables = []
    for one in series:
        x = one.q @ arms
        laws = [np.sign(x) * np.maximum(np.abs(x) - knee, 0.0) for knee in knees]
        laws += [np.abs(x), np.sign(one.v @ arms)]
        tables.append(np.concatenate([one.q[one.rows], one.v[one.rows], one.row_values(np.hstack(laws))], axis=1))
    return np.concatenate(tables)


def weights_of(
    table: Float[np.ndarray, "rows columns"], target: Float[np.ndarray, "rows dofs"]
) -> Float[np.ndarray, "columns dofs"]:
    """Least squares on columns of any size."""
    size = np.maximum(np.linalg.norm(table, axis=0), np.finfo(float).tiny)
    return np.linalg.lstsq(table / size, target, rcond=1e-12)[0] / size[:, None]


def _left(series: list[Series]) -> float:
    """Share of the power of the accelerations that the regression leaves, mean over the outputs, every coefficient
    counted; infinite where rows are too few."""
    table = np.concatenate([motion_and_lines(series), np.concatenate([one.input_rows for one in series])], axis=1)
    target = np.concatenate([one.a[one.rows] for one in series])
    rows, columns = table.shape
    if rows < ROWS_PER_COEFFICIENT * columns:
        return np.inf
    left = np.sum((target - table @ weights_of(table, target)) ** 2, axis=0)
    power = np.maximum(np.sum(target**2, axis=0), np.finfo(float).tiny)
    return float(np.mean(left / power)) * rows / (rows - columns)
