"""Transfer functions of a family of mechanical systems, linear in its parameters, and their derivatives.

Z(s) = Σ_i θ_i s^{k_i} S_i with fixed matrices S_i (k = 2 for masses, 1 for dampers, 0 for springs). Forces give
q = Z⁻¹E u, a base q = Z⁻¹(sD + K) r x, or relative to it −Z⁻¹ s²M r x.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from ...mechanics.drives import ORDER, AbstractDrive, BaseAcceleration, Force
from ..normal import part
from ..prediction import Setting
from ..structure import Structure


@dataclass(frozen=True)
class Family:
    """`bases` (S_i) and `powers` (k_i) of every parameter; `drive`; `order`: time derivatives that outputs measure."""

    bases: Float[np.ndarray, "parameters dofs dofs"]
    powers: Int[np.ndarray, " parameters"]
    drive: AbstractDrive
    order: Int[np.ndarray, " outputs"]

    @classmethod
    def of(cls, structure: Structure, setting: Setting) -> "Family":
        """The family that a structure of 1 × 1 or full blocks describes, in the units of a setting."""
        dofs = setting.dofs
        sizes, owners = structure.sizes(dofs), structure.owners(dofs)
        count = sum(n * (n + 1) // 2 for n in sizes)
        rows = [structure.matrices(part(unit, sizes), dofs) for unit in np.eye(count)]
        powers = np.concatenate(
            [
                np.full(n * (n + 1) // 2, {"mass": 2, "damping": 1, "stiffness": 0}[owner])
                for n, owner in zip(sizes, owners)
            ]
        )
        bases = np.array([np.asarray(three[2 - k]) for three, k in zip(rows, powers)])
        return cls(bases, powers, setting.drive, np.array([ORDER[kind] for kind in setting.measured]))

    def matrices(self, theta: Float[np.ndarray, " parameters"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, D, K."""
        return tuple(np.einsum("p,pij->ij", theta * (self.powers == k), self.bases) for k in (2, 1, 0))

    def response(
        self, theta: Float[np.ndarray, "*starts parameters"], s: Complex[np.ndarray, " points"], *, slopes: bool = False
    ) -> tuple[Complex[np.ndarray, "*starts points outputs inputs"], Complex[np.ndarray, "..."] | None]:
        """H at some points, and its derivatives by every parameter as a last axis where `slopes`."""
        terms = s[:, None] ** self.powers
        Z = np.einsum("...p,sp,pij->...sij", theta, terms, self.bases)
        base = not isinstance(self.drive, Force)
        E = np.asarray(self.drive.direction if base else self.drive.input_map, dtype=complex)
        moved = np.zeros(len(self.powers))
        if not base:
            R = np.broadcast_to(E, (*Z.shape[:-2], *E.shape))
        else:
            moved = np.where(self.powers == 2, -1.0, 0.0) if self.drive.relative else (self.powers < 2) * 1.0
            R = np.einsum("...p,sp,pij,jm->...sim", theta * moved, terms, self.bases, E)
        p = len(self.order)
        X = np.linalg.solve(Z, np.broadcast_to(np.eye(Z.shape[-1]), Z.shape))
        full = X @ R
        power = self.order - (2 if isinstance(self.drive, BaseAcceleration) else 0)
        rate = s[:, None, None] ** power[:, None]
        H = full[..., :p, :] * rate
        if not slopes:
            return H, None
        inner = -np.einsum("sp,pij,...sjm->...spim", terms, self.bases, full)
        if base:
            inner = inner + np.einsum("p,sp,pij,jm->spim", moved, terms, self.bases, E)
        dH = np.einsum("...soi,...spim->...somp", X[..., :p, :], inner) * rate[..., None]
        return H, dH


def realized_response(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states inputs"],
    C: Float[np.ndarray, "outputs states"],
    D: Float[np.ndarray, "outputs inputs"],
    s: Complex[np.ndarray, " points"],
) -> Complex[np.ndarray, "points outputs inputs"]:
    """C (sI − A)⁻¹ B + D."""
    pencil = s[:, None, None] * np.eye(len(A)) - A
    return C @ np.linalg.solve(pencil, np.broadcast_to(B + 0j, (len(s), *B.shape))) + D


def contour(
    rates: Float[np.ndarray, " modes"], angle: float, count: int = 60, beyond: float = 3.0
) -> Complex[np.ndarray, " points"]:
    """Points s = ω e^{jφ} around some rates: φ = 0 is smooth, π/2 the imaginary axis with its resonances.

    **Arguments:** `rates` [1/time]; `angle` φ [rad]; `count`: how many; `beyond`: how far beyond the slowest and the
    fastest.
    """
    rates = rates[rates > 1e-3 * np.max(rates)]
    grid = np.geomspace(np.min(rates) / beyond, np.max(rates) * beyond, count)
    if angle > 1.5:
        # More points where the response changes: near the modes themselves.
        near = np.concatenate([rates * x for x in (0.9, 0.97, 1.0, 1.03, 1.1)])
        grid = np.sort(np.concatenate([grid, near]))
    return grid * np.exp(1j * angle)
