"""Starting models: subspace and regression, judged alike by free-run simulation."""

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import Force
from ...numerics.matrices.linear_algebra import project_positive
from ...numerics.matrices.positive import ClarabelSolver
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.stored_programs import ONCE, stored
from ...records import Record
from ..setup.prediction import Setting, best_run
from ..setup.preparation import Signals, prepare
from ..setup.units import Scaling
from ..subspace.filter_bank import pole
from ..subspace.grid import candidates, drives_every_coordinate, record_factors, score
from ..subspace.input_matrix import InputFit, fit_to_record
from ..subspace.physical import from_inverse_mass, input_matrix, jointly
from ..subspace.projection import AbstractWeight
from ..subspace.realization import AbstractMap, Realization
from .base_start import MassKnowledge, modes_under_base
from .regression import regress, regression_time_constants

BASIS_LIMIT = 1e10
MOST_CELLS = 5
"""Cells of the grid that are carried on where the first does not serve."""

THOROUGH_CELLS = 14
"""The same where the start is the end: cells that simulate alike differ in M, D, K, and the record says which to take
only once B₂ is fitted to it."""

SMALL = 9
"""Entries of B₂ up to which that fit costs next to nothing."""

POOR = 0.3
"""Share of an output's power left by a start above which others are tried too."""

LOST = 0.7
"""How much less likely per output sample than its cell a start may be, logarithms, for no other to be tried: half of
the logarithm of a power four times as large."""

REACH_LIMIT = 1e-11


@dataclass(frozen=True)
class Start:
    """A starting model in scaled coordinates.

    `matrices`: M, D, K; `deviation`: mean square free-run residual per output; `method`: "subspace",
    "regression" or "modal"; `time_constant` [s], None for modal; `block_rows`; `singular_values` of the projection;
    `table`: score of every (τ, i) tried; `grid`: those τ [s] and i.
    """

    matrices: tuple[Array, Array, Array]
    deviation: Float[np.ndarray, " outputs"]
    method: str
    time_constant: float | None
    block_rows: int | None
    singular_values: Float[np.ndarray, " values"] | None
    table: Float[np.ndarray, "time_constants choices"] | None
    grid: tuple[tuple[float, ...], tuple[int, ...]] | None = None

    @property
    def score(self) -> float:
        """Likelihood of the free run, −∞ where it is unstable."""
        return float(score(np.asarray(self.deviation)))

    @property
    def serves(self) -> bool:
        """Whether the free run is near enough to the record for one refinement to find the optimum."""
        return bool(np.all(self.deviation < POOR))


@dataclass(frozen=True)
class StartOptions:
    """How a start is looked for.

    `time_constants` [s] and `block_rows` to try; `weight`; `map`; `input_matrix_from`: "record" (regression on
    simulated responses), "factor" (the paper's step 6), or "best" (both, judged by free run); `known_mass`: scaled,
    or None; `thorough`: whether no refinement follows, so that the best of many cells is looked for; `mass`: what is
    known of it under base excitation, None for forces.
    """

    time_constants: Float[np.ndarray, " time_constants"]
    block_rows: tuple[int, ...]
    weight: AbstractWeight
    map: AbstractMap
    input_matrix_from: str
    known_mass: Array | None
    thorough: bool = False
    mass: MassKnowledge | None = None


@stored
def model_run(
    matrices: tuple[Array, Array, Array], setting: Setting, signals: Signals
) -> tuple[Float[Array, "samples outputs"], Float[Array, " outputs"]]:
    """Free run with the best initial state and offsets, and its mean square residual per output."""
    return best_run(setting.system(*matrices), signals)


def total_deviation(matrices, setting: Setting, signals: list[Signals]) -> np.ndarray:
    """Mean square free-run residual per output over all records."""
    parts = [np.asarray(model_run(matrices, setting, s)[1]) for s in signals]
    weights = [np.sum(np.asarray(s.kept), axis=0) for s in signals]
    return np.sum([p * w for p, w in zip(parts, weights)], axis=0) / np.sum(weights, axis=0)


def physical_model(
    realization: Realization, fit: InputFit, setting: Setting, known_mass: Array | None, averaged: bool = False
) -> tuple[Array, Array, Array]:
    """M, D, K (scaled) of a realisation, by the problem that the drive allows, on the host.

    `averaged`: as of `from_inverse_mass`, where that is the problem.

    **Raises:** `ComputationError` where an input does not reach every coordinate, or a problem has no solution.
    """
    realization, fit, known_mass = jax.device_get((realization, fit, known_mass))
    try:
        with np.errstate(all="ignore"):
            return _physical_model(realization, fit, setting, known_mass, averaged)
    except np.linalg.LinAlgError as error:
        raise ComputationError(RESULTS.semidefinite_solver, stage="physical parameters", detail=str(error)) from error


def _physical_model(realization, fit, setting, known_mass, averaged):
    solver = ClarabelSolver()
    if isinstance(setting.drive, Force) and known_mass is None:
        E = np.asarray(setting.drive.input_map)
        if drives_every_coordinate(setting.drive):
            return from_inverse_mass(realization, fit, E, solver, averaged=averaged)
        B2 = input_matrix(fit).reshape(E.shape)
        matrices, reach = jointly(realization, (B2, E), solver)
        if not float(reach) > REACH_LIMIT:
            raise ComputationError(
                RESULTS.unreachable, stage="physical parameters", detail=f"relative reach {float(reach):.1e}"
            )
        return matrices
    return jointly(realization, None, solver, known_mass)[0]


@stored(level=ONCE)
def _record_fit(realization, signals, weights, setting):
    return fit_to_record(
        realization,
        signals.u,
        signals.y,
        signals.kept * weights,
        measured=setting.measured,
        hold=setting.hold,
    )


def subspace_starts(
    signals: list[Signals], setting: Setting, sampling_time: float, options: StartOptions
) -> list[Start]:
    """Subspace models from a grid of time constants and block rows, best first.

    One where the best cell serves and a refinement follows; where the model of a cell simulates poorly, or much worse
    than the cell (its damping, say, was cut off at the edge of what is physical), those of the next cells too.

    **Arguments:** `signals`: scaled records; `setting`; `sampling_time` [s]; `options`.

    **Returns:** one or more `Start`s.

    **Raises:** `ComputationError` when no choice gives a usable model.
    """
    padded = max(options.block_rows)
    poles = pole(np.asarray(options.time_constants), sampling_time)
    factor_grid, householder = record_factors(signals, poles, padded)
    longest = max(signals, key=lambda s: s.samples)
    found = candidates(
        factor_grid,
        poles,
        np.asarray(options.block_rows, float),
        longest,
        inputs=longest.u.shape[1],
        padded=padded,
        weight=options.weight,
        map=options.map,
        measured=setting.measured,
        hold=setting.hold,
        householder=householder,
        base=None if isinstance(setting.drive, Force) else setting.drive,
    )
    table = score(found.deviation)
    if not np.any(np.isfinite(table)):
        raise _why_none(found)
    order = np.argsort(-table, axis=None)[: int(np.isfinite(table).sum())]
    failure = None
    starts: list[Start] = []
    # M⁻¹ from B₂ alone may be had in two ways.
    alone = options.known_mass is None and drives_every_coordinate(setting.drive)
    ways = (False, True) if alone else (False,)
    small = len(setting.measured) * longest.u.shape[1] <= SMALL
    many = options.thorough and small and options.mass is None
    for flat in order[: THOROUGH_CELLS if many else MOST_CELLS]:
        index = np.unravel_index(flat, table.shape)
        chosen = jax.tree_util.tree_map(lambda leaf, index=index: np.asarray(leaf[index]), found)
        best = None
        for physical in _physical_ways(chosen, signals, setting, options, ways):
            try:
                matrices = physical()
            except ComputationError as error:
                failure = error
                continue
            here = Start(
                matrices,
                total_deviation(matrices, setting, signals),
                "subspace",
                float(options.time_constants[index[0]]),
                int(options.block_rows[index[1]]),
                chosen.realization.singular_values,
                table,
                (tuple(np.asarray(options.time_constants, float).tolist()), options.block_rows),
            )
            if np.isfinite(here.score) and (best is None or here.score > best.score):
                best = here
        if best is not None:
            starts.append(best)
            if best.serves and not options.thorough and best.score > table[index] - LOST:
                break
    if not starts:
        raise failure or ComputationError(RESULTS.unstable_start, stage="subspace start")
    return sorted(starts, key=lambda start: -start.score)


def _physical_ways(chosen, signals: list[Signals], setting: Setting, options: StartOptions, ways) -> list[Callable]:
    """Ways from a cell to M, D, K; each raises `ComputationError` where it finds none."""
    if options.mass is not None:
        realization = jax.device_get(chosen.realization)

        by_modes = partial(modes_under_base, realization, chosen.deviation, signals, setting, options.mass)
        return [by_modes, partial(physical_model, realization, chosen.fit, setting, options.known_mass)]
    fits = _input_fits(chosen, signals, setting, options.input_matrix_from)
    pairs = itertools.product(fits, ways)
    return [partial(physical_model, chosen.realization, fit, setting, options.known_mass, way) for fit, way in pairs]


def _input_fits(chosen, signals: list[Signals], setting: Setting, source: str) -> list[InputFit]:
    """The least squares for B₂ that `source` names."""
    fits = [chosen.fit] if source != "record" else []
    if source != "factor":
        spread = np.sqrt(np.maximum(chosen.deviation, 1e-24))
        weights = np.exp(np.mean(np.log(spread))) / spread
        parts = jax.device_get([_record_fit(chosen.realization, s, weights, setting) for s in signals])
        stacked = InputFit(np.concatenate([p.factor for p in parts]), np.concatenate([p.target for p in parts]))
        fits.append(stacked)
    return fits


def _why_none(found) -> ComputationError:
    """Which failure made every choice of the grid unusable."""
    condition = np.asarray(found.realization.basis_condition)
    values = np.asarray(found.realization.singular_values)
    states = found.realization.A_lambda.shape[-1]
    last = values[..., states - 1] / values[..., 0]
    if not np.any(last > 1e-12):
        return ComputationError(RESULTS.order_not_found, stage="subspace start")
    if not np.any(condition < BASIS_LIMIT):
        return ComputationError(RESULTS.singular_state_basis, stage="subspace start")
    if not np.any(np.isfinite(np.asarray(found.realization.A21))):
        return ComputationError(RESULTS.negative_real_pole, stage="subspace start")
    return ComputationError(RESULTS.unstable_start, stage="subspace start")


def regression_start(
    signals: list[Signals],
    setting: Setting,
    time_constants: Float[np.ndarray, " time_constants"],
    sampling_time: float,
    first: Start | None = None,
) -> Start:
    """The best regression model over time constants, with simulated outputs as instruments where they serve.

    **Arguments:** as for `subspace_starts`; `time_constants` [s] of its grid; `first`: a model whose free run serves as
    instruments.

    **Returns:** a `Start`.

    **Raises:** `ComputationError` when no time constant gives a finite model.
    """
    E = setting.drive.input_map
    best = None
    for tau in regression_time_constants(time_constants, sampling_time):
        matrices = first.matrices if first is not None else None
        for _ in range(3):
            instruments = None
            if matrices is not None:
                runs = [model_run(matrices, setting, s) for s in signals]
                if all(np.all(np.isfinite(np.asarray(run))) and np.min(np.asarray(dev)) < 0.5 for run, dev in runs):
                    instruments = [run for run, _ in runs]
            try:
                matrices = regress(signals, instruments, E, float(tau), measured=setting.measured, hold=setting.hold)
            except ComputationError:
                break
            deviation = total_deviation(matrices, setting, signals)
            here = Start(matrices, deviation, "regression", float(tau * sampling_time), None, None, None)
            if np.isfinite(here.score) and (best is None or here.score > best.score):
                best = here
            if instruments is None and not np.all(deviation < 0.5):
                break
    if best is None:
        raise ComputationError(RESULTS.unstable_start, stage="regression start")
    return best


def filled(records: list[Record], scaling: Scaling, runs: list[np.ndarray] | None) -> list[Signals]:
    """Signals with missing outputs filled: by interpolation, or by a free run (scaled) where there is one."""
    result = []
    for k, record in enumerate(records):
        y = np.array(record.y)
        for column in range(y.shape[1]):
            missing = ~np.isfinite(y[:, column])
            if not np.any(missing):
                continue
            if runs is None:
                known = np.flatnonzero(~missing)
                y[missing, column] = np.interp(np.flatnonzero(missing), known, y[known, column])
            else:
                size = float(scaling.outputs[column])
                level = np.nanmean(record.y[:, column])
                y[missing, column] = np.asarray(runs[k])[: len(y), column][missing] * size + level
        result.append(prepare(dataclasses.replace(record, y=y), scaling))
    return result


def nearest_physical(matrices: tuple[Array, Array, Array]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same matrices, symmetric and positive semidefinite, on the host."""
    return tuple(project_positive((X + X.T) / 2) for X in map(np.asarray, matrices))
