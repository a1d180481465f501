"""Static records of bodies on springs that are not linear:

    y = offset + G (u − E⁻¹ Σ b f(bᵀ y)),

solved for y at every sample by Newton's method, begun where the body would be without the springs, since of several
places a measured one is always near; its derivatives are those of the solution.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, Local, Scales, Term
from ...numerics.programs.stored_programs import stored

STEPS = 30
"""Of Newton's method at every sample."""

SOLVED = 1e-6
"""What a solution may leave, relative to where the body would be without the springs."""

ASKED = -1.0, -0.7, -0.3, 0.3, 0.7, 1.0
"""Displacements, relative to the largest, at which a law is asked whether it is a spring."""


def is_spring(effect: AbstractEffect, scales: Scales) -> bool:
    """Whether an effect is a force that depends on displacement alone, and is no constant, which an offset is."""
    if not isinstance(effect, AbstractForceEffect) or effect.states or effect.places == "input":
        return False
    if effect.scheduled or effect.tied_to_clock or effect.own_phase:
        return False
    q = jnp.asarray(scales.q_peak * np.array(ASKED))
    for p in effect.shapes(scales):
        there, back = (np.asarray(effect.force(p, _at(q, v), jnp.zeros(0))) for v in (scales.q_peak, -scales.q_peak))
        if np.any(there != back):
            return False
        if np.ptp(there) > 0:
            return True
    return False


def _at(q, v=0.0) -> Local:
    none = 0.0 * q
    return Local(q, none + v, none, none + 1.0, none, none, none)


@stored
def curve(
    laws: tuple[AbstractForceEffect, ...],
    arms: tuple[Float[Array, " outputs"], ...],
    values: tuple[Float[Array, " parameters"], ...],
    offset: Float[Array, " outputs"],
    gain: Float[Array, "outputs inputs"],
    to_inputs: Float[Array, "inputs outputs"],
    u: Float[Array, "samples inputs"],
) -> tuple[Array, Array, Array]:
    """Outputs at every sample, their derivatives by offset, gain (row by row) and values of the laws, law by law, and
    those by the inputs.

    **Arguments:** `laws`, their `arms` and `values`; `offset`; `gain`; `to_inputs`: E⁻¹; `u`: with all effects at the
    inputs. Not finite where no place was found.
    """

    def residual(theta, y, u):
        offset, gain, values = theta
        pushed = sum(b * law.force(p, _at(b @ y), jnp.zeros(0)) for law, b, p in zip(laws, arms, values))
        return y - offset - gain @ (u - to_inputs @ pushed)

    theta = offset, gain, values

    def at(u):
        def slope(y):
            return jax.jacfwd(residual, argnums=1)(theta, y, u)

        def newton(_, y):
            return y - _solved(slope(y), residual(theta, y, u))

        free = offset + gain @ u
        y = jax.lax.fori_loop(0, STEPS, newton, free)
        found = jnp.abs(residual(theta, y, u)) <= SOLVED * jnp.max(jnp.abs(free))
        y = jnp.where(found, y, jnp.nan)
        by_theta, by_input = jax.jacfwd(residual, argnums=(0, 2))(theta, y, u)
        by_offset, by_gain, by_values = by_theta
        parts = [by_offset, by_gain.reshape(len(y), -1), *by_values]
        A = slope(y)
        return y, -_solved(A, jnp.concatenate(parts, axis=1)), -_solved(A, by_input)

    return jax.vmap(at)(u)


def _solved(A, b):
    """A⁻¹ b; of one equation without the call of LAPACK that takes longer than all else."""
    return b / A[0, 0] if len(A) == 1 else jnp.linalg.solve(A, b)


def arm_at(term: Term, outputs: int) -> Float[np.ndarray, " outputs"]:
    """The arm b of a law at a coordinate, or between two."""
    b = np.zeros(outputs)
    b[term.place.first] = 1.0
    if term.place.second >= 0:
        b[term.place.second] = -1.0
    return b


def force_columns(
    term: Term, gain: np.ndarray, to_inputs: np.ndarray, y: Float[np.ndarray, "samples outputs"]
) -> Float[np.ndarray, "columns samples outputs"]:
    """What the basis of a law does to the outputs to first order, along a measured motion."""
    b = arm_at(term, y.shape[1])
    along = -(gain @ (to_inputs @ b))
    here = _at(jnp.asarray(y @ b))
    forces = [term.effect.force(jnp.asarray(p), here, jnp.zeros(0)) for p in term.effect.basis(np.asarray(term.values))]
    return np.stack([np.asarray(f)[:, None] * along for f in forces])
