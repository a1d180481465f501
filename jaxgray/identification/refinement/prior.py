"""What is assumed of masses under base excitation, which leaves ratios of modal masses open.

Outputs on a moving base depend on M⁻¹D and M⁻¹K alone. With proportional damping, M = Φ⁻ᵀ diag(m) Φ⁻¹ fits equally
well for every positive m (Φ the mode shapes), D and K with it; nearly proportional damping hardly determines the m.
"""

import numpy as np
from jaxtyping import Bool, Float

from ...numerics.matrices.linear_algebra import symmetric_vector
from ..setup.structure import Structure
from ..setup.units import Scaling
from .conic import pseudo_inverse, sizes_of
from .normal_equations import Prior, join

SPREAD = 0.5
"""Standard deviation assumed of an entry of the mass, relative to the mean mass: half as much, twice as much."""

LEFT = 0.5
"""Share of what is known of a combination of masses above which it is the prior that says it."""


def mass_prior(
    structure: Structure,
    scaling: Scaling,
    known: Float[np.ndarray, "dofs dofs"],
    fixed: Bool[np.ndarray, " entries"],
) -> Prior | None:
    """Equal masses, to within `SPREAD`.

    **Arguments:** `structure`; `scaling`; `known`: scaled mass, NaN where it is not known; `fixed`: entries of the
    joined block vectors that are held.

    **Returns:** a `Prior` of the entries of the mass, None where all of them are known.
    """
    dofs = len(known)
    one = np.ones((dofs, dofs))
    unit, damping, stiffness = (np.asarray(X) for X in scaling.matrices_in(one, one, one))
    diagonal = np.diag(known / unit)
    mean = float(np.mean(diagonal[np.isfinite(diagonal)])) if np.isfinite(diagonal).any() else 1.0
    zero = np.zeros_like(unit)

    def joined(M):
        return join([np.asarray(block) for block in structure.blocks(M, zero, zero, lift=0.0)])

    sizes, owners = structure.sizes(dofs), structure.owners(dofs)
    own = np.concatenate([np.full(n * (n + 1) // 2, owner == "mass") for n, owner in zip(sizes, owners)])
    if np.all(fixed[own]):
        return None
    centre = np.where(own, joined(np.diag(np.diag(unit)) * mean), 0.0)
    spread = symmetric_vector(unit) if sizes[0] == dofs else np.diag(unit)
    precision = np.zeros(len(own))
    precision[own] = 1 / (SPREAD * mean * spread) ** 2
    return Prior(centre, precision)


def inverse_with(
    information: Float[np.ndarray, "parameters parameters"], prior: Prior, free: Bool[np.ndarray, " parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Inverse of an information matrix in which a direction may be known from the prior alone.

    Such a direction has as little as 1e-12 of the curvature of the entries that it moves, which rounding would swallow:
    the prior is added in the eigenvectors of what the record says.

    **Arguments:** `information`, the prior's share included; `prior`; `free`: parameters that were not held.

    **Returns:** the inverse over the free parameters.
    """
    assumed = np.zeros(len(information))
    assumed[: len(prior.precision)] = prior.precision
    assumed = assumed[free]
    H = np.asarray(information)[np.ix_(free, free)] - np.diag(assumed)
    scale = sizes_of(np.diag(H) + assumed)
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale[None, :])
    seen = np.where(values > 1e-15 * values[-1], values, 0.0)
    both = np.diag(seen) + vectors.T @ ((assumed / scale**2)[:, None] * vectors)
    back = vectors / scale[:, None]
    return back @ pseudo_inverse(both) @ back.T


def left_open(information: Float[np.ndarray, "parameters parameters"], prior: Prior, fixed) -> int:
    """How many combinations of masses the record leaves to the prior.

    **Arguments:** `information`, the prior's share included; `prior`; `fixed`: entries that are held.
    """
    free = np.ones(len(information), bool)
    free[: len(fixed)] &= ~np.asarray(fixed, bool)
    assumed = np.concatenate([prior.precision, np.zeros(len(information) - len(prior.precision))])[free]
    mass = assumed > 0
    covariance = inverse_with(information, prior, free)[np.ix_(mass, mass)]
    weight = np.sqrt(assumed[mass])
    return int(np.sum(np.linalg.eigvalsh(covariance * weight[:, None] * weight[None, :]) > LEFT))
