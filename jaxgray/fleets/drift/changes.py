"""Whether, when and how a series of estimates has changed: steps and ramps, by the generalised likelihood ratio.

A series x over the records of a machine, with standard errors up to a common factor, is x = Z β + a g + ε: Z a constant
and the covariates, g a step or a ramp that begins at some record. With P the projection off Z,

    T = max over g of −(ν/2) ln(1 − (gᵀ P x)²/(gᵀ P g · xᵀ P x)),        ν = records − columns of Z,

which does not depend on the factor of the errors: that is taken from the series itself. The distribution of T without a
change is simulated for the same Z and g.

**Reference:** M. Basseville, I. Nikiforov, *Detection of Abrupt Changes*, Prentice Hall, 1993, §2.4.3 (GLR, the CUSUM
with an unknown size).
"""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

EDGE = 3
"""Records before and after the earliest and the latest beginning of a change."""

NULLS = 20_000
"""Series without a change by which thresholds are simulated."""

TAIL = 0.01
"""Share of the simulated statistics from which their tail is extrapolated by an exponential, which T has."""

WITHIN = 1.92
"""What the logarithm of the likelihood may lack for a beginning to be in the 95 % interval."""

FEWEST = 12
"""Records from which a machine's changes are looked for."""

KINDS = ("step", "ramp")


@dataclass(frozen=True, eq=False)
class Shapes:
    """The changes that are looked for in series of one length under one set of conditions.

    `design`: orthonormal columns of constant and covariates, weighted; `shapes`: steps, then ramps, off these and of
    unit length; `sizes`: their lengths before; `begins`: record at which each begins; `kinds`: which are steps, which
    ramps; `weights`: of the records; `nulls`: sorted statistics of series without a change.
    """

    design: Float[np.ndarray, "records columns"]
    shapes: Float[np.ndarray, "shapes records"]
    sizes: Float[np.ndarray, " shapes"]
    begins: np.ndarray
    kinds: tuple[str, ...]
    weights: Float[np.ndarray, " records"]
    nulls: Float[np.ndarray, " nulls"]

    @property
    def freedom(self) -> int:
        """Records less the columns of the design."""
        return self.design.shape[0] - self.design.shape[1]

    def curve(self, k: int) -> Float[np.ndarray, " records"]:
        """Shape `k` as it is: 0 before it begins, then 1, or rising by 1/records to less than 1."""
        return curve(self.kinds[k], int(self.begins[k]), len(self.weights))

    def probability(self, statistic: float) -> float:
        """Of a statistic as large without a change; beyond the simulated ones by an exponential tail."""
        count = len(self.nulls)
        start = self.nulls[int(count * (1 - TAIL))]
        if statistic <= start:
            return float((count - np.searchsorted(self.nulls, statistic) + 1) / (count + 1))
        excess = self.nulls[self.nulls > start] - start
        # Not faster than the statistic of a single shape falls.
        rate = min(1.0, 1.0 / float(np.mean(excess)))
        return float(TAIL * np.exp(-rate * (statistic - start)))


@dataclass(frozen=True)
class Change:
    """The change that a series shows best.

    `kind`: "step" or "ramp"; `begins`: index of the record; `interval`: 95 % of it; `size`: at the last record, with
    its `standard_error`; `statistic` T; `probability` without a change; `before`: constant part before it, with error.
    """

    kind: str
    begins: int
    interval: tuple[int, int]
    size: float
    standard_error: float
    statistic: float
    probability: float
    before: tuple[float, float]


def curve(kind: str, begins: int, records: int) -> Float[np.ndarray, " records"]:
    """A step or a ramp over records; a ramp ends at less than 1, by 1/records a record."""
    at = np.arange(records) - begins
    return (at >= 0).astype(float) if kind == "step" else np.maximum(at + 1, 0) / records


def conditions(covariates: Float[np.ndarray, "records covariates"]) -> Float[np.ndarray, "records columns"]:
    """A constant, the covariates about their means in standard deviations, and their squares; constant ones left out.

    Squares take up what a linear model of the covariate leaves.
    """
    spread = covariates.std(axis=0)
    moving = spread > 1e-9 * np.maximum(np.abs(covariates).max(axis=0, initial=0.0), 1e-300)
    c = (covariates[:, moving] - covariates[:, moving].mean(axis=0)) / spread[moving]
    return np.concatenate([np.ones((len(covariates), 1)), c, c**2], axis=1)


def shapes_of(Z: Float[np.ndarray, "records columns"], weights: Float[np.ndarray, " records"]) -> Shapes:
    """The changes to look for, and their statistics without one.

    **Arguments:** `Z`: by `conditions`; `weights`: one over the standard error of each record, in any unit.
    """
    weights = weights / np.sqrt(np.mean(weights**2))
    key = Z.shape, np.round(Z, 9).tobytes(), np.round(weights, 6).tobytes()
    return _shapes(*key)


@functools.lru_cache(maxsize=512)
def _shapes(shape, Z: bytes, weights: bytes) -> Shapes:
    Z, weights = np.frombuffer(Z).reshape(shape), np.frombuffer(weights)
    records = len(weights)
    Q, R = np.linalg.qr(Z * weights[:, None])
    Q = Q[:, np.abs(np.diag(R)) > 1e-9 * np.abs(R).max()]
    begins, kinds, rows, sizes = [], [], [], []
    for kind in KINDS:
        for first in range(EDGE, records - EDGE + 1):
            g = curve(kind, first, records) * weights
            off = g - Q @ (Q.T @ g)
            # What the covariates do as well is no change of its own.
            if off @ off > 0.02 * (g @ g):
                begins.append(first)
                kinds.append(kind)
                sizes.append(np.linalg.norm(off))
                rows.append(off / sizes[-1])
    G = np.array(rows).reshape(len(rows), records)
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((records, NULLS))
    noise -= Q @ (Q.T @ noise)
    share = np.max((G @ noise) ** 2, axis=0, initial=0.0) / np.sum(noise**2, axis=0)
    nulls = np.sort(-(records - Q.shape[1]) / 2 * np.log1p(-np.minimum(share, 1 - 1e-12)))
    return Shapes(Q, G, np.array(sizes), np.array(begins), tuple(kinds), weights, nulls)


def change_of(x: Float[np.ndarray, " records"], shapes: Shapes) -> Change | None:
    """The change that a series shows best; None where no shape can be told from the covariates.

    **Arguments:** `x`: estimates, in the order of the records; `shapes`: by `shapes_of`, for their weights.
    """
    if not len(shapes.shapes):
        return None
    z = x * shapes.weights
    r = z - shapes.design @ (shapes.design.T @ z)
    power = max(float(r @ r), 1e-300)
    along = shapes.shapes @ r
    T = -shapes.freedom / 2 * np.log1p(-np.minimum(along**2 / power, 1 - 1e-12))
    k = int(np.argmax(T))
    alike = [
        begin
        for begin, kind, t in zip(shapes.begins, shapes.kinds, T)
        if kind == shapes.kinds[k] and t >= T[k] - WITHIN
    ]
    spread = np.sqrt(max(power - along[k] ** 2, 0.0) / max(shapes.freedom - 1, 1))
    end = shapes.curve(k)[-1]
    size, error = along[k] / shapes.sizes[k] * end, spread / shapes.sizes[k] * end
    begins = int(shapes.begins[k])
    before = x[:begins] - 0.0
    deviation = float(np.std(before, ddof=1) / np.sqrt(len(before))) if len(before) > 1 else float("inf")
    return Change(
        shapes.kinds[k],
        begins,
        (int(min(alike)), int(max(alike))),
        float(size),
        float(error),
        float(T[k]),
        shapes.probability(float(T[k])),
        (float(np.mean(before)), deviation),
    )
