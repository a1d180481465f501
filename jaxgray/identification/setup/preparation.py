"""From records to scaled, padded arrays that traced code can take."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...numerics.outcomes import RESULTS, ComputationError
from ...records import Record
from .padding import padded_samples
from .units import Scaling


class Signals(eqx.Module):
    """One record, scaled to unit size and padded to a whole number of chunks.

    `u`, `y`: padded with zeros; missing outputs are zero; `kept`: 1 for every output sample that was
    measured; `samples`: how many are real.
    """

    u: Float[Array, "samples inputs"]
    y: Float[Array, "samples outputs"]
    kept: Float[Array, "samples outputs"]
    samples: int = eqx.field(static=True)

    @property
    def stacked(self) -> Float[Array, "samples signals"]:
        """u and y side by side."""
        return jnp.concatenate([self.u, self.y], axis=1)

    @property
    def inside(self) -> Float[Array, " samples"]:
        """1 for the samples of the record, 0 for padding."""
        return (jnp.arange(self.u.shape[0]) < self.samples).astype(self.u.dtype)


def _size(parts: list[np.ndarray]) -> np.ndarray:
    values = np.concatenate(parts)
    spread = np.sqrt(np.nanmean((values - np.nanmean(values, axis=0)) ** 2, axis=0))
    level = np.sqrt(np.nanmean(values**2, axis=0))
    return np.where(spread > 1e-12 * level, spread, level)


def scaling_of(records: list[Record]) -> Scaling:
    """Scaling to unit standard deviation of every channel over all records."""
    for kind, parts, names in (
        ("input", [r.u for r in records], records[0].input_names),
        ("output", [r.y for r in records], records[0].output_names),
    ):
        values = np.concatenate(parts)
        for k, name in enumerate(names):
            column = values[:, k][np.isfinite(values[:, k])]
            if len(column) == 0 or np.ptp(column) <= 1e-12 * np.max(np.abs(column)):
                raise ComputationError(
                    RESULTS.not_exciting,
                    stage="preparation",
                    detail=f"{kind} {name!r} is constant" + ("" if len(column) == 0 else f" ({column[0]:g})"),
                )
    return Scaling.of(
        _size([r.u for r in records]),
        _size([r.y for r in records]),
        records[0].sampling_time,
        records[0].measured,
    )


def prepare(record: Record, scaling: Scaling, *, samples: int | None = None) -> Signals:
    """Scaled and padded signals of one record.

    **Arguments:** `record`; `scaling`; `samples`: length to pad to (default: the next of a few sizes).

    **Returns:** `Signals`. The mean of every output is taken off first, for the sake of rounding; the offset
    is estimated anyway.
    """
    length = padded_samples(record.samples) if samples is None else samples
    padding = ((0, length - record.samples), (0, 0))
    known = np.isfinite(record.y)
    y = np.where(known, (record.y - np.nanmean(record.y, axis=0)) / np.asarray(scaling.outputs), 0.0)
    u = record.u / np.asarray(scaling.inputs)
    # What `jnp.asarray` does too, but by a program of its own for every shape.
    u, y, kept = (jax.device_put(np.pad(x, padding)) for x in (u, y, known.astype(float)))
    return Signals(u, y, kept, record.samples)
