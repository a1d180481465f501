"""The canonical form as what is free in M, D and K: every entry that it does not set, and nothing else.

K11 = S + Σ a_j a_jᵀ/ω_j² with the static stiffness S ⪰ 0 of the measured coordinates, so that K ⪰ 0 is a cone of S
alone and a body free to move lies on a flat edge of it.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ....numerics.matrices.namespace import namespace
from ...setup.structure import AbstractAssembly, Full, Structure


class CanonicalMass(AbstractAssembly):
    """Any positive mass of the measured coordinates, `unit` for each hidden one."""

    hidden: int = eqx.field(static=True)
    unit: Float[Array, ""]

    def sizes(self, dofs):
        return (dofs - self.hidden,)

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        xp = namespace(*blocks)
        own = blocks[0]
        across = xp.zeros((own.shape[0], self.hidden))
        return _joined(own, across, xp.ones(self.hidden) * self.unit, xp)

    def blocks(self, matrix, mass, stiffness):
        p = matrix.shape[0] - self.hidden
        return [matrix[:p, :p]]


class CanonicalCoupling(AbstractAssembly):
    """Damping or stiffness in which hidden coordinates are coupled to the measured ones alone.

    `hidden`: how many; `shift` (outputs × hidden): couplings are numbers of either sign, held as their distance from
    −shift; `own_shift`: how far the block of the measured coordinates may lie below the edge, None for a matrix that is
    positive semidefinite as a whole.
    """

    hidden: int = eqx.field(static=True)
    shift: Float[Array, "outputs hidden"]
    own_shift: Float[Array, ""] | None = None

    @property
    def positive(self):
        return self.own_shift is None

    @property
    def sized(self):
        return False

    def sizes(self, dofs):
        p = dofs - self.hidden
        return (p,) + (1,) * (self.hidden + p * self.hidden)

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        xp = namespace(*blocks)
        first, n = blocks[0], self.hidden
        p = first.shape[0]
        own = xp.stack([block[0, 0] for block in blocks[1 : 1 + n]])
        across = xp.stack([block[0, 0] for block in blocks[1 + n :]]).reshape(p, n) - self.shift
        if self.own_shift is None:
            first = first + (across / own) @ across.T
        else:
            first = first - self.own_shift * np.eye(p)
        return _joined(first, across, own, xp)

    def blocks(self, matrix, mass, stiffness):
        xp = namespace(matrix)
        p = matrix.shape[0] - self.hidden
        own = xp.diag(matrix)[p:]
        across = matrix[:p, p:]
        if self.own_shift is None:
            first = matrix[:p, :p] - (across / own) @ across.T
        else:
            first = matrix[:p, :p] + self.own_shift * np.eye(p)
        numbers = [*own, *(across + self.shift).ravel()]
        return [first, *(xp.reshape(xp.asarray(value), (1, 1)) for value in numbers)]


def _joined(first, across, own, xp):
    return xp.concatenate([xp.concatenate([first, across], axis=1), xp.concatenate([across.T, xp.diag(own)], axis=1)])


REACH = 8.0
"""How far couplings and an indefinite damping may go, in units of the largest size at the start."""


def canonical_structure(
    M: Float[Array, "dofs dofs"],
    D: Float[Array, "dofs dofs"],
    K: Float[Array, "dofs dofs"],
    hidden: int,
    *,
    unit: Float[Array, ""] | None = None,
) -> Structure:
    """What is free in the canonical form, in units taken from a start.

    **Arguments:** `M`, `D`, `K`: the start, its hidden masses all alike; `hidden`: how many coordinates are; `unit`:
    the hidden masses, default those of the start.
    """
    p = len(M) - hidden
    xp = namespace(M, D, K)

    def shift(X):
        diagonal = xp.sqrt(xp.abs(xp.diag(X)))
        return REACH * xp.outer(diagonal[:p], diagonal[p:])

    # Damping enters as it is: what a body free to move loses in all is a sum of its entries, and well known.
    far = REACH * xp.max(xp.abs(xp.diag(D)))
    damping = Full() if hidden <= 1 else CanonicalCoupling(hidden, shift(D), far)
    return Structure(
        CanonicalMass(hidden, M[-1, -1] if unit is None else unit),
        damping,
        CanonicalCoupling(hidden, shift(K)),
    )
