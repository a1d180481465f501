"""The canonical form of a system with coordinates that no sensor sees.

q = T q' with T = [I 0; T21 T22] leaves inputs and outputs as they are, so that M, D, K of more coordinates than outputs
are never determined, only a representative of them: every hidden coordinate a unit mass of its own,

    M = diag(M11, I),   D22 = diag(2 ζ_j ω_j),   K22 = diag(ω_j²),   D12 = (b_j),   K12 = (a_j),

ω_j ascending and the largest entry of every a_j positive. ω_j, ζ_j are the modes of the hidden part while the measured
coordinates are held still. 3p(p+1)/2 + n(2p+2) numbers for p measured and n hidden coordinates.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from ....numerics.matrices.linear_algebra import from_triangle, triangle_vector
from ....numerics.matrices.namespace import namespace


def canonical_count(outputs: int, hidden: int) -> int:
    """How many numbers the inputs and outputs of such a system determine: 3p(p+1)/2 + n(2p+2)."""
    return 3 * outputs * (outputs + 1) // 2 + hidden * (2 * outputs + 2)


class Canonical(eqx.Module):
    """M11, D11, K11 of the measured coordinates, and what every hidden one adds.

    `mass`, `damping`, `stiffness` (outputs × outputs); `squared` (ω_j²) and `rate` (2 ζ_j ω_j) of every hidden mode;
    `spring` (a_j) and `damper` (b_j), one column a hidden coordinate. Time in the unit of the matrices.
    """

    mass: Float[Array, "outputs outputs"]
    damping: Float[Array, "outputs outputs"]
    stiffness: Float[Array, "outputs outputs"]
    squared: Float[Array, " hidden"]
    rate: Float[Array, " hidden"]
    spring: Float[Array, "outputs hidden"]
    damper: Float[Array, "outputs hidden"]

    @property
    def outputs(self) -> int:
        """Number of measured coordinates."""
        return self.mass.shape[0]

    @property
    def hidden(self) -> int:
        """Number of hidden coordinates."""
        return self.squared.shape[0]

    @property
    def matrices(self) -> tuple[Array, Array, Array]:
        """M, D, K of all coordinates, the measured ones first."""
        xp = namespace(self.mass, self.damping, self.stiffness, self.squared, self.rate, self.spring, self.damper)
        none = xp.zeros_like(self.spring)

        def block(first, across, second):
            return xp.concatenate(
                [xp.concatenate([first, across], axis=1), xp.concatenate([across.T, xp.diag(second)], axis=1)]
            )

        return (
            block(self.mass, none, xp.ones_like(self.squared)),
            block(self.damping, self.damper, self.rate),
            block(self.stiffness, self.spring, self.squared),
        )

    @property
    def vector(self) -> Float[Array, " parameters"]:
        """All numbers in one row: triangles of M11, D11, K11 by columns, then ω², 2ζω, a, b hidden by hidden."""
        xp = namespace(self.mass, self.squared)
        own = xp.concatenate([self.squared[None], self.rate[None], self.spring, self.damper])
        triangles = [triangle_vector(X) for X in (self.mass, self.damping, self.stiffness)]
        return xp.concatenate([*triangles, own.T.ravel()])

    @classmethod
    def from_vector(cls, vector: Float[Array, " parameters"], outputs: int, hidden: int) -> "Canonical":
        """Inverse of `vector`."""
        count = outputs * (outputs + 1) // 2
        M, D, K = (from_triangle(vector[k * count : (k + 1) * count]) for k in range(3))
        own = vector[3 * count :].reshape(hidden, 2 * outputs + 2).T
        return cls(M, D, K, own[0], own[1], own[2 : 2 + outputs], own[2 + outputs :])

    def ordered(self) -> "Canonical":
        """Hidden coordinates by ω, the largest entry of every a_j positive (of b_j, where a_j is zero)."""
        spring, damper = np.asarray(self.spring), np.asarray(self.damper)
        order = np.argsort(np.asarray(self.squared))
        telling = np.where(np.any(spring != 0, axis=0), spring, damper)
        largest = np.take_along_axis(telling, np.argmax(np.abs(telling), axis=0)[None], axis=0)[0]
        sign = np.where(largest < 0, -1.0, 1.0)
        return Canonical(
            self.mass,
            self.damping,
            self.stiffness,
            np.asarray(self.squared)[order],
            np.asarray(self.rate)[order],
            (spring * sign)[:, order],
            (damper * sign)[:, order],
        )


def canonical_gauge(outputs: int, hidden: int) -> Bool[np.ndarray, "matrices dofs dofs"]:
    """Entries of M, D, K that the canonical form sets, to zero or one: they are a choice and not a finding."""
    dofs = outputs + hidden
    index = np.arange(dofs)
    own = (index[:, None] >= outputs) | (index[None, :] >= outputs)
    between = (index[:, None] >= outputs) & (index[None, :] >= outputs) & (index[:, None] != index[None, :])
    return np.stack([own, between, between])
