"""What inputs and outputs determine of the parameters of a structure: a rank test, and its outcome in words.

Locally, parameters are determined exactly if the derivatives of the transfer function by them are independent. The rank
is that of almost every system of the structure, so that it is tested at random ones near the one at hand.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .transfer import Family, contour

MORE_POINTS = 4
"""Random systems beyond the number of parameters at which the rank is tested: a combination must hold at all of them,
and each takes away at least one direction that holds by chance."""

INDEPENDENT = 1e-9
"""Singular value of the derivatives, relative to the largest, from which a direction counts."""

SIMPLE = 1e-6
"""Rounding allowed in the coefficients of a combination."""


@dataclass(frozen=True)
class Determinacy:
    """`rank` of `parameters`; `determined`: which parameters are, one by one; `combinations`: what is determined of the
    others, in words; `space`: orthonormal combinations of the parameters that were not known, determined everywhere."""

    rank: int
    parameters: int
    determined: Bool[np.ndarray, " parameters"]
    combinations: tuple[str, ...]
    space: Float[np.ndarray, "combinations parameters"]

    @property
    def complete(self) -> bool:
        """Whether every parameter is determined."""
        return bool(self.determined.all())


def determinacy(
    family: Family,
    theta: Float[np.ndarray, " parameters"],
    names: tuple[str, ...],
    *,
    units: Float[np.ndarray, " parameters"] | None = None,
    held: Bool[np.ndarray, " parameters"] | None = None,
    seed: int = 0,
) -> Determinacy:
    """What the transfer function determines of parameters that stand for themselves (masses, dampers, springs).

    **Arguments:** `family`; `theta`: parameters at hand, positive; `names`; `units`: what one unit of each parameter by
    its name is in `theta`, default 1; `held`: those that are known; `seed` of the random systems.

    **Returns:** a `Determinacy`.

    **Reference:** Bellman & Åström, Mathematical Biosciences 7 (1970) 329-339 (structural identifiability).
    """
    held = np.zeros(len(theta), bool) if held is None else held
    units = np.ones(len(theta)) if units is None else units
    free = np.flatnonzero(~held)
    rng = np.random.default_rng(seed)
    linear, logarithmic, ranks = [], [], []
    floor = np.array([1e-3 * np.max(theta[family.powers == k], initial=0.0) for k in (0, 1, 2)])
    base = np.maximum(theta, np.maximum(floor[family.powers], 1e-300))
    for _ in range(len(free) + MORE_POINTS):
        at = np.where(held, theta, base * np.exp(rng.normal(0.0, 0.4, len(theta))))
        basis = _row_space(family, at, free)
        ranks.append(len(basis))
        logarithmic.append(basis)
        # From derivatives by logarithms to those by the values, in the units of the names.
        linear.append(np.linalg.qr((basis / at[free] * units[free]).T)[0].T)
    rank = max(ranks)
    shared = _intersection([X for X, r in zip(linear, ranks) if r == rank])
    products = _intersection([X for X, r in zip(logarithmic, ranks) if r == rank])
    known = np.ones(len(theta), bool)
    for own, k in enumerate(free):
        unit = np.eye(len(free))[own]
        known[k] = all(np.linalg.norm(unit - X.T @ (X @ unit)) < 1e-4 for X in logarithmic)
    alone = [own for own, k in enumerate(free) if not known[k]]
    words = ()
    if alone:
        named = [names[free[own]] for own in alone]
        words = (*_sums(shared, alone, named), *_products(products, alone, named))
    return Determinacy(rank, len(free), known, words, shared)


def _row_space(family: Family, theta, free) -> Float[np.ndarray, "rank parameters"]:
    """Orthonormal directions of the logarithms of the free parameters that move the transfer function."""
    M, D, K = family.matrices(theta)
    values = np.abs(np.linalg.eigvals(np.linalg.solve(M, K)))
    rates = np.sqrt(values[values > 1e-9 * np.max(values)])
    if not len(rates):
        rates = np.abs(np.linalg.eigvals(np.linalg.solve(M, D)))
    s = np.concatenate([contour(rates, angle, 40) for angle in (0.4, 1.2)])
    H, dH = family.response(theta, s, slopes=True)
    size = np.sqrt(np.mean(np.abs(H) ** 2, axis=(1, 2), keepdims=True))
    J = (dH / size[..., None] * theta)[..., free].reshape(-1, len(free))
    J = np.concatenate([J.real, J.imag])
    norm = np.linalg.norm(J, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    _, values, Vt = np.linalg.svd(J / norm)
    rank = int(np.sum(values > INDEPENDENT * values[0]))
    return np.linalg.qr((Vt[:rank] * norm).T)[0].T


def _intersection(spaces: list[np.ndarray]) -> Float[np.ndarray, "directions parameters"]:
    """Directions that lie in all of some row spaces."""
    count = spaces[0].shape[1]
    outside = np.concatenate([np.eye(count) - X.T @ X for X in spaces])
    _, values, Vt = np.linalg.svd(outside)
    return Vt[values < 1e-4]


def _reduced(X: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Reduced row echelon form."""
    X, row = X.copy(), 0
    for column in range(X.shape[1]):
        if row == len(X):
            break
        pivot = row + int(np.argmax(np.abs(X[row:, column])))
        if abs(X[pivot, column]) < 1e-5:
            continue
        X[[row, pivot]] = X[[pivot, row]]
        X[row] /= X[row, column]
        X -= np.outer(np.where(np.arange(len(X)) == row, 0.0, X[:, column]), X[row])
        row += 1
    return X[:row]


def _own(space, alone) -> Float[np.ndarray, "rows columns"]:
    """What a space holds of some parameters alone."""
    others = [k for k in range(space.shape[1]) if k not in alone]
    if len(others) and len(space):
        _, values, Vt = np.linalg.svd(space[:, others].T)
        rank = int(np.sum(values > 1e-6))
        space = Vt[rank:] @ space
    return _reduced(space[:, alone])


def _sums(space, alone, names) -> list[str]:
    found = []
    for row in _own(space, alone):
        if np.sum(np.abs(row) > SIMPLE) < 2:
            continue
        terms = [(v, name) for v, name in zip(row, names) if abs(v) > SIMPLE]
        text = ""
        for v, name in terms:
            sign = (" - " if v < 0 else " + ") if text else ("-" if v < 0 else "")
            text += sign + ("" if abs(abs(v) - 1) < 1e-3 else f"{abs(v):.3g} ") + name
        found.append(text)
    return found


def _products(space, alone, names) -> list[str]:
    found = []
    for row in _own(space, alone):
        terms = [(int(np.round(v)), name) for v, name in zip(row, names) if abs(v) > 1e-3]
        if len(terms) < 2 or np.max(np.abs(row - np.round(row))) > 1e-3:
            continue
        over = " · ".join(name + ("" if v == 1 else f"^{v}") for v, name in terms if v > 0)
        under = " · ".join(name + ("" if v == -1 else f"^{-v}") for v, name in terms if v < 0)
        found.append(over if not under else f"{over} / ({under})" if " " in under else f"{over} / {under}")
    return found
