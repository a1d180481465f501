"""The model of a given structure that is nearest to a free one, in the metric of what the record determines.

Entry by entry a chain takes the noise of a full matrix for springs to the ground. In the metric of the information
matrix what is well known is kept, and what is hardly known gives way.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ...numerics.matrices.bounded import bounded
from ...numerics.matrices.positive import ClarabelSolver
from ...numerics.outcomes import RESULTS, ComputationError
from ..setup.structure import Absent, AbstractAssembly, Full, Structure
from .conic import block_units, pseudo_inverse, step_inside
from .normal_equations import join, part
from .refine import Refinement, StructurePrice

STEPS = 20
"""Most Gauss-Newton steps; one is enough where the structure is linear and the cone is not in the way."""

SETTLED = 1e-3
"""Fall of the squared distance, in units of the noise variance, that is not worth another step."""

RIDGE = 1e-10
"""Share of the curvature that keeps what the record leaves open where it is."""


def is_relaxed(structure: Structure) -> bool:
    """Whether nothing is asked of the matrices but to be physical."""
    return all(isinstance(a, Full | Absent) for a in (structure.mass, structure.damping, structure.stiffness))


def relaxed(structure: Structure) -> Structure:
    """The same without what was asked of the matrices; a matrix that is absent stays so."""

    def free(assembly: AbstractAssembly) -> AbstractAssembly:
        return assembly if isinstance(assembly, Absent) else Full()

    return Structure(free(structure.mass), free(structure.damping), free(structure.stiffness))


def nearest_structured(
    free: Refinement, structure: Structure, fixed: Bool[np.ndarray, " entries"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, D, K of a structure, nearest to a refined model without it.

    (z(θ) − ẑ)ᵀ H (z(θ) − ẑ) over blocks θ ⪰ 0: z the entries of M, D, K, H their information with first states and
    offsets eliminated.

    **Arguments:** `free`: a refinement with the `relaxed` structure; `structure`; `fixed`: entries of the structure's
    joined block vectors that keep their value.

    **Returns:** scaled M, D, K of that structure.
    """
    matrices = [np.asarray(X) for X in (free.mass, free.damping, free.stiffness)]
    dofs, sizes = len(matrices[0]), structure.sizes(len(matrices[0]))
    target = join([np.asarray(block) for block in free.blocks])
    entries, H = len(target), np.asarray(free.normal.information)
    inner = pseudo_inverse(H[entries:, entries:])
    H = H[:entries, :entries] - H[:entries, entries:] @ inner @ H[entries:, :entries]
    H = (H + H.T) / 2 + RIDGE * np.diag(np.diag(H))
    present = [not isinstance(a, Absent) for a in (structure.mass, structure.damping, structure.stiffness)]

    def assembled(theta):
        found = structure.matrices(part(theta, sizes), dofs)
        return join([np.asarray(X) for X, there in zip(found, present) if there])

    def slopes(theta, unit):
        # The entries are polynomials of at most second degree: central differences are exact.
        return np.stack(
            [(assembled(theta + h) - assembled(theta - h)) / (2 * u) for u, h in zip(unit, np.diag(unit))], axis=1
        )

    theta = join([np.asarray(block) for block in structure.blocks(*matrices, lift=0.0)])
    floors = np.array(structure.floors(dofs))
    solver, damping = ClarabelSolver(), 0.0
    off = assembled(theta) - target
    cost = off @ H @ off
    for _ in range(STEPS):
        J = slopes(theta, np.where(theta != 0, np.abs(theta), 1.0))
        quadratic = J.T @ H @ J
        unit = block_units(part(theta, sizes), np.diag(quadratic))
        scaled = quadratic * unit[:, None] * unit[None, :]
        scaled = scaled + (damping + RIDGE) * np.diag(np.diag(scaled))
        slope = (J.T @ (H @ off)) * unit
        step = step_inside(solver, scaled, slope, theta / unit, floors, sizes, fixed)
        if step is None or not np.all(np.isfinite(step)):
            damping = max(10 * damping, 1e-6)
            continue
        trial = theta + step * unit
        off_there = assembled(trial) - target
        reached = off_there @ H @ off_there if bounded(off_there) else np.inf
        if not reached < cost:
            if damping > 1e3:
                break
            damping = max(10 * damping, 1e-6)
            continue
        gained, theta, off, cost = cost - reached, trial, off_there, reached
        damping = damping / 10 if damping > 1e-9 else 0.0
        if gained < SETTLED:
            break
    return tuple(np.asarray(X) for X in structure.matrices(part(theta, sizes), dofs))


def refine_structured(
    matrices: tuple[np.ndarray, np.ndarray, np.ndarray],
    structure: Structure,
    fixed: Bool[np.ndarray, " entries"],
    fixed_free: Bool[np.ndarray, " entries"],
    refined: Callable[..., Refinement],
) -> Refinement:
    """Refine a model of a given structure, begun at the free optimum's nearest model of that structure.

    **Arguments:** `matrices`: scaled M, D, K to start from; `structure`; `fixed`: entries of its joined block vectors
    that keep their value; `fixed_free`: the same for the `relaxed` structure; `refined`: called with matrices, a
    structure and its fixed entries, refines; `near` as of `refine`.

    **Returns:** a `Refinement` whose `price` says what the structure costs, None where no free optimum was found.
    """
    try:
        free = refined(matrices, relaxed(structure), fixed_free)
        ends = [refined(nearest_structured(free, structure, fixed), structure, fixed, near=True)]
    except ComputationError:
        return refined(matrices, structure, fixed)
    if ends[0].result != RESULTS.successful:
        try:
            ends.append(refined(matrices, structure, fixed))
        except ComputationError:
            pass
    best = min(ends, key=lambda end: end.cost)
    saved = int((~fixed_free).sum() - (~fixed).sum())
    return eqx.tree_at(
        lambda r: r.price, best, StructurePrice(saved, best.cost - free.cost), is_leaf=lambda x: x is None
    )
