"""The diagnosis of records without a usable free run: decided in the force equation, judged on short windows.

Laws are added one by one to E u = M q̈ + D q̇ + K q. Among those that explain most of what the best one explains, a new
law goes before one that shares a part with a law already in the model, and the one of the fewest parameters first.
"""

import dataclasses
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from ...mechanics.drives import AbstractDrive
from ...mechanics.effects.base import AbstractEffect, Term
from ...mechanics.model import MechanicalModel
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress, BudgetSpent
from ...records import Record
from .. import settings
from ..acceptance import AbstractEvidence, bound_of, negligible, unproven, unsound
from ..findings import Gain, Reason, Refusal, Rejected
from ..model.free_run import FreeRun, rms_of
from ..model.held_out_gain import gain_of
from .library import Library, Scores, score
from .regression import Equation, ForceFit
from .rows import band_of, series_of
from .unmeasured_forces import BriefForce, samples_of
from .windows import Windows, window_samples

SHORT = 8
"""Candidates that are refitted in one round."""

STARTS = 3
"""Shapes from which each of them is refitted."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A refitted candidate: `fit` with it, `delta_bic` against the model without, `explained` power. Equal to itself
    alone."""

    fit: ForceFit
    delta_bic: float
    explained: float

    @property
    def term(self) -> Term:
        """The term that was added."""
        return self.fit.terms[-1]

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        return self.term.effect.id, self.term.place.name

    @property
    def parameters(self) -> int:
        """Values that were estimated for it."""
        return len(self.fit.moving[-1])


@dataclass(frozen=True)
class Taken:
    """An accepted law: `trial`, the `rivals` of its class, `gain`, relative force `error` and free `runs` with it;
    `stood_in`: what had stood in for it before, with its ΔBIC against it."""

    trial: Trial
    rivals: tuple[Trial, ...]
    gain: Gain
    error: float
    runs: tuple[list[FreeRun], list[FreeRun]]
    stood_in: tuple[tuple[Trial, float], ...] = ()


@dataclass
class Search:
    """How far the search got, and what it works with."""

    records: list[Record]
    held: list[Record]
    drive: AbstractDrive
    equation: Equation
    library: Library
    windows: Windows
    rng: np.random.Generator
    progress: AbstractProgress
    base: ForceFit | None = None
    fit: ForceFit | None = None
    taken: list[Taken] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    scores: Scores | None = None
    base_runs: tuple[list[FreeRun], list[FreeRun]] = ((), ())
    runs: tuple[list[FreeRun], list[FreeRun]] = ((), ())
    strong: bool = False
    brief_forces: tuple[BriefForce, ...] = ()

    def model(self, fit: ForceFit) -> MechanicalModel:
        """The model of a fit."""
        first = self.records[0]
        terms = tuple(Term(t.effect, t.place, jnp.asarray(t.values)) for t in fit.terms)
        return MechanicalModel(
            *fit.matrices,
            drive=self.drive,
            measured=first.measured,
            input_names=first.input_names,
            output_names=first.output_names,
            input_units=first.input_units,
            output_units=first.output_units,
            effects=terms,
        )

    def error(self, fit: ForceFit) -> float:
        """Relative force error where the body moves: at rest dry friction takes any value."""
        return self.equation.relative_error(fit)

    def run(self, fit: ForceFit) -> tuple[list[FreeRun], list[FreeRun]]:
        """Free runs on the windows of the records, and of those held out."""
        runs = self.windows.run(self.model(fit))
        return runs[: len(self.records)], runs[len(self.records) :]


def search_once(
    records: list[Record],
    held: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    brief_forces: tuple[BriefForce, ...],
    rng: np.random.Generator,
    progress: AbstractProgress,
) -> Search:
    """Add laws to the force equation until nothing more is found.

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`: forces; `catalogue`; `max_effects`; `brief_forces`:
    left out; `rng`: of the resampling; `progress`.

    **Returns:** a `Search`.

    **Raises:** `ComputationError` where the force equation has no solution of positive mass.
    """
    progress.unlimited.stage("setting up the force equation")
    E = np.asarray(drive.input_map)
    cutoff = min(map(band_of, records))
    left_out = samples_of(brief_forces, records + held)
    series = [series_of(r, cutoff, left_out=mask) for r, mask in zip(records, left_out)]
    everything = [series_of(r, cutoff, at_rest=True, left_out=mask) for r, mask in zip(records + held, left_out)]
    equation = Equation(series, E)
    if min(len(s.rows) for s in series) < 4 * equation.entries + 8:
        raise ComputationError(
            RESULTS.too_short,
            stage="force equation",
            detail=f"{min(len(s.rows) for s in series)} rows of motion below {cutoff:.3g} Hz in the shortest record",
        )
    length = window_samples(records + held)
    windows = Windows(records + held, everything, length, left_out)
    names = records[0].input_names, records[0].output_names
    progress.unlimited.stage("looking for effects")
    library = Library.of(equation, catalogue, names)
    search = Search(records, held, drive, equation, library, windows, rng, progress, brief_forces=brief_forces)
    search.base = search.fit = _settled(equation, ())
    if search.base is None:
        raise ComputationError(RESULTS.nonfinite, stage="force equation", detail="no positive mass fits the record")
    search.base_runs = search.runs = search.run(search.base)
    for turn in range(max_effects + 1):
        search.scores = score(library, search.fit, frozenset(t.trial.name for t in search.taken))
        search.strong = False
        if turn == max_effects or not search.scores.fires:
            break
        search.progress.unlimited.stage("looking for effects" if turn == 0 else f"looking further ({turn} found)")
        try:
            found = _round(search)
        except BudgetSpent:
            # What was seen and not all tried is left.
            search.strong = True
            break
        if not found:
            break
        _backward(search)
    _recount(search)
    return search


def _settled(equation: Equation, terms: tuple[Term, ...]) -> ForceFit | None:
    """A fit with the weight of its own residual."""
    first = equation.fit(terms, equation.plain())
    return None if first is None else equation.fit(first.terms, equation.weight_of(first.residual))


def _trials(search: Search) -> list[Trial]:
    """The most promising candidates, refitted from several shapes each; the best of each, best first."""
    equation, weight = search.equation, search.scores.weight
    without = equation.fit(search.fit.terms, weight)
    starts: dict[tuple[str, str], list] = {}
    for one in search.scores.scores:
        key = one.shape.effect.id, one.shape.place.name
        if one.delta_bic < settings.MIN_DELTA_BIC or (key not in starts and len(starts) == SHORT):
            continue
        if len(starts.setdefault(key, [])) < STARTS:
            starts[key].append(one)
    found = []
    for key, ones in starts.items():
        search.progress.stage(f"refitting {key[0]} at {key[1]}")
        fits = [equation.fit((*search.fit.terms, one.shape.term(one.weights)), weight) for one in ones]
        fits = [fit for fit in fits if fit is not None]
        if not fits:
            why = Refusal(Reason.NOT_SIMULATED, "its refit found nothing finite of positive mass")
            search.rejected.append(Rejected.of(key, np.nan, why))
            continue
        best = min(fits, key=lambda fit: fit.criterion)
        delta = without.criterion - best.criterion - 2 * np.log(ones[0].shape.tried)
        found.append(Trial(best, float(delta), _power(without) - _power(best)))
    return sorted(found, key=lambda trial: -trial.delta_bic)


def _power(fit: ForceFit) -> float:
    return fit.cost / fit.count


@dataclass(frozen=True)
class _Evidence(AbstractEvidence):
    """What the force equation says of a trial."""

    search: Search
    trial: Trial

    @property
    def delta_bic(self) -> float:
        return self.trial.delta_bic

    def bound(self):
        return bound_of(self.trial.term, self.trial.fit.moving[-1])

    def other_law(self):
        term = self.trial.term
        scales = self.search.equation.scales(term.effect, term.place)
        return term.effect.unresolved(np.asarray(term.values, float), scales)

    def size(self):
        return self.trial.fit.significance(len(self.trial.fit.terms) - 1)

    def explained(self):
        before, after = (self.search.error(fit) for fit in (self.search.fit, self.trial.fit))
        return 1 - (after / before) ** 2


def _refused(search: Search, trial: Trial) -> Refusal | None:
    """Why a refit cannot be accepted, before any held-out data are looked at."""
    evidence = _Evidence(search, trial)
    if (refusal := unsound(evidence)) is not None:
        return refusal
    place, parts = trial.term.place.name, _symbols(trial.term)
    if sum(t.trial.term.place.name == place and bool(_symbols(t.trial.term) & parts) for t in search.taken) > 1:
        return Refusal(Reason.NEEDLESS, "a second refinement of what is in the model already")
    return negligible(evidence, "what is left of the force")


def _ordered(search: Search, trials: list[Trial]) -> list[Trial]:
    """Trials in the order in which they are judged: of those that explain most, new laws before wider forms of what is
    in the model, then the simplest."""
    known = {place: _symbols(t.trial.term) for t in search.taken for place in [t.trial.term.place.name]}

    def generalises(trial):
        return bool(known.get(trial.term.place.name, frozenset()) & _symbols(trial.term))

    result, pool = [], list(trials)
    while pool:
        best = max(t.explained for t in pool)
        enough = [t for t in pool if t.explained >= settings.SIMPLER_SHARE * best]
        result.append(min(enough, key=lambda t: (generalises(t), t.parameters, -t.delta_bic)))
        pool.remove(result[-1])
    return result


def _symbols(term: Term) -> frozenset:
    return frozenset(p.name for p in term.effect.parameters if p.amplitude)


def _round(search: Search) -> bool:
    """Accept the first trial that holds; whether one did."""
    passed = []
    for trial in _trials(search):
        why = _refused(search, trial)
        if why is None:
            passed.append(trial)
        elif trial.delta_bic > 0:
            search.rejected.append(Rejected.of(trial.name, trial.delta_bic, why))
    search.strong = bool(passed)
    names = search.records[0].output_names
    judged = 0
    for trial in _ordered(search, passed):
        search.progress.stage(f"judging {trial.name[0]} at {trial.name[1]}")
        fit = _settled(search.equation, trial.fit.terms)
        if fit is None:
            continue
        runs = search.run(fit)
        before, after, base = (x[1] or x[0] for x in (search.runs, runs, search.base_runs))
        if not all(np.all(np.isfinite(run.e)) for run in after):
            why = Refusal(Reason.NOT_SIMULATED, "its free run on windows overflows")
            search.rejected.append(Rejected.of(trial.name, trial.delta_bic, why))
            continue
        judged += 1
        options = {"held_out": bool(runs[1]), "rng": search.rng, "trials": judged}
        gain = gain_of(before, after, base, rms_of(base), names, **options)
        if (why := unproven(gain, "held-out windows")) is not None:
            search.rejected.append(Rejected.of(trial.name, trial.delta_bic, why, gain))
            continue
        rivals = []
        for other in passed:
            difference = trial.delta_bic - other.delta_bic
            if other is trial:
                continue
            needless = difference > 0 and _symbols(trial.term) <= _symbols(other.term)
            if abs(difference) < settings.CLASS_DELTA_BIC and not (
                needless and trial.term.place.name == other.term.place.name
            ):
                rivals.append(other)
            else:
                words = f"explained better by {' at '.join(trial.name)} (by {difference:.0f})"
                if difference < 0:
                    words = f"explains little more than {' at '.join(trial.name)}, with more parameters"
                why = Refusal(Reason.EXPLAINED_BETTER, words)
                search.rejected.append(Rejected.of(other.name, other.delta_bic, why))
        search.fit, search.runs = fit, runs
        search.taken.append(Taken(trial, tuple(rivals[:3]), gain, search.error(fit), runs))
        return True
    return False


def _backward(search: Search) -> None:
    """Drop a law that newer ones have made needless, in the fit and held out."""
    for k in range(len(search.taken) - 1):
        if search.fit.significance(k) >= settings.MIN_STANDARD_ERRORS:
            continue
        terms = tuple(t for j, t in enumerate(search.fit.terms) if j != k)
        fit = _settled(search.equation, terms)
        if fit is None:
            continue
        runs = search.run(fit)
        new, old, base = (x[1] or x[0] for x in (runs, search.runs, search.base_runs))
        names = search.records[0].output_names
        if gain_of(new, old, base, rms_of(base), names, held_out=True, rng=search.rng).ci99_lower > 0:
            continue
        before = _settled(search.equation, tuple(t.trial.term for t in search.taken[:-1]))
        gone = search.taken.pop(k)
        last = search.taken[-1]
        if before is not None:
            weight = search.equation.weight_of(fit.residual)
            old, new = (search.equation.fit(one.terms, weight) for one in (before, fit))
            pair = gone.trial, float(new.criterion - old.criterion)
            search.taken[-1] = dataclasses.replace(last, stood_in=(*last.stood_in, pair))
        why = Refusal(Reason.NEEDLESS, "needless once the others are in the model")
        search.rejected.append(Rejected.of(gone.trial.name, gone.trial.delta_bic, why))
        search.fit, search.runs = fit, runs
        search.taken[-1] = dataclasses.replace(search.taken[-1], runs=runs)
        return


def _recount(search: Search) -> None:
    """Gains that add up: of every law over what the laws before it leave, in units of what the last one leaves."""
    base = before = search.base_runs[1] or search.base_runs[0]
    floor = rms_of(search.runs[0])
    names, held_out = search.records[0].output_names, bool(search.base_runs[1])
    for k, taken in enumerate(search.taken):
        after = taken.runs[1] or taken.runs[0]
        gain = gain_of(before, after, base, floor, names, held_out=held_out, rng=search.rng)
        search.taken[k] = dataclasses.replace(taken, gain=gain)
        before = after
