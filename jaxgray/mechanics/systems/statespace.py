"""State-space models: from continuous time to samples under a hold, and back."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...numerics.matrices.matrix_exponential import matrix_exponential
from ...numerics.matrices.matrix_logarithm import matrix_logarithm
from ...numerics.responses.lifting import respond

HOLDS = ("zero", "linear")


def check_hold(hold: str) -> str:
    """The hold itself, or a `ValueError` that names the choices."""
    if hold not in HOLDS:
        raise ValueError(f"hold={hold!r} is not known; choose 'zero' (computer output) or 'linear' (analogue).")
    return hold


class StateSpace(eqx.Module):
    """ẋ = A x + B u, y = C x + D u; or x⁺ = A x + B u once sampled.

    **Arguments:** `A`, `B`, `C`, `D`; `sampling_time` [s], or None in continuous time.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> system = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]]).state_space()
        >>> np.linalg.eigvals(np.asarray(system.A)).round(3)
        array([-0.75+6.28j, -0.75-6.28j])
    """

    A: Float[Array, "states states"]
    B: Float[Array, "states inputs"]
    C: Float[Array, "outputs states"]
    D: Float[Array, "outputs inputs"]
    sampling_time: float | None = None

    def transformed(self, T: Float[Array, "states states"]) -> "StateSpace":
        """The same system in the state T x."""
        return StateSpace(
            jnp.linalg.solve(T.T, (T @ self.A).T).T,
            T @ self.B,
            jnp.linalg.solve(T.T, self.C.T).T,
            self.D,
            self.sampling_time,
        )

    def response(
        self, u: Float[Array, "samples inputs"], x0: Float[Array, " states"] | None = None
    ) -> Float[Array, "samples outputs"]:
        """Outputs of the sampled system for the input `u`, from the state `x0` (at rest by default)."""
        return respond(self.A, self.B, self.C, self.D, u, x0)

    def transfer(self, omega: Float[Array, " frequencies"]) -> Array:
        """C (jωI − A)⁻¹ B + D in continuous time at ω [rad/s], one outputs × inputs matrix a frequency."""
        eye = jnp.eye(self.A.shape[0])
        pencil = 1j * omega[:, None, None] * eye - self.A
        return self.C @ jnp.linalg.solve(pencil, jnp.broadcast_to(self.B + 0j, (len(omega), *self.B.shape))) + self.D


def hold_matrices(
    A: Float[Array, "states states"], B: Float[Array, "states inputs"], sampling_time: float, hold: str
) -> tuple[Array, Array, Array]:
    """Sampled equation x⁺ = A_d x + B_0 u + B_1 u⁺ that the hold makes exact.

    **Arguments:** `A`, `B`: continuous time; `sampling_time` [s]; `hold`: "zero" or "linear".

    **Returns:** A_d, B_0, B_1 (zero for a zero-order hold).
    """
    states, inputs = B.shape
    if check_hold(hold) == "zero":
        block = jnp.zeros((states + inputs, states + inputs))
        block = block.at[:states, :states].set(A * sampling_time)
        block = block.at[:states, states:].set(B * sampling_time)
        flow = matrix_exponential(block)
        B0 = flow[:states, states:]
        return flow[:states, :states], B0, jnp.zeros_like(B0)
    size = states + 2 * inputs
    block = jnp.zeros((size, size))
    block = block.at[:states, :states].set(A * sampling_time)
    block = block.at[:states, states : states + inputs].set(B * sampling_time)
    block = block.at[states : states + inputs, states + inputs :].set(jnp.eye(inputs))
    flow = matrix_exponential(block)
    B1 = flow[:states, states + inputs :]
    return flow[:states, :states], flow[:states, states : states + inputs] - B1, B1


def sampled(system: StateSpace, sampling_time: float, hold: str) -> StateSpace:
    """The system at its sampling instants, exact for inputs that follow the hold.

    Under a linear hold the state is x − B_1 u, which turns u⁺ out of the recursion.

    **Arguments:** `system` in continuous time; `sampling_time` [s]; `hold`: "zero" or "linear".

    **Returns:** a `StateSpace` with that sampling time.
    """
    Ad, B0, B1 = hold_matrices(system.A, system.B, sampling_time, hold)
    return StateSpace(Ad, Ad @ B1 + B0, system.C, system.D + system.C @ B1, sampling_time)


def continuous_matrix(Ad: Float[Array, "states states"], sampling_time: float) -> Float[Array, "states states"]:
    """Continuous-time A = log(A_d)/h of a sampled system matrix."""
    return matrix_logarithm(Ad) / sampling_time
