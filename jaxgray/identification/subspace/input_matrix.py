"""Least squares for B₂ = M⁻¹ E, given the realisation: from the record, or from the compressed factor.

Both give the same thing, the quadratic ½‖F vec(B₂) − g‖² left when initial state and offsets are taken
out, so that whatever constrains B₂ can be added afterwards. vec stacks B₂ row by row.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...mechanics.systems.drives import ORDER
from ...mechanics.systems.statespace import hold_matrices
from ...numerics.matrices.linear_algebra import triangular_factor
from ...numerics.responses.lifting import respond, scaled_free_response
from .projection import Data
from .realization import Realization


class InputFit(eqx.Module):
    """½‖factor vec(B₂) − target‖², `factor` with dofs · inputs columns."""

    factor: Float[Array, "rows entries"]
    target: Float[Array, " rows"]


def output_rows(
    A: Float[Array, "states states"], measured: tuple[str, ...]
) -> tuple[Float[Array, "outputs states"], Float[Array, "outputs dofs"]]:
    """C, and the D that multiplies B₂, of outputs measured one per coordinate (time in samples)."""
    dofs = A.shape[0] // 2
    rows = jnp.concatenate([jnp.eye(2 * dofs), A[dofs:]])
    picked = jnp.array([ORDER[kind] * dofs + k for k, kind in enumerate(measured)])
    accelerated = jnp.array([float(kind == "acceleration") for kind in measured])
    return rows[picked], jnp.diag(accelerated)


def unit_drives(realization: Realization, measured: tuple[str, ...], hold: str) -> tuple[Array, Array, Array, Array]:
    """Sampled system driven by one unit entry of B₂ per coordinate.

    **Returns:** A_d, B̃ (states × dofs), C, D̃ (outputs × dofs); multiply B̃ and D̃ by B₂ for the true ones.
    """
    A = realization.A
    dofs = realization.A21.shape[0]
    C, D = output_rows(A, measured)
    Ad, B0, B1 = hold_matrices(A, jnp.eye(2 * dofs)[:, dofs:], 1.0, hold)
    return Ad, Ad @ B1 + B0, C, D + C @ B1


def fit_to_record(
    realization: Realization,
    u: Float[Array, "samples inputs"],
    y: Float[Array, "samples outputs"],
    kept: Float[Array, "samples outputs"],
    *,
    measured: tuple[str, ...],
    hold: str,
) -> InputFit:
    """Regression of the outputs on the simulated responses to unit entries of B₂.

    The smallest error of the two ways, at the price of a pass over the record.

    **Arguments:** `realization`; `u`, `y`: scaled; `kept`: weight of each output sample, 0 where it is
    missing; `measured`; `hold`.

    **Returns:** an `InputFit` with initial state and offsets taken out.
    """
    Ad, Bd, C, Dd = unit_drives(realization, measured, hold)
    samples, inputs = u.shape
    outputs = y.shape[1]

    def response(b, d, signal):
        return respond(Ad, b[:, None], C, d[:, None], signal[:, None])

    by_input = jax.vmap(response, (None, None, 1), -1)
    responses = jax.vmap(by_input, (1, 1, None), -2)(Bd, Dd, u).reshape(samples, outputs, -1)
    free = scaled_free_response(Ad, C, samples)
    offsets = jnp.broadcast_to(jnp.eye(outputs), (samples, outputs, outputs))
    table = jnp.concatenate([free, offsets, responses, y[:, :, None]], axis=2) * kept[:, :, None]
    nuisance = free.shape[2] + outputs
    R = triangular_factor(table.reshape(samples * outputs, -1))[nuisance:, nuisance:]
    return InputFit(R[:, :-1], R[:, -1])


def fit_to_factor(drives: tuple[Array, Array, Array, Array], data: Data) -> InputFit:
    """The paper's step 6 in the Laguerre family: Γ^⊥ Y_f = Γ^⊥ H(B₂) U_f, without the record.

    With X_j the filtered states and 𝒜 = (A_d − aI)(I − aA_d)⁻¹, for j ≥ 1

        X_j = 𝒜 X_{j+1} + (I − aA_d)⁻¹ B̃ (f_{j+1} + a f_j) u,
        X_0 = √((1−a)/(1+a)) (A_λ X_1 + B̃ f_1 u/(1−a)),

    X_{i−1} free.

    **Arguments:** `drives`: `unit_drives` of the realisation; `data`: future and past.

    **Returns:** an `InputFit`.

    **Reference:** Olofsson et al., step 6; recursion in the Laguerre family by substitution of λ_d.
    """
    Ad, Bd, C, Dd = drives
    a = data.a
    states, dofs = Bd.shape
    # The rows beyond those that span the inputs hold nothing of H U_f.
    rows = data.family.shape[1] * data.inputs
    eye = jnp.eye(states)
    # The two factors of 𝒜 commute.
    both = jnp.linalg.solve(eye - a * Ad, jnp.concatenate([Ad - a * eye, Bd], axis=1))
    ratio, drive = both[:, :states], both[:, states:]
    A_lambda = (Ad - a * eye) / (1 - a)
    root = jnp.sqrt((1 - a) / (1 + a))
    u = data.family[:rows, : data.padded + 1, : data.inputs]

    def step(carry, j):
        gamma, X = carry
        first = j == 0
        free = jnp.where(first, root * A_lambda, ratio)
        kick = jnp.where(first, root / (1 - a) * Bd, drive)
        signal = jnp.where(first, u[:, 1], u[:, j + 1] + a * u[:, j])
        last = j == data.block_rows - 1
        inside = j < data.block_rows - 1
        gamma = jnp.where(last, eye, jnp.where(inside, free @ gamma, gamma))
        moved = X @ free.T + jnp.einsum("sr,qi->qris", kick, signal).reshape(rows, -1, states)
        X = jnp.where(inside, moved, X)
        live = j < data.block_rows
        out_gamma = jnp.where(live, C @ gamma, 0.0)
        feed = jnp.einsum("pr,qi->qrip", Dd, u[:, j]).reshape(rows, -1, C.shape[0])
        return (gamma, X), (out_gamma, jnp.where(live, X @ C.T + feed, 0.0))

    start = (jnp.zeros((states, states)), jnp.zeros((rows, dofs * data.inputs, states)))
    _, (gamma, forced) = jax.lax.scan(step, start, jnp.arange(data.padded - 1, -1, -1))
    gamma = gamma[::-1].reshape(-1, states)
    forced = forced[::-1].transpose(0, 3, 1, 2).reshape(gamma.shape[0], rows, -1)
    _, Yf = data.future()
    Q = jnp.linalg.qr(gamma / jnp.linalg.norm(gamma, axis=0))[0]

    def off(X):
        return X - jnp.tensordot(Q, Q.T @ X.reshape(X.shape[0], -1), 1).reshape(X.shape)

    table = jnp.concatenate([off(forced), off(Yf[:rows].T)[:, :, None]], axis=2)
    R = triangular_factor(table.reshape(-1, table.shape[2]))
    return InputFit(R[:, :-1], R[:, -1])
