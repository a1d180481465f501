"""The equation of motion as rows of a regression: measured motion in the band where it stands above its noise.

    E u = M q̈ + D q̇ + K q + Σ b φ(q, q̇),      every term through the same zero-phase low-pass.

**Reference:** Gautier, Janot & Vandanjon, IEEE Trans. Control Syst. Technol. 21 (2013) 428-444.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from ...mechanics.effects.base import AbstractEffect, AbstractInputEffect, Local, Place, Scales
from ...mechanics.extended import arm_along, held_input
from ...mechanics.force_over_time import force_over_time
from ...numerics.stored_programs import stored
from ...records import Record
from ..screening.scales import LEVELS, root_mean_square

ABOVE_NOISE = 100.0
"""The band ends where the power of the motion comes down to so many times that of its noise."""

ROWS_PER_CYCLE = 2.5
"""Rows kept per cycle of the cut-off frequency: about as many as are independent."""

AT_REST = 0.1
"""Share of the typical velocity below which a coordinate counts as at rest."""

ORDER = 4


@dataclass(frozen=True)
class Series:
    """One record in the band of the regression.

    `q`, `v`, `a`: displacement, velocity, acceleration, filtered; `start`, `end`: input over every sample;
    `scheduling`; `rows`: samples kept as rows; `numerator`, `denominator` of the filter; `cutoff_hz`; `sampling_time`.
    """

    q: Float[np.ndarray, "samples dofs"]
    v: Float[np.ndarray, "samples dofs"]
    a: Float[np.ndarray, "samples dofs"]
    start: Float[np.ndarray, "samples inputs"]
    end: Float[np.ndarray, "samples inputs"]
    scheduling: Float[np.ndarray, " samples"]
    rows: np.ndarray
    numerator: np.ndarray
    denominator: np.ndarray
    cutoff_hz: float
    sampling_time: float

    def row_values(self, X: Float[np.ndarray, "samples *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """Series through the filter, at the rows."""
        return scipy.signal.filtfilt(self.numerator, self.denominator, np.asarray(X, float), axis=0)[self.rows]

    @property
    def input_rows(self) -> Float[np.ndarray, "rows inputs"]:
        """The input, as it is around every sample."""
        return self.row_values(around_samples(self.start, self.end))


def around_samples(start, end):
    """A held input seen at its samples: the mean of what comes before and after, so that the hold delays nothing."""
    before = jnp.concatenate([end[:1], end[:-1]]) if isinstance(end, jax.Array) else np.concatenate([end[:1], end[:-1]])
    return (start + before) / 2


def band_of(record: Record) -> float:
    """Cut-off frequency [Hz]: where the spectrum of the motion meets its noise, missing samples left out; the lowest
    over the outputs.

    Spectra are taken of second differences, so that slow large motion does not leak into the rest; the noise is the
    median of the upper half.
    """
    samples, sampling_time = record.samples, record.sampling_time
    lowest, highest = 8.0 / (samples * sampling_time), 0.2 / sampling_time
    found = highest
    for column in (one[np.isfinite(one)] for one in record.y.T):
        length = max(min(4096, len(column) // 4), min(len(column), 32))
        frequency, power = scipy.signal.welch(np.diff(column, 2), 1.0 / sampling_time, nperseg=length)
        power = power[1:] / np.maximum(2 * np.sin(np.pi * frequency[1:] * sampling_time), 1e-12) ** 4
        noise = np.median(power[len(power) // 2 :])
        below = np.flatnonzero(power < ABOVE_NOISE * noise)
        below = below[below > np.argmax(power)]
        if len(below):
            found = min(found, float(frequency[1 + below[0]]))
    return float(np.clip(found, min(lowest, highest), highest))


def series_of(
    record: Record,
    cutoff_hz: float,
    *,
    at_rest: bool = False,
    left_out: Bool[np.ndarray, " samples"] | None = None,
) -> Series:
    """A record through the zero-phase low-pass, with derivatives of the filtered motion by central differences.

    **Arguments:** `record`: displacements or velocities measured; `cutoff_hz`; `at_rest`: keep rows at rest as well;
    `left_out`: samples that say nothing, default none.

    **Returns:** a `Series`; rows at rest (unless asked for), near the ends and near samples that are missing or left
    out are not among its rows.
    """
    h = record.sampling_time
    b, a = scipy.signal.butter(ORDER, min(2 * cutoff_hz * h, 0.99))
    known = np.isfinite(record.y)
    y = np.stack([_bridged(column, good) for column, good in zip(record.y.T, known.T)], axis=1)
    y = scipy.signal.filtfilt(b, a, y, axis=0)
    slope = np.gradient(y, h, axis=0)
    second = np.zeros_like(y)
    second[1:-1] = (y[2:] - 2 * y[1:-1] + y[:-2]) / h**2
    q, v, acceleration = y.copy(), slope.copy(), second
    for k, kind in enumerate(record.measured):
        if kind == "velocity":
            q[:, k] = np.concatenate([[0.0], np.cumsum((y[1:, k] + y[:-1, k]) * h / 2)])
            v[:, k], acceleration[:, k] = y[:, k], slope[:, k]
    edge = int(np.ceil(0.5 / (cutoff_hz * h)))
    good = np.ones(record.samples, bool)
    good[:edge] = good[-edge:] = False
    lost = ~known.all(axis=1) if left_out is None else ~known.all(axis=1) | left_out
    for gap in np.flatnonzero(lost):
        good[max(0, gap - edge) : gap + edge + 1] = False
    # At rest dry friction takes any value up to its limit: such rows say nothing of it, and mislead about the rest.
    if not at_rest:
        good &= ~at_rest_of(v)
    step = max(1, int(1.0 / (ROWS_PER_CYCLE * cutoff_hz * h)))
    rows = np.arange(0, record.samples, step)
    start, end = (np.asarray(x) for x in held_input(jnp.asarray(record.u), record.hold))
    p = np.zeros(record.samples) if record.scheduling is None else record.scheduling
    return Series(q, v, acceleration, start, end, p, rows[good[rows]], b, a, cutoff_hz, h)


def at_rest_of(v: Float[np.ndarray, "samples dofs"]) -> Bool[np.ndarray, " samples"]:
    """Where any coordinate rests, of filtered velocities."""
    return np.any(np.abs(v) <= AT_REST * np.sqrt(np.mean(v**2, axis=0)), axis=1)


def _bridged(column: Float[np.ndarray, " samples"], known: Bool[np.ndarray, " samples"]) -> np.ndarray:
    at = np.arange(len(column))
    return column if known.all() else np.interp(at, at[known], column[known])


_force = stored(force_over_time)


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
    p, time = jnp.asarray(values, dtype=float), jnp.asarray(series.sampling_time)
    if isinstance(effect, AbstractInputEffect):
        arm = input_map[:, place.first]
        start, end = jnp.asarray(series.start[:, place.first]), jnp.asarray(series.end[:, place.first])
        made = (_change_slopes if slopes else _change)(effect, p, start, end, time)
    else:
        arm = np.asarray(arm_along(effect, place, input_map))
        made = (_force_slopes if slopes else _force)(effect, p, local_at(effect, place, series, arm), time)
    made = np.asarray(made)
    if not np.all(np.isfinite(made)):
        return np.full((len(series.rows), len(arm), *made.shape[1:]), np.nan)
    made = series.row_values(made)
    return np.einsum("r...,d->rd...", made, arm)


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
        (series.cutoff_hz,),
    )
