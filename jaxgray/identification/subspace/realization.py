"""From the projections to a continuous-time state-space model whose states are displacement and velocity."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...mechanics.systems.drives import ORDER
from ...numerics.matrices.linear_algebra import least_squares
from ...numerics.matrices.matrix_logarithm import matrix_logarithm
from .projection import Projections


class AbstractMap(eqx.Module):
    """The way from A_λ, the system matrix in the λ-operator, to continuous time."""

    @abc.abstractmethod
    def continuous(self, A_lambda: Float[Array, "states states"], a: Float[Array, ""]) -> Float[Array, "states states"]:
        """A·h: the continuous-time system matrix, time counted in samples."""


class ExactMap(AbstractMap):
    """A_d = a I + (1−a) A_λ and A = log(A_d)/h, exact for filters under a hold."""

    def continuous(self, A_lambda, a):
        return matrix_logarithm(a * jnp.eye(A_lambda.shape[0]) + (1 - a) * A_lambda)


class PaperMap(AbstractMap):
    """A = (A_λ − I)/τ, the limit for h/τ → 0 that the paper uses."""

    def continuous(self, A_lambda, a):
        return (A_lambda - jnp.eye(A_lambda.shape[0])) * -jnp.log(a)


MAPS = {"exact": ExactMap(), "paper": PaperMap()}
"""Maps by the name that the command uses."""


class Realization(eqx.Module):
    """ẋ = A x, y = C x in the basis of displacement and velocity, time counted in samples.

    `A`: [0 I; A21 A22]; `A_lambda`, `C_lambda`: before the change of basis; `basis_condition`: condition
    number of that change; `singular_values` of the projection.
    """

    A21: Float[Array, "dofs dofs"]
    A22: Float[Array, "dofs dofs"]
    A_lambda: Float[Array, "states states"]
    C_lambda: Float[Array, "outputs states"]
    basis_condition: Float[Array, ""]
    singular_values: Float[Array, " values"]

    @property
    def A(self) -> Float[Array, "states states"]:
        """[0 I; A21 A22], per sample."""
        dofs = self.A21.shape[0]
        return jnp.block([[jnp.zeros((dofs, dofs)), jnp.eye(dofs)], [self.A21, self.A22]])


def realize(projections: Projections, a: Float[Array, ""], measured: tuple[str, ...], map: AbstractMap) -> Realization:
    """A and C by the robust least squares, then the mechanical state basis.

    With S the rows C_k A^(−r_k) (r_k = 0, 1, 2 for measured displacement, velocity, acceleration of output k),
    T = [S; S A] turns A into [0 I; A21 A22].

    **Arguments:** `projections`; `a`: filter pole; `measured`: quantity per output; `map`: to continuous time.

    **Returns:** a `Realization`, not finite or with a large `basis_condition` where the outputs do not
    determine displacement and velocity.

    **Reference:** Van Overschee & De Moor, algorithm 4.8, step 5; Olofsson et al., state constraints.
    """
    targets = jnp.concatenate([projections.target_states, projections.target_outputs], axis=1)
    solution = least_squares(projections.regressor, targets).T
    order = projections.regressor.shape[1]
    A_lambda, C = solution[:order], solution[order:]
    A = map.continuous(A_lambda, a)

    rows = []
    integrated = [C]
    for _ in range(max(ORDER[kind] for kind in measured)):
        integrated.append(jnp.linalg.solve(A.T, integrated[-1].T).T)
    for k, kind in enumerate(measured):
        rows.append(integrated[ORDER[kind]][k])
    S = jnp.stack(rows)
    SA = S @ A
    # States are scaled to like size first: with time counted in samples, velocities are tiny.
    size_S = jnp.linalg.norm(S)
    size_SA = jnp.linalg.norm(SA)
    T = jnp.concatenate([S / size_S, SA / size_SA])
    lower = jnp.linalg.solve(T.T, (SA @ A).T).T
    dofs = S.shape[0]
    singular = jnp.linalg.svd(T, compute_uv=False)
    return Realization(
        lower[:, :dofs] / size_S,
        lower[:, dofs:] / size_SA,
        A_lambda,
        C,
        singular[0] / singular[-1],
        projections.singular_values,
    )
