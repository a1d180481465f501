"""Transfer functions of a family of mechanical systems, linear in its parameters, and their derivatives.

Z(s) = Σ_i θ_i s^{k_i} S_i with fixed matrices S_i (k = 2 for masses, 1 for dampers, 0 for springs). Forces give
q = Z⁻¹E u, a base q = Z⁻¹(sD + K) r x, or relative to it −Z⁻¹ s²M r x.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from ....mechanics.systems.drives import ORDER, AbstractDrive, BaseAcceleration, Force
from ...refinement.normal_equations import part
from ...setup.prediction import Setting
from ...setup.structure import Structure


@dataclass(frozen=True)
class Family:
    """`bases` (S_i) and `powers` (k_i) of every parameter; `drive`; `order`: time derivatives that outputs measure;
    `arms` (a_i) where every S_i is a_i a_iᵀ, else None."""

    bases: Float[np.ndarray, "parameters dofs dofs"]
    powers: Int[np.ndarray, " parameters"]
    drive: AbstractDrive
    order: Int[np.ndarray, " outputs"]
    arms: Float[np.ndarray, "parameters dofs"] | None = None

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
        values, vectors = np.linalg.eigh(bases)
        single = np.all(np.abs(values[:, :-1]) < 1e-12 * values[:, -1:])
        arms = vectors[:, :, -1] * np.sqrt(values[:, -1:]) if single else None
        return cls(bases, powers, setting.drive, np.array([ORDER[kind] for kind in setting.measured]), arms)

    def matrices(self, theta: Float[np.ndarray, " parameters"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, D, K."""
        return tuple(np.einsum("p,pij->ij", theta * (self.powers == k), self.bases) for k in (2, 1, 0))

    def response(
        self, theta: Float[np.ndarray, "*starts parameters"], s: Complex[np.ndarray, " points"], *, slopes: bool = False
    ) -> tuple[Complex[np.ndarray, "*starts points outputs inputs"], Complex[np.ndarray, "..."] | None]:
        """H at some points, and its derivatives by every parameter as a last axis where `slopes`."""
        terms = s[:, None] ** self.powers
        count, n = self.bases.shape[:2]
        flat = self.bases.reshape(count, n * n)
        weighted = theta[..., None, :] * terms
        Z = (weighted @ flat).reshape(*weighted.shape[:-1], n, n)
        base = not isinstance(self.drive, Force)
        E = np.asarray(self.drive.direction if base else self.drive.input_map, dtype=complex)
        moved = np.zeros(count)
        if not base:
            R = np.broadcast_to(E, (*Z.shape[:-2], *E.shape))
        else:
            moved = np.where(self.powers == 2, -1.0, 0.0) if self.drive.relative else (self.powers < 2) * 1.0
            R = ((weighted * moved) @ flat).reshape(Z.shape) @ E
        p = len(self.order)
        both = np.concatenate([R, np.broadcast_to(np.eye(n), Z.shape)], axis=-1)
        both = np.linalg.solve(Z, both)
        full, seen = both[..., : R.shape[-1]], both[..., :p, R.shape[-1] :]
        power = self.order - (2 if isinstance(self.drive, BaseAcceleration) else 0)
        rate = s[:, None, None] ** power[:, None]
        H = full[..., :p, :] * rate
        if not slopes:
            return H, None
        # Of the parameter's matrix with what moves it: the motion, less what the base gives it.
        right = full[..., None, :, :] - (moved[:, None, None] * E if base else 0.0)
        if self.arms is not None:
            left = seen @ self.arms.T
            if base:
                across = np.einsum("pj,...pjm->...pm", self.arms, right)
            else:
                across = self.arms @ full
            dH = -terms[..., None, None, :] * left[..., :, None, :] * np.swapaxes(across, -1, -2)[..., None, :, :]
        else:
            turned = np.matmul(self.bases, right)
            dH = -np.einsum("...oi,...pim->...omp", seen, turned) * terms[:, None, None, :]
        return H, dH * rate[..., None]


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
