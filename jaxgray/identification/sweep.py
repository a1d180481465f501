"""The table over time constant τ × block rows i: what the subspace start alone makes of every choice."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..numerics.data_frames import data_frame
from ..numerics.matrices.linear_algebra import triangle
from ..numerics.notebook import Shown
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.programs.runtime import ready, undisturbed
from ..numerics.progress import AbstractProgress, Silent
from ..records import Record, check_compatible, records_of
from .initialization.physical_grid import physical_grid
from .initialization.start import filled, model_run
from .setup.options import drive_of, pick
from .setup.prediction import Setting
from .setup.preparation import Signals, prepare, scaling_of
from .setup.units import Scaling
from .standing import uniform_records
from .subspace.filter_bank import pole
from .subspace.grid import candidates, default_time_constants, record_factors, usable_block_rows
from .subspace.projection import WEIGHTS
from .subspace.realization import MAPS

SPACINGS = ("logarithmic", "linear")
DEFAULT_COUNT = 10
GROWTH = 30.0
"""Logarithm of what a realised model may grow by over the record before it counts as unstable."""


@dataclass(frozen=True, eq=False)
class Sweep(Shown):
    """The subspace start for every time constant τ × block rows i, judged by free-run simulation.

    `time_constants` [s], `block_rows`: the axes; `fit_percent` and, with held-out records,
    `validation_fit_percent`: τ × i × outputs, NaN where a choice gives no stable model; `mass`, `damping`,
    `stiffness`: τ × i × dofs × dofs in the record's units, NaN likewise; `unstable`: how many choices realise
    a model that grows without bound; `failed`: how many gave no model at all; `output_names`.
    """

    time_constants: Float[np.ndarray, " time_constants"]
    block_rows: Int[np.ndarray, " choices"]
    fit_percent: Float[np.ndarray, "time_constants choices outputs"]
    validation_fit_percent: Float[np.ndarray, "time_constants choices outputs"] | None
    mass: Float[np.ndarray, "time_constants choices dofs dofs"]
    damping: Float[np.ndarray, "time_constants choices dofs dofs"]
    stiffness: Float[np.ndarray, "time_constants choices dofs dofs"]
    unstable: int
    failed: int
    output_names: tuple[str, ...]

    @property
    def judged_by(self) -> Float[np.ndarray, "time_constants choices outputs"]:
        """The fit that decides: held out where there is such a record."""
        return self.fit_percent if self.validation_fit_percent is None else self.validation_fit_percent

    @property
    def best_index(self) -> tuple[int, int]:
        """Place (τ, i) of the best choice: least sum over outputs of ln(100 − fit)."""
        left = np.sum(np.log(np.maximum(100.0 - self.judged_by, 1e-12)), axis=2)
        row, column = np.unravel_index(np.nanargmin(left), left.shape)
        return int(row), int(column)

    @property
    def best(self) -> dict:
        """The best choice: `time_constant`, `block_rows`, the fits, and `mass`, `damping`, `stiffness`."""
        k = self.best_index
        return {
            "time_constant": float(self.time_constants[k[0]]),
            "block_rows": int(self.block_rows[k[1]]),
            "fit_percent": self.fit_percent[k],
            "validation_fit_percent": None if self.validation_fit_percent is None else self.validation_fit_percent[k],
            "mass": self.mass[k],
            "damping": self.damping[k],
            "stiffness": self.stiffness[k],
        }

    def to_dataframe(self):
        """The table as a pandas `DataFrame`, one row a choice.

        **Returns:** `time_constant` [s], `block_rows`; `fit_percent_y1`, …, with held-out records
        `fit_percent_y1_validation`, …; `mass[0,0]`, …: NaN where a choice gave no stable model.

        **Raises:** `ImportError` without pandas.
        """
        fits = {"": self.fit_percent, "_validation": self.validation_fit_percent}
        entries = [
            (name, r, c) for name in ("mass", "damping", "stiffness") for r, c in zip(*triangle(self.mass.shape[2]))
        ]
        return data_frame(
            [
                {"time_constant": float(tau), "block_rows": int(i)}
                | {
                    f"fit_percent_{output}{kind}": float(fit[j, k, o])
                    for kind, fit in fits.items()
                    if fit is not None
                    for o, output in enumerate(self.output_names)
                }
                | {f"{name}[{r},{c}]": float(getattr(self, name)[j, k, r, c]) for name, r, c in entries}
                for j, tau in enumerate(self.time_constants)
                for k, i in enumerate(self.block_rows)
            ]
        )

    def __repr__(self) -> str:
        where = "estimation" if self.validation_fit_percent is None else "held-out"
        worst = np.min(self.judged_by, axis=2)
        head = ["τ [s]", *(f"i = {i}" for i in self.block_rows)]
        rows = [
            [f"{tau:.4g}", *("–" if np.isnan(v) else f"{v:.2f}" for v in line)]
            for tau, line in zip(self.time_constants, worst)
        ]
        row, column = self.best_index
        rows[row][column + 1] += "*"
        width = [max(len(line[k]) for line in [head, *rows]) for k in range(len(head))]
        lines = ["  ".join(text.rjust(w) for text, w in zip(line, width)) for line in [head, *rows]]
        best = self.best
        return "\n".join(
            [
                f"Sweep: fit on the {where} record in %, worst output of {', '.join(self.output_names)}",
                *("  " + line for line in lines),
                f"  best (*): τ = {best['time_constant']:.4g} s, i = {best['block_rows']}; {self.missing}",
            ]
        )

    @property
    def missing(self) -> str:
        """How many choices gave no usable model, in words."""
        cells = len(self.time_constants) * len(self.block_rows)
        return f"{self.unstable} of {cells} choices unstable, {self.failed} without a model"


@undisturbed()
def sweep(
    record: Record | list[Record],
    time_constants=None,
    block_rows=None,
    *,
    validation: Record | list[Record] | None = None,
    spacing: str = "logarithmic",
    weight="moesp",
    map="exact",
    excitation: str = "force",
    input_map=None,
    relative: bool = False,
    progress: AbstractProgress | None = None,
) -> Sweep:
    """Every time constant × block rows from one factor per time constant, without refinement.

    **Arguments:**

    - `record`: one record, or several of the same system. A record of rows at times of their own is identified first;
      the sweep then uses the uniform record that this model gives in its place.
    - `time_constants`: τ [s], one or several; default ten from the record.
    - `block_rows`: i, one or several; default 4, 6, 8, 10 as the record allows.
    - `validation`: records that are simulated but not used; default none.
    - `spacing`: of the default time constants, "logarithmic" (default) or "linear" (the paper's search).
    - `weight`: "moesp" (default), "n4sid", "cva", "past-inputs", or a weight object.
    - `map`: "exact" (default) or "paper", from the λ-operator to continuous time.
    - `excitation`, `input_map`, `relative`: as for `identify`.
    - `progress`: told of every stage; silent by default.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` for arguments or data that cannot serve; `ComputationError` when no choice gives
    a stable model.

    **Reference:** Olofsson et al., section on the choice of λ-parameters.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.sweep(record, time_constants=[0.05, 0.1], block_rows=[4, 6])
        >>> found.mass.shape
        (2, 2, 1, 1)
        >>> bool(np.all(found.best["fit_percent"] > 99))
        True
    """
    ready()
    progress = Silent() if progress is None else progress
    records = records_of(record, "record")
    held_out = [] if validation is None else records_of(validation, "validation")
    asked = {"excitation": excitation, "input_map": input_map, "relative": relative}
    records, held_out = uniform_records(records, held_out, progress, **asked)
    check_compatible(records + held_out)
    weight, map = pick("weight", weight, WEIGHTS), pick("map", map, MAPS)
    drive = drive_of(records[0], excitation, input_map, relative)
    longest = max(records, key=lambda r: r.samples)
    taus = _time_constants(time_constants, spacing, longest)
    rows = _block_rows(block_rows, longest)

    progress.stage("preparing")
    scaling = scaling_of(records)
    setting = Setting(
        drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time),
        records[0].measured,
        records[0].hold,
    )
    signals = [prepare(r, scaling) for r in records]
    unseen = [prepare(r, scaling) for r in held_out]
    complete = filled(records, scaling, None) if any(r.has_missing for r in records) else signals

    def table(data: list[Signals]):
        progress.stage("compressing")
        poles = pole(jnp.asarray(taus), scaling.sampling_time)
        factor_grid, householder = record_factors(data, poles, max(rows))
        progress.stage("realising")
        found = candidates(
            factor_grid,
            poles,
            jnp.asarray(rows, float),
            None,
            inputs=longest.inputs,
            padded=max(rows),
            weight=weight,
            map=map,
            measured=setting.measured,
            hold=setting.hold,
            householder=householder,
        )
        progress.stage("simulating")
        return _cells(found, setting, signals)

    matrices, deviation, failed = table(complete)
    if complete is not signals and np.isfinite(deviation).any():
        # Gaps filled by the best model's own run leave less of the interpolation in the second table.
        k = np.unravel_index(np.nanargmin(np.sum(np.log(deviation), axis=2)), failed.shape)
        best = tuple(jnp.asarray(X[k]) for X in matrices)
        runs = [model_run(best, setting, s)[0] for s in complete]
        matrices, deviation, failed = table(filled(records, scaling, runs))
    if not np.isfinite(deviation).any():
        raise ComputationError(RESULTS.unstable_start, stage="sweep")

    stable = np.isfinite(deviation).all(axis=2)
    apart = _deviations(matrices, stable, setting, unseen) if unseen else None
    return Sweep(
        taus,
        np.array(rows),
        _fit_percent(deviation, records, scaling),
        _fit_percent(apart, held_out, scaling) if unseen else None,
        *_physical(matrices, deviation, scaling),
        int(np.sum(~np.isfinite(deviation).all(axis=2) & ~failed)),
        int(np.sum(failed)),
        records[0].output_names,
    )


def _time_constants(given, spacing: str, record: Record) -> Float[np.ndarray, " time_constants"]:
    if spacing not in SPACINGS:
        raise ValueError(f"spacing={spacing!r} is not known; choose from {', '.join(SPACINGS)}.")
    if given is None:
        grid = default_time_constants(record, DEFAULT_COUNT)
        return grid if spacing == "logarithmic" else np.linspace(grid[0], grid[-1], DEFAULT_COUNT)
    grid = np.unique(np.atleast_1d(np.asarray(given, dtype=float)))
    if grid.size == 0 or not np.all(np.isfinite(grid)) or np.any(grid <= 0):
        raise ValueError(f"time_constants={given} must be positive; give one number or several, in s.")
    return grid


def _block_rows(given, record: Record) -> tuple[int, ...]:
    rows = np.unique(np.atleast_1d(np.asarray(usable_block_rows(record) if given is None else given)))
    if rows.size == 0 or np.any(rows != np.round(rows)) or np.any(rows < 3):
        raise ValueError(f"block_rows={given} must be whole numbers of at least 3.")
    most = int(np.max(rows))
    columns = 2 * most * (record.inputs + record.outputs + 1)
    if record.samples <= columns:
        raise ComputationError(
            RESULTS.too_short,
            stage="sweep",
            detail=f"{record.samples} samples for {most} block rows, which need more than {columns}",
        )
    return tuple(int(i) for i in rows)


def _cells(
    found, setting: Setting, signals: list[Signals]
) -> tuple[tuple, Float[np.ndarray, "time_constants choices outputs"], Bool[np.ndarray, "time_constants choices"]]:
    """Physical matrices of every choice, the free-run deviation, and where there is no model at all."""
    matrices, usable, _ = physical_grid(found, setting)
    system = np.asarray(jax.vmap(jax.vmap(lambda realization: realization.A))(found.realization))
    rates = np.linalg.eigvals(np.where(usable[:, :, None, None], system, 0.0)).real.max(axis=2)
    tame = usable & (rates * max(s.samples for s in signals) <= GROWTH)
    return matrices, _deviations(matrices, tame, setting, signals), ~usable


@jax.jit
def _runs(matrices, setting: Setting, signals: Signals):
    """Mean square free-run residual per output of every model, one after the other."""
    return jax.lax.map(lambda one: model_run(one, setting, signals)[1], matrices)


def _deviations(
    matrices: tuple, judged: Bool[np.ndarray, "time_constants choices"], setting: Setting, signals: list[Signals]
) -> Float[np.ndarray, "time_constants choices outputs"]:
    """Mean square free-run residual over all records where `judged`, not a number elsewhere or where not finite."""
    # The others are run too, as any model that is fine: one size, one compilation.
    first = tuple(np.argwhere(judged)[0]) if judged.any() else (0, 0)
    stacked = tuple(
        jnp.asarray(np.where(judged[:, :, None, None], X, X[first]).reshape(-1, *X.shape[2:])) for X in matrices
    )
    weights = [np.asarray(jnp.sum(s.kept, axis=0)) for s in signals]
    total = np.sum([np.asarray(_runs(stacked, setting, s)) * w for s, w in zip(signals, weights)], axis=0)
    table = (total / np.sum(weights, axis=0)).reshape(*judged.shape, -1)
    good = judged & np.isfinite(table).all(axis=2)
    return np.where(good[:, :, None], table, np.nan)


def _physical(matrices: tuple, deviation: np.ndarray, scaling: Scaling) -> list[np.ndarray]:
    """Mass, damping and stiffness of every stable choice in the record's units."""
    stable = np.isfinite(deviation).all(axis=2)[:, :, None, None]
    return [np.where(stable, np.asarray(X), np.nan) for X in scaling.matrices_out(*matrices)]


def _fit_percent(deviation: np.ndarray, records: list[Record], scaling: Scaling) -> np.ndarray:
    """100(1 − ‖y−ŷ‖/‖y−ȳ‖) from mean square residuals over all records."""
    squares = [np.nansum((r.y - np.nanmean(r.y, axis=0)) ** 2, axis=0) for r in records]
    power = np.sum(squares, axis=0) / np.sum([np.sum(~r.missing, axis=0) for r in records], axis=0)
    return 100.0 * (1.0 - np.sqrt(deviation / power) * np.asarray(scaling.outputs))
