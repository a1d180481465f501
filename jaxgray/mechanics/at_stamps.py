"""Free runs of a model at the times at which a record was sampled, and the uniform record that stands for it.

A record of rows at times of their own and a uniform record tell the same of a model where they leave the same residual:
the free run at the uniform times plus the residual at the rows' own times, its smooth part moved to those times. About
a model that is near the truth the residual is little more than noise, and what little else it holds changes by less
than itself between a row and its place on the grid; made anew about the model that was fitted to it, it does so again,
until nothing moves.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline, CubicSpline, splrep

from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.responses.varying_steps import response, step_matrices
from ..records import Record
from ..records.stamped import inputs_on
from ..records.stamped.stamps import START
from .fitted_run import fitted_run
from .model import MechanicalModel
from .runs.first_state import linear_state
from .runs.simulate import simulate
from .systems.statespace import hold_matrices

LONGEST = 4.0
"""Steps of the grid in a step of the exact run, at most: longer ones are cut."""

FINER = 4
"""Samples per step of the grid in which what effects add is followed."""

KNOTS = (4, 8, 16, 32, 64, 128)
"""Rows from one knot to the next of the splines that are tried."""

MORE_THAN_NOISE = 1.2
"""Residual over its white part from which some of it is smooth, and is not the same at a place on the grid as at the
time of its row."""

LEAST = 1e-300
"""Size of an output that does not move."""


def at_own_times(model: MechanicalModel, record: Record) -> Record:
    """The uniform record that stands for a record about a model, see `about`; a uniform record stands for itself."""
    return about(model, record) if record.has_own_times else record


def about(model: MechanicalModel, record: Record) -> Record:
    """The uniform record that leaves of a model what the rows at times of their own leave of it.

    **Arguments:** `model`, with the record's channels in its order; `record`, with `stamps`. Samples that are missing
    on its grid stay so.

    **Returns:** a `Record` whose channels on the grid count.

    **Raises:** `ComputationError` where the model's motion is not finite.
    """
    linear, plain, h = replace(model, effects=()), record.on_grid, record.sampling_time
    free, driven, (P, x) = _exact(linear, record)
    units = np.concatenate([np.ones(model.dofs), np.full(model.dofs, h)])
    speed = model.drive.state_space(model.mass, model.damping, model.stiffness, ("velocity",) * model.dofs, h)
    # What a measured base displacement takes out of the state.
    base = np.concatenate([np.zeros_like(speed.D), np.asarray(speed.D) * h]) @ record.u[0]
    if model.effects:
        fitted = fitted_run(model, plain)
        x0, offset, substeps = fitted.x0, fitted.offset, fitted.substeps
        begin = np.linalg.solve(P, x0 * units - base - x)
    else:
        (begin, offset), substeps = _first_state(record, free, driven), 1
        x0 = (P @ begin + x + base) / units
    there = free @ begin + driven + offset
    here = simulate(model, plain.u, h, hold=plain.hold, x0=x0, offset=offset, substeps=substeps)
    if model.effects:
        there = there + _added(model, linear, record, x0, substeps)
    y, stamps = np.full(record.y.shape, np.nan), record.stamps
    for k in range(record.outputs):
        rows = np.flatnonzero(stamps.place[:, k] >= 0)
        place = stamps.place[rows, k]
        left = stamps.y[rows, k] - there[rows, k]
        y[place, k] = here[place, k] + left + _moved(stamps.time[rows], left, record.start_time + h * place)
    return replace(plain, y=np.where(np.isfinite(record.y), y, np.nan))


def _moved(time: np.ndarray, left: np.ndarray, there: np.ndarray) -> np.ndarray:
    """By how much the smooth part of a residual changes from times to others beside them: none where it is noise.

    The spline whose knots are as far apart as generalised cross-validation says.
    """
    known = np.flatnonzero(np.isfinite(left))
    # Clocks that were mended may put rows in another order, or two at one time.
    t, first = np.unique(time[known], return_index=True)
    e = left[known][first]
    white = np.sum(np.diff(e, n=2) ** 2) / (6 * max(len(e) - 2, 1))
    change = np.zeros(len(left))
    if len(e) < 8 * KNOTS[0] or not np.mean(e**2) > MORE_THAN_NOISE**2 * white:
        return change
    best = np.inf
    for every in KNOTS:
        if len(e) < 8 * every:
            break
        spline = BSpline(*splrep(t, e, task=-1, t=t[every:-every:every]))
        freedom = len(e) - (len(spline.t) - 4)
        left_over = float(np.sum((e - spline(t)) ** 2)) / freedom**2
        if left_over < best:
            best = left_over
            change[known] = spline(there[known]) - spline(time[known])
    return change


def _exact(model: MechanicalModel, record: Record):
    """Outputs of a linear model at every row of the stamps: by its first state in units of the grid's steps, rows ×
    outputs × states, and by the inputs, NaN for rows before the first that counts; and likewise the state at the start
    of the grid."""
    h, stamps = record.sampling_time, record.stamps
    events = stamps.since(record.start_time)
    time, u, given = _cut(events.time / h, events.u, stamps.hold)
    system = jax.device_get(model.state_space(h))
    n, m = system.B.shape
    where = "simulation at the rows' times"
    try:
        matrices = step_matrices(lambda lengths: _flows(system.A, system.B, lengths, stamps.hold), np.diff(time))
    except ValueError as error:
        raise ComputationError(RESULTS.nonfinite, stage=where, detail=str(error).rstrip(".")) from None
    forced = np.einsum("knm,km->kn", matrices[:, :, n : n + m], u[:-1])
    forced += np.einsum("knm,km->kn", matrices[:, :, n + m :], u[1:])
    P, x = response(matrices[:, :, :n], forced)
    if not (np.isfinite(P).all() and np.isfinite(x).all()):
        raise ComputationError(RESULTS.nonfinite, stage=where, detail="the model's motion grows without bound")
    shape = (len(stamps.time), record.outputs)
    free, driven = np.full((*shape, n), np.nan), np.full(shape, np.nan)
    # Of every event given, with the beginning itself.
    there = np.flatnonzero(given)
    P, x = np.concatenate([np.eye(n)[None], P])[there], np.concatenate([np.zeros((1, n)), x])[there]
    rows = events.row >= 0
    free[events.row[rows]] = system.C @ P[rows]
    driven[events.row[rows]] = x[rows] @ system.C.T + u[there[rows]] @ system.D.T
    start = int(np.argmax(events.row == START))
    return free, driven, (P[start], x[start])


@partial(jax.jit, static_argnames="hold")
def _flows(A, B, lengths, hold):
    return jax.vmap(lambda length: jnp.concatenate(hold_matrices(A, B, length, hold), axis=1))(lengths)


def _cut(time: np.ndarray, u: np.ndarray, hold: str):
    """Events with long steps cut, and which of them were given."""
    parts = np.maximum(np.ceil(np.diff(time) / LONGEST), 1).astype(int)
    begin = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(begin)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[begin]
    rise = share[:, None] * np.diff(u, axis=0)[begin] if hold == "linear" else 0.0
    time = np.append(time[begin] + share * np.diff(time)[begin], time[-1])
    return time, np.concatenate([u[begin] + rise, u[-1:]]), np.append(share == 0, True)


def _first_state(record: Record, free: np.ndarray, driven: np.ndarray):
    """First state and offsets by which a linear run comes nearest to the rows."""
    stamps = record.stamps
    sampled = (stamps.place >= 0) & np.isfinite(driven)
    size = np.array([max(np.std(column[there]), LEAST) for column, there in zip(stamps.y.T, sampled.T)])
    parts = (np.where(sampled[..., None], free, 0.0), np.where(sampled, stamps.y - driven, 0.0))
    return linear_state(*parts, sampled / size, offset=True)


def _added(model: MechanicalModel, linear: MechanicalModel, record: Record, x0, substeps: int) -> np.ndarray:
    """What effects add to the outputs at the rows' times: smooth between samples, unlike inputs and what they do.

    By the inputs as they were given: what a limit makes of a mean is not the mean of what it makes.
    """
    h, stamps = record.sampling_time / FINER, record.stamps
    at = record.start_time + h * np.arange(record.samples * FINER)
    u = inputs_on(at, h, stamps.input_time, stamps.u, stamps.hold)
    runs = [simulate(one, u, h, hold=record.hold, x0=x0, substeps=max(substeps // FINER, 1)) for one in (model, linear)]
    return CubicSpline(at, runs[0] - runs[1])(np.clip(stamps.time, at[0], at[-1]))
