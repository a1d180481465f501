"""Free run, first state and one-step prediction of a mechanical model, from and to plain arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.matrices.riccati import kalman_gain
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.runtime import ready
from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.lifting import free_response, respond
from ...records import Record
from ...records.channels import as_channels, as_seconds
from ..systems.abstract_model import AbstractMechanicalModel, effect_names
from ..systems.statespace import StateSpace, check_hold, hold_matrices, sampled
from .extended import Plant, extended_run
from .first_state import linear_state, refined_state

LEAST_NOISE = 1e-6
"""Output noise, relative to the output, that prediction assumes at least: without, it has no gain."""


def sampled_model(model: AbstractMechanicalModel, sampling_time, hold: str) -> tuple[StateSpace, Array, Array]:
    """The linear part of a model at its sampling instants, and what its state holds.

    The state of the sampled system is x̃ = (q, h q̇) − (H + S) u: H is what the linear hold takes out of the
    recursion, S what a measured base displacement adds to the velocity.

    **Arguments:** `model`; `sampling_time` (h) [s]; `hold`: "zero" or "linear".

    **Returns:** the sampled `StateSpace`, H and S (states × inputs).
    """
    continuous = model.state_space(sampling_time)
    speed = model.drive.state_space(
        model.mass, model.damping, model.stiffness, ("velocity",) * model.dofs, sampling_time
    )
    to_speed = jnp.concatenate([jnp.zeros_like(speed.D), speed.D * sampling_time])
    return sampled(continuous, 1.0, hold), hold_matrices(continuous.A, continuous.B, 1.0, hold)[2], to_speed


# Apart, so that a record of another length does not compile the matrix exponential again.
_sampled_model = stored(sampled_model, level=ONCE)
_respond = stored(respond)
_free_response = stored(free_response)


@stored
def _extended(model: AbstractMechanicalModel, u, sampling_time, hold, x0, scheduling, substeps):
    plant = Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
    return extended_run(plant, model.effects, x0, u, sampling_time, hold, scheduling=scheduling, substeps=substeps)


def free_run(
    model: AbstractMechanicalModel, u, sampling_time, hold: str, x0, *, scheduling=None, substeps: int = 1
) -> Float[Array, "samples outputs"]:
    """Outputs of a model, its effects included.

    **Arguments:** `model`; `u`: inputs (samples × inputs); `sampling_time` [s]; `hold`: "zero" or "linear";
    `x0`: first (q, q̇), or None: at rest, a measured base at zero until the first sample; `scheduling`: channel that
    some effects read, default zeros; `substeps`: steps per sample of the effects that are forces.

    **Returns:** the outputs, one row a sample: exact for the linear part and inputs that follow the hold, of second
    order in the step for forces that effects add.
    """
    if model.effects:
        state = jnp.zeros(2 * model.dofs) if x0 is None else x0
        return _extended(model, u, sampling_time, hold, state, scheduling, substeps)
    system, held, to_speed = _sampled_model(model, sampling_time, hold)
    start = -held @ u[0]
    if x0 is not None:
        q, v = jnp.split(x0, 2)
        start = start + jnp.concatenate([q, v * sampling_time]) - to_speed @ u[0]
    return _respond(system.A, system.B, system.C, system.D, u, start)


def simulate(
    model: AbstractMechanicalModel,
    u,
    sampling_time: float,
    *,
    hold: str = "zero",
    x0=None,
    offset=None,
    scheduling=None,
    substeps: int = 1,
) -> Float[np.ndarray, "samples outputs"]:
    """Free-run simulation: outputs from the inputs and the first state alone.

    **Arguments:** `model`; `u`: inputs (samples × inputs; one dimension is one input), finite;
    `sampling_time` [s]; `hold`: the input between samples, "zero" (default) or "linear"; `x0`: displacements,
    then velocities of the coordinates at the first sample (relative to the base where the base acceleration
    is the input), default at rest, a measured base at zero until the first sample; `offset`: constant added
    to each output, default none; `scheduling`: channel (samples), for effects that read it; `substeps`: steps per
    sample of the forces that effects add, default 1; the error falls with their square.

    **Returns:** the outputs (samples × outputs), in the output units.

    **Raises:** `ValueError` where an argument does not fit; `ComputationError` where the outputs are not
    finite.
    """
    u, h = _input(model, u, sampling_time, hold)
    x0 = _vector("x0", x0, 2 * model.dofs, "displacements, then velocities")
    _steps(substeps)
    p = _scheduling(model, scheduling, len(u))
    y = np.asarray(free_run(model, u, h, hold, x0, scheduling=p, substeps=_counted(substeps)))
    offset = _vector("offset", offset, model.outputs, "one value per output")
    if offset is not None:
        y = y + np.asarray(offset)
    if not np.isfinite(y).all():
        raise ComputationError(RESULTS.nonfinite, stage="simulation", detail="the outputs grow without bound")
    return y


def initial_state(
    model: AbstractMechanicalModel,
    u,
    y,
    sampling_time: float,
    *,
    hold: str = "zero",
    offset: bool = True,
    kept=None,
    scheduling=None,
    substeps: int = 1,
) -> tuple[Float[np.ndarray, " states"], Float[np.ndarray, " outputs"]]:
    """First state and constant output offset by which a model's free run comes nearest to a record.

    min Σ ((y − ŷ − offset)/σ)² over the first state and the offsets, a linear least squares with each output
    in units of its own standard deviation σ. Where the two cannot be told apart (a rigid body may
    stand anywhere) the smallest solution is taken, every unknown counted by what it moves. With effects the
    least squares are no longer linear; they start from the solution without.

    **Arguments:** `model`; `u`, `y`: inputs and outputs (samples × channels), NaN in `y` where missing;
    `sampling_time` [s]; `hold`: "zero" (default) or "linear"; `offset`: whether outputs may have one, default
    True; `kept`: which samples (or samples × outputs) count, default all; `scheduling`, `substeps`: as for `simulate`.

    **Returns:** `x0` (displacements, then velocities at the first sample) and `offset`, as `simulate` takes
    them.

    **Raises:** `ValueError` where an argument does not fit or no sample is left; `ComputationError` where the
    model's own motion is not finite.
    """
    u, h = _input(model, u, sampling_time, hold)
    y = _output(model, y, u)
    _steps(substeps)
    p = _scheduling(model, scheduling, len(u))
    dofs, outputs, samples = model.dofs, model.outputs, len(y)
    known = np.isfinite(y)
    if kept is not None:
        kept = np.asarray(kept, dtype=bool)
        if kept.shape not in ((samples,), y.shape):
            raise ValueError(f"kept has shape {kept.shape}; give ({samples},) or {y.shape} truth values.")
        known = known & kept.reshape(samples, -1)
    if not known.any():
        raise ValueError("y and kept leave no sample to find the initial state from; keep some that are measured.")
    system, held, to_speed = _sampled_model(model, h, hold)
    forced = np.asarray(_respond(system.A, system.B, system.C, system.D, u, jnp.zeros(2 * dofs)))
    free = np.asarray(_free_response(system.A, system.C, samples))
    bounded = np.isfinite(forced).all() and np.isfinite(free).all()
    if not bounded and not model.effects:
        raise ComputationError(
            RESULTS.nonfinite, stage="initial state", detail="the model's motion grows without bound"
        )
    counted = np.maximum(known.sum(axis=0), 1)
    measured = np.where(known, y, 0.0)
    size = np.sqrt(np.sum(np.where(known, measured - measured.sum(axis=0) / counted, 0.0) ** 2, axis=0) / counted)
    weight = known / np.where(size > 0, size, 1.0)
    found = np.zeros(2 * dofs), np.zeros(outputs)
    if bounded:
        state, shift = linear_state(free, measured - forced, weight, offset)
        state = state + np.asarray((held + to_speed) @ u[0])
        found = np.concatenate([state[:dofs], state[dofs:] / float(h)]), shift
    if not model.effects:
        return found
    rest = np.zeros(2 * dofs), np.zeros(outputs)
    run = eqx.Partial(_from_state, model, u, h, hold, p, _counted(substeps))
    return refined_state(run, [found, rest], measured, weight, offset)


def _counted(substeps: int):
    """One step by a program of its own, more by one for any number."""
    return substeps if substeps == 1 else jnp.asarray(substeps)


def _from_state(model, u, sampling_time, hold, scheduling, substeps, x0):
    return free_run(model, u, sampling_time, hold, x0, scheduling=scheduling, substeps=substeps)


@stored
def _corrections(system, residual, kept, force, deviation):
    """One-step corrections C x̂ of the free run by a stationary Kalman filter on its residual."""
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
    model: AbstractMechanicalModel,
    u,
    y,
    sampling_time: float,
    *,
    hold: str = "zero",
    x0=None,
    offset=None,
    force_noise_ratio=0.0,
    output_noise=None,
    scheduling=None,
) -> Float[np.ndarray, "samples outputs"]:
    """One-step prediction: every output from the inputs and all earlier outputs.

    x̂⁺ = A x̂ + B u + G (y − ŷ), with the stationary Kalman gain G of white noise at the inputs, covariance
    ρ diag(mean square of each input), and at the outputs. Without noise at the inputs it is the free run.

    **Arguments:** `model`; `u`, `y`: inputs and outputs (samples × channels), NaN in `y` where missing;
    `sampling_time` [s]; `hold`: "zero" (default) or "linear"; `x0`, `offset`, `scheduling`: as for `simulate`;
    `force_noise_ratio` (ρ): one for all inputs or one per input, default 0; `output_noise`: standard
    deviation of the noise per output, default from the second differences of the free-run residual.

    **Returns:** the predicted outputs (samples × outputs).

    **Raises:** `ValueError` where an argument does not fit, or where the model has effects and noise at the inputs
    is asked for; `ComputationError` where the outputs are not finite.

    **Reference:** Ljung, *System Identification*, §4.3 (innovations form).
    """
    ratio = np.broadcast_to(np.asarray(force_noise_ratio, dtype=float), model.inputs)
    if not (np.isfinite(ratio).all() and (ratio >= 0).all()):
        raise ValueError(f"force_noise_ratio is {force_noise_ratio}; give finite ratios, 0 or more.")
    if ratio.any() and model.effects:
        raise ValueError(
            f"model has effects ({effect_names(model)}), and one-step prediction is linear only; call simulate, or "
            "predict with dataclasses.replace(model, effects=())."
        )
    free = simulate(model, u, sampling_time, hold=hold, x0=x0, offset=offset, scheduling=scheduling)
    u, h = _input(model, u, sampling_time, hold)
    y = _output(model, y, u)
    if not ratio.any():
        return free
    residual = y - free
    known = np.isfinite(residual)
    if output_noise is None:
        output_noise = _white_part(residual)
    output_noise = np.asarray(_vector("output_noise", output_noise, model.outputs, "one per output"))
    if (output_noise < 0).any():
        raise ValueError(f"output_noise is {output_noise}; give standard deviations, 0 or more.")
    size = np.sqrt(np.sum(np.where(known, y, 0.0) ** 2, axis=0) / np.maximum(known.sum(axis=0), 1))
    deviation = np.maximum(output_noise, LEAST_NOISE * np.where(size > 0, size, 1.0))
    force = ratio * np.mean(np.asarray(u) ** 2, axis=0)
    system, _, _ = _sampled_model(model, h, hold)
    residual = np.where(known, residual, 0.0)
    return free + np.asarray(_corrections(system, *map(jnp.asarray, (residual, known, force, deviation))))


def signals_of(u, y, sampling_time, hold):
    """What a method was given: a record, which brings everything along, or the arrays themselves.

    **Arguments:** `u`: a `Record`, or inputs; `y`: outputs, None with a record; `sampling_time` [s], None
    with a record; `hold`: None for the record's own, or "zero" without a record.

    **Returns:** u, y, sampling time, hold.

    **Raises:** `ValueError` when something is given twice or not at all.
    """
    if isinstance(u, Record):
        if y is not None or sampling_time is not None:
            raise ValueError("y and sampling_time come with the record; leave them out.")
        return u.u, u.y, u.sampling_time, u.hold if hold is None else hold
    if sampling_time is None:
        raise ValueError("sampling_time is missing; give it in s, or give a Record.")
    return u, y, sampling_time, "zero" if hold is None else hold


def _white_part(residual: Float[np.ndarray, "samples outputs"]) -> Float[np.ndarray, " outputs"]:
    """Standard deviation of the white part of a residual: second differences of white noise have six times
    its variance, those of anything slow next to none."""
    second = np.diff(residual, n=2, axis=0) ** 2
    known = np.isfinite(second)
    return np.sqrt(np.where(known, second, 0.0).sum(axis=0) / (6 * np.maximum(known.sum(axis=0), 1)))


def _input(model, u, sampling_time, hold) -> tuple[Array, Array]:
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
    # As an array, since a plain number would be compiled in.
    return jnp.asarray(u), jnp.asarray(as_seconds("sampling_time", sampling_time))


def _output(model, y, u) -> Float[np.ndarray, "samples outputs"]:
    y = as_channels("y", y)
    if y.shape != (len(u), model.outputs):
        raise ValueError(
            f"y has shape {y.shape}; give {(len(u), model.outputs)}, as many samples as u and a column per output."
        )
    return y


def _steps(substeps) -> None:
    if not isinstance(substeps, int) or substeps < 1:
        raise ValueError(f"substeps is {substeps!r}; give a whole number, 1 or more.")


def _scheduling(model, scheduling, samples) -> Array | None:
    if scheduling is not None:
        return _vector("scheduling", scheduling, samples, "one value per sample")
    for term in model.effects:
        if term.effect.scheduled:
            raise ValueError(f"scheduling is missing, and {term.effect.id} of the model reads it; give the channel.")
    return None


def _vector(name, given, length, meaning) -> Array | None:
    if given is None:
        return None
    vector = np.ravel(np.asarray(given, dtype=float))
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} is {given}; give {length} finite numbers: {meaning}.")
    return jnp.asarray(vector)
