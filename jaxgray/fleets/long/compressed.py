"""A long record reduced by many workers to what the subspace identification needs, and refined by all of them."""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...identification.setup.preparation import scaling_of
from ...identification.setup.units import Scaling
from ...identification.streaming import best_choice, model_of_factors, pattern_of
from ...identification.subspace.compression import factor_of_rows
from ...identification.subspace.filter_bank import pole
from ...mechanics.model import MechanicalModel
from ...numerics.programs.runtime import ready
from ...numerics.progress import AbstractProgress, Silent
from ...records import Record
from ..runner import carry_out, engines, refuse
from ..tasks import names
from .factors import Chunk, Seam, Tree, reduced, trusted
from .source import Source

CHUNK = 2**19
"""Samples of a chunk: a worker holds one, some 16 MB of four channels, and what correlating it needs."""

HEAD = 2**16
"""Samples by which channels are scaled, and time constants and block rows chosen."""


@dataclass(frozen=True, eq=False)
class LongRecord:
    """A record of any length, reduced.

    `source`; `pattern`: channels, units and hold; `scaling` and `level` by the first samples; `poles`, `block_rows`;
    `factor` for every time constant, as one pass gives it; `sizes`: standard deviation of every channel over all
    samples, by `scaling`.
    """

    source: Source
    pattern: Record
    scaling: Scaling
    level: Float[np.ndarray, " outputs"]
    poles: Float[np.ndarray, " time_constants"]
    block_rows: int
    factor: Float[np.ndarray, "time_constants columns columns"] = field(repr=False)
    sizes: Float[np.ndarray, " signals"] = field(repr=False)

    def model(self, *, block_rows=None, input_map=None) -> MechanicalModel:
        """Mass, damping and stiffness by the subspace identification, not refined.

        **Arguments:** `block_rows`: i up to that of the compression, default that; `input_map`: as for `identify`.

        **Raises:** `ComputationError` where the record gives no model.
        """
        inputs = self.pattern.inputs
        found = [factor_of_rows(jnp.asarray(R), inputs, self.block_rows) for R in self.factor]
        good = trusted(np.array([float(pivot) for _, pivot in found]))
        grid = jnp.stack([jnp.where(keep, factor, jnp.nan) for (factor, _), keep in zip(found, good)])
        return model_of_factors(
            grid, self.poles, self.pattern, self.scaling, self.sizes, self.block_rows, block_rows, input_map
        )


def compress_on_workers(
    place,
    *,
    inputs,
    outputs,
    sampling_time: float,
    samples: int | None = None,
    time_constants=None,
    block_rows: int | None = None,
    hold: str = "zero",
    measured="displacement",
    input_map=None,
    client=None,
    scheduler: str | None = None,
    workers: int | None = None,
    chunk_samples: int = CHUNK,
    householder: bool = False,
    progress: AbstractProgress | None = None,
) -> LongRecord:
    """Reduce one record on many workers: each reads chunks of its own, and only small factors travel.

    The result is that of one pass over the whole record, to rounding: filter states are carried over the seams.

    **Arguments:**

    - `place`: a NPY, Parquet or HDF5 file that all workers reach, or a function of first sample and count that returns
        samples × columns and can be pickled.
    - `inputs`, `outputs`: names of columns; of a function in the order of its columns, inputs first.
    - `sampling_time`: time between samples [s].
    - `samples`: how many; default all of the file.
    - `time_constants` [s], `block_rows`: default those that serve the first samples best.
    - `hold`, `measured`: as for `read_record`.
    - `input_map`: where forces act, for that choice; as for `identify`.
    - `client`, `scheduler`, `workers`: as for `fleet`.
    - `chunk_samples`: samples of a chunk; default 524 288.
    - `householder`: filter the rows in any case, instead of correlating them where that is as exact; default off.
    - `progress`: told of every chunk; silent by default.

    **Returns:** a `LongRecord`.

    **Raises:** `ValueError` for arguments or data that cannot serve; `Lost` where the workers are gone.
    """
    ready()
    inputs, outputs = names("inputs", inputs), names("outputs", outputs)
    progress = Silent() if progress is None else progress
    if chunk_samples < HEAD // 64:
        raise ValueError(f"chunk_samples={chunk_samples} is too few; give {HEAD // 64} or more, such as {CHUNK}.")
    source = Source.of(place, inputs, outputs, samples)
    first = source.read(0, HEAD)
    split = len(inputs)
    options = {"input_names": inputs, "output_names": outputs, "hold": hold, "measured": measured}
    head = Record(first[:, :split], first[:, split:], sampling_time, **options)
    scaling = scaling_of([head])
    if time_constants is None or block_rows is None:
        time_constants, block_rows = best_choice(head, scaling, time_constants, block_rows, input_map)
    taus = np.unique(np.atleast_1d(np.asarray(time_constants, dtype=float)))
    if not np.all(taus > 0) or int(block_rows) < 3:
        raise ValueError(f"time_constants={time_constants} must be positive and block_rows={block_rows} at least 3.")
    poles, rows = tuple(float(a) for a in np.asarray(pole(taus, sampling_time))), int(block_rows)
    level = np.concatenate([np.zeros(split), head.y.mean(axis=0)])
    sizes = np.concatenate([np.asarray(scaling.inputs), np.asarray(scaling.outputs)])
    chunks = [
        Chunk(
            source,
            at,
            min(chunk_samples, source.samples - at),
            poles,
            rows,
            tuple(level),
            tuple(sizes),
            householder,
            index,
        )
        for index, at in enumerate(range(0, source.samples, chunk_samples))
    ]
    seam, tree, early = Seam(poles, 2 * rows - 1, len(sizes)), Tree(), {}
    moments = [np.zeros(len(sizes)), np.zeros(len(sizes)), 0]

    def found(value) -> None:
        # States follow from chunk to chunk: what comes early waits.
        index, part = value
        early[index] = part
        while moments[2] in early:
            part = early.pop(moments[2])
            tree.add(seam.joined(part))
            moments[0], moments[1], moments[2] = moments[0] + part.sums, moments[1] + part.squares, moments[2] + 1

    with engines(client, scheduler, workers) as engine:
        carry_out(engine(), reduced, chunks, [1] * len(chunks), refuse, progress, found=found, what="chunks")
    mean = moments[0] / source.samples
    pattern = pattern_of((inputs, outputs), (head.input_units, head.output_units), hold, head.measured, sampling_time)
    spread = np.sqrt(moments[1] / source.samples - mean**2)
    return LongRecord(source, pattern, scaling, level[split:], np.array(poles), rows, tree.whole(), spread)
