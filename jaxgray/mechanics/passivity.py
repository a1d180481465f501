"""Whether M, D, K are those of a passive and reciprocal structure: one that gives no energy, and answers a force at one
place with the motion at another as the other way round.

With M > 0, D ≥ 0 in its symmetric part, and K ≥ 0 symmetric, the energy ½ q̇ᵀM q̇ + ½ qᵀK q never rises by itself. The
receptances H_ij and H_ji are equal where all three are symmetric (Maxwell and Betti).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ROUNDING = 1e-9
"""What rounding leaves of computed matrices, relative to the largest entry."""


@dataclass(frozen=True)
class Violation:
    """What a matrix should not have: `matrix` is mass, damping or stiffness; `kind` "negative" or "asymmetric"; `value`
    its least eigenvalue with the mass as unit, or the largest difference of two entries; `at`: the coordinate that
    moves most in that direction, or the two of the entry."""

    matrix: str
    kind: str
    value: float
    at: tuple[int, ...]


def violations(
    mass: Float[np.ndarray, "dofs dofs"],
    damping: Float[np.ndarray, "dofs dofs"],
    stiffness: Float[np.ndarray, "dofs dofs"],
    *,
    rounding: float = ROUNDING,
) -> tuple[Violation, ...]:
    """What M, D, K have that a passive, reciprocal structure cannot have; nothing for one.

    **Arguments:** `mass`, `damping`, `stiffness`; `rounding`: negative eigenvalue relative to the largest entry, and
    difference of two entries likewise, that do not count.
    """
    given = {"mass": mass, "damping": damping, "stiffness": stiffness}
    matrices = {name: np.asarray(X, dtype=float) for name, X in given.items()}
    # Coordinates may have different units: each in that of its own mass.
    scale = np.sqrt(np.abs(np.diag(matrices["mass"])))
    scale = np.where(scale > 0, scale, 1.0)
    found = []
    for name, X in matrices.items():
        X = X / np.outer(scale, scale)
        largest = np.max(np.abs(X))
        values, vectors = np.linalg.eigh((X + X.T) / 2)
        if values[0] < -rounding * largest or (name == "mass" and values[0] <= 0):
            found.append(Violation(name, "negative", float(values[0]), (int(np.argmax(np.abs(vectors[:, 0]))),)))
        difference = np.abs(X - X.T)
        if np.max(difference) > rounding * largest:
            i, j = sorted(map(int, np.unravel_index(np.argmax(difference), X.shape)))
            found.append(Violation(name, "asymmetric", float(given[name][i, j] - given[name][j, i]), (i, j)))
    return tuple(found)
