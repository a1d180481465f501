"""Physical matrices under base excitation, mode by mode.

A realisation gives M⁻¹D and M⁻¹K as they come, modes that the record hardly shows among them: a semidefinite fit that
weighs all entries alike bends the modes that matter to the noise of those that do not. Free residues at free poles,
begun at the realisation's, find the modes that the record shows; what it does not show is filled in.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ...mechanics.systems.statespace import sampled
from ...numerics.matrices.linear_algebra import from_symmetric_vector
from ...numerics.outcomes import RESULTS, ComputationError
from ..refinement.normal_equations import Prior
from ..setup.prediction import Setting
from ..setup.preparation import Signals
from ..subspace.realization import Realization
from ..validation.free_modes import RivalFit, Whitened, fit_rival, further_modes, no_modes, poles_of

STEPS = 30
"""Most Gauss-Newton steps of the poles."""

TRIES = 3
"""Places from which one more mode is begun."""

OSCILLATING = 0.3
"""Largest damping ratio of a pole of the realisation that is taken for a mode."""

OWN = 0.1
"""Least part of a shape outside the shapes of stronger modes, relative to it, for it to count as one."""


class MassKnowledge(eqx.Module):
    """What is known and assumed of free M, D, K under base excitation.

    `prior` of their entries, None where all masses are given; `mass`: scaled, NaN where nothing is given.
    """

    prior: Prior | None
    mass: Float[np.ndarray, "dofs dofs"]

    @property
    def assumed(self) -> Float[np.ndarray, "dofs dofs"]:
        """The mass, or what is assumed of it."""
        if self.prior is None:
            return self.mass
        n = len(self.mass)
        return from_symmetric_vector(self.prior.centre[: n * (n + 1) // 2])


def modes_under_base(
    realization: Realization,
    deviation: Float[np.ndarray, " outputs"],
    signals: list[Signals],
    setting: Setting,
    given: MassKnowledge,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M ≻ 0, D ≻ 0, K ≻ 0 with the modes of the longest record.

    With shapes Φ, M = Φ⁻ᵀ diag(m) Φ⁻¹, K = Φ⁻ᵀ diag(m c0) Φ⁻¹ and D = Φ⁻ᵀ diag(m c1) Φ⁻¹ fit equally well for all
    m > 0: those that bring M nearest to what is assumed of it, m_j = φ_jᵀ M₀ φ_j.

    **Arguments:** `realization`, whose poles are the first ones; `deviation`: mean square of what it leaves, per
    output; `signals`: scaled records; `setting`; `given`: what is known of the mass.

    **Returns:** scaled M, D, K.

    **Raises:** `ComputationError` where the modes are not finite.
    """
    dofs = len(setting.measured)
    longest = max(signals, key=lambda s: s.samples)
    n = longest.samples
    y = np.where(np.asarray(longest.kept)[:n] > 0, np.asarray(longest.y)[:n], np.nan)
    size = np.sqrt(np.maximum(deviation, np.finfo(float).tiny))
    data = Whitened.of(y, np.asarray(longest.u)[:n], [np.ones(1)] * dofs, size, direct=True)
    poles = poles_of(np.asarray(realization.A))
    c0, c1 = np.exp(poles).T
    poles = poles[c1 < 2 * OSCILLATING * np.sqrt(c0)][:dofs]
    fit = fit_rival(poles, data, steps=STEPS) if len(poles) else no_modes(data)
    while len(fit.poles) < dofs:
        starts = [np.concatenate([fit.poles, new[None]]) for new in further_modes(fit, data, keep=TRIES)]
        fit = min((fit_rival(each, data, steps=STEPS) for each in starts), key=lambda found: found.cost)
    M0 = given.assumed
    # The fit counts every output in units of what the realisation leaves.
    own = [_shape(size[:, None] * _share(fit, data, j, setting)) for j in range(dofs)]
    shapes = _independent(own, np.sum(fit.motions**2, axis=(0, 2)), M0)
    c0, c1 = np.exp(fit.poles).T
    masses = np.einsum("ij,ik,kj->j", shapes, M0, shapes)
    inverse = np.linalg.inv(shapes)
    matrices = [(inverse.T * (masses * x)) @ inverse for x in (1.0, c1, c0)]
    if not all(np.all(np.isfinite(X)) for X in matrices):
        raise ComputationError(RESULTS.unstable_start, stage="modes under base excitation")
    # A mass that is held keeps its value; the others and D, K follow.
    held = np.isfinite(np.diag(given.mass))
    share = np.mean(np.diag(given.mass)[held] / np.diag(matrices[0])[held]) if held.any() else 1.0
    return tuple((X + X.T) / 2 * share for X in matrices)


def _share(fit: RivalFit, data: Whitened, j: int, setting: Setting) -> Complex[np.ndarray, "outputs inputs"]:
    """How far mode j moves every coordinate, relative to a mass on a spring of the same pole on a base that moves by
    one unit."""
    c0, c1 = np.exp(fit.poles[j])
    w = np.sqrt(c0)
    n = len(setting.measured)
    unit = eqx.tree_at(lambda drive: drive.direction, setting.drive, np.ones_like(np.asarray(setting.drive.direction)))
    continuous = unit.state_space(np.eye(n), c1 * np.eye(n), c0 * np.eye(n), setting.measured, 1.0)
    alone = sampled(continuous, 1.0, setting.hold)
    inside = np.linalg.solve(np.exp(1j * w) * np.eye(2 * n) - np.asarray(alone.A), np.asarray(alone.B))
    return fit.response(j, w, data) / (np.asarray(alone.C) @ inside)


def _shape(share: Complex[np.ndarray, "outputs inputs"]) -> Float[np.ndarray, " outputs"]:
    """The shape of a mode from its shares, sizes kept where their phase is not that of a mechanical system."""
    share = np.nan_to_num(share, nan=0.0, posinf=0.0, neginf=0.0)
    sized = np.abs(share) * np.where(share.real >= 0, 1.0, -1.0)
    vector = np.linalg.svd(sized)[0][:, 0]
    return vector / np.linalg.norm(vector)


def _independent(
    shapes: list[np.ndarray], strengths: Float[np.ndarray, " modes"], mass: Float[np.ndarray, "dofs dofs"]
) -> Float[np.ndarray, "dofs modes"]:
    """Shapes as columns; for a weak one that lies among stronger ones, what is orthogonal to these by `mass`."""
    lower = np.linalg.cholesky(mass)
    found, basis = {}, np.zeros((len(mass), 0))
    for j in np.argsort(-strengths):
        own = lower.T @ shapes[j]
        left = own - basis @ (basis.T @ own)
        if np.linalg.norm(left) < OWN * np.linalg.norm(own):
            rest = np.eye(len(mass)) - basis @ basis.T
            own = left = rest[:, np.argmax(np.diag(rest))]
        found[j] = np.linalg.solve(lower.T, own)
        basis = np.column_stack([basis, left / np.linalg.norm(left)])
    return np.column_stack([found[j] for j in range(len(shapes))])
