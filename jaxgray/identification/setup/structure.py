"""What is free in M, D and K: every matrix is assembled from positive semidefinite blocks.

A full matrix is one block, a diagonal mass one 1 × 1 block per coordinate, a chain one block per spring,
proportional damping two numbers. Positive blocks make positive matrices, so that one refinement serves all.
"""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.linear_algebra import project_positive
from ...numerics.matrices.namespace import namespace

SLOWEST = 1e-3
"""Rate [rad/sample] that stands for a matrix that is zero: a start needs a size to move from."""

MASS_FLOOR = 1e-9
"""Smallest eigenvalue of a mass block, relative to its mean one: the model needs an inverse."""

LIFT = 1e-3
"""Smallest eigenvalue of a start, relative to its largest: Cholesky factors do not move off the edge."""


class AbstractAssembly(eqx.Module):
    """How one of M, D, K is built from blocks."""

    @property
    def positive(self) -> bool:
        """Whether a singular matrix lies on the edge of what is allowed to it."""
        return True

    @property
    def sized(self) -> bool:
        """Whether blocks have a size of their own, so that one which is zero is a parameter without effect."""
        return True

    @abc.abstractmethod
    def sizes(self, dofs: int) -> tuple[int, ...]:
        """Rows of each block."""

    @abc.abstractmethod
    def matrix(self, blocks: list[Array], mass: Array | None, stiffness: Array | None) -> Array:
        """The matrix that the blocks make; damping may also need the other two."""

    @abc.abstractmethod
    def blocks(self, matrix: Array, mass: Array | None, stiffness: Array | None) -> list[Array]:
        """Blocks nearest to a given matrix, not yet lifted off the edge."""

    @abc.abstractmethod
    def scaled(self, coordinates: Float[Array, " dofs"]) -> "AbstractAssembly":
        """The same where coordinate k is counted in these units and the equation of motion multiplied by them."""


class Full(AbstractAssembly):
    """Any symmetric positive semidefinite matrix."""

    def sizes(self, dofs):
        return (dofs,)

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        return blocks[0]

    def blocks(self, matrix, mass, stiffness):
        return [matrix]


class Diagonal(AbstractAssembly):
    """A diagonal matrix with entries ≥ 0."""

    def sizes(self, dofs):
        return (1,) * dofs

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        xp = namespace(*blocks)
        return xp.diag(xp.concatenate([block[0] for block in blocks]))

    def blocks(self, matrix, mass, stiffness):
        return [matrix[k, k].reshape(1, 1) for k in range(matrix.shape[0])]


class Chain(AbstractAssembly):
    """Springs from every coordinate to ground and between neighbours, each ≥ 0.

    `coordinates`: units in which the coordinates are counted, None where all are the same: in other units a spring
    between two neighbours pulls at them unequally.
    """

    coordinates: Float[Array, " dofs"] | None = None

    def sizes(self, dofs):
        return (1,) * (2 * dofs - 1)

    def matrix(self, blocks, mass, stiffness):
        dofs = (len(blocks) + 1) // 2
        xp = namespace(*blocks, self.coordinates)
        springs = xp.stack([block[0, 0] for block in blocks])
        arms = np.concatenate([np.eye(dofs), np.eye(dofs)[:-1] - np.eye(dofs)[1:]]) * self._units(dofs)
        return xp.einsum("s,si,sj->ij", springs, arms, arms)

    def _units(self, dofs):
        """The coordinates' units about one, so that springs keep the size of the matrix's entries."""
        xp = namespace(self.coordinates)
        return np.ones(dofs) if self.coordinates is None else self.coordinates / xp.max(self.coordinates)

    def scaled(self, coordinates):
        return Chain(coordinates if self.coordinates is None else self.coordinates * coordinates)

    def blocks(self, matrix, mass, stiffness):
        dofs = matrix.shape[0]
        units = self._units(dofs)
        matrix = matrix / units[:, None] / units[None, :]
        between = [-(matrix[k, k + 1] + matrix[k + 1, k]) / 2 for k in range(dofs - 1)]
        ground = [((matrix[k] + matrix[:, k]) / 2).sum() for k in range(dofs)]
        return [value.reshape(1, 1) for value in ground + between]


class Proportional(AbstractAssembly):
    """D = αM + βK with α, β ≥ 0 (modal damping)."""

    def sizes(self, dofs):
        return (1, 1)

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        return blocks[0][0, 0] * mass + blocks[1][0, 0] * stiffness

    def blocks(self, matrix, mass, stiffness):
        xp = namespace(matrix, mass, stiffness)
        table = xp.stack([mass.ravel(), stiffness.ravel()], axis=1)
        scale = xp.linalg.norm(table, axis=0)
        found = xp.linalg.lstsq(table / scale, matrix.ravel(), rcond=None)[0] / scale
        return [xp.reshape(found[0], (1, 1)), xp.reshape(found[1], (1, 1))]


class Absent(AbstractAssembly):
    """A matrix that is zero, such as the stiffness of a rigid body."""

    def sizes(self, dofs):
        return ()

    def scaled(self, coordinates):
        return self

    def matrix(self, blocks, mass, stiffness):
        return namespace(mass).zeros_like(mass)

    def blocks(self, matrix, mass, stiffness):
        return []


class Structure(eqx.Module):
    """Assemblies of M, D and K."""

    mass: AbstractAssembly = Full()
    damping: AbstractAssembly = Full()
    stiffness: AbstractAssembly = Full()

    def sizes(self, dofs: int) -> tuple[int, ...]:
        """Rows of all blocks, of mass first, then damping, then stiffness."""
        return self.mass.sizes(dofs) + self.damping.sizes(dofs) + self.stiffness.sizes(dofs)

    def scaled(self, coordinates: Float[Array, " dofs"]) -> "Structure":
        """The same where coordinate k is counted in these units and the equation of motion multiplied by them."""
        return Structure(*(each.scaled(coordinates) for each in (self.mass, self.damping, self.stiffness)))

    def owners(self, dofs: int) -> tuple[str, ...]:
        """The matrix to which each block belongs."""
        return tuple(name for name in ("mass", "damping", "stiffness") for _ in getattr(self, name).sizes(dofs))

    def floors(self, dofs: int) -> tuple[float, ...]:
        """Least eigenvalue of each block, in units of its size."""
        return tuple(MASS_FLOOR if owner == "mass" else 0.0 for owner in self.owners(dofs))

    def logarithmic(self, dofs: int) -> tuple[bool, ...]:
        """Whether each block's factor has a logarithmic diagonal: the mass, which must not become singular."""
        return tuple(owner == "mass" for owner in self.owners(dofs))

    def matrices(self, blocks: list[Array], dofs: int) -> tuple[Array, Array, Array]:
        """M, D, K from the blocks."""
        first = len(self.mass.sizes(dofs))
        second = first + len(self.damping.sizes(dofs))
        M = self.mass.matrix(blocks[:first], None, None)
        K = self.stiffness.matrix(blocks[second:], M, None)
        return M, self.damping.matrix(blocks[first:second], M, K), K

    def blocks(self, M: Array, D: Array, K: Array, *, lift: float = LIFT) -> list[Array]:
        """Blocks nearest to M, D, K, lifted off the edge of the cone.

        **Arguments:** `M`, `D`, `K`, time in samples; `lift`: smallest eigenvalue, relative to the largest of the
        matrix, or to that of a slow motion where the matrix is zero.
        """
        xp = namespace(M, D, K)
        inertia = xp.linalg.norm(M, ord=2)
        result = []
        for assembly, matrix, slowest in (
            (self.mass, M, 1.0),
            (self.damping, D, SLOWEST),
            (self.stiffness, K, SLOWEST**2),
        ):
            natural = xp.maximum(xp.linalg.norm(matrix, ord=2), slowest * inertia)
            if isinstance(assembly, Proportional):
                natural = natural / xp.maximum(inertia, xp.linalg.norm(K, ord=2))
            for block in assembly.blocks(matrix, M, K):
                size = natural if block.shape[0] == 1 else xp.maximum(xp.linalg.norm(block, ord=2), natural)
                result.append(lifted(block, lift * size))
        return result


def lifted(X: Float[Array, "n n"], floor: Float[Array, ""]) -> Float[Array, "n n"]:
    """Nearest matrix with eigenvalues ≥ floor."""
    xp = namespace(X)
    eye = xp.eye(X.shape[0])
    return project_positive((X + X.T) / 2 - floor * eye) + floor * eye


_BY_NAME = {
    "diagonal-mass": ("mass", Diagonal()),
    "chain": ("stiffness", Chain()),
    "modal-damping": ("damping", Proportional()),
}


def structure_of(names: str | tuple[str, ...] | None) -> Structure:
    """The structure that these names describe, any of diagonal-mass, chain, modal-damping.

    **Raises:** `ValueError` for a name that is none of them.
    """
    names = () if names is None else (names,) if isinstance(names, str) else tuple(names)
    chosen = {}
    for name in names:
        if name not in _BY_NAME:
            raise ValueError(f"structure={name!r} is not known; choose from {', '.join(_BY_NAME)}.")
        owner, assembly = _BY_NAME[name]
        chosen[owner] = assembly
    return Structure(**chosen)


NAMES = tuple(_BY_NAME)
"""Structures by the name that the command uses."""
