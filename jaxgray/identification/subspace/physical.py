"""Mass, damping and stiffness from the realisation: convex problems over semidefinite matrices.

Everything is in scaled coordinates with time counted in samples; `Scaling` leads back to the record's units.
"""

import equinox as eqx
from jaxtyping import Array, Float

from ...numerics.matrices.linear_algebra import duplication, from_symmetric_vector, symmetric_vector
from ...numerics.matrices.namespace import namespace
from ...numerics.matrices.positive import AbstractPositiveSolver, PositiveLeastSquares
from .input_matrix import InputFit
from .realization import Realization

FLOOR = 1e-6
"""Smallest eigenvalue allowed to an inverse mass, relative to the mean one."""


def input_matrix(fit: InputFit) -> Float[Array, " entries"]:
    """vec(B₂) (row by row) without constraints."""
    xp = namespace(fit.factor)
    Q, R = xp.linalg.qr(fit.factor)
    return xp.linalg.solve(R, Q.T @ fit.target)


def from_inverse_mass(
    realization: Realization,
    fit: InputFit,
    E: Float[Array, "dofs inputs"],
    solver: AbstractPositiveSolver,
    *,
    averaged: bool = False,
) -> tuple[Array, Array, Array]:
    """M, D, K in the paper's order: inverse mass from the input matrix, then stiffness and damping.

    M⁻¹ ⪰ εI from B₂ = M⁻¹E;  K = argmin ‖M⁻¹K + A21‖_F over K ⪰ 0;  D likewise with A22. Needs an input on
    every coordinate.

    **Arguments:** `realization`; `fit` of B₂; `E`: scaled input map; `solver`; `averaged`: take for M⁻¹ the symmetric
    part of B₂E⁺, as the paper does, instead of the symmetric matrix that fits best. The fit trusts the realisation,
    whose errors lie in B₂ too, and is the poorer of the two (by a sixth on the reference system) unless some input
    hardly moves anything.

    **Returns:** scaled M, D, K.

    **Reference:** Olofsson et al., equations (22) to (24).
    """
    xp = namespace(realization.A21, fit.factor, E)
    dofs = E.shape[0]
    basis = duplication(dofs)
    # vec(X E) row by row is (I ⊗ Eᵀ) vec(X).
    columns = fit.factor @ xp.kron(xp.eye(dofs), E.T) @ basis
    scale = xp.linalg.norm(columns) / xp.sqrt(columns.shape[1])
    if averaged:
        X = input_matrix(fit).reshape(E.shape) @ xp.linalg.pinv(E)
        size = xp.linalg.norm(X)
        scale, mean = 1.0 / size, symmetric_vector((X + X.T) / 2) / size
        problem = PositiveLeastSquares.from_residual(xp.eye(len(mean)), mean, (dofs,), (0.0,))
    else:
        problem = PositiveLeastSquares.from_residual(columns / scale, fit.target, (dofs,), (0.0,))
    size = xp.abs(xp.trace(from_symmetric_vector(problem.unconstrained()))) / dofs
    problem = eqx.tree_at(lambda p: p.floors, problem, FLOOR * size[None])
    X = from_symmetric_vector(solver(problem)) / scale

    # Whitened by X/‖X‖: the problems for K and D have the condition of X, not its size.
    size = xp.linalg.norm(X)
    table = xp.kron(X / size, xp.eye(dofs)) @ basis

    def restoring(target):
        norm = xp.linalg.norm(target)
        norm = xp.where(norm > 0, norm, 1.0)
        found = solver(PositiveLeastSquares.from_residual(table, -target.ravel() / norm, (dofs,), (0.0,)))
        return from_symmetric_vector(found) * norm / size

    eye = xp.eye(dofs)
    return xp.linalg.solve(X, eye), restoring(realization.A22), restoring(realization.A21)


def jointly(
    realization: Realization,
    input_equation: tuple[Float[Array, "dofs inputs"], Float[Array, "dofs inputs"]] | None,
    solver: AbstractPositiveSolver,
    mass: Float[Array, "dofs dofs"] | None = None,
) -> tuple[tuple[Array, Array, Array], Float[Array, ""]]:
    """M, D, K from one semidefinite least squares, also for fewer inputs than coordinates.

    ‖K + M A21‖²/‖A21‖² + ‖D + M A22‖²/‖A22‖² + ‖M B₂ − E‖²/‖B₂‖² over M ≻ 0, D ⪰ 0, K ⪰ 0; without an input
    equation (base excitation) the scale is set by tr M = dofs.

    **Arguments:** `realization`; `input_equation`: (B₂, E), scaled, or None; `solver`; `mass`: a known mass,
    scaled, or None.

    **Returns:** scaled (M, D, K), and the smallest eigenvalue of the problem relative to the largest: near zero
    where the inputs do not reach every coordinate.
    """
    A21, A22 = realization.A21, realization.A22
    xp = namespace(A21, *(input_equation or ()), mass)
    dofs = A21.shape[0]
    rate = xp.sqrt(xp.linalg.norm(A21, ord=2))
    A21, A22 = A21 / rate**2, A22 / rate
    size21, size22 = xp.linalg.norm(A21), xp.linalg.norm(A22)
    size22 = xp.where(size22 > 0, size22, 1.0)
    basis = duplication(dofs)
    eye = xp.eye(dofs)
    none = xp.zeros((dofs**2, basis.shape[1]))

    def times(A):
        # vec(M A) row by row is (I ⊗ Aᵀ) vec(M).
        return xp.kron(eye, A.T) @ basis

    tables = [
        xp.hstack([times(A21), none, basis]) / size21,
        xp.hstack([times(A22), basis, none]) / size22,
    ]
    targets = [xp.zeros(2 * dofs**2)]
    unit = 1.0
    if input_equation is not None:
        B2 = input_equation[0] / rate**2
        unit = xp.linalg.norm(input_equation[1]) / xp.linalg.norm(B2)
        table = times(B2)
        tables.append(xp.pad(table, ((0, 0), (0, 2 * basis.shape[1]))) / xp.linalg.norm(B2))
        targets.append((input_equation[1] / unit).ravel() / xp.linalg.norm(B2))
    elif mass is None:
        row = xp.concatenate([symmetric_vector(eye) / dofs, xp.zeros(2 * basis.shape[1])])
        tables.append(row[None])
        targets.append(xp.ones(1))
    table, target = xp.concatenate(tables), xp.concatenate(targets)
    singular = xp.linalg.svd(table, compute_uv=False)
    entries = basis.shape[1]
    if mass is None:
        floors = xp.array([FLOOR, 0.0, 0.0])
        found = solver(PositiveLeastSquares.from_residual(table, target, (dofs,) * 3, floors))
    else:
        known = symmetric_vector(mass * rate**2)
        unit = 1.0
        rest = PositiveLeastSquares.from_residual(
            table[: 2 * dofs**2, entries:], -table[: 2 * dofs**2, :entries] @ known, (dofs,) * 2, (0.0, 0.0)
        )
        found = xp.concatenate([known, solver(rest)])
    M, D, K = (from_symmetric_vector(found[k * entries : (k + 1) * entries]) * unit for k in range(3))
    if input_equation is None and mass is None:
        share = dofs / xp.trace(M)
        M, D, K = M * share, D * share, K * share
    return (M / rate**2, D / rate, K), (singular[-1] / singular[0]) ** 2
