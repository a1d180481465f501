"""Free run, first state and one-step prediction of a mechanical model, from and to plain arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.lifting import free_response, respond
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.riccati import kalman_gain
from ..numerics.runtime import ready
from ..records.channels import as_channels, as_seconds
from .model import MechanicalModel
from .statespace import StateSpace, check_hold, hold_matrices, sampled

RANK_TOLERANCE = 1e-10
"""Singular value, relative to the largest, below which a direction of first state and offset is not determined."""


def sampled_model(model: MechanicalModel, sampling_time, hold: str) -> tuple[StateSpace, Array]:
    """The linear part of a model at its sampling instants, time counted in samples, and where its state starts.

    The state of the sampled system is x̃ = (q, h q̇) − S u: S holds what the linear hold takes out of the
    recursion and what a measured base displacement adds to the velocity.

    **Arguments:** `model`; `sampling_time` (h) [s]; `hold`: "zero" or "linear".

    **Returns:** the sampled `StateSpace`, and S (states × inputs).
    """
    continuous = model.state_space(sampling_time)
    speed = model.drive.state_space(
        model.mass, model.damping, model.stiffness, ("velocity",) * model.dofs, sampling_time
    )
    to_speed = jnp.concatenate([jnp.zeros_like(speed.D), speed.D * sampling_time])
    return sampled(continuous, 1.0, hold), hold_matrices(continuous.A, continuous.B, 1.0, hold)[2] + to_speed


def linear_free_run(model: MechanicalModel, u, sampling_time, hold: str, x0) -> Float[Array, "samples outputs"]:
    """Outputs of the linear part of a model, exact for inputs that follow the hold; traceable.

    **Arguments:** `model`; `u`: inputs (samples × inputs); `sampling_time` [s]; `hold`: "zero" or "linear";
    `x0`: first (q, q̇), or None: at rest, a measured base at zero until the first sample.

    **Returns:** the outputs, one row a sample.
    """
    system, shift = sampled_model(model, sampling_time, hold)
    if x0 is None:
        continuous = model.state_space(sampling_time)
        start = -hold_matrices(continuous.A, continuous.B, 1.0, hold)[2] @ u[0]
    else:
        start = jnp.concatenate([x0[: model.dofs], x0[model.dofs :] * sampling_time]) - shift @ u[0]
    return respond(system.A, system.B, system.C, system.D, u, start)


@eqx.filter_jit
def free_run(model: MechanicalModel, u, sampling_time, hold: str, x0) -> Float[Array, "samples outputs"]:
    """Outputs of a model: the one place where what is added to the linear part, `model.effects`, is dispatched.

    **Arguments**, **Returns:** as for `linear_free_run`.
    """
    return linear_free_run(model, u, sampling_time, hold, x0)


def simulate(
    model: MechanicalModel, u, sampling_time: float, *, hold: str = "zero", x0=None, offset=None
) -> Float[np.ndarray, "samples outputs"]:
    """Free-run simulation: outputs from the inputs and the first state alone.

    **Arguments:** `model`; `u`: inputs (samples × inputs; one dimension is one input), finite;
    `sampling_time` [s]; `hold`: the input between samples, "zero" (default) or "linear"; `x0`: displacements,
    then velocities of the coordinates at the first sample (relative to the base where the base acceleration
    is the input), default at rest, a measured base at zero until the first sample; `offset`: constant added
    to each output, default none.

    **Returns:** the outputs (samples × outputs), in the output units.

    **Raises:** `ValueError` where an argument does not fit; `ComputationError` where the outputs are not finite.
    """
    u, h = _input(model, u, sampling_time, hold)
    x0 = _vector("x0", x0, 2 * model.dofs, "displacements, then velocities")
    y = np.asarray(free_run(model, u, h, hold, x0))
    offset = _vector("offset", offset, model.dofs, "one value per output")
    if offset is not None:
        y = y + np.asarray(offset)
    if not np.isfinite(y).all():
        raise ComputationError(RESULTS.nonfinite, stage="simulation", detail="the outputs grow without bound")
    return y


@eqx.filter_jit
def _start_regression(model, u, sampling_time, hold):
    system, shift = sampled_model(model, sampling_time, hold)
    forced = respond(system.A, system.B, system.C, system.D, u)
    return forced, free_response(system.A, system.C, u.shape[0]), shift @ u[0]


def initial_state(
    model: MechanicalModel, u, y, sampling_time: float, *, hold: str = "zero", offset: bool = True, kept=None
) -> tuple[Float[np.ndarray, " states"], Float[np.ndarray, " outputs"]]:
    """First state and constant output offset by which a model's free run comes nearest to a record.

    min Σ_k ‖(y − ŷ_k − offset_k)/rms_k‖² over the first state and the offsets, a linear least squares with each
    output in units of its own standard deviation. Where the two cannot be told apart (a rigid body may stand
    anywhere) the smallest solution is taken, every unknown counted by what it moves.

    **Arguments:** `model`; `u`, `y`: inputs and outputs (samples × channels), NaN in `y` where missing;
    `sampling_time` [s]; `hold`: "zero" (default) or "linear"; `offset`: whether outputs may have one, default
    True; `kept`: which samples (or samples × outputs) count, default all.

    **Returns:** `x0` (displacements, then velocities at the first sample) and `offset`, as `simulate` takes
    them.

    **Raises:** `ValueError` where an argument does not fit or no sample is left; `ComputationError` where the
    model's own motion is not finite.
    """
    u, h = _input(model, u, sampling_time, hold)
    y = _output(model, y, u)
    dofs, samples = model.dofs, len(y)
    known = np.isfinite(y)
    if kept is not None:
        kept = np.asarray(kept, dtype=bool)
        if kept.shape not in ((samples,), y.shape):
            raise ValueError(f"kept has shape {kept.shape}; give ({samples},) or {y.shape} truth values.")
        known = known & kept.reshape(samples, -1)
    if not known.any():
        raise ValueError("y and kept leave no sample to find the initial state from; keep some that are measured.")
    forced, free, shift = (np.asarray(part) for part in _start_regression(model, u, h, hold))
    if not (np.isfinite(forced).all() and np.isfinite(free).all()):
        raise ComputationError(RESULTS.nonfinite, stage="initial state", detail="the model's motion grows without bound")
    counted = np.maximum(known.sum(axis=0), 1)
    measured = np.where(known, y, 0.0)
    size = np.sqrt(np.sum(np.where(known, measured - measured.sum(axis=0) / counted, 0.0) ** 2, axis=0) / counted)
    weight = known / np.where(size > 0, size, 1.0)
    table = free
    if offset:
        table = np.concatenate([free, np.broadcast_to(np.eye(dofs), (samples, dofs, dofs))], axis=2)
    table = (table * weight[:, :, None])[known]
    norm = np.linalg.norm(table, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    target = ((measured - forced) * weight)[known]
    found = np.linalg.lstsq(table / norm, target, rcond=RANK_TOLERANCE)[0] / norm
    state = found[: 2 * dofs] + shift
    state = np.concatenate([state[:dofs], state[dofs:] / h])
    return state, found[2 * dofs :] if offset else np.zeros(dofs)


@eqx.filter_jit
def _corrections(model, u, residual, kept, sampling_time, hold, force, deviation):
    """One-step corrections C x̂ of the free run by a stationary Kalman filter on its residual."""
    system, _ = sampled_model(model, sampling_time, hold)
    C = system.C / deviation[:, None]
    D = system.D / deviation[:, None]
    gain, _ = kalman_gain(
        system.A, C, system.B * force @ system.B.T, system.B * force @ D.T, jnp.eye(len(C)) + D * force @ D.T
    )

    # Sample by sample, since a missing output leaves only the measured ones to correct the state.
    def step(x, now):
        error, known = now
        return system.A @ x + gain @ jnp.where(known, error - C @ x, 0.0), C @ x

    _, predicted = jax.lax.scan(step, jnp.zeros(system.A.shape[0]), (residual / deviation, kept))
    return predicted * deviation


def predict(
    model: MechanicalModel,
    u,
    y,
    sampling_time: float,
    *,
    hold: str = "zero",
    x0=None,
    offset=None,
    force_noise_ratio=0.0,
    output_noise=None,
) -> Float[np.ndarray, "samples outputs"]:
    """One-step prediction: every output from the inputs and all earlier outputs.

    x̂⁺ = A x̂ + B u + G (y − ŷ), with the stationary Kalman gain G of white noise at the inputs, covariance
    ρ diag(mean square of each input), and at the outputs. Without noise at the inputs it is the free run.

    **Arguments:** `model`; `u`, `y`: inputs and outputs (samples × channels), NaN in `y` where missing;
    `sampling_time` [s]; `hold`: "zero" (default) or "linear"; `x0`, `offset`: as for `simulate`;
    `force_noise_ratio` (ρ): one for all inputs or one per input, default 0; `output_noise`: standard deviation
    of the noise per output, default from the second differences of the free-run residual.

    **Returns:** the predicted outputs (samples × outputs).

    **Raises:** `ValueError` where an argument does not fit; `ComputationError` where the outputs are not finite.

    **Reference:** Ljung, *System Identification*, §4.3 (innovations form).
    """
    free = simulate(model, u, sampling_time, hold=hold, x0=x0, offset=offset)
    u, h = _input(model, u, sampling_time, hold)
    y = _output(model, y, u)
    ratio = np.broadcast_to(np.asarray(force_noise_ratio, dtype=float), model.inputs)
    if not (np.isfinite(ratio).all() and (ratio >= 0).all()):
        raise ValueError(f"force_noise_ratio is {force_noise_ratio}; give finite ratios, 0 or more.")
    if not ratio.any():
        return free
    residual = y - free
    known = np.isfinite(residual)
    if output_noise is None:
        output_noise = _white_part(residual)
    output_noise = np.asarray(_vector("output_noise", output_noise, model.dofs, "one per output"))
    if (output_noise < 0).any():
        raise ValueError(f"output_noise is {output_noise}; give standard deviations, 0 or more.")
    # Below this share of the signal is rounding, and the gain would divide by zero.
    size = np.sqrt(np.mean(free**2, axis=0))
    deviation = np.maximum(output_noise, 1e-9 * np.where(size > 0, size, 1.0))
    force = ratio * np.mean(np.asarray(u) ** 2, axis=0)
    return free + np.asarray(
        _corrections(model, u, jnp.asarray(np.where(known, residual, 0.0)), jnp.asarray(known), h, hold, force, deviation)
    )


def _white_part(residual: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Standard deviation of the white part of a residual: second differences of white noise have six times its
    variance, those of anything slow next to none."""
    second = np.diff(residual, n=2, axis=0) ** 2
    known = np.isfinite(second)
    return np.sqrt(np.where(known, second, 0.0).sum(axis=0) / (6 * np.maximum(known.sum(axis=0), 1)))


def _input(model, u, sampling_time, hold) -> tuple[Array, float]:
    ready()
    check_hold(hold)
    u = as_channels("u", u)
    if u.shape[1] != model.inputs:
        raise ValueError(
            f"u has {u.shape[1]} channels, the model has {model.inputs} inputs {model.input_names}; give one "
            "column per input."
        )
    if np.isnan(u).any():
        raise ValueError(f"u is NaN at sample {np.argwhere(np.isnan(u))[0][0]}; fill or cut the input.")
    return jnp.asarray(u), as_seconds("sampling_time", sampling_time)


def _output(model, y, u) -> Float[np.ndarray, "samples outputs"]:
    y = as_channels("y", y)
    if y.shape != (len(u), model.dofs):
        raise ValueError(f"y has shape {y.shape}; give {(len(u), model.dofs)}, as many samples as u, one column per output.")
    return y


def _vector(name, given, length, meaning) -> Array | None:
    if given is None:
        return None
    vector = np.ravel(np.asarray(given, dtype=float))
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} is {given}; give {length} finite numbers: {meaning}.")
    return jnp.asarray(vector)
