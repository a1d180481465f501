"""What one record says of a machine's reference model: the local statistic of its parameters and of effects.

With the residual e of the reference model's free run, its derivatives J by every entry of M, D, K, the responses X of
effects, and the noise's inverse covariance W, first state and output offsets projected out,

    s = √N ζ = [J X]ᵀ W e,        F = [J X]ᵀ W [J X].

F⁻¹ s is one step of Gauss and Newton from the reference; s has mean F δ and covariance F where the parameters are off
by a small δ.

**Reference:** A. Benveniste, M. Basseville, G. Moustakides, IEEE Transactions on Automatic Control 32, 1987.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...diagnosis.model.candidate import Data
from ...diagnosis.screening.features import Motion, features
from ...diagnosis.screening.scales import scales_at
from ...identification.refinement.uncertainty import entry_names
from ...identification.setup.options import drive_of
from ...mechanics.at_stamps import at_own_times
from ...mechanics.effects import by_id
from ...mechanics.fitted_run import fitted_run
from ...mechanics.modal_uncertainty import stacked_entries, with_entries
from ...mechanics.model import MechanicalModel
from ...mechanics.runs.extended import Plant
from ...mechanics.runs.simulate import free_run
from ...numerics.programs.stored_programs import stored
from ...records import Record

WEAR = (
    "coulomb_friction",
    "quadratic_drag",
    "cubic_stiffness",
    "bilinear_stiffness",
    "dead_zone_stiffness",
    "end_stop",
    "input_dead_zone",
)
"""Effects that begin or grow as machines wear: looked for where nothing else is said."""

DIGITS = 10
"""Digits of what is kept."""


def score(record: Record, own: dict, *, effects=WEAR, input_map=None) -> dict:
    """Statistic and information of one record at a reference model.

    **Arguments:** `record`; `own`: "mass", "damping", "stiffness" of the reference, and "noise", standard deviation per
    output; `effects`: ids; `input_map`: as for `identify`.

    **Returns:** "names" of what is tested, entries first; "entries": how many of them are entries of M, D, K; "score"
    s, "information" F, and "dispersion": mean square of the residual in units of the noise, all of the record's units.
    """
    model = MechanicalModel(
        *(np.array(own[name]) for name in ("mass", "damping", "stiffness")),
        drive=drive_of(record, "force", input_map, False),
        measured=record.measured,
        input_names=record.input_names,
        output_names=record.output_names,
        input_units=record.input_units,
        output_units=record.output_units,
    )
    record = at_own_times(model, record)
    data = Data.of(record)
    run = fitted_run(model, record)
    x0, h = jnp.asarray(run.x0), jnp.asarray(record.sampling_time)
    J, first = _slopes(model, stacked_entries(model), jnp.asarray(data.u), h, record.hold, x0)
    responses, names = _responses(model, data, x0, tuple(by_id(name) for name in effects))
    outputs = record.outputs
    samples = data.samples
    columns = np.concatenate([np.asarray(J)[:samples], np.moveaxis(responses, 0, 2)[:samples]], axis=2)
    offsets = np.broadcast_to(np.eye(outputs), (samples, outputs, outputs))
    nuisances = np.concatenate([np.asarray(first)[:samples], offsets], axis=2)
    kept = np.isfinite(record.y)
    weight = np.where(kept, 1.0, 0.0) / np.array(own["noise"])
    e = (np.where(kept, record.y - run.simulated, 0.0) * weight).ravel()
    X, Z = ((part * weight[:, :, None]).reshape(-1, part.shape[2]) for part in (columns, nuisances))
    scale = np.linalg.norm(Z, axis=0)
    basis, _ = np.linalg.qr(Z / np.where(scale > 0, scale, 1.0))
    X, e = X - basis @ (basis.T @ X), e - basis @ (basis.T @ e)
    return {
        "names": [*entry_names(outputs), *names],
        "entries": len(entry_names(outputs)),
        "samples": samples,
        "score": _rounded(X.T @ e),
        "information": _rounded(X.T @ X),
        "dispersion": float(e @ e / max(kept.sum() - Z.shape[1], 1)),
        "warnings": [],
    }


def _rounded(values: np.ndarray) -> list:
    """Numbers to some digits, so that files stay small."""
    if values.ndim > 1:
        return [_rounded(row) for row in values]
    return [float(f"{v:.{DIGITS}g}") for v in values]


@stored
def _slopes(model, entries, u, h, hold: str, x0) -> tuple[Array, Array]:
    """Derivatives of the free run's outputs by the entries of M, D, K, and by the first state."""

    def run(entries, x0):
        return free_run(with_entries(model, entries), u, h, hold, x0)

    return jax.jacfwd(run, argnums=(0, 1))(entries, x0)


@stored
def _moved(model, u, h, hold: str, x0) -> Array:
    return free_run(model, u, h, hold, x0)


def _responses(
    model: MechanicalModel, data: Data, x0, effects: tuple
) -> tuple[Float[np.ndarray, "columns samples outputs"], list[str]]:
    """Responses to one unit of each effect at every place, of the middle one of its shapes, and their names."""
    if not effects:
        return np.zeros((0, len(data.u), model.outputs)), []
    u, h = jnp.asarray(data.u), jnp.asarray(data.sampling_time)

    def of(kind):
        plain = dataclasses.replace(model, measured=(kind,) * model.dofs)
        return np.asarray(_moved(plain, u, h, data.hold, x0))

    motion = Motion(of("displacement"), of("velocity"), np.asarray(_moved(model, u, h, data.hold, x0)))
    plant = Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
    names = model.input_names, model.output_names
    scales = scales_at(plant, motion, data, *names, ())
    made = features(plant, motion, data, effects, scales, *names)
    chosen, told, at, groups = [], [], 0, {}
    for shape in made.shapes:
        groups.setdefault((shape.effect.id, shape.place.name), []).append((at, shape))
        at += len(shape.basis)
    for (effect, place), shapes in groups.items():
        first, shape = shapes[len(shapes) // 2]
        response = made.responses[first]
        # A place that does not move says nothing.
        if np.all(np.isfinite(response)) and np.any(response[: data.samples]):
            chosen.append(response)
            told.append(f"{effect} {place}")
    return np.array(chosen).reshape(len(chosen), len(data.u), model.outputs), told
