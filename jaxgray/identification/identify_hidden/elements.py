"""Masses, dampers and springs of a structure, from M, D, K."""

import numpy as np
from jaxtyping import Bool, Float

from ...mechanics.model import MechanicalModel
from ...numerics.matrices.linear_algebra import triangle
from ..hidden import Connections, Determinacy, Element
from ..result import Identification

ZERO = 1e-9
"""Share of the largest element of its kind below which one counts as zero."""


def at_zero(model: MechanicalModel, structure: str | None) -> list[str]:
    """Dampers and springs of a structure that ended at zero; none without a structure."""
    if structure is None:
        return []
    connections = Connections(structure, model.coordinates)
    rows, columns = triangle(model.dofs)
    entries = np.concatenate([np.asarray(X)[rows, columns] for X in (model.mass, model.damping, model.stiffness)])
    values = np.linalg.pinv(entries_by_elements(connections)) @ entries
    found = []
    for owner in ("damping", "stiffness"):
        own = [k for k, name in enumerate(connections.elements) if name.startswith(owner)]
        found += [connections.elements[k] for k in own if values[k] <= ZERO * np.max(values[own])]
    return found


def entries_by_elements(connections: Connections) -> Float[np.ndarray, "entries parameters"]:
    """Derivative of the stacked triangles of M, D, K by masses, dampers and springs."""
    dofs = len(connections.names)
    structure = connections.structure
    rows, columns = triangle(dofs)
    result = []
    for unit in np.eye(len(connections.elements)):
        three = structure.matrices([np.array([[v]]) for v in unit], dofs)
        result.append(np.concatenate([np.asarray(X)[rows, columns] for X in three]))
    return np.stack(result, axis=1)


def undetermined_entries(
    connections: Connections, outcome: Determinacy, held
) -> dict[str, Bool[np.ndarray, "dofs dofs"]]:
    """Entries of M, D, K that depend on what is open, but for combinations that are determined."""
    L = entries_by_elements(connections)[:, ~held]
    space = outcome.space
    left = L - (L @ space.T) @ space
    size = np.linalg.norm(L, axis=1)
    opened = np.linalg.norm(left, axis=1) > 1e-4 * np.where(size > 0, size, 1.0)
    dofs = len(connections.names)
    rows, columns = triangle(dofs)
    found = {}
    for name, values in zip(("mass", "damping", "stiffness"), np.split(opened, 3)):
        found[name] = np.zeros((dofs, dofs), bool)
        found[name][rows, columns] = found[name][columns, rows] = values
    return found


def elements_of(result: Identification, connections: Connections, outcome: Determinacy, held) -> tuple[Element, ...]:
    """Values and errors of masses, dampers and springs, from those of the matrices."""
    L = entries_by_elements(connections)
    back = np.linalg.pinv(L)
    rows, columns = triangle(len(connections.names))
    entries = np.concatenate([X[rows, columns] for X in (result.mass, result.damping, result.stiffness)])
    values = back @ entries
    errors = None
    if result.uncertainty is not None:
        errors = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", back, result.covariance, back), 0.0))
    found = []
    for k, name in enumerate(connections.elements):
        determined = bool(outcome.determined[k])
        error = None if errors is None or not determined else float(errors[k])
        found.append(Element(name, float(values[k]) if determined else None, error, bool(held[k])))
    return tuple(found)
