"""What stands out in a population of records: outliers against the fleet, and trends over time."""

from dataclasses import dataclass

import numpy as np
import scipy.stats

from .tables import parameters

FAR_OUT = 5.0
"""Deviations from the median, in robust standard deviations of the fleet or in the record's own errors, whichever are
larger, from which a value is an outlier."""

FEWEST = 8
"""Records from which the spread of a fleet is known well enough to call any of them an outlier."""

FALSE_DISCOVERIES = 0.05
"""Expected share of false ones among trends that are told."""

MOST_PAIRED = 1500
"""Records from which trends are computed at most, evenly over time: their cost grows with the square."""


@dataclass(frozen=True)
class Outlier:
    """A value that stands out: `row` of its record, `parameter`, `value`, `median` of the fleet, and by how many
    standard deviations (`distance`, signed)."""

    row: dict
    parameter: str
    value: float
    median: float
    distance: float


@dataclass(frozen=True)
class Trend:
    """A parameter that rises or falls over time: `slope` per unit of time, its 95 % interval, and its probability."""

    parameter: str
    slope: float
    interval: tuple[float, float]
    probability: float


def values_of(rows: list[dict], name: str) -> np.ndarray:
    """A column as numbers, NaN where there is none."""
    return np.array([np.nan if row.get(name) is None else row[name] for row in rows], dtype=float)


def all_parameters(rows: list[dict]) -> list[str]:
    """Parameters of the system that any record has, in order."""
    return list(dict.fromkeys(name for row in rows for name in parameters(row)))


def outliers(rows: list[dict]) -> list[Outlier]:
    """Values far from the median of the fleet, the farthest first."""
    found = []
    for name in all_parameters(rows):
        x, error = values_of(rows, name), values_of(rows, f"{name}_error")
        known = np.isfinite(x)
        if known.sum() < FEWEST:
            continue
        median = float(np.median(x[known]))
        spread = 1.4826 * float(np.median(np.abs(x[known] - median)))
        scale = np.maximum(np.nan_to_num(error), max(spread, 1e-12 * abs(median)))
        distance = (x - median) / np.where(scale > 0, scale, np.inf)
        for k in np.flatnonzero(known & (np.abs(distance) > FAR_OUT)):
            found.append(Outlier(rows[k], name, float(x[k]), median, float(distance[k])))
    return sorted(found, key=lambda one: -abs(one.distance))


def trends(rows: list[dict]) -> list[Trend]:
    """Parameters that rise or fall over time by Kendall's test, with Theil's slope; false ones kept to a few percent.

    **Reference:** Benjamini and Hochberg (1995) for the share of false ones.
    """
    when, made = values_of(rows, "when_number"), []
    for name in all_parameters(rows):
        x = values_of(rows, name)
        known = np.flatnonzero(np.isfinite(x) & np.isfinite(when))
        if len(known) < FEWEST or np.ptp(x[known]) == 0 or np.ptp(when[known]) == 0:
            continue
        known = known[np.argsort(when[known], kind="stable")][:: -(-len(known) // MOST_PAIRED)]
        probability = float(scipy.stats.kendalltau(when[known], x[known]).pvalue)
        slope, _, low, high = scipy.stats.theilslopes(x[known], when[known])
        made.append(Trend(name, float(slope), (float(low), float(high)), probability))
    if not made:
        return []
    kept = discoveries(np.array([trend.probability for trend in made]), FALSE_DISCOVERIES)
    return sorted((trend for trend, keep in zip(made, kept) if keep), key=lambda trend: trend.probability)


def discoveries(probabilities: np.ndarray, rate: float) -> np.ndarray:
    """Which of many tests are discoveries, the expected share of false ones at most `rate`.

    **Reference:** Benjamini and Hochberg, *Journal of the Royal Statistical Society B* 57, 1995.
    """
    order = np.argsort(probabilities)
    limit = rate * np.arange(1, len(order) + 1) / len(order)
    below = np.flatnonzero(probabilities[order] <= limit)
    kept = np.zeros(len(order), bool)
    if len(below):
        kept[order[: below[-1] + 1]] = True
    return kept
