"""Records of rows at times of their own: identified on equivalent uniform records, which are computed again until they
no longer change."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..mechanics.at_stamps import at_own_times
from ..numerics.progress import AbstractProgress
from ..numerics.text import listed
from ..records import Record, preflight
from ..records.stamped import ClockError
from .clocks import with_clocks
from .result import Identification
from .validation.residuals import noise_floor

MOST_TURNS = 10
"""Times that the uniform records are made anew, at most."""

RESTS = 0.01
"""Change of the uniform records, in standard deviations of the noise, that is left."""

CLEAR = 5.0
"""Difference in log-likelihood from which the grid explains a record better than the times of its rows, for sure."""

STANDS = 0.01
"""Step of a clock, in standard errors, that is left."""

SAID = 0.1
"""The same from which it is said."""

ROUNDING = 1e-12
"""The same, relative to the motion."""

LEAST = 1e-300
"""Noise of an output that has none."""


LOGGED = (
    "The times of the rows are not those at which they were sampled: uniform times explain the outputs better, and "
    "were taken. The logger may stamp rows when it writes them."
)
"""What is said where the grid explains a record better than the times of its rows."""


def identify_stamped(
    fit: Callable[[list[Record], list[Record]], Identification],
    records: list[Record],
    held_out: list[Record],
    progress: AbstractProgress,
) -> Identification:
    """Identify from records some of which have rows at times of their own.

    A fit of the uniform records that stand for them about a model has no other residual there than the rows leave; it
    moves the model, and the records with it, until both rest. Every number then is of the rows at their own times; the
    slopes by which they are weighed are those at the places on the grid. Where the samples are explained better on the
    grid than at the times of their rows, these are the logger's, and the grid is kept.

    **Arguments:** `fit`: from uniform records, and those held out, to an `Identification`; `records`, `held_out`;
    `progress`.

    **Returns:** an `Identification`; its records are the uniform ones.

    **Raises:** as `fit`.
    """
    now, unseen = ([r.on_grid for r in group] for group in (records, held_out))
    messages = [finding.message for r in now for finding in preflight(r, relations=False)]
    found, moved, rests = fit(now, unseen), np.inf, False
    uniform = found
    mended, clocks, off = records, (), np.zeros(0)
    for turn in range(MOST_TURNS):
        progress.stage(f"simulating at the rows' own times ({turn + 1})")
        if turn:
            # About the first fit the grid itself is still wrong.
            found, mended, off = with_clocks(found, mended)
            clocks = added(clocks, found.clocks)
        new, unseen = ([at_own_times(found.model, r) for r in group] for group in (mended, held_out))
        before, moved = moved, change(now, new)
        if np.all(np.abs(off) < STANDS) and at_rest(moved, found.noise_floor, new):
            rests = True
            break
        now = new
        found = fit(now, unseen)
        if turn > 1 and np.all(np.abs(off) < STANDS) and np.all(moved > before / 2):
            break
    moved = 0.0 if rests else float(np.max(moved / np.maximum(found.noise_floor, LEAST)))
    if _left(uniform) + CLEAR < _left(found):
        return replace(uniform, warnings=(LOGGED, *uniform.warnings), grid_kept=True)
    if clocks:
        found = replace(with_clocks(found, mended)[0], clocks=clocks)
    notes = [note(r, moved) for r in records if r.has_own_times]
    notes += [clock.sentence(records[0].sampling_time) for clock in clocks]
    return replace(found, warnings=tuple(dict.fromkeys([*notes, *messages, *found.warnings])))


def at_rest(moved: np.ndarray, noise: np.ndarray, records: list[Record]) -> bool:
    """Whether a change of every output is little beside its noise, or rounding."""
    return bool(np.all(moved < np.maximum(RESTS * noise, ROUNDING * size(records))))


def added(clocks: tuple[ClockError, ...], steps: tuple[ClockError, ...]) -> tuple[ClockError, ...]:
    """What steps of clocks come to, one after another."""
    if not clocks:
        return steps
    return tuple(
        replace(
            new, offset=old.offset + new.offset + new.rate * old.offset, rate=old.rate + new.rate + old.rate * new.rate
        )
        for old, new in zip(clocks, steps)
    )


def _left(found: Identification) -> float:
    """What a fit leaves of the outputs, as minus the logarithm of its likelihood but for a constant: what the past of
    the residual does not say, since a law that is missing says nothing of times."""
    left = 0.0
    for fit in found.estimation:
        left += np.log(np.maximum(noise_floor(fit.residual), LEAST)) @ np.isfinite(fit.residual).sum(axis=0)
    return float(left)


def change(old: list[Record], new: list[Record]) -> np.ndarray:
    """Largest root mean square change of every output of some records."""
    return np.max([np.sqrt(np.nanmean((one.y - other.y) ** 2, axis=0)) for one, other in zip(old, new)], axis=0)


def size(records: list[Record]) -> np.ndarray:
    """Largest standard deviation of every output of some records."""
    return np.max([np.nanstd(record.y, axis=0) for record in records], axis=0)


def note(record: Record, moved: float) -> str:
    """What is said of a record of rows at times of their own."""
    unsampled = [name for name, share in zip(record.output_names, record.missing.mean(axis=0)) if share > 0.1]
    rates = f" ({listed(unsampled)} sampled more rarely than the grid)" if unsampled else ""
    rest = "" if moved < SAID else f"; in the last turn the outputs on the grid still moved by {moved:.2g} of the noise"
    return (
        f"The rows have times of their own, up to {record.stamps.jitter:.2g} samples off a uniform grid of "
        f"{record.sampling_time:.6g} s{rates}: simulated and fitted at these times{rest}."
    )
