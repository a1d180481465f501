"""The equation of motion as rows of a regression: measured motion in the band where it stands above its noise.

    E u = M q̈ + D q̇ + K q + Σ b φ(q, q̇),      every term through the same zero-phase filter.

Where accelerations are measured, velocity and displacement are their integrals, and the filter is a band-pass.

**Reference:** Gautier, Janot & Vandanjon, IEEE Trans. Control Syst. Technol. 21 (2013) 428-444.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, AbstractInputEffect, Local, Place, Scales
from ...mechanics.runs.extended import arm_along, held_input
from ...mechanics.runs.force_over_time import force_over_time
from ...numerics.programs.stored_programs import stored
from ...records import Record
from ..screening.scales import LEVELS, root_mean_square
from .band import ORDER, Band, integrals

ROWS_PER_CYCLE = 2.5
"""Rows kept per cycle of the cut-off frequency: about as many as are independent."""

BRIDGED = 0.1
"""Longest gap, relative to the shortest period of the band, that a straight line bridges."""

AT_REST = 0.1
"""Share of the typical velocity below which a coordinate counts as at rest."""


@dataclass(frozen=True)
class Series:
    """One record in the band of the regression.

    `q`, `v`, `a`: displacement, velocity, acceleration, filtered; `start`, `end`: input over every sample;
    `scheduling`; `rows`: samples kept as rows; `sections` of the filter; `band`; `sampling_time`.
    """

    q: Float[np.ndarray, "samples dofs"]
    v: Float[np.ndarray, "samples dofs"]
    a: Float[np.ndarray, "samples dofs"]
    start: Float[np.ndarray, "samples inputs"]
    end: Float[np.ndarray, "samples inputs"]
    scheduling: Float[np.ndarray, " samples"]
    rows: np.ndarray
    sections: np.ndarray
    band: Band
    sampling_time: float

    def filtered(self, X: Float[np.ndarray, "samples *columns"]) -> Float[np.ndarray, "samples *columns"]:
        """Series through the filter."""
        return scipy.signal.sosfiltfilt(self.sections, np.asarray(X, float), axis=0)

    def row_values(self, X: Float[np.ndarray, "samples *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """The same at the rows."""
        return self.filtered(X)[self.rows]

    @property
    def input_rows(self) -> Float[np.ndarray, "rows inputs"]:
        """The input, as it is around every sample."""
        return self.row_values(around_samples(self.start, self.end))


def around_samples(start, end):
    """A held input seen at its samples: the mean of what comes before and after, so that the hold delays nothing."""
    before = jnp.concatenate([end[:1], end[:-1]]) if isinstance(end, jax.Array) else np.concatenate([end[:1], end[:-1]])
    return (start + before) / 2


def series_of(
    record: Record,
    band: Band,
    *,
    at_rest: bool = False,
    left_out: Bool[np.ndarray, " samples"] | None = None,
) -> Series:
    """A record through the zero-phase filter, with derivatives of the filtered motion by central differences, integrals
    of accelerations in the frequency domain.

    **Arguments:** `record`; `band`; `at_rest`: keep rows at rest as well; `left_out`: samples that say nothing, default
    none.

    **Returns:** a `Series`; rows at rest (unless asked for), near the ends and near samples that are missing or left
    out are not among its rows.
    """
    h = record.sampling_time
    high = min(2 * band.high * h, 0.99)
    if band.low > 0:
        sections = scipy.signal.butter(ORDER, [2 * band.low * h, high], "bandpass", output="sos")
    else:
        sections = scipy.signal.butter(ORDER, high, output="sos")
    known = np.isfinite(record.y)
    y = np.stack([_bridged(column, good) for column, good in zip(record.y.T, known.T)], axis=1)
    # Integrated first: what the filter adds at the ends of a record would grow.
    whole = {k: integrals(y[:, k], h, band.low) for k, kind in enumerate(record.measured) if kind == "acceleration"}
    y = scipy.signal.sosfiltfilt(sections, y, axis=0)
    slope = np.gradient(y, h, axis=0)
    second = np.zeros_like(y)
    second[1:-1] = (y[2:] - 2 * y[1:-1] + y[:-2]) / h**2
    q, v, acceleration = y.copy(), slope.copy(), second
    for k, kind in enumerate(record.measured):
        if kind == "velocity":
            q[:, k] = np.concatenate([[0.0], np.cumsum((y[1:, k] + y[:-1, k]) * h / 2)])
            v[:, k], acceleration[:, k] = y[:, k], slope[:, k]
        elif kind == "acceleration":
            v[:, k], q[:, k] = scipy.signal.sosfiltfilt(sections, np.stack(whole[k]), axis=1)
            acceleration[:, k] = y[:, k]
    edge = int(np.ceil(0.5 / (band.high * h)))
    ends = int(np.ceil(1.0 / (band.low * h))) if band.low > 0 else edge
    good = np.ones(record.samples, bool)
    good[:ends] = good[-ends:] = False
    lost = ~known.all(axis=1) if left_out is None else ~known.all(axis=1) | left_out
    for gap in _runs(lost):
        # What bridges a long gap spoils the integrals as far as an end does.
        near = ends if len(gap) > BRIDGED / (band.high * h) else edge
        good[max(0, gap[0] - near) : gap[-1] + near + 1] = False
    # At rest dry friction takes any value up to its limit: such rows say nothing of it, and mislead about the rest.
    if not at_rest:
        good &= ~at_rest_of(v)
    step = max(1, int(1.0 / (ROWS_PER_CYCLE * band.high * h)))
    rows = np.arange(0, record.samples, step)
    start, end = (np.asarray(x) for x in held_input(jnp.asarray(record.u), record.hold))
    p = np.zeros(record.samples) if record.scheduling is None else record.scheduling
    return Series(q, v, acceleration, start, end, p, rows[good[rows]], sections, band, h)


def _runs(mask: Bool[np.ndarray, " samples"]) -> list[np.ndarray]:
    """Samples of a mask, one array for each stretch without a break."""
    at = np.flatnonzero(mask)
    return [run for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(run)]


def at_rest_of(v: Float[np.ndarray, "samples dofs"]) -> Bool[np.ndarray, " samples"]:
    """Where any coordinate rests, of filtered velocities."""
    return np.any(np.abs(v) <= AT_REST * np.sqrt(np.mean(v**2, axis=0)), axis=1)


def _bridged(column: Float[np.ndarray, " samples"], known: Bool[np.ndarray, " samples"]) -> np.ndarray:
    at = np.arange(len(column))
    return column if known.all() else np.interp(at, at[known], column[known])


AT_ONCE = 16
"""Forces of one law that are computed together."""

_force = stored(force_over_time)


@stored
def _forces(effect, p, here, time):
    return jax.vmap(lambda one: force_over_time(effect, one, here, time))(p)


@stored
def _force_slopes(effect, p, here, time):
    return jax.jacfwd(lambda p: force_over_time(effect, p, here, time))(p)


@stored
def _change(effect: AbstractInputEffect, p, start, end, time):
    a, b = effect.apply(p, start, end, time)
    return around_samples(start, end) - around_samples(a, b)


@stored
def _change_slopes(effect, p, start, end, time):
    return jax.jacfwd(lambda p: _change(effect, p, start, end, time))(p)


def contribution(
    effect: AbstractEffect,
    place: Place,
    values,
    series: Series,
    input_map: Float[np.ndarray, "dofs inputs"],
    *,
    slopes: bool = False,
) -> Float[np.ndarray, "rows dofs *parameters"]:
    """What a term adds to the right side at the rows of a record, or its slopes by all parameters.

    **Arguments:** `effect`, `place`, `values`: the term; `series`; `input_map` (E); `slopes`.
    """
    made, arm = _along(effect, place, values, series, input_map, slopes)
    if not np.all(np.isfinite(made)):
        return np.full((len(series.rows), len(arm), *made.shape[1:]), np.nan)
    return np.einsum("r...,d->rd...", series.row_values(made), arm)


def contributions(
    effect: AbstractForceEffect,
    place: Place,
    table: Float[np.ndarray, "terms parameters"],
    series: Series,
    input_map: Float[np.ndarray, "dofs inputs"],
) -> Float[np.ndarray, "rows dofs terms"]:
    """What terms of one force law at one place, their values the rows of a table, each add to the right side."""
    arm, time = np.asarray(arm_along(effect, place, input_map)), jnp.asarray(series.sampling_time)
    here, count = local_at(effect, place, series, arm), len(table)
    # Batches of one size are one program.
    batches = np.resize(table, (-(-count // AT_ONCE), AT_ONCE, table.shape[1]))
    rows = np.full((len(batches), AT_ONCE, len(series.rows)), np.nan)
    for p, some in zip(batches, rows):
        made = np.asarray(_forces(effect, jnp.asarray(p), here, time))
        good = np.all(np.isfinite(made), axis=1)
        some[good] = series.row_values(made[good].T).T
    return np.einsum("kr,d->rdk", rows.reshape(-1, len(series.rows))[:count], arm)


def forces_along(
    effect: AbstractEffect, place: Place, values, series: Series, input_map: Float[np.ndarray, "dofs inputs"]
) -> Float[np.ndarray, "samples dofs"]:
    """What a term adds to the right side along the filtered motion, itself not filtered; arguments as of
    `contribution`."""
    return np.multiply.outer(*_along(effect, place, values, series, input_map, False))


def _along(effect, place, values, series, input_map, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Size of what a term adds, sample by sample, or its slopes by all parameters; and where it acts."""
    p, time = jnp.asarray(values, dtype=float), jnp.asarray(series.sampling_time)
    if isinstance(effect, AbstractInputEffect):
        arm = input_map[:, place.first]
        start, end = jnp.asarray(series.start[:, place.first]), jnp.asarray(series.end[:, place.first])
        made = (_change_slopes if slopes else _change)(effect, p, start, end, time)
    else:
        arm = np.asarray(arm_along(effect, place, input_map))
        made = (_force_slopes if slopes else _force)(effect, p, local_at(effect, place, series, arm), time)
    return np.asarray(made), arm


def local_at(effect, place: Place, series: Series, arm) -> Local:
    """What a law sees, as series."""
    samples = len(series.q)
    u = series.start[:, place.first] if effect.places == "input" else np.zeros(samples)
    t = np.arange(samples) * series.sampling_time
    parts = (series.q @ arm, series.v @ arm, series.a @ arm, np.ones(samples), u, t, series.scheduling)
    return Local(*parts)


def scales_of(effect: AbstractEffect, place: Place, series: Series, input_map, force: float) -> Scales:
    """Sizes in the record by which the shapes of an effect at a place are chosen; `force`: typical force there."""
    arm = np.asarray(arm_along(effect, place, input_map))
    q, v = series.q @ arm, series.v @ arm
    u = series.start[:, place.first] if effect.places == "input" else np.zeros(1)
    h, samples = series.sampling_time, len(series.q)

    return Scales(
        root_mean_square(q),
        root_mean_square(v),
        float(np.abs(q).max()),
        float(np.abs(v).max()),
        tuple(map(float, np.quantile(np.abs(q), LEVELS))),
        root_mean_square(u),
        float(np.abs(u).max()),
        tuple(map(float, np.quantile(np.abs(u), LEVELS))),
        force,
        1.0,
        h,
        samples * h,
        (series.band.high,),
    )
