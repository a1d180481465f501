"""A record with what several checks look at, each computed when it is first asked for."""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxgray.records.checks.answers import Answer, aligned, answer, least_lead
from jaxgray.records.checks.defects import spikes
from jaxgray.records.checks.modes import SHIFTS, Modes, input_power, modes
from jaxgray.records.checks.relations import BACK, RESTING, direction, distinguishable, left_by_outputs, overlap
from jaxgray.records.cleaning import without_defects
from jaxgray.records.record import Record

MOST_SPOILT = 0.02
"""Share of missing and spoilt samples of an output above which only that is said of it."""

RUBBED, RUBS = (0.05, 0.6), 0.6
"""Unexplained shares between which dry friction is looked for, and what it may leave of one."""

EXPLAINED = 0.5
"""Unexplained share up to which a relation says something of signs and times."""

ROUGH = 0.05
"""Misfit of the modes, as a share of power, above which they say nothing."""

PLAIN_SHIFT = 0.1
"""Unexplained share up to which a shift of one output alone is said."""

AGREED = 0.05
"""Relative difference of the shifts of two outputs up to which they are one."""

FRICTION_PHASE, FAR_BETTER, BETTER = 0.4, 8.0, 4.0
"""Phase in rad up to which friction is taken for a shift, and how much better a shift must fit below and above it."""

UNSHIFTED = 0.03
"""Misfit of the modes without a shift below which none is looked for."""

PLAINLY = 40.0, 50.0
"""Misfit without a shift, over that with it and over the power that is unexplained, from which it stands out."""

CANCELLING = 1.5
"""Size of a mode, over all of the motion, from which modes only cancel each other."""

UNCAUSED, CAUSED_LATER = 0.5, (0.3, 0.4)
"""Unexplained share above which an output may come before what moves it; the share that inputs to come may leave, and
that over the share before."""

MANY = 400
"""Samples from which relations over time between channels are looked for."""

ALIKE = 0.5
"""Overlap of the spectra of the first and the last part of an input below which it is a sweep."""

LEFT = 0.45
"""Share that outputs leave of an input, beyond its own past, below which they tell it: a controller is seen."""

LEAST_SHIFT, LEAST_PHASE = 1.75, 0.1
"""Samples, and rad at the strongest mode, from which a shift is said: the hold of the input is worth half a sample."""


@dataclass(frozen=True)
class MovingOutput:
    """An output that moves.

    Spikes are looked for once and made missing for the other detectors: one beyond a limit hides the limit,
    and rest between two of them looks like a stuck sensor.
    """

    name: str
    y: np.ndarray
    spikes: np.ndarray
    without_spikes: np.ndarray


class Answering(NamedTuple):
    """An output and how it answers the inputs: `position` in the record, `y` without its mean and spoilt samples (zero
    there), over its largest value `size`, what was `found`, and the directions of motion that stand `beside` the
    inputs, where dry friction is seen."""

    position: int
    name: str
    y: np.ndarray
    size: float
    found: Answer
    beside: np.ndarray | None = None


class Looked:
    """A record with what several checks look at; each is computed when it is first asked for."""

    def __init__(self, record: Record):
        self.record = record
        self.moving = [
            MovingOutput(name, y, places, _with_gaps(y, places))
            for name, y in zip(record.output_names, record.y.T)
            if not is_constant(y)
            for places in [spikes(y)]
        ]
        self.explained: set[str] = set()
        """Outputs whose relation to the inputs another finding has explained."""

    @functools.cached_property
    def u(self) -> np.ndarray:
        """Inputs without their means, over their largest values; those that are constant zero."""
        return np.stack([np.zeros(len(x)) if is_constant(x) else _scaled(x)[0] for x in self.record.u.T], axis=1)

    @functools.cached_property
    def outputs(self) -> list[tuple[int, str, np.ndarray, float]]:
        """Outputs that move: position, name, signal without its mean and over its largest value, NaN where it is
        missing or spoilt, and that value."""
        clean = without_defects(self.record)
        return [
            (k, name, *_scaled(y))
            for k, (name, y) in enumerate(zip(clean.output_names, clean.y.T))
            if not is_constant(y)
        ]

    @functools.cached_property
    def answering(self) -> list[Answering]:
        """Outputs with a relation to the inputs, none of those with many spoilt samples."""
        if not np.any(self.u):
            return []
        found = []
        for k, name, y, size in self.outputs:
            one = answer(self.u, y) if np.mean(np.isnan(y)) <= MOST_SPOILT else None
            if one is None:
                continue
            rubbing = answer(self.u, y, None, self.directions) if RUBBED[0] < one.share < RUBBED[1] else None
            rubs = rubbing is not None and rubbing.share < RUBS * one.share
            more = (rubbing, self.directions) if rubs else (one,)
            found.append(Answering(k, name, np.nan_to_num(y), size, *more))
        return found

    @functools.cached_property
    def directions(self) -> np.ndarray:
        """Directions in which the outputs move: what dry friction there depends on."""
        kinds = self.record.measured
        return np.stack([direction(np.nan_to_num(y), kinds[k]) for k, _, y, _ in self.outputs], axis=1)

    @functools.cached_property
    def aligned(self) -> dict[str, tuple[int, Answer]]:
        """How outputs answer inputs that are put off by so many samples that they explain more."""
        return {one.name: aligned(self.u, one.y, one.found, one.beside) for one in self.answering}

    @functools.cached_property
    def modes(self) -> dict[str, Modes]:
        """Modes of the outputs that the inputs explain well enough, if need be shifted in time."""
        record, found = self.record, {}
        if not distinguishable(self.u):
            return found
        power = input_power(self.u)
        for one in self.answering:
            lead, best = self.aligned[one.name]
            if best.share < EXPLAINED:
                seen = modes(best, power, record.measured[one.position], record.hold, lead)
                if seen is not None:
                    found[one.name] = seen
        return found

    @functools.cached_property
    def shifts(self) -> dict[str, float]:
        """Samples by which outputs are late, of those whose modes say so: all alike where all are best served by one
        shift, otherwise those that the inputs explain well."""
        fits = {
            name: (seen.shift, seen.misfit, seen.unshifted, seen.omega[0], seen.share)
            for name, seen in self.modes.items()
            if np.max(np.abs(seen.parts)) < CANCELLING
        }
        if len(fits) == len(self.answering) > 1:
            misfit = np.mean([self.modes[name].misfits for name in fits], axis=0)
            best, omega = int(np.argmin(misfit)), min(fit[3] for fit in fits.values())
            share = max(self.modes[name].share for name in fits)
            if _is_shift(SHIFTS[best], misfit[best], misfit[len(SHIFTS) // 2], omega, share):
                return dict.fromkeys(fits, float(SHIFTS[best]))
        # Friction turns the phases of single outputs, but then much is left unexplained, and each is turned otherwise.
        shifted = {name: fit[0] for name, fit in fits.items() if _is_shift(*fit)}

        def sure(name: str) -> bool:
            others = [shift for other, shift in shifted.items() if other != name]
            agreed = any(abs(shift - shifted[name]) <= AGREED * abs(shift) for shift in others)
            return len(self.answering) == 1 or self.modes[name].share < PLAIN_SHIFT or agreed

        return {name: shift for name, shift in shifted.items() if sure(name)}

    @functools.cached_property
    def left(self) -> list[float]:
        """What outputs leave of every input beyond its own past, 1 where it rests, is a sweep or is short."""
        first = [1 if kind == "acceleration" or self.record.hold != "zero" else 0 for kind in self.record.measured]
        outputs = [(one.y, first[one.position]) for one in self.answering]

        def told(x: np.ndarray) -> bool:
            moves = len(x) >= MANY and np.median(np.abs(np.diff(x))) > RESTING * np.std(x)
            return bool(moves and overlap(x) > ALIKE)

        return [left_by_outputs(x, outputs) if told(x) else 1.0 for x in self.u.T]

    @functools.cached_property
    def early(self) -> dict[str, float]:
        """Samples by which outputs come before what moves them, negative, of those that hardly follow from the past of
        the inputs and do from what comes; the most of any where all do."""
        found = {}
        # Outputs that come before an input by more than is looked back do not tell it, as a controller's would.
        most = np.inf if min(self.left, default=1.0) > LEFT else BACK
        for one in self.answering:
            lead, best = self.aligned[one.name]
            most_left = min(CAUSED_LATER[0], CAUSED_LATER[1] * one.found.share)
            if lead > 0 and one.found.share > UNCAUSED and best.share < most_left:
                least = least_lead(self.u, one.y, lead, best.share, one.beside)
                if LEAST_SHIFT <= least <= most:
                    found[one.name] = -float(least)
        if len(found) == len(self.answering):
            found = dict.fromkeys(found, min(found.values(), default=0.0))
        return found

    @property
    def open(self) -> list[Answering]:
        """Those that no finding has explained yet."""
        return [one for one in self.answering if one.name not in self.explained]


def _is_shift(shift: float, misfit: float, unshifted: float, omega: float, share: float) -> bool:
    """Whether a shift in samples is one: large enough at a mode of `omega` rad per sample, and far better than none,
    which is seen by a misfit that is large, or stands out of what is unexplained (`share`)."""
    phase = abs(shift) * omega
    better = FAR_BETTER if phase < FRICTION_PHASE else BETTER
    large = abs(shift) >= LEAST_SHIFT and phase > LEAST_PHASE
    seen = unshifted > max(better * misfit, UNSHIFTED) or unshifted > max(PLAINLY[0] * misfit, PLAINLY[1] * share**2)
    return bool(large and misfit < ROUGH and seen)


def _scaled(x: np.ndarray) -> tuple[np.ndarray, float]:
    """A signal that moves, without its mean and over its largest value, and that value: squares of very small and very
    large ones vanish or overflow."""
    largest = np.nanmax(np.abs(x))
    x = x / largest
    x = x - np.nanmean(x)
    size = np.nanmax(np.abs(x))
    return x / size, float(largest * size)


def _with_gaps(y: np.ndarray, places: np.ndarray) -> np.ndarray:
    x = y.copy()
    x[places] = np.nan
    return x


def is_constant(x: np.ndarray) -> bool:
    there = x[~np.isnan(x)]
    return there.size == 0 or bool(np.ptp(there) <= 1e-12 * np.abs(there).max())


def proportion(a: np.ndarray, b: np.ndarray) -> float | None:
    """The factor c for which b − c a is constant, None where there is none."""
    there = ~(np.isnan(a) | np.isnan(b))
    if there.sum() < 10 or is_constant(a[there]) or is_constant(b[there]):
        return None
    x, z = a[there] - a[there].mean(), b[there] - b[there].mean()
    # Scaled, because squares of very small values vanish.
    x_scale, z_scale = np.abs(x).max(), np.abs(z).max()
    x, z = x / x_scale, z / z_scale
    factor = float(x @ z / (x @ x))
    if np.linalg.norm(z - factor * x) > 1e-6 * np.linalg.norm(z):
        return None
    return factor * float(z_scale / x_scale)
