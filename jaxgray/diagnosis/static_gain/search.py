"""The diagnosis of records that say nothing of inertia: effects at the inputs of a static gain, and springs
(`selection.py`)."""

from dataclasses import dataclass

import numpy as np

from ...identification.validation.structure_test import ROUNDING
from ...mechanics.effects.base import AbstractEffect, AbstractInputEffect, Place, Scales, Term, places_of
from ...mechanics.systems.drives import AbstractDrive, Force
from ...numerics.progress import AbstractProgress
from ...records import Record
from ..acceptance import bound_of
from ..model.candidate import estimated
from ..model.free_run import FreeRun, rms_of
from ..noise.effective_samples import independent_share
from ..selection import AbstractSelection, AbstractTrial
from .regression import Static, StaticFit
from .springs import is_spring


@dataclass(frozen=True)
class Trial(AbstractTrial):
    """A refitted candidate; `delta_bic` against the fit `without` it, under its own share of independent samples."""

    without: StaticFit
    scales: Scales
    fit: StaticFit
    delta_bic: float
    share: float

    def bound(self):
        return bound_of(self.term, estimated(self.term))

    def other_law(self):
        return self.term.effect.unresolved(np.asarray(self.term.values, float), self.scales)

    def by_contact(self) -> tuple[str, str]:
        """The name that its contact gives a law with a gap: backlash where it is left in more than half of the samples,
        an end stop where in fewer; of other laws their own."""
        names = self.term.effect.by_contact
        if not names:
            return self.name
        often = float(self.term.values[1]) < self.scales.q_quantiles[0]
        return names[0 if often else 1], self.name[1]

    def explained(self):
        return 1 - self.fit.cost / self.without.cost

    def size(self):
        """Of several amplitudes, which may share one loop between them, what ΔBIC says."""
        term = self.term
        amplitudes = [j for j in estimated(term) if term.effect.parameters[j].amplitude]
        if len(amplitudes) != 1:
            return float(np.sqrt(max(self.delta_bic, 0.0) / len(amplitudes))) if amplitudes else np.inf
        error = self.fit.term_errors(len(self.fit.terms) - 1, self.share)[amplitudes[0]]
        return abs(float(term.values[amplitudes[0]])) / error if error > 0 else 0.0


@dataclass(kw_only=True)
class StaticSearch(AbstractSelection):
    """The selection over a static gain: `problem` and `later` fit the records and those held out; `effects`: tried."""

    problem: Static
    later: Static
    effects: tuple[AbstractEffect, ...]

    def run(self, fit):
        return self.problem.run(fit), self.later.run(fit)

    def looks(self, last):
        return not _is_rounding(self.base_runs[0], self.records)

    def trials(self):
        trials, accepted = [], {taken.trial.name for taken in self.taken}
        for effect in self.effects:
            places = places_of(effect, self.records[0].input_names, self.records[0].output_names)
            for place in places:
                if (effect.id, place.name) not in accepted:
                    self.progress.stage(f"refitting {effect.id} at {place.name}")
                    trial = _trial(self.problem, self.fit, effect, place, len(places))
                    trials += [] if trial is None else [trial]
        names = {trial.name for trial in trials}
        return sorted((t for t in trials if t.by_contact() not in names - {t.name}), key=lambda t: -t.delta_bic)


def search_static(
    records: list[Record],
    held: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    *,
    rng: np.random.Generator,
    progress: AbstractProgress,
) -> StaticSearch:
    """The effects at the inputs of a static gain, and the springs, that explain the records.

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`; `catalogue`: of which input effects are tried, and
    springs where every coordinate has an input;
    `max_effects`; `rng`; `progress`.
    """
    progress.unlimited.stage("fitting a static gain")
    inverse = _inverse(drive)
    problem, later = Static(records, inverse), Static(held, inverse)
    effects = tuple(e for e in catalogue if isinstance(e, AbstractInputEffect))
    if inverse is not None:
        at_first = problem.displacements(Place(records[0].output_names[0], 0))
        effects += tuple(e for e in catalogue if is_spring(e, at_first))
    data = {"records": records, "held": held, "problem": problem, "later": later}
    search = StaticSearch(**data, effects=effects, rng=rng, progress=progress)
    search.base = search.fit = search.problem.fit(())
    search.select(max_effects)
    return search


def _inverse(drive: AbstractDrive) -> np.ndarray | None:
    """Which inputs are a force at each coordinate; None where not every coordinate has one."""
    if not isinstance(drive, Force):
        return None
    E = np.asarray(drive.input_map, dtype=float)
    return np.linalg.inv(E) if E.shape[0] == E.shape[1] and np.linalg.matrix_rank(E) == len(E) else None


def _is_rounding(runs: list[FreeRun], records: list[Record]) -> bool:
    """Whether runs leave nothing but rounding of the outputs."""
    size = np.max([np.nanmax(np.abs(record.y), axis=0) for record in records], axis=0)
    return bool(np.all(rms_of(runs) <= ROUNDING * size))


def _trial(problem: Static, before: StaticFit, effect: AbstractEffect, place, places: int) -> Trial | None:
    """A candidate refitted from all its shapes, one of so many places; None where none is finite."""
    at_input = isinstance(effect, AbstractInputEffect)
    best, scales = None, problem.scales(place) if at_input else problem.displacements(place)
    shapes = effect.shapes(scales)
    for values in shapes:
        start = problem.with_first_sizes(before, Term(effect, place, np.array(values, float)))
        made = problem.fit((*before.terms, start))
        if made is not None and (best is None or made.cost < best.cost):
            best = made
    if best is None:
        return None
    parts = (run.e[run.kept.all(axis=1)] for run in problem.run(best))
    share = independent_share(max(parts, key=len))
    delta = before.criterion(share) - best.criterion(share) - 2 * np.log(len(shapes) * places)
    return Trial(before, scales, best, float(delta), share)
