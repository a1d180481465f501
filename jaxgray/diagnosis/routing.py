"""Which way a diagnosis goes: the free run of the linear model, the force equation, or a static gain."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..identification import Identification, identify
from ..identification.identify_hidden import wants_hidden
from ..identification.setup.options import drive_by
from ..identification.validation.structure_test import ROUNDING
from ..mechanics.effects.base import AbstractEffect, AbstractForceEffect
from ..mechanics.systems.drives import AbstractDrive, BaseAcceleration, Force
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.progress import AbstractProgress, BudgetSpent
from ..numerics.responses.filters import white_part
from ..records import Record
from . import settings
from .conclusions.equation_error import force_diagnosis
from .conclusions.static_gain import static_diagnosis
from .equation_error.base_motion import as_forces
from .equation_error.search import Search, Table, Trial, first_trials, table_of
from .equation_error.unmeasured_forces import samples_of
from .equation_error.without_unmeasured_forces import search_forces
from .model.free_run import overall, rms_of
from .result import Diagnosis

Route = Literal["free run", "force equation", "static gain"]

KNOTS, LEAST_KNOTS = 33, 9
"""Ends of the straight pieces of a curve over the input; with fewer the input is no more than some levels."""

RADII = np.linspace(0.04, 0.48, 12)
"""Of plays, relative to the range of the input; half of it is the most that moves."""

NEIGHBOURS = 3
"""Samples before and after, in which a motion that is not static shows."""

NOT_MENDED = (RESULTS.unreachable, RESULTS.too_short, RESULTS.singular_state_basis)
"""Failures of the linear fit that no other way mends."""


@dataclass(frozen=True)
class ForceEquation:
    """The force equation of a diagnosis, which is set up once and searched once for the same records, whoever asks:
    for the first law, or for all.

    `catalogue`; `max_effects`; `seed`; `progress`.
    """

    catalogue: tuple[AbstractEffect, ...]
    max_effects: int
    seed: int
    progress: AbstractProgress
    _tables: dict = field(default_factory=dict)
    _searches: dict = field(default_factory=dict)
    _firsts: dict = field(default_factory=dict)

    def table(self, records: list[Record], drive: AbstractDrive) -> Table:
        """What a search begins with.

        **Raises:** as `table_of`.
        """
        none = samples_of((), records)
        return _once(
            self._tables, (records,), lambda: table_of(records, drive, self.catalogue, None, none, self.progress)
        )

    def search(self, records: list[Record], held: list[Record], drive: AbstractDrive) -> Search:
        """The whole search.

        **Raises:** as `search_forces`.
        """
        groups = records, held
        return _once(self._searches, groups, lambda: self._searched(*groups, drive, self.max_effects))

    def first(self, records: list[Record], held: list[Record], drive: AbstractDrive) -> Search:
        """The search as far as its first law; the whole one where forces act that are not among the inputs, as more
        laws may explain these.

        **Raises:** as `search_forces`.
        """
        groups = records, held
        if _key(groups) in self._searches:
            return self.search(*groups, drive)
        found = _once(self._firsts, groups, lambda: self._searched(*groups, drive, 1))
        return self.search(*groups, drive) if found.brief_forces else found

    def _searched(self, records, held, drive, most: int) -> Search:
        options = {"rng": np.random.default_rng(self.seed), "progress": self.progress}
        options["table"] = lambda: self.table(records, drive)
        return search_forces(records, held, drive, self.catalogue, most, **options)


def _key(groups: tuple[list[Record], ...]) -> tuple:
    return tuple(tuple(map(id, records)) for records in groups)


def _once(known: dict, groups: tuple[list[Record], ...], make: Callable[[], Any]) -> Any:
    """What was made for these very records, or else is made now, in the place of what was made for others."""
    key = _key(groups)
    found = known.get(key)
    if found is None:
        # As long as they are kept, no others have their identity.
        found = [list(records) for records in groups], make()
        known.clear()
        known[key] = found
    return found[1]


def begin(
    records: list[Record], held: list[Record], forces: ForceEquation, options: dict
) -> Identification | Diagnosis:
    """The linear fit, or the whole diagnosis of records on which its free run is of no use.

    **Arguments:** `records`, `held`; `forces`: with what is looked for; `options`: of `identify`.

    **Returns:** an `Identification` where the free run serves, otherwise a `Diagnosis` by another route.

    **Raises:** as `identify`.
    """
    identification = failure = None
    catalogue, max_effects, seed, progress = forces.catalogue, forces.max_effects, forces.seed, forces.progress
    drive = drive_by(records[0], options)
    if _of_displacements(records, drive) and all(map(is_static_curve, records)):
        rng = np.random.default_rng(seed)
        return static_diagnosis(
            records, held, drive, catalogue, max_effects, identification=None, rng=rng, progress=progress
        )
    try:
        identification = identify(records, validation=held, progress=progress.unlimited, **options)
    except ComputationError as error:
        failure = error
        if any(error.result == one for one in NOT_MENDED) or not any(np.any(record.u) for record in records):
            raise
    unseen = wants_hidden(options.get("hidden", 0), options.get("structure"), records[0].output_names)
    if failure is not None and unseen:
        raise failure
    if identification is not None and identification.model.hidden:
        # Every other way needs the motion of all coordinates.
        return identification
    rng = np.random.default_rng(seed)
    route = route_of(records, identification, drive)
    if route == "static gain":
        return static_diagnosis(
            records, held, drive, catalogue, max_effects, identification=identification, rng=rng, progress=progress
        )
    converges = identification is not None and may_converge_in_phase(identification)
    if converges and _fit(identification) >= settings.USELESS_FIT:
        # The search asks the force equation for its laws, and a poor free run may show more than these.
        return identification
    if route == "force equation":
        try:
            search = forces.search(records, held, drive)
        except ComputationError as error:
            if identification is None:
                # The linear fit says what is wrong with the record.
                raise failure from error
            return identification
        # A free run that is poor but of some use may show what the force equation does not; and with the laws of the
        # force equation the free run of a body on a spring may converge in phase.
        useless = identification is None or _fit(identification) < settings.USELESS_FIT
        if (search.taken or useless) and not (search.taken and converges):
            return force_diagnosis(search, identification)
        return identification
    if failure is not None:
        raise failure
    return identification


def asked_of_forces(
    records: list[Record],
    held: list[Record],
    identification: Identification | None,
    forces: ForceEquation,
    options: dict,
) -> Callable[[bool], Search | None] | None:
    """What gives the search in the force equation of records on which the free run of some output is poor, or far from
    what the noise of its samples explains.

    **Arguments:** as `begin`; `identification`: the linear fit, None where a user's own model is judged.

    **Returns:** a function of whether all laws are asked for, or the first alone, which searches once however often it
    is called and gives None where the force equation has no solution; None where it does not apply.
    """
    if identification is None or identification.model.hidden:
        return None
    if not (worst_fit(identification) < settings.USABLE_FIT or _far(records, identification)):
        return None
    drive = drive_by(records[0], options)
    if not isinstance(drive, Force) or "acceleration" in records[0].measured:
        return None

    @functools.cache
    def search(whole: bool) -> Search | None:
        forces.progress.unlimited.stage("looking in the force equation")
        try:
            return (forces.search if whole else forces.first)(records, held, drive)
        except ComputationError:
            return None

    return search


def force_equation_trials(
    records: list[Record], forces: ForceEquation, options: dict
) -> Callable[[], list[Trial]] | None:
    """Trials of the force equation for the first law: starts of refits alone.

    **Arguments:** as `begin`.

    **Returns:** a function without arguments, which looks once however often it is called; None where the equation is
    not known: on a base known by its displacement, and where accelerations jump at the samples.
    """
    drive = drive_by(records[0], options)
    based = isinstance(drive, BaseAcceleration)
    # Under a zero-order hold accelerations jump at the samples, and their integrals are late by half of one.
    pushed = isinstance(drive, Force) and ("acceleration" not in records[0].measured or records[0].hold == "linear")
    if not based and not pushed:
        return None

    progress = forces.progress

    @functools.cache
    def trials() -> list[Trial]:
        try:
            progress.stage("looking in the force equation")
            if not based:
                return first_trials(forces.table(records, drive))
            relative, inertia, mass = as_forces(records, drive)
            none = samples_of((), relative)
            return first_trials(table_of(relative, inertia, forces.catalogue, mass, none, progress))
        except (ComputationError, BudgetSpent, np.linalg.LinAlgError, ValueError):
            # A record that shows it nothing, such as an output that never moves, is no reason to stop.
            return []

    return trials


def by_accelerations(records: list[Record], options: dict) -> bool:
    """Whether accelerations are measured, or move the base: there strong laws are lost to the free run."""
    return "acceleration" in records[0].measured or isinstance(drive_by(records[0], options), BaseAcceleration)


def may_converge_in_phase(identification: Identification) -> bool:
    """Whether a body on springs has a poor free run, which a missing law may bring into phase with the record."""
    return bool(np.any(identification.stiffness)) and _fit(identification) < settings.POOR_FIT


def by_force_equation(found: Diagnosis, forces: Callable[[bool], Search | None] | None) -> Diagnosis:
    """A diagnosis of free runs, or what the force equation finds, where the first is not sound and its model is twice
    as far from windows of the held-out data.

    **Arguments:** `found`; `forces`: as `asked_of_forces` gives it.
    """
    sound = found.verdict in ("named", "equivalent") and (found.gain is None or found.gain.ci95[0] > 0)
    search = None if sound or forces is None else forces(True)
    if search is None or not search.taken:
        return found
    if found.extended is None and may_converge_in_phase(found.identification):
        return force_diagnosis(search, found.identification)
    own = (found.baseline if found.extended is None else found.extended).model
    # What else it has belongs to a record's clock, or to a sensor.
    laws = (t for t in own.effects if isinstance(t.effect, AbstractForceEffect) and not t.effect.tied_to_clock)
    runs = search.windows.run(dataclasses.replace(own, effects=tuple(laws)))
    here, there = (runs[len(search.records) :] or runs), (search.runs[1] or search.runs[0])
    nearer = overall(rms_of(there), rms_of(here)) < settings.MUCH_NEARER
    return force_diagnosis(search, found.identification) if nearer else found


def route_of(records: list[Record], identification: Identification | None, drive: AbstractDrive) -> Route:
    """The way a diagnosis goes.

    A single sine gives two equations, and M, D, K are three: where the motion follows it statically, a static gain.
    The force equation, where there is no linear model, where it has no stiffness and its free run drifts, or where its
    free run is poor or does not determine the masses.

    **Arguments:** `records`; `identification`: the linear fit, None where it failed; `drive`.

    **Returns:** "free run", "force equation" or "static gain".
    """
    if _of_displacements(records, drive) and all(map(is_single_sine, records)) and all(map(is_static, records)):
        return "static gain"
    if not isinstance(drive, Force) or "acceleration" in records[0].measured:
        return "free run"
    if identification is None:
        return "force equation"
    fit = _fit(identification)
    mass, errors = np.diag(identification.mass), identification.standard_errors
    undetermined = errors is not None and np.any(np.diag(errors["mass"]) > settings.UNDETERMINED_MASS * np.abs(mass))
    if not np.any(identification.stiffness) and fit < settings.USABLE_FIT:
        return "force equation"
    if fit < settings.POOR_FIT or (undetermined and fit < settings.USABLE_FIT):
        return "force equation"
    return "free run"


def _far(records: list[Record], identification: Identification) -> bool:
    """Whether the free run of some output leaves many times the noise of its samples."""
    left = np.max([one.rmse for one in identification.estimation], axis=0)
    quiet = [np.sqrt(white_part(np.nan_to_num(r.y), np.isfinite(r.y))) for r in records]
    return bool(np.any(left > settings.NOISE_MULTIPLE * np.max(quiet, axis=0)))


def worst_fit(identification: Identification) -> float:
    """Fit [%] of the free run of the output that has the poorest."""
    return float(np.min([one.fit_percent for one in identification.estimation]))


def _fit(identification: Identification) -> float:
    """Mean fit [%] of the free run."""
    return float(np.mean([one.fit_percent for one in identification.estimation]))


def is_single_sine(record: Record) -> bool:
    """Whether every input that moves is one sine about a mean."""
    u = record.u - record.u.mean(axis=0)
    for column in u.T[np.std(u, axis=0) > 0]:
        power = np.abs(np.fft.rfft(column * np.hanning(len(column)), 4 * len(column))) ** 2
        # A sine's own width, and its mean that the window lets through, in bins of the padded transform.
        peak = int(np.argmax(power[12:])) + 12
        near = _refined(column, peak / (4 * len(column)))
        if near > settings.SINGLE_LINE_SHARE * float(column @ column):
            return False
    return bool(np.any(np.std(u, axis=0) > 0))


def _refined(x: np.ndarray, frequency: float) -> float:
    """Least sum of squares that a mean and a sine near a frequency (per sample) leave."""
    n, least = np.arange(len(x)), np.inf
    width = 0.5 / len(x)
    for _ in range(6):
        for f in frequency + width * np.linspace(-1, 1, 9):
            table = np.stack([np.ones(len(x)), np.cos(2 * np.pi * f * n), np.sin(2 * np.pi * f * n)], axis=1)
            e = x - table @ np.linalg.lstsq(table, x, rcond=None)[0]
            if e @ e < least:
                least, best = float(e @ e), f
        frequency, width = best, width / 4
    return least


def _of_displacements(records: list[Record], drive: AbstractDrive) -> bool:
    return isinstance(drive, Force) and all(kind == "displacement" for kind in records[0].measured)


def is_static_curve(record: Record) -> bool:
    """Whether the outputs are a curve over the one input, or loops over it that do not depend on the time they take,
    as far as the record shows: what the input just was, or will be, makes it no better. Then it says nothing of mass
    and damping."""
    if record.inputs != 1 or not np.ptp(record.u) > 0 or not is_static(record):
        return False
    u, away = record.u[:, 0], range(1, NEIGHBOURS + 1)
    knots = np.unique(np.quantile(u, np.linspace(0, 1, KNOTS)))
    if len(knots) < LEAST_KNOTS:
        return False
    before = [u - np.concatenate([np.full(k, u[0]), u[:-k]]) for k in away]
    after = [u - np.concatenate([u[k:], np.full(k, u[-1])]) for k in away]
    near = np.stack([*before, *after], axis=1)
    curve = np.concatenate([np.ones((record.samples, 1)), np.maximum(u[:, None] - knots[None, :-1], 0.0)], axis=1)
    if _says_no_more(record, curve, near):
        return True
    # At one frequency and amplitude a lag draws the same loop.
    return not is_single_sine(record) and _says_no_more(
        record, np.concatenate([curve, plays(u, RADII * np.ptp(u))], axis=1), near
    )


def _says_no_more(record: Record, table: np.ndarray, near: np.ndarray) -> bool:
    """Whether the inputs `near` a sample explain no more of any output than a table of its columns does."""
    both = np.concatenate([table, near], axis=1)
    for y in record.y.T:
        known = np.isfinite(y)
        alone, more = (_left(columns[known], y[known]) for columns in (table, both))
        if not alone > 0.0:
            # Rounding is all that the table leaves.
            continue
        gain = known.sum() * np.log(alone / max(more, 1e-300)) - 2 * NEIGHBOURS * np.log(known.sum())
        if gain > settings.MIN_DELTA_BIC:
            return False
    return True


def plays(u: Float[np.ndarray, " samples"], radii: Float[np.ndarray, " radii"]) -> Float[np.ndarray, "samples radii"]:
    """What follows an input with play of several radii, begun in the middle: loops without a time of their own are
    sums of them (Kuhnen 2003)."""
    z = np.full(len(radii), u[0])
    result = np.empty((len(u), len(radii)))
    for k, value in enumerate(u):
        z = np.clip(z, value - radii, value + radii)
        result[k] = z
    return result


def _left(table: np.ndarray, y: np.ndarray) -> float:
    """Mean square that a least-squares fit leaves, 0 where it is rounding."""
    size = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    e = y - (table / size) @ np.linalg.lstsq(table / size, y, rcond=1e-10)[0]
    left = float(e @ e) / len(y)
    return left if left > (ROUNDING * np.max(np.abs(y))) ** 2 else 0.0


def is_static(record: Record) -> bool:
    """Whether a straight line in the inputs leaves less than half of every output's motion."""
    table = np.concatenate([np.ones((record.samples, 1)), record.u], axis=1)
    for y in record.y.T:
        known = np.isfinite(y)
        e = y[known] - table[known] @ np.linalg.lstsq(table[known], y[known], rcond=None)[0]
        if not np.std(e) < settings.STATIC_RESIDUAL * np.std(y[known]):
            return False
    return True
