"""Prediction errors of a mechanical model on records, as a pure function of its parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import AbstractDrive
from ...mechanics.systems.statespace import StateSpace, sampled
from ...numerics.matrices.riccati import kalman_gain
from ...numerics.responses.lifting import SHORT_BLOCK, respond, scaled_free_response
from .preparation import Signals

RIDGE = 1e-11
"""Added to the Gram matrix of first state and offsets, relative to its trace: a state may not be visible."""


class Nuisance(eqx.Module):
    """What every record has of its own, and what the noise is like.

    `x0`: first state; `offset`: constant added to the outputs, or None; `noise`: standard deviation of the force noise
    relative to the first output's (one per input, either sign), then ln of the other outputs' noise variances
    relative to the first; or None for white output noise.
    """

    x0: Float[Array, "records states"]
    offset: Float[Array, "records outputs"] | None
    noise: Float[Array, " ratios"] | None


class Batch(eqx.Module):
    """Records of one system, scaled and padded to one length.

    `gaps`: whether samples may be missing elsewhere than in the padding.
    """

    u: Float[Array, "records samples inputs"]
    y: Float[Array, "records samples outputs"]
    kept: Float[Array, "records samples outputs"]
    gaps: bool = eqx.field(static=True, default=True)

    @classmethod
    def of(cls, signals: list[Signals]) -> "Batch":
        """Stack records, the shorter padded."""
        length = max(s.u.shape[0] for s in signals)

        def stack(name):
            parts = [getattr(s, name) for s in signals]
            padded = [np.pad(np.asarray(part), ((0, length - part.shape[0]), (0, 0))) for part in parts]
            return jax.device_put(np.stack(padded))

        return cls(stack("u"), stack("y"), stack("kept"), any(has_gaps(np.asarray(s.kept)) for s in signals))


def has_gaps(kept: Float[np.ndarray, "samples outputs"]) -> bool:
    """Whether samples are missing elsewhere than at the end, or not of all outputs alike."""
    some = kept[:, 0] > 0
    return bool(np.any(kept != some[:, None]) or np.any(some[1:] & ~some[:-1]))


class Setting(eqx.Module):
    """What stays fixed while parameters move: drive, measured quantities and hold, all scaled; `hidden`: how many
    coordinates no output measures, the last ones."""

    drive: AbstractDrive
    measured: tuple[str, ...] = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    hidden: int = eqx.field(static=True, default=0)

    @property
    def dofs(self) -> int:
        """Number of coordinates."""
        return len(self.measured) + self.hidden

    def system(self, M: Array, D: Array, K: Array) -> StateSpace:
        """Sampled system, time in samples."""
        return sampled(self.drive.state_space(M, D, K, self.measured, 1.0), 1.0, self.hold)


def free_run(system: StateSpace, batch: Batch, nuisance: Nuisance) -> Float[Array, "records samples outputs"]:
    """Simulated outputs of every record, offset included."""

    def one(u, x0):
        return respond(system.A, system.B, system.C, system.D, u, x0, block=SHORT_BLOCK)

    y = jax.vmap(one)(batch.u, nuisance.x0)
    return y if nuisance.offset is None else y + nuisance.offset[:, None, :]


def best_run(system: StateSpace, signals: Signals) -> tuple[Float[Array, "samples outputs"], Float[Array, " outputs"]]:
    """Free run of a sampled system with the best first state and offsets, and its mean square residual per output."""
    samples, outputs = signals.y.shape
    free = scaled_free_response(system.A, system.C, samples)
    offsets = jnp.broadcast_to(jnp.eye(outputs), (samples, outputs, outputs))
    forced = respond(system.A, system.B, system.C, system.D, signals.u)
    table = jnp.concatenate([free, offsets], axis=2)
    rows = (table * signals.kept[:, :, None]).reshape(samples * outputs, -1)
    gram = rows.T @ rows
    target = rows.T @ ((signals.y - forced) * signals.kept).reshape(-1)
    solution = jnp.linalg.solve(gram + RIDGE * jnp.trace(gram) * jnp.eye(gram.shape[0]), target)
    simulated = forced + table @ solution
    deviation = jnp.sum(((signals.y - simulated) * signals.kept) ** 2, axis=0)
    return simulated, deviation / jnp.maximum(jnp.sum(signals.kept, axis=0), 1.0)


def noise_model(system: StateSpace, noise: Float[Array, " ratios"], inputs: int) -> tuple[Array, Array]:
    """Kalman gain, and innovation covariance scaled to unit determinant, of white noise at the inputs and outputs.

    **Arguments:** `system` sampled; `noise`: standard deviation of each input's noise relative to the first
    output's, then ln of the other outputs' variances relative to the first; `inputs`: how many.
    """
    outputs = system.C.shape[0]
    force = jnp.diag(noise[:inputs] ** 2)
    output = jnp.diag(jnp.exp(jnp.concatenate([jnp.zeros(1), noise[inputs:]])))
    R = output + system.D @ force @ system.D.T
    gain, innovation = kalman_gain(system.A, system.C, system.B @ force @ system.B.T, system.B @ force @ system.D.T, R)
    return gain, innovation / jnp.linalg.det(innovation) ** (1 / outputs)


def prediction_errors(
    system: StateSpace, batch: Batch, nuisance: Nuisance, whitening: Float[Array, "outputs outputs"]
) -> Float[Array, "records samples outputs"]:
    """Whitened prediction errors, zero where a sample is missing.

    Output-error form: W (y − ŷ) with W = `whitening`. Innovations form: the free-run residual filtered by the
    stationary Kalman filter, whitened by its own covariance at unit determinant; the sum of squares then is
    the Gaussian likelihood with the common noise level concentrated out.

    **Arguments:** `system` sampled; `batch`; `nuisance`; `whitening`: lower triangular, ignored in the
    innovations form.

    **Returns:** one error per output sample.
    """
    residual = (batch.y - free_run(system, batch, nuisance)) * batch.kept
    return weighed(residual, system, batch, nuisance, whitening)


def weighed(
    residual: Float[Array, "records samples outputs"],
    system: StateSpace,
    batch: Batch,
    nuisance: Nuisance,
    whitening: Float[Array, "outputs outputs"],
) -> Float[Array, "records samples outputs"]:
    """The linear map from residuals of the free run, zero where a sample is missing, to prediction errors."""
    if nuisance.noise is None:
        return jnp.einsum("rnp,op->rno", residual, whitening) * batch.kept
    gain, covariance = noise_model(system, nuisance.noise, system.B.shape[1])
    outputs = system.C.shape[0]

    def innovations(e):
        return respond(system.A - gain @ system.C, gain, -system.C, jnp.eye(outputs), e)

    epsilon = jax.vmap(innovations)(residual)
    lower = jnp.linalg.cholesky(covariance)
    flat = jsl.solve_triangular(lower, epsilon.reshape(-1, outputs).T, lower=True).T
    return flat.reshape(epsilon.shape) * batch.kept
