"""Records longer than memory: read once, chunk by chunk, and never again.

What is kept does not grow with the record (`Moments`), can be saved, and can be added to: later samples of the same
record continue it, later records of the same system join it.
"""

import dataclasses
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ..mechanics.model import MechanicalModel
from ..mechanics.systems.statespace import check_hold
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.programs.runtime import give_back, ready
from ..numerics.whole_files import write_whole
from ..records import Record
from ..records.readers.chunks import CHUNK_SAMPLES, read_chunks
from ..records.readers.containers import KINDS, npz_members
from ..records.readers.limits import check_file, reading
from .initialization.physical_grid import physical_grid
from .initialization.start import StartOptions, subspace_starts
from .setup.options import drive_of
from .setup.prediction import Setting
from .setup.preparation import prepare, scaling_of
from .setup.units import Scaling
from .subspace.compression import RANK_TOLERANCE, combine, factor_of_gram
from .subspace.correlation import LAG_BLOCK, Moments, add_samples, gram, no_moments
from .subspace.filter_bank import pole
from .subspace.grid import candidates, default_time_constants, usable_block_rows
from .subspace.projection import MOESP
from .subspace.realization import ExactMap

STEP = 2**14
"""Samples taken at a time out of a chunk: what the correlations need in passing stays small."""

_add = jax.jit(add_samples)


@dataclass(frozen=True, eq=False)
class CompressedRecord:
    """A record of any length, reduced to what the subspace identification needs of it.

    `pattern`: channels, units and hold, a record of two samples; `scaling` and `level` (mean of the first outputs),
    fixed by the first chunk; `poles`, `block_rows`; `parts`: moments of every record joined so far, the last of which
    `extended` continues; `samples`.
    """

    pattern: Record
    scaling: Scaling
    level: np.ndarray
    poles: np.ndarray
    block_rows: int
    parts: tuple[Moments, ...]
    samples: int

    def extended(self, chunks: Iterable[np.ndarray]) -> "CompressedRecord":
        """The same record with later samples: columns u, then y, in the record's units, following without a gap."""
        moments, samples = self.parts[-1], self.samples
        for chunk in chunks:
            moments = self._absorb(moments, np.asarray(chunk, dtype=float))
            samples += len(chunk)
        return dataclasses.replace(self, parts=(*self.parts[:-1], moments), samples=samples)

    def joined(self, chunks: Iterable[np.ndarray]) -> "CompressedRecord":
        """A later record of the same system, with a first state and offsets of its own."""
        empty = no_moments(jnp.asarray(self.poles), self.pattern.inputs + self.pattern.outputs, self.block_rows)
        return dataclasses.replace(self, parts=(*self.parts, empty)).extended(chunks)

    def _absorb(self, moments: Moments, chunk: np.ndarray) -> Moments:
        inputs = self.pattern.inputs
        if chunk.ndim != 2 or chunk.shape[1] != inputs + self.pattern.outputs or not np.all(np.isfinite(chunk)):
            raise ValueError(
                f"a chunk has shape {chunk.shape} or missing values; give {inputs} inputs and {self.pattern.outputs} "
                "outputs as finite columns. Records with gaps are read whole, by read_record."
            )
        u = chunk[:, :inputs] / np.asarray(self.scaling.inputs)
        y = (chunk[:, inputs:] - self.level) / np.asarray(self.scaling.outputs)
        size = STEP if len(chunk) > LAG_BLOCK else LAG_BLOCK
        for first in range(0, len(chunk), size):
            part = np.concatenate([u[first : first + size], y[first : first + size]], axis=1)
            kept = (np.arange(size) < len(part)).astype(float)
            moments = _add(moments, self.poles, np.pad(part, ((0, size - len(part)), (0, 0))), kept)
            # Otherwise chunks that wait for their turn would pile up in memory.
            jax.block_until_ready(moments)
        give_back()
        return moments

    def _sizes(self) -> np.ndarray:
        """Standard deviation of every channel over all samples, relative to that of the first chunk."""
        plain = np.sum([np.asarray(part.plain) for part in self.parts], axis=0)
        return np.sqrt(np.diag(plain)[:-1] / plain[-1, -1] - (plain[-1, :-1] / plain[-1, -1]) ** 2)

    def model(self, *, block_rows=None, input_map=None) -> MechanicalModel:
        """Mass, damping and stiffness by the subspace identification, without going back to the record.

        Not refined, and without error bars: both need the samples. With several time constants the first of the
        grid that gives a physical model is taken, from the middle outwards.

        **Arguments:** `block_rows`: i up to that of the compression, default that; `input_map`: as for `identify`.

        **Returns:** a `MechanicalModel` in the record's units.

        **Raises:** `ComputationError` where the record cannot be compressed or gives no model.
        """
        inputs = self.pattern.inputs
        poles = jnp.asarray(self.poles)
        each = []
        for part in self.parts:
            factors, pivots = jax.vmap(lambda G: factor_of_gram(G, inputs, self.block_rows))(gram(part, poles))
            each.append(jnp.where((pivots > RANK_TOLERANCE)[:, None, None], factors, jnp.nan))
        grid = jax.vmap(lambda several: combine(several, inputs, self.block_rows))(jnp.stack(each, axis=1))
        return model_of_factors(
            grid, self.poles, self.pattern, self.scaling, self._sizes(), self.block_rows, block_rows, input_map
        )

    def save(self, path) -> None:
        """Write it to a NPZ file, which is whole or not there."""
        pattern = self.pattern
        told = {
            "names": [pattern.input_names, pattern.output_names],
            "units": [pattern.input_units, pattern.output_units],
            "hold": pattern.hold,
            "measured": pattern.measured,
            "sampling_time": pattern.sampling_time,
            "block_rows": self.block_rows,
            "samples": self.samples,
            "parts": len(self.parts),
        }
        arrays = {f"part{k}_{j}": leaf for k, m in enumerate(self.parts) for j, leaf in enumerate(_leaves(m))}
        sizes = {"inputs": self.scaling.inputs, "outputs": self.scaling.outputs}
        buffer = io.BytesIO()
        np.savez(buffer, told=json.dumps(told), level=self.level, poles=self.poles, **sizes, **arrays)
        write_whole(buffer.getvalue(), path)

    @classmethod
    def load(cls, path) -> "CompressedRecord":
        """Read what `save` wrote.

        **Raises:** `ValueError` where it is something else.
        """
        path = Path(path)
        check_file(path)
        with reading(path, "compressed record"):
            file = {name: stored.read() for name, stored in npz_members(path, KINDS + "U").items()}
            told = json.loads(str(file["told"]))
            pattern = pattern_of(
                told["names"], told["units"], told["hold"], tuple(told["measured"]), told["sampling_time"]
            )
            parts = tuple(Moments(*(jnp.asarray(file[f"part{k}_{j}"]) for j in range(3))) for k in range(told["parts"]))
            scaling = Scaling.of(file["inputs"], file["outputs"], told["sampling_time"], pattern.measured)
            return cls(pattern, scaling, file["level"], file["poles"], told["block_rows"], parts, told["samples"])


def model_of_factors(
    grid, poles, pattern: Record, scaling: Scaling, sizes, compressed_rows: int, block_rows=None, input_map=None
) -> MechanicalModel:
    """The model of the first time constant that gives a physical one, from the middle outwards.

    **Arguments:** `grid`: factor for each of the `poles`; `pattern`: channels and hold; `scaling` of the factors;
    `sizes`: standard deviation of every channel over all samples, relative to `scaling`; `compressed_rows`: i of the
    factors; `block_rows`: i to use, default that; `input_map`: as for `identify`.

    **Raises:** `ValueError` for block rows that are not there; `ComputationError` where there is no model.
    """
    i = compressed_rows if block_rows is None else int(block_rows)
    if not 3 <= i <= compressed_rows:
        raise ValueError(f"block_rows={block_rows} must lie between 3 and {compressed_rows}.")
    inputs, poles = pattern.inputs, jnp.asarray(poles)
    if not bool(jnp.any(jnp.all(jnp.isfinite(grid), axis=(1, 2)))):
        raise ComputationError(RESULTS.not_exciting, stage="compression", detail="its filtered copies are dependent")
    drive = drive_of(pattern, "force", input_map, False)
    # Channels are weighed by their size over all samples, not over the first chunk.
    grid = grid / jnp.tile(sizes, 2 * compressed_rows)
    scaling = Scaling.of(
        scaling.inputs * sizes[:inputs], scaling.outputs * sizes[inputs:], scaling.sampling_time, pattern.measured
    )
    scaled = drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    setting = Setting(scaled, pattern.measured, pattern.hold)
    found = candidates(
        grid,
        poles,
        jnp.asarray([float(i)]),
        None,
        inputs=inputs,
        padded=compressed_rows,
        weight=MOESP(),
        map=ExactMap(),
        measured=setting.measured,
        hold=setting.hold,
        householder=False,
    )
    matrices, usable, _ = physical_grid(found, setting)
    middle = sorted(np.flatnonzero(usable[:, 0]), key=lambda k: abs(k - (len(poles) - 1) / 2))
    if not middle:
        raise ComputationError(RESULTS.unstable_start, stage="subspace identification")
    M, D, K = scaling.matrices_out(*(X[middle[0], 0] for X in matrices))
    names = ("measured", "input_names", "output_names", "input_units", "output_units")
    return MechanicalModel(M, D, K, drive=drive, **{name: getattr(pattern, name) for name in names})


def _leaves(moments: Moments) -> tuple:
    return moments.states, moments.products, moments.plain


def pattern_of(names, units, hold, measured, sampling_time) -> Record:
    """Channels, units and hold of a record, as one of two samples."""
    two = [np.array([[0.0] * len(side), [1.0] * len(side)]) for side in names]
    return Record(
        *two,
        sampling_time,
        input_names=tuple(names[0]),
        output_names=tuple(names[1]),
        input_units=tuple(units[0]),
        output_units=tuple(units[1]),
        hold=hold,
        measured=measured,
    )


def compress(
    path,
    *,
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    sampling_time: float,
    time_constants=None,
    block_rows: int | None = None,
    hold: str = "zero",
    measured: str | Sequence[str] = "displacement",
    input_map=None,
    chunk_samples: int = CHUNK_SAMPLES,
) -> CompressedRecord:
    """Read a file once, chunk by chunk, and keep what the subspace identification needs of it.

    Memory does not grow with the file. The record need not start at rest, and sensors may have offsets.

    **Arguments:**

    - `path`: a NPY (mapped), Parquet or HDF5 file.
    - `inputs`, `outputs`: names of the columns, as for `read_record`.
    - `sampling_time`: time between rows [s].
    - `time_constants`: τ [s], one or several; default that which serves the first chunk best.
    - `block_rows`: the largest i wanted; default that which serves the first chunk best.
    - `hold`: "zero" (default) or "linear"; `measured`: as for `read_record`.
    - `input_map`: where forces act, for the choice of τ and i; as for `identify`.
    - `chunk_samples`: rows held at a time; default 65 536.

    **Returns:** a `CompressedRecord`.

    **Raises:** `ValueError` for arguments or data that cannot serve; `ComputationError` where the first chunk does not
    give a model, unless τ and i are given.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> table = np.array(list(zip(u, y[:, 0])), dtype=[("F", float), ("x", float)])
        >>> np.save("long.npy", table)
        >>> filters = {"time_constants": 0.05, "block_rows": 6}
        >>> found = jaxgray.compress("long.npy", inputs="F", outputs="x", sampling_time=0.01, **filters)
        >>> found.samples, round(float(found.model().mass[0, 0]), 1)
        (1000, 2.0)
    """
    ready()
    check_hold(hold)
    inputs = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    if chunk_samples < 1:
        raise ValueError(f"chunk_samples={chunk_samples} must be at least 1; the default is {CHUNK_SAMPLES}.")
    chunks = iter(read_chunks(path, inputs + outputs, chunk_samples=chunk_samples))
    first = next(chunks)
    if not np.all(np.isfinite(first)):
        raise ValueError(f"{path} has missing values; records with gaps are read whole, by read_record.")
    split = len(inputs)
    head = Record(
        first[:, :split],
        first[:, split:],
        sampling_time,
        input_names=inputs,
        output_names=outputs,
        hold=hold,
        measured=measured,
    )
    scaling = scaling_of([head])
    if time_constants is None or block_rows is None:
        time_constants, block_rows = best_choice(head, scaling, time_constants, block_rows, input_map)
    taus = np.unique(np.atleast_1d(np.asarray(time_constants, dtype=float)))
    if not np.all(taus > 0) or int(block_rows) < 3:
        raise ValueError(f"time_constants={time_constants} must be positive and block_rows={block_rows} at least 3.")
    poles = np.asarray(pole(taus, sampling_time))
    names, units = (head.input_names, head.output_names), (head.input_units, head.output_units)
    begun = CompressedRecord(
        pattern_of(names, units, hold, head.measured, head.sampling_time),
        scaling,
        head.y.mean(axis=0),
        poles,
        int(block_rows),
        (no_moments(jnp.asarray(poles), split + len(outputs), int(block_rows)),),
        0,
    )
    return begun.extended([first]).extended(chunks)


def best_choice(head: Record, scaling: Scaling, time_constants, block_rows, input_map):
    """τ and i that serve the first chunk best."""
    drive = drive_of(head, "force", input_map, False)
    scaled = drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    taus = default_time_constants(head) if time_constants is None else np.atleast_1d(time_constants)
    rows = usable_block_rows(head) if block_rows is None else (int(block_rows),)
    setting = Setting(scaled, head.measured, head.hold)
    options = StartOptions(taus, rows, MOESP(), ExactMap(), "factor", None)
    start = subspace_starts([prepare(head, scaling)], setting, scaling.sampling_time, options)[0]
    return start.time_constant if time_constants is None else time_constants, start.block_rows
