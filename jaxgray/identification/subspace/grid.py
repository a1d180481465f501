"""Time constant τ × block rows i: every choice from one factor per τ, scored by free-run simulation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import AbstractDrive, Force
from ...mechanics.systems.statespace import StateSpace, sampled
from ...numerics.matrices.namespace import namespace
from ...numerics.programs.stored_programs import ONCE, stored
from ...records import Record
from ..setup.prediction import best_run
from ..setup.preparation import Signals
from .compression import RANK_TOLERANCE, combine, factors
from .input_matrix import InputFit, fit_to_factor, unit_drives
from .physical import input_matrix
from .projection import AbstractWeight, arrange, project
from .realization import AbstractMap, Realization, realize

DEFAULT_BLOCK_ROWS = (4, 6, 8, 10)
DEFAULT_TIME_CONSTANTS = 10


class Candidate(eqx.Module):
    """One start: the realisation, the least squares for B₂, and how far its free run is from the record.

    `deviation`: mean square of the free-run residual per output, scaled outputs; not finite where the
    simulation is unstable.
    """

    realization: Realization
    fit: InputFit
    deviation: Float[Array, " outputs"]


def default_time_constants(record: Record, count: int = DEFAULT_TIME_CONSTANTS) -> Float[np.ndarray, " time_constants"]:
    """Logarithmic grid of τ [s], from two samples to the slowest motion that the record shows.

    The slowest motion is taken from the outputs' spectra: the frequency below which half of the power lies,
    but no slower than a twentieth of the record.

    **Arguments:** `record`; `count`: how many.

    **Returns:** τ, ascending.
    """
    y = np.nan_to_num(record.y - np.nanmean(record.y, axis=0))
    power = np.abs(np.fft.rfft(y * np.hanning(len(y))[:, None], axis=0)) ** 2
    power = np.cumsum(np.mean(power / np.sum(power, axis=0), axis=1))
    line = max(1, int(np.searchsorted(power, 0.5)))
    slowest = len(y) * record.sampling_time / (2 * np.pi * line)
    low = 2 * record.sampling_time
    high = np.clip(slowest, 20 * record.sampling_time, record.duration / 20)
    return np.geomspace(low, max(high, 2 * low), count)


def record_factors(
    signals: list[Signals], poles: Float[Array, " time_constants"], block_rows: int
) -> tuple[Float[Array, "time_constants columns columns"], bool]:
    """Factors of one or several records for every pole.

    Where the rows are dependent for most poles (hardly any noise), all are done by Householder QR. Where only a
    few poles make them so, these poles are far off: their factors are not a number, and they are passed over.

    **Returns:** the factors, and whether Householder QR was used.
    """
    inputs = signals[0].u.shape[1]

    def parts_by(householder: bool):
        options = {"inputs": inputs, "block_rows": block_rows, "householder": householder}
        return [_factors(poles, s.u, s.y, np.asarray(s.samples), **options) for s in signals]

    parts = parts_by(householder=False)
    usable = np.all([np.asarray(pivot) > RANK_TOLERANCE for _, pivot in parts], axis=0)
    householder = bool(np.sum(usable) <= len(usable) / 2)
    if householder:
        parts = parts_by(householder=True)
        usable[:] = True
    return _combined([factor for factor, _ in parts], usable, inputs, block_rows), householder


@stored
def _factors(poles, u, y, samples, **options):
    inside = (jnp.arange(len(u)) < samples).astype(u.dtype)
    return factors(poles, jnp.concatenate([u, y], axis=1), inside, **options)


@stored(level=ONCE)
def _combined(parts, usable, inputs, block_rows):
    grid = jax.vmap(lambda several: combine(several, inputs, block_rows))(jnp.stack(parts, axis=1))
    return jnp.where(usable[:, None, None], grid, jnp.nan)


def candidate(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    block_rows: Float[Array, ""],
    signals: Signals | None,
    **static,
) -> Candidate:
    """Realisation, input matrix and free-run deviation (best first state and offsets) of one (τ, i), in traced code.

    **Arguments:** `signals`: what the free run is held against, or None for none; the rest as for `realized`.

    **Returns:** a `Candidate`.
    """
    found, system = realized(factor, a, block_rows, **static)
    return found if signals is None else with_deviation(found, best_run(system, signals)[1])


def with_deviation(found: Candidate, deviation) -> Candidate:
    """A candidate with how far its free run is from the record."""
    return Candidate(found.realization, found.fit, deviation)


def realized(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    block_rows: Float[Array, ""],
    *,
    inputs: int,
    padded: int,
    weight: AbstractWeight,
    map: AbstractMap,
    measured: tuple[str, ...],
    hold: str,
    householder: bool,
    base: AbstractDrive | None = None,
) -> tuple[Candidate, StateSpace]:
    """Realisation and input matrix of one (τ, i), in traced code.

    **Arguments:** `factor` of the record; `a`: filter pole; `block_rows`: i ≤ `padded`; `base`: the scaled drive where
    it is the motion of the base, whose response follows from M⁻¹D and M⁻¹K alone; the rest static.

    **Returns:** a `Candidate` whose free run is still to be made, and the system to make it with.
    """
    data = arrange(factor, a, block_rows, inputs, padded)
    projections = project(data, weight, 2 * len(measured), householder=householder)
    realization = realize(projections, a, measured, map)
    drives = unit_drives(realization, measured, hold)
    fit = fit_to_factor(drives, data)
    B2 = input_matrix(fit).reshape(len(measured), inputs)
    Ad, Bd, C, Dd = drives
    found = Candidate(realization, fit, jnp.full(len(measured), jnp.nan))
    if base is not None:
        continuous = base.state_space(jnp.eye(len(measured)), -realization.A22, -realization.A21, measured, 1.0)
        return found, sampled(continuous, 1.0, hold)
    return found, StateSpace(Ad, Bd @ B2, C, Dd @ B2)


@stored
def _over_block_rows(factor_grid, poles, k, block_rows, **static):
    return jax.vmap(lambda i: realized(factor_grid[k], poles[k], i, **static))(block_rows)


# Apart, so that a record of another length does not compile the realisations again.
@stored
def _deviations(systems, signals):
    return jax.vmap(lambda system: best_run(system, signals)[1])(systems)


def candidates(
    factor_grid: Float[Array, "time_constants columns columns"],
    poles: Float[Array, " time_constants"],
    block_rows: Float[Array, " choices"],
    signals: Signals | None,
    **static,
) -> Candidate:
    """`candidate` over the grid τ × i, on the host; the leading axes of the result are the grid's.

    Two compiled programs serve every τ, the second started when the first has ended. The loop over τ stays on the host,
    one after the other: a traced loop gains nothing, and two programs with batches of small decompositions at once can
    wait for each other's threads without end (see `numerics.programs.backend`).
    """

    def at(k):
        found, systems = jax.block_until_ready(_over_block_rows(factor_grid, poles, k, block_rows, **static))
        return jax.device_get(found if signals is None else with_deviation(found, _deviations(systems, signals)))

    return jax.tree_util.tree_map(lambda *parts: np.stack(parts), *(at(np.asarray(k)) for k in range(len(poles))))


def score(deviation: Float[Array, "*grid outputs"]) -> Float[Array, "*grid"]:
    """−½ Σ ln deviation over outputs: the likelihood of the free run; −∞ where it is unstable."""
    xp = namespace(deviation)
    value = -0.5 * xp.sum(xp.log(xp.maximum(deviation, 1e-300)), axis=-1)
    return xp.where(xp.all(xp.isfinite(deviation), axis=-1), value, -xp.inf)


def usable_block_rows(record: Record, choices=DEFAULT_BLOCK_ROWS) -> tuple[int, ...]:
    """The choices that the number of outputs needs and the record's length allows."""
    outputs, inputs = record.outputs, record.inputs
    least = 3
    most = max(least, (record.samples // 3) // (2 * (inputs + outputs) + 2))
    return tuple(sorted({int(np.clip(i, least, most)) for i in choices}))


def drives_every_coordinate(drive: AbstractDrive) -> bool:
    """Whether forces act on every coordinate, so that B₂ determines the mass by itself."""
    if not isinstance(drive, Force):
        return False
    E = np.asarray(drive.input_map)
    return bool(np.linalg.matrix_rank(E) == E.shape[0])
