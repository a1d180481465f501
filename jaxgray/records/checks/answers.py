"""How outputs answer inputs, by a difference equation long enough for any linear system: no structure, no parameters.

    y(k) + a₁ y(k−1) + … + a_p y(k−p) = Σ_j b_j0 u_j(k) + … + b_jp u_j(k−p) + e(k)

by least squares, each output from its own past. Such an equation is consistent for a linear system and any coloured
noise as p grows; what it leaves is told apart by what e and e/A look like. Columns beside the inputs (`beside`) stand
for forces that nobody measured: dry friction has the sign of a velocity.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxgray.numerics.responses.filters import filtered

ORDERS = (20, 40)
"""Orders tried: the first serves where the second is hardly better."""

BETTER = 0.8
"""Share of the unexplained part below which the longer equation is taken."""

MOST_ROWS = 8000
"""Rows of the least-squares problem; of longer records, blocks all over it."""

BLOCK = 1000


@dataclass(frozen=True, eq=False)
class Answer:
    """One output by the inputs.

    **Arguments:**

    - `a`: 1, a₁, …; `b`: of every input; `c`: of every column beside them.
    - `innovation`: e, zero where a sample that it needs is missing.
    - `unexplained`: e/A, the output without what the inputs explain; missing samples are zero.
    - `share`: RMS of the unexplained over that of the output; infinite where nothing stable explains it.
    - `stable`: whether 1/A was, as it was fitted; if not, A has its roots reflected, and the innovation is that before.
    """

    a: Float[np.ndarray, " past"]
    b: Float[np.ndarray, "inputs past"]
    c: Float[np.ndarray, "beside past"]
    innovation: Float[np.ndarray, " samples"]
    unexplained: Float[np.ndarray, " samples"]
    share: float
    stable: bool = True

    def by(self, u: Float[np.ndarray, " samples"], j: int) -> Float[np.ndarray, " samples"]:
        """What input j brings, from rest."""
        return filtered(self.b[j], self.a, u)


def answer(
    u: Float[np.ndarray, "samples inputs"],
    y: Float[np.ndarray, " samples"],
    rows: slice | None = None,
    beside: Float[np.ndarray, "samples beside"] | None = None,
) -> Answer | None:
    """Fit one output, both without their means.

    **Arguments:**

    - `u`, `y`: signals; NaN where an output is missing.
    - `rows`: those fitted to; default all.
    - `beside`: columns that stand for forces beside the inputs; default none.

    **Returns:** the `Answer`, None where the record is too short.
    """
    best = None
    for order in ORDERS:
        found = fitted(u, y, order, rows, beside)
        if found is not None and (best is None or found.share < BETTER * best.share):
            best = found
    return best


SHIFTS = (15, 50, -15, -45)
"""Samples by which inputs are put off where they explain little: an equation of this length reaches that much on."""

PLAIN = 0.02
"""Unexplained share below which nothing is shifted."""


def aligned(u: np.ndarray, y: np.ndarray, found: Answer, beside: np.ndarray | None = None) -> tuple[int, Answer]:
    """An output by inputs that are put off by so many samples that they explain it better.

    **Returns:** how many samples earlier the output is than in the record that was fitted, and the `Answer`; 0 and
    `found` where no shift explains far more.
    """
    best = 0, found
    if found.share < PLAIN or len(y) < 10 * max(ORDERS):
        return best
    for lead in SHIFTS:
        moved, x = put_off(u, y, lead)
        # The longer equation: some of its length goes into the shift.
        other = fitted(moved, x, ORDERS[-1], None, beside)
        if other is not None and other.share < 0.6 * best[1].share:
            best = lead, answer(moved, x, None, beside)
    return best


def put_off(u: np.ndarray, y: np.ndarray, lead: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs put off by so many samples, and an output without those that lose theirs."""
    x = y.astype(float).copy()
    x[len(x) - lead if lead > 0 else 0 : None if lead > 0 else -lead] = np.nan
    return np.roll(u, -lead, axis=0), x


def least_lead(u: np.ndarray, y: np.ndarray, most: int, share: float, beside: np.ndarray | None = None) -> int:
    """The fewest samples, up to `most`, by which inputs are put off and explain an output all but about a `share`."""
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        found = fitted(*put_off(u, y, middle), ORDERS[-1], None, beside)
        low, high = (low, middle) if found is not None and found.share < ABOUT * share else (middle, high)
    return high


ABOUT = 1.5
"""Unexplained share, over the least one, that is as good."""


def fitted(
    u: np.ndarray, y: np.ndarray, order: int, rows: slice | None, beside: np.ndarray | None = None
) -> Answer | None:
    """The same by an equation of one order."""
    own = u.shape[1]
    u = u if beside is None else np.concatenate([u, beside], axis=1)
    n, inputs = u.shape
    known = np.isfinite(y)
    x = np.where(known, y, 0.0)
    usable = known.copy()
    usable[:order] = False
    for lag in np.flatnonzero(~known):
        usable[lag : lag + order + 1] = False
    chosen = np.zeros(n, bool)
    chosen[slice(None) if rows is None else rows] = True
    places = _spread(np.flatnonzero(usable & chosen))
    unknowns = order + inputs * (order + 1)
    if len(places) < 3 * unknowns:
        return None
    X = np.empty((unknowns, len(places)))
    for k in range(1, order + 1):
        X[k - 1] = x[places - k]
    for j in range(inputs):
        column = np.ascontiguousarray(u[:, j])
        for k in range(order + 1):
            X[order + j * (order + 1) + k] = column[places - k]
    size = np.sqrt(np.mean(X**2, axis=1))
    size[size == 0.0] = 1.0
    X /= size[:, None]
    theta = smallest(X, X, x[places]) / size
    a = np.concatenate([[1.0], -theta[:order]])
    b = theta[order:].reshape(inputs, order + 1)
    e = filtered(a, [1.0], x) - sum(filtered(b[j], [1.0], u[:, j]) for j in range(inputs))
    judged = usable & chosen

    def left_by(a, e):
        with np.errstate(over="ignore", invalid="ignore"):
            left = np.where(known, filtered([1.0], a, np.where(usable, e, 0.0)), 0.0)
            # What went before the rows is not theirs to explain.
            own = left if rows is None else filtered([1.0], a, np.where(judged, e, 0.0))
            return left, float(np.sqrt(np.mean(own[judged] ** 2) / np.mean(x[judged] ** 2)))

    left, share = left_by(a, e)
    stable = share < UNSTABLE
    if not stable:
        # What little the inputs leave may put poles outside of the unit circle: with those inside, the inputs anew.
        inside = _reflected(a)
        through = [filtered([1.0], inside, column) for column in u.T]
        X = np.stack([column[places - k] for column in through for k in range(order + 1)])
        size = np.sqrt(np.mean(X**2, axis=1)) + 1e-300
        X /= size[:, None]
        anew = (smallest(X, X, x[places]) / size).reshape(inputs, order + 1)
        by_inputs = filtered(inside, [1.0], x) - sum(filtered(anew[j], [1.0], u[:, j]) for j in range(inputs))
        left, share = left_by(inside, by_inputs)
        a, b, left, share = (inside, anew, left, share) if share < 1.0 else (a, b, x, np.inf)
    e[~usable] = 0.0
    return Answer(a, b[:own], b[own:], e, left, share, stable)


UNSTABLE = 3.0
"""Unexplained share from which an equation counts as unstable."""


def smallest(W: np.ndarray, X: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The solution of W Xᵀ θ = W t, symmetric, and the smallest where an input of few frequencies leaves some open."""
    values, vectors = np.linalg.eigh(W @ X.T)
    kept = values > 1e-12 * values[-1]
    V = vectors[:, kept]
    return V @ ((V.T @ (W @ t)) / values[kept])


def _reflected(a: np.ndarray) -> np.ndarray:
    """A polynomial with the roots outside of the unit circle reflected into it."""
    z = np.roots(a)
    outside = np.abs(z) >= 1.0
    z[outside] = np.minimum(1.0 / np.abs(z[outside]), INSIDE) * np.exp(1j * np.angle(z[outside]))
    return np.poly(z).real


INSIDE = 0.999
"""Largest modulus of a root that was reflected."""


def _spread(places: np.ndarray) -> np.ndarray:
    """At most so many of them, in blocks all over the record."""
    if len(places) <= MOST_ROWS:
        return places
    blocks = np.array_split(places, MOST_ROWS // BLOCK)
    return np.concatenate([block[:BLOCK] for block in blocks])
