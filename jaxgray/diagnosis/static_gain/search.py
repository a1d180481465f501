"""The diagnosis of records that say nothing of inertia: effects at the inputs of a static gain, judged held out."""

from dataclasses import dataclass

import numpy as np

from ...identification.validation.structure_test import ROUNDING
from ...mechanics.effects.base import AbstractEffect, AbstractInputEffect, Scales, Term, places_of
from ...numerics.progress import AbstractProgress, BudgetSpent
from ...records import Record
from .. import settings
from ..acceptance import AbstractEvidence, bound_of, negligible, unproven, unsound
from ..findings import Gain, Reason, Refusal, Rejected
from ..model.candidate import estimated
from ..model.free_run import FreeRun, rms_of
from ..model.held_out_gain import gain_of
from ..noise.effective_samples import independent_share
from .regression import Static, StaticFit


@dataclass(frozen=True)
class Trial(AbstractEvidence):
    """A refitted candidate; `delta_bic` against the fit `without` it, under its own share of independent samples."""

    without: StaticFit
    scales: Scales
    fit: StaticFit
    delta_bic: float
    share: float
    runs: list[FreeRun]

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        term = self.fit.terms[-1]
        return term.effect.id, term.place.name

    def bound(self):
        return bound_of(self.fit.terms[-1], estimated(self.fit.terms[-1]))

    def other_law(self):
        term = self.fit.terms[-1]
        return term.effect.unresolved(np.asarray(term.values, float), self.scales)

    def explained(self):
        return 1 - self.fit.cost / self.without.cost

    def size(self):
        """Of several amplitudes, which may share one loop between them, what ΔBIC says."""
        term = self.fit.terms[-1]
        amplitudes = [j for j in estimated(term) if term.effect.parameters[j].amplitude]
        if len(amplitudes) != 1:
            return float(np.sqrt(max(self.delta_bic, 0.0) / len(amplitudes))) if amplitudes else np.inf
        error = self.fit.term_errors(len(self.fit.terms) - 1, self.share)[amplitudes[0]]
        return abs(float(term.values[amplitudes[0]])) / error if error > 0 else 0.0


@dataclass(frozen=True)
class StaticSearch:
    """What the search over a static gain ended with.

    `base`, `fit`: without effects and with those taken; `base_runs`, `runs`: their runs over the data of the fit and
    over the held-out data; `taken`: per effect its refit, those that explain as much, and its gain; `rejected`;
    `something_left`: whether a further effect passed every test but was not taken.
    """

    base: StaticFit
    fit: StaticFit
    base_runs: tuple[list[FreeRun], list[FreeRun]]
    runs: tuple[list[FreeRun], list[FreeRun]]
    taken: tuple[tuple[Trial, tuple[Trial, ...], Gain], ...]
    rejected: tuple[Rejected, ...]
    something_left: bool


def search_static(
    records: list[Record],
    held: list[Record],
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    *,
    rng: np.random.Generator,
    progress: AbstractProgress,
) -> StaticSearch:
    """The effects at the inputs of a static gain that explain the records.

    **Arguments:** `records`, `held`: to fit, and to judge; `catalogue`: of which the input effects are tried;
    `max_effects`; `rng`; `progress`.
    """
    progress.unlimited.stage("fitting a static gain")
    problem, later = Static(records), Static(held)
    names, inputs = records[0].output_names, records[0].input_names
    base = fit = problem.fit(())
    base_runs = problem.run(base), later.run(base)
    runs = base_runs
    taken: list[tuple[Trial, tuple[Trial, ...], Gain]] = []
    rejected: list[Rejected] = []
    strong = False
    effects = [e for e in catalogue if isinstance(e, AbstractInputEffect)]
    # One look more than effects may be added: whether something is left.
    for turn in range(0 if _is_rounding(base_runs[0], records) else max_effects + 1):
        accepted = {trial.name for trial, _, _ in taken}
        try:
            trials = _trials(problem, fit, effects, accepted, (inputs, names), progress)
        except BudgetSpent:
            strong = True
            break
        passed = []
        for trial in trials:
            why = unsound(trial) or negligible(trial, "what is left")
            if why is None:
                passed.append(trial)
            elif trial.delta_bic > 0:
                rejected.append(Rejected.of(trial.name, trial.delta_bic, why))
        strong = bool(passed)
        if turn == max_effects:
            break
        found = None
        for judged, trial in enumerate(passed, start=1):
            new = problem.run(trial.fit), later.run(trial.fit)
            before, after, first = (x[1] or x[0] for x in (runs, new, base_runs))
            options = {"held_out": bool(held), "rng": rng, "trials": judged}
            gain = gain_of(before, after, first, rms_of(first), names, **options)
            if (why := unproven(gain)) is None:
                found = trial, gain, new
                break
            rejected.append(Rejected.of(trial.name, trial.delta_bic, why, gain))
        if found is None:
            break
        trial, gain, runs = found
        rivals = []
        for other in passed:
            difference = trial.delta_bic - other.delta_bic
            if 0 <= difference < settings.CLASS_DELTA_BIC and other is not trial:
                rivals.append(other)
            elif difference >= settings.CLASS_DELTA_BIC:
                words = f"explained better by {' at '.join(trial.name)} (by {difference:.0f})"
                rejected.append(Rejected.of(other.name, other.delta_bic, Refusal(Reason.EXPLAINED_BETTER, words)))
        taken.append((trial, tuple(rivals[:3]), gain))
        fit = trial.fit
    return StaticSearch(base, fit, base_runs, runs, tuple(taken), tuple(rejected), strong)


def _trials(problem: Static, fit: StaticFit, effects, accepted, channels, progress) -> list[Trial]:
    """Every effect at every place where it is not in the model, refitted, best first."""
    trials = []
    for effect in effects:
        places = places_of(effect, *channels)
        for place in places:
            if (effect.id, place.name) not in accepted:
                progress.stage(f"refitting {effect.id} at {place.name}")
                trial = _trial(problem, fit, effect, place, len(places))
                trials += [] if trial is None else [trial]
    return sorted(trials, key=lambda trial: -trial.delta_bic)


def _is_rounding(runs: list[FreeRun], records: list[Record]) -> bool:
    """Whether runs leave nothing but rounding of the outputs."""
    size = np.max([np.nanmax(np.abs(record.y), axis=0) for record in records], axis=0)
    return bool(np.all(rms_of(runs) <= ROUNDING * size))


def _trial(problem: Static, before: StaticFit, effect: AbstractEffect, place, places: int) -> Trial | None:
    """A candidate refitted from all its shapes, one of so many places; None where none is finite."""
    best, scales = None, problem.scales(place)
    shapes = effect.shapes(scales)
    for values in shapes:
        start = np.array(values, float)
        start[[p.amplitude for p in effect.parameters]] *= 0.1
        made = problem.fit((*before.terms, Term(effect, place, effect.bounded(start))))
        if made is not None and (best is None or made.cost < best.cost):
            best = made
    if best is None:
        return None
    runs = problem.run(best)
    share = independent_share(max((run.e[run.kept.all(axis=1)] for run in runs), key=len))
    delta = before.criterion(share) - best.criterion(share) - 2 * np.log(len(shapes) * places)
    return Trial(before, scales, best, float(delta), share, runs)
