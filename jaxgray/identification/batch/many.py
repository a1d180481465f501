"""Many records, each of its own system: one model per record, all computed side by side."""

import dataclasses
import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
import scipy.special

from ...mechanics.systems.drives import AbstractDrive
from ...numerics.matrices.linear_algebra import triangle
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.runtime import ready, undisturbed
from ...numerics.programs.stored_programs import stored
from ...numerics.progress import AbstractProgress, Silent
from ...records import Record, check_compatible, on_one_grid
from ...records.joining import SAMPLING_TIME_TOLERANCE
from ..identify import identify
from ..initialization.start import POOR, StartOptions, filled, subspace_starts
from ..setup.options import drive_of, pick
from ..setup.padding import padded_samples
from ..setup.prediction import Setting
from ..setup.preparation import prepare, scaling_of
from ..setup.structure import structure_of
from ..setup.units import Scaling
from ..subspace.filter_bank import pole
from ..subspace.grid import default_time_constants, drives_every_coordinate, usable_block_rows
from ..subspace.projection import WEIGHTS
from ..subspace.realization import ExactMap
from .result import Identifications
from .stamped import fit_stamped
from .start import start_one
from .steps import LAGS, One, Refined, refine_one

CHUNK_SAMPLES = 2**15
"""Samples that one device takes at a time: what they need stays in cache, and the many small products of matrices take
longer than calling them."""

EDGE = 1e-4
"""Smallest eigenvalue, relative to the largest, under which an end may be a trap of the Cholesky factors."""


@undisturbed()
def identify_many(
    records: Sequence[Record],
    *,
    time_constants=None,
    block_rows=None,
    weight="moesp",
    input_map=None,
    structure=None,
    alone: bool = True,
    devices=None,
    progress: AbstractProgress | None = None,
) -> Identifications:
    """Mass, damping and stiffness of every record by itself, computed as batches.

    For specimens of one kind, repeated tests, Monte-Carlo runs: same channels, same sampling time, a system of its own
    behind each record. The subspace start and the prediction-error refinement are those of `identify`, taken side by
    side; what is left out are forced choices of method and the tests of `assess`. A record for which the batch gives no
    reliable model (no start, not settled, at the edge of what is physical, poor fit) is not reported as identified.

    **Arguments:**

    - `records`: two or more, of any lengths; outputs may have gaps, rows times of their own.
    - `time_constants`: τ [s] to try for every record, one or several; default that which serves the longest
        record best, its half and its double.
    - `block_rows`: i to try, one or several; default that which serves the longest record best.
    - `weight`: as for `identify`; default "moesp".
    - `input_map`: where forces act, as for `identify`; default input j on the coordinate of output j.
    - `structure`: any of "diagonal-mass", "chain", "modal-damping"; default none.
    - `alone`: identify the records that the batch does not finish one by one, by `identify` (default); otherwise
        they keep the batch's answer, marked as failed.
    - `devices`: devices that share the records; default all local ones.
    - `progress`: told of every stage; silent by default.

    **Returns:** an `Identifications`, with an outcome per record.

    **Raises:** `ValueError` for arguments or records that do not go together; `ComputationError` when no start can
    be found for the longest records.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.identify_many([record, record], time_constants=[0.05], block_rows=[6])
        >>> found.successful.tolist(), found.mass[:, 0, 0].round(1).tolist()
        ([True, True], [2.0, 2.0])
    """
    ready()
    progress = Silent() if progress is None else progress
    records = list(records)
    if not records or not all(isinstance(r, Record) for r in records):
        raise ValueError("records must be a non-empty list of Record; for one record use identify.")
    records = on_one_grid(records, SAMPLING_TIME_TOLERANCE)
    check_compatible(records)
    weight = pick("weight", weight, WEIGHTS)
    drive = drive_of(records[0], "force", input_map, False)
    form = structure_of(structure)
    devices = jax.local_devices() if devices is None else list(devices)

    progress.stage("preparing")

    def fit(uniform: list[Record]) -> Identifications:
        scalings, refused = _scalings(uniform)
        usable = [k for k in range(len(uniform)) if k not in refused]
        if not usable:
            raise next(iter(refused.values()))
        taus, rows = _choices([uniform[k] for k in usable], drive, time_constants, block_rows, weight)
        options = (taus, rows, weight, form, drives_every_coordinate(drive))
        found = _in_chunks(uniform, scalings, usable, drive, options, devices, progress)
        return _assembled(uniform, scalings, usable, refused, drive, found, taus, rows)

    result = fit_stamped(fit, records) if any(r.has_own_times for r in records) else fit(records)
    if alone:
        progress.stage("identifying what is left one by one")
        result = _finished(result, records, {"weight": weight, "input_map": input_map, "structure": structure})
    return result


def choices(
    records: Sequence[Record], *, time_constants=None, block_rows=None, weight=None, input_map=None
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Time constants [s] and block rows that `identify_many` would try for these records.

    Given back to it, they make what it finds for a record independent of the other records of the call.

    **Arguments:** as for `identify_many`; `weight`: default "moesp".

    **Raises:** `ComputationError` when no start can be found for the longest records.
    """
    weight = pick("weight", "moesp" if weight is None else weight, WEIGHTS)
    return _choices(list(records), drive_of(records[0], "force", input_map, False), time_constants, block_rows, weight)


def _scalings(records: list[Record]) -> tuple[dict[int, Scaling], dict[int, ComputationError]]:
    """Scaling of every record, and the failures of those that have none."""
    scalings, refused = {}, {}
    for k, record in enumerate(records):
        try:
            scalings[k] = scaling_of([record])
        except ComputationError as error:
            refused[k] = error
    return scalings, refused


def _setting(record: Record, scaling: Scaling, drive: AbstractDrive) -> Setting:
    scaled = drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    return Setting(scaled, record.measured, record.hold)


def _choices(records, drive, time_constants, block_rows, weight) -> tuple[np.ndarray, tuple[int, ...]]:
    """τ [s] and i to try: those given, or those that serve the longest record that can be started."""
    longest = sorted(records, key=lambda r: -r.samples)
    rows = usable_block_rows(min(records, key=lambda r: r.samples)) if block_rows is None else block_rows
    rows = np.unique(np.atleast_1d(np.asarray(rows, dtype=float)))
    if rows.size == 0 or np.any(rows != np.round(rows)) or np.any(rows < 3):
        raise ValueError(f"block_rows={block_rows} must be whole numbers of at least 3.")
    rows = tuple(int(i) for i in rows)
    shortest, needed = longest[-1].samples, 2 * max(rows) * (records[0].inputs + records[0].outputs + 1)
    if shortest <= needed:
        raise ComputationError(
            RESULTS.too_short,
            stage="subspace start",
            detail=f"{shortest} samples for {max(rows)} block rows, which need more than {needed}",
        )
    if time_constants is not None:
        taus = np.unique(np.atleast_1d(np.asarray(time_constants, dtype=float)))
        if taus.size == 0 or not np.all(np.isfinite(taus)) or np.any(taus <= 0):
            raise ValueError(f"time_constants={time_constants} must be positive; give one number or several, in s.")
        if block_rows is not None:
            return taus, rows
    failure = None
    for record in longest[:5]:
        scaling = scaling_of([record])
        grid = default_time_constants(record) if time_constants is None else taus
        try:
            start = subspace_starts(
                filled([record], scaling, None),
                _setting(record, scaling, drive),
                scaling.sampling_time,
                StartOptions(grid, rows, weight, ExactMap(), "factor", None),
            )[0]
        except ComputationError as error:
            failure = error
            continue
        best = start.time_constant
        return (np.array([best / 2, best, 2 * best]) if time_constants is None else taus), (start.block_rows,)
    raise failure


def _each(arrays, static, rows: tuple[int, ...], weight, every_coordinate: bool, gaps: bool):
    """Start and refinement of one record, and the place of its start in the grid."""
    one, setting, form, poles = eqx.combine(arrays, static)
    start, choice = start_one(one, setting, poles, rows, weight, every_coordinate=every_coordinate)
    return refine_one(start, one, setting, form, gaps=gaps), choice


@stored
def _side_by_side(stacked, static, rows, weight, every_coordinate, gaps):
    """A chunk on one device; kept on disk whole, since tracing it takes as long as many records do."""
    return jax.vmap(lambda arrays: _each(arrays, static, rows, weight, every_coordinate, gaps))(stacked)


@functools.cache
def _program(devices: tuple, rows: tuple[int, ...], weight, every_coordinate: bool, gaps: bool, static):
    """The compiled start and refinement of a chunk, its records spread over the devices."""
    if len(devices) == 1:

        def alone(stacked):
            return _side_by_side(jax.device_put(stacked, devices[0]), static, rows, weight, every_coordinate, gaps)

        return alone
    mesh = jax.sharding.Mesh(np.array(devices), ("records",))
    spec = jax.sharding.PartitionSpec("records")

    def one(arrays):
        return _each(arrays, static, rows, weight, every_coordinate, gaps)

    spread = jax.jit(jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    sharding = jax.sharding.NamedSharding(mesh, spec)
    return lambda stacked: spread(jax.device_put(stacked, sharding))


def _in_chunks(records, scalings, usable, drive, options, devices, progress) -> tuple[Refined, np.ndarray]:
    """`Refined` of every usable record, stacked, and the place of its start in the grid τ × i."""
    taus, rows, weight, form, every_coordinate = options
    gaps = any(records[k].has_missing for k in usable)
    padded = padded_samples(max(records[k].samples for k in usable))
    size = len(devices) * max(1, min(CHUNK_SAMPLES // padded, -(-len(usable) // len(devices))))

    def arrays(k):
        record = records[k]
        signals = filled([record], scalings[k], None)[0] if record.has_missing else prepare(record, scalings[k])
        pad = ((0, padded - signals.u.shape[0]), (0, 0))
        u, y, kept = (np.pad(np.asarray(x), pad) for x in (signals.u, signals.y, signals.kept))
        kept[: record.samples] = ~record.missing
        inside = (np.arange(padded) < record.samples).astype(float)
        poles = np.asarray(pole(taus, record.sampling_time))
        scaled = form.scaled(np.asarray(scalings[k].coordinates))
        return One(u, y, kept, inside), _setting(record, scalings[k], drive), scaled, poles

    def chunk(first):
        picked = usable[first : first + size]
        rows_of = [eqx.partition(arrays(k), eqx.is_array) for k in picked]
        dynamic, static = [d for d, _ in rows_of], rows_of[0][1]
        dynamic += dynamic[-1:] * (size - len(picked))
        program = _program(tuple(devices), rows, weight, every_coordinate, gaps, static)
        stacked = jax.tree_util.tree_map(lambda *leaves: np.stack(leaves), *dynamic)
        return program(stacked)

    # One after the other: two programs with batches of decompositions at once may wait for ever
    # (`numerics.programs.backend`).
    parts = []
    for first in range(0, len(usable), size):
        progress.stage("identifying", fraction=first / len(usable))
        parts.append(chunk(first))
    joined = jax.tree_util.tree_map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves]), *parts)
    return jax.tree_util.tree_map(lambda leaf: leaf[: len(usable)], joined)


def _assembled(records, scalings, usable, refused, drive, found, taus, rows) -> Identifications:
    """Results in the records' units; what was refused or went astray is not a number and said."""
    refined, choice = found
    count, outputs = len(records), records[0].outputs
    r, c = triangle(outputs)
    entries = 3 * len(r)
    matrices = np.full((3, count, outputs, outputs), np.nan)
    covariance = np.full((count, entries, entries), np.nan)
    rmse, white = np.full((count, outputs), np.nan), np.zeros(count, bool)
    results, details = [RESULTS.nonfinite] * count, [""] * count
    taken = np.zeros(count, int)
    where = np.full((count, 2), np.nan)
    for k, error in refused.items():
        results[k], details[k] = error.result, str(error)
    limit = scipy.special.chdtri(LAGS, 0.01 / outputs)
    one = np.ones((outputs, outputs))
    for place, k in enumerate(usable):
        units = np.array([np.asarray(X) for X in scalings[k].matrices_out(one, one, one)])
        matrices[:, k] = np.array([X[place] for X in refined.matrices]) * units
        scale = units[:, r, c].ravel()
        covariance[k] = refined.covariance[place] * scale[:, None] * scale[None, :]
        rmse[k] = np.sqrt(refined.deviation[place]) * np.asarray(scalings[k].outputs)
        white[k] = bool(np.all(refined.portmanteau[place] < limit))
        taken[k] = refined.steps[place]
        where[k] = taus[choice[place] // len(rows)], rows[choice[place] % len(rows)]
        results[k], details[k] = _outcome(refined, place)
    level = np.array([np.nanstd(record.y, axis=0) for record in records])
    return Identifications(
        *matrices,
        covariance,
        100 * (1 - rmse / np.where(level > 0, level, np.nan)),
        rmse,
        white,
        tuple(results),
        tuple(details),
        np.zeros(count, bool),
        taken,
        where[:, 0],
        where[:, 1],
        drive,
        records[0].measured,
        records[0].input_names,
        records[0].output_names,
        records[0].input_units,
        records[0].output_units,
    )


def _outcome(refined: Refined, place: int) -> tuple[RESULTS, str]:
    """What the batch makes of a record, and why it is not an answer."""
    if not all(np.all(np.isfinite(X[place])) for X in refined.matrices):
        return RESULTS.unstable_start, "no usable start"
    if not refined.settled[place]:
        return RESULTS.refinement_diverged, f"not settled after {int(refined.steps[place])} steps"
    if not np.all(np.isfinite(refined.covariance[place])):
        return RESULTS.nonfinite, "no finite covariance"
    if refined.least_eigenvalue[place] < EDGE:
        return RESULTS.refinement_diverged, "at the edge of what is physical"
    if not np.all(refined.deviation[place] < POOR):
        return RESULTS.refinement_diverged, "a poor fit, perhaps a local optimum"
    return RESULTS.successful, ""


def _finished(result: Identifications, records: list[Record], options: dict) -> Identifications:
    """The records that the batch left, by `identify`."""
    left = [k for k, outcome in enumerate(result.results) if outcome != RESULTS.successful]
    if not left:
        return result
    copies = {
        name: np.array(getattr(result, name))
        for name in ("mass", "damping", "stiffness", "covariance", "fit_percent", "rmse", "white", "alone")
    }
    results, details = list(result.results), list(result.details)
    for k in left:
        copies["alone"][k] = True
        try:
            found = identify(records[k], **options)
        except ComputationError as error:
            results[k], details[k] = error.result, str(error)
            for name in ("mass", "damping", "stiffness", "covariance", "fit_percent", "rmse"):
                copies[name][k] = np.nan
            continue
        for name in ("mass", "damping", "stiffness", "covariance"):
            copies[name][k] = getattr(found, name)
        copies["fit_percent"][k] = list(found.fit_percent["estimation"].values())
        copies["rmse"][k] = list(found.rmse["estimation"].values())
        copies["white"][k] = found.residual_test.white
        results[k], details[k] = found.refinement.result, "; ".join(found.warnings)
        if not np.all(copies["fit_percent"][k] > 100 * (1 - np.sqrt(POOR))):
            results[k] = RESULTS.refinement_diverged
    return dataclasses.replace(result, **copies, results=tuple(results), details=tuple(details))
