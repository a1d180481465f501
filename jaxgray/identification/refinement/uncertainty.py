"""How well the record determines the model: covariance, weak directions, entries at the edge."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.linear_algebra import from_triangle, triangle, triangle_vector
from ...numerics.programs.stored_programs import ONCE, stored
from ..setup.structure import Structure
from ..setup.units import Scaling
from .conic import pseudo_inverse
from .normal_equations import join, part
from .prior import inverse_with
from .refine import Refinement

EDGE = 1e-6
"""Eigenvalue, relative to the largest of its matrix, below which a matrix counts as singular."""

WEAK = 0.5
"""Standard error, relative to the natural size of a parameter, above which a direction is hardly determined."""

UNMOVED = 1e-3
"""Change of all outputs together, in noise standard deviations, that a parameter makes by its whole size below
which it is said not to move them."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of M, D, K in the record's units, and what limits it.

    `covariance`: of the stacked upper triangles (by columns) of mass, damping, stiffness; `names`: of these
    entries; `condition_number` of the information scaled to unit diagonal; `weak_directions`: combinations of
    parameters that the record hardly determines, in words; `unmoved`: parameters that do not move any output;
    `at_edge`: matrices that are singular, with the direction, in words; `sandwich`: whether the residual's colour
    is taken into account.
    """

    covariance: Float[np.ndarray, "entries entries"]
    names: tuple[str, ...]
    condition_number: float
    weak_directions: tuple[str, ...]
    unmoved: tuple[str, ...]
    at_edge: tuple[str, ...]
    sandwich: bool = False

    def standard_errors(self) -> dict[str, Float[np.ndarray, "dofs dofs"]]:
        """Standard error of every entry of mass, damping, stiffness."""
        parts = np.split(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), 3)
        return {name: from_triangle(values) for name, values in zip(("mass", "damping", "stiffness"), parts)}


def entry_names(dofs: int) -> tuple[str, ...]:
    """mass[0,0], … in the order of the covariance."""
    rows, columns = triangle(dofs)
    return tuple(f"{matrix}[{r},{c}]" for matrix in ("mass", "damping", "stiffness") for r, c in zip(rows, columns))


@stored(level=ONCE)
def _entries_by_blocks(blocks: list[Array], scaling: Scaling, structure: Structure) -> Array:
    """Derivative of the stacked triangles, in the record's units, by the joined block vectors."""
    sizes = tuple(block.shape[0] for block in blocks)
    dofs = scaling.coordinates.shape[0]

    def entries(z):
        matrices = scaling.matrices_out(*structure.matrices(part(z, sizes), dofs))
        return jnp.concatenate([triangle_vector(X) for X in matrices])

    return jax.jacfwd(entries)(join(blocks))


def uncertainty(
    refinement: Refinement, scaling: Scaling, structure: Structure, *, fixed=None, meat: Array | None = None
) -> Uncertainty:
    """Covariance of M, D, K from the Gauss-Newton information, nuisance parameters estimated too.

    **Arguments:** `refinement`; `scaling`; `structure`; `fixed`: block entries that were held; `meat`: sum of
    the outer products of the score, allowing for coloured residuals, for the sandwich J⁻¹ S J⁻¹; default none.

    **Returns:** an `Uncertainty`.

    **Reference:** Ljung, *System Identification*, §9.4 (asymptotic covariance); Huber (1967) for the sandwich.
    """
    H = np.asarray(refinement.normal.information)
    transform = np.asarray(_entries_by_blocks(refinement.blocks, scaling, structure))
    entries = transform.shape[1]
    free = np.ones(len(H), bool)
    if fixed is not None:
        free[:entries] &= ~np.asarray(fixed, bool)
    inverse = None if refinement.prior is None else inverse_with(H, refinement.prior, free)
    H = H[np.ix_(free, free)]
    diagonal = np.diag(H)
    inverse = pseudo_inverse(H) if inverse is None else inverse
    covariance = inverse * float(refinement.variance)
    if meat is not None:
        covariance = inverse @ np.asarray(meat)[np.ix_(free, free)] @ inverse
    full = np.zeros((len(free), len(free)))
    full[np.ix_(free, free)] = covariance
    dofs = scaling.coordinates.shape[0]
    names = entry_names(dofs)
    result = transform @ full[:entries, :entries] @ transform.T

    # The physical part, nuisance eliminated, in units of each parameter's natural size and of the noise.
    count = int(free[:entries].sum())
    inner = pseudo_inverse(H[count:, count:])
    reduced = H[:count, :count] - H[:count, count:] @ inner @ H[count:, :count]
    sizes = _natural_sizes(refinement.blocks)[free[:entries]]
    scaled = reduced * sizes[:, None] * sizes[None, :] / max(float(refinement.variance), 1e-300)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2) if count else (np.ones(1), np.eye(1))
    block_names = _block_entry_names(structure, dofs)
    kept_names = [name for name, keep in zip(block_names, free[:entries]) if keep]
    strength = diagonal[:count] * sizes**2 / max(float(refinement.variance), 1e-300)
    sized = np.array([getattr(structure, name.split("[")[0].split(" ")[0]).sized for name in kept_names], bool)
    # One that is not there has no size by which to judge it.
    telling = sized | (sizes > 0) | (diagonal[:count] == 0)
    unmoved = tuple(name for name, moved, told in zip(kept_names, strength, telling) if told and not moved > UNMOVED**2)
    weak = tuple(
        _combination(vectors[:, k], kept_names)
        for k in range(count)
        if values[k] < 1 / WEAK**2 and np.max(strength[np.abs(vectors[:, k]) > 0.3], initial=0.0) > UNMOVED**2
    )
    return Uncertainty(
        (result + result.T) / 2,
        names,
        _condition(values) if count else 1.0,
        weak,
        unmoved,
        _edges(refinement, scaling, structure),
        meat is not None,
    )


def _condition(values: np.ndarray) -> float:
    """Largest over smallest eigenvalue, infinite where the smallest is not positive."""
    return float(values[-1] / values[0]) if values[0] > 1e-300 * max(values[-1], 1.0) else float("inf")


def _natural_sizes(blocks: list[Array]) -> np.ndarray:
    """√(X_rr X_cc) of every entry: what an entry could be, also where it is zero."""
    sizes = []
    for block in blocks:
        rows, columns = triangle(block.shape[0])
        diagonal = np.abs(np.diag(np.asarray(block)))
        sizes.append(np.sqrt(diagonal[rows] * diagonal[columns]))
    return np.concatenate(sizes)


def _block_entry_names(structure: Structure, dofs: int) -> list[str]:
    names = []
    for k, (owner, n) in enumerate(zip(structure.owners(dofs), structure.sizes(dofs))):
        rows, columns = triangle(n)
        names += [f"{owner}[{r},{c}]" if n == dofs else f"{owner} term {k}" for r, c in zip(rows, columns)]
    return names


def _combination(vector: np.ndarray, names: list[str]) -> str:
    order = np.argsort(-np.abs(vector))
    shown = [k for k in order[:4] if abs(vector[k]) > 0.2 * abs(vector[order[0]])]
    return " ".join(f"{'+' if vector[k] > 0 else '-'}{abs(vector[k]):.2f} {names[k]}" for k in shown)


def _edges(refinement: Refinement, scaling: Scaling, structure: Structure) -> tuple[str, ...]:
    found = []
    for name in ("mass", "damping", "stiffness"):
        if not getattr(structure, name).positive:
            continue
        matrix = np.asarray(getattr(refinement, name))
        values, vectors = np.linalg.eigh(matrix)
        for value, vector in zip(values, vectors.T):
            if value <= EDGE * max(values[-1], 1e-300):
                direction = vector * np.asarray(scaling.coordinates)
                direction = direction / direction[np.argmax(np.abs(direction))]
                found.append(f"{name} is singular in the direction [{', '.join(f'{v:.3g}' for v in direction)}]")
    return tuple(found)
