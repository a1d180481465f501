"""The diagnosis of records without a usable free run: decided in the force equation, judged on short windows.
`first_trials` ranks the first law alone, as a start of refits by the free run.

Laws are added one by one to E u = M q̈ + D q̇ + K q (`selection.py`). Among those that explain most of what the best
one explains, laws that share no part with a law already in the model come first, and of these the one with the fewest
parameters.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ...mechanics.effects.base import AbstractEffect, Term
from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import AbstractDrive
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.programs.side_by_side import side_by_side
from ...numerics.progress import AbstractProgress
from ...records import Record
from .. import settings
from ..acceptance import bound_of, unsound
from ..findings import NEEDLESS_NOW, Reason, Refusal, Rejected
from ..selection import AbstractSelection, AbstractTrial
from .integrated_band import integrated_band
from .library import Library, Score, Scores, score
from .regression import Equation, ForceFit
from .rows import series_of
from .unmeasured_forces import BriefForce, samples_of
from .windows import Windows, window_samples

SHORT = 8
"""Candidates that are refitted in one round."""

STARTS = 3
"""Shapes from which each of them is refitted."""


@dataclass(frozen=True)
class Table:
    """What a search begins with: rows of an `equation`, candidates of a `library` in them, and the fit without any;
    `progress`. The ranking and the trials of the first law are made once, whoever asks."""

    equation: Equation
    library: Library
    base: ForceFit
    progress: AbstractProgress

    @functools.cached_property
    def scores(self) -> Scores:
        """The ranking of the first law."""
        return score(self.library, self.base, frozenset())

    @functools.cached_property
    def trials(self) -> tuple[list["Trial"], list[Rejected]]:
        """The trials of the first law, best first, and the refits that failed."""
        return trials_of(self.equation, self.base, self.scores, self.progress)


@dataclass(frozen=True, eq=False)
class Trial(AbstractTrial):
    """A refitted candidate: `fit` with it, `delta_bic` against the model without, `power` that it explains; `before`:
    the fit that it goes on from; `equation`. Equal to itself alone."""

    fit: ForceFit
    delta_bic: float
    power: float
    before: ForceFit
    equation: Equation

    @property
    def parameters(self) -> int:
        """Values that were estimated for it."""
        return len(self.fit.moving[-1])

    def bound(self):
        return bound_of(self.term, self.fit.moving[-1])

    def other_law(self):
        scales = self.equation.scales(self.term.effect, self.term.place)
        return self.term.effect.unresolved(np.asarray(self.term.values, float), scales)

    def size(self):
        return self.fit.significance(len(self.fit.terms) - 1)

    def explained(self):
        before, after = (self.equation.relative_error(fit) for fit in (self.before, self.fit))
        return 1 - (after / before) ** 2


@dataclass(kw_only=True)
class Search(AbstractSelection):
    """The selection in the force equation: forces of `drive`, rows and candidates of `table`, free runs over `windows`;
    `scores`: the last look; `brief_forces`: left out."""

    residual: ClassVar[str] = "what is left of the force"
    judged_on: ClassVar[str] = "held-out windows"

    drive: AbstractDrive
    table: Table
    windows: Windows | None = None
    scores: Scores | None = None
    brief_forces: tuple[BriefForce, ...] = ()

    @property
    def equation(self) -> Equation:
        """The rows."""
        return self.table.equation

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

    def matrix_errors(self, fit: ForceFit) -> dict[str, np.ndarray] | None:
        """Standard errors of M, D, K by name; None for what has none."""
        return dict(zip(("mass", "damping", "stiffness"), fit.errors))

    def error(self, fit: ForceFit) -> float:
        """Relative force error where the body moves: at rest dry friction takes any value."""
        return self.equation.relative_error(fit)

    def run(self, fit):
        runs = self.windows.run(self.model(fit))
        return runs[: len(self.records)], runs[len(self.records) :]

    def looks(self, last):
        names = frozenset(taken.trial.name for taken in self.taken)
        self.scores = score(self.table.library, self.fit, names) if names else self.table.scores
        return self.scores.fires and not last

    def trials(self):
        found, failed = (
            trials_of(self.equation, self.fit, self.scores, self.progress) if self.taken else self.table.trials
        )
        self.rejected += failed
        return found

    def needless(self, trial):
        place, parts = trial.term.place.name, _symbols(trial.term)
        terms = [taken.trial.term for taken in self.taken]
        if sum(term.place.name == place and bool(_symbols(term) & parts) for term in terms) > 1:
            return Refusal(Reason.NEEDLESS, "a second refinement of what is in the model already")
        return None

    def ordered(self, trials):
        """Of those that explain most, new laws before wider forms of what is in the model, then the simplest."""
        known = {taken.trial.term.place.name: _symbols(taken.trial.term) for taken in self.taken}

        def generalises(trial):
            return bool(known.get(trial.term.place.name, frozenset()) & _symbols(trial.term))

        result, pool = [], list(trials)
        while pool:
            best = max(t.power for t in pool)
            enough = [t for t in pool if t.power >= settings.SIMPLER_SHARE * best]
            result.append(min(enough, key=lambda t: (generalises(t), t.parameters, -t.delta_bic)))
            pool.remove(result[-1])
        return result

    def settled(self, trial):
        return _settled(self.equation, trial.fit.terms)

    def alike(self, trial, other):
        """Not where the other is the same with more to it."""
        wider = trial.delta_bic > other.delta_bic and _symbols(trial.term) <= _symbols(other.term)
        return not (wider and trial.term.place.name == other.term.place.name)

    def drop(self):
        """In the fit and held out."""
        for k in range(len(self.taken) - 1):
            if self.fit.significance(k) >= settings.MIN_STANDARD_ERRORS:
                continue
            fit = _settled(self.equation, tuple(t for j, t in enumerate(self.fit.terms) if j != k))
            if fit is None:
                continue
            runs = self.run(fit)
            if self.gain_over(runs, self.runs).ci99_lower > 0:
                continue
            before = _settled(self.equation, tuple(taken.trial.term for taken in self.taken[:-1]))
            gone = self.taken.pop(k)
            last = dataclasses.replace(self.taken[-1], fit=fit, runs=runs)
            if before is not None:
                weight = self.equation.weight_of(fit.residual)
                old, new = (self.equation.fit(one.terms, weight) for one in (before, fit))
                pair = gone.trial, float(new.criterion - old.criterion)
                last = dataclasses.replace(last, stood_in=(*last.stood_in, pair))
            self.rejected.append(Rejected.of(gone.trial.name, gone.trial.delta_bic, NEEDLESS_NOW))
            self.fit, self.runs, self.taken[-1] = fit, runs, last
            return


def trials_of(
    equation: Equation, fit: ForceFit, scores: Scores, progress: AbstractProgress
) -> tuple[list[Trial], list[Rejected]]:
    """The best candidates of a ranking beside the terms of a fit, each refitted from its best shapes.

    **Arguments:** `equation`; `fit`; `scores`: ranking of what it leaves; `progress`.

    **Returns:** the trials, best first, and the refits that failed.
    """
    weight = scores.weight
    without = equation.fit(fit.terms, weight)
    starts: dict[tuple[str, str], list[Score]] = {}
    for one in scores.scores:
        key = one.shape.effect.id, one.shape.place.name
        if one.delta_bic < settings.MIN_DELTA_BIC or (key not in starts and len(starts) == SHORT):
            continue
        if len(starts.setdefault(key, [])) < STARTS:
            starts[key].append(one)

    def refitted(ones: list[Score]) -> ForceFit | None:
        shape = ones[0].shape
        progress.stage(f"refitting {shape.effect.id} at {shape.place.name}")
        fits = [equation.fit((*fit.terms, one.shape.term(one.weights)), weight) for one in ones]
        return min((one for one in fits if one is not None), key=lambda one: one.criterion, default=None)

    found, failed = [], []
    for (key, ones), best in zip(starts.items(), side_by_side(refitted, starts.values())):
        if best is None:
            why = Refusal(Reason.NOT_SIMULATED, "its refit found nothing finite of positive mass")
            failed.append(Rejected.of(key, np.nan, why))
            continue
        delta = without.criterion - best.criterion - 2 * np.log(ones[0].shape.tried)
        found.append(Trial(best, float(delta), _power(without) - _power(best), fit, equation))
    return sorted(found, key=lambda trial: -trial.delta_bic), failed


def search_once(
    records: list[Record],
    held: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    max_effects: int,
    brief_forces: tuple[BriefForce, ...],
    rng: np.random.Generator,
    progress: AbstractProgress,
    table: Callable[[], Table] | None = None,
) -> Search:
    """Add laws to the force equation until nothing more is found.

    **Arguments:** `records`, `held`: to fit, and to judge; `drive`: forces; `catalogue`; `max_effects`; `brief_forces`:
    left out; `rng`: of the resampling; `progress`; `table`: gives that of `table_of` where nothing is left out, if it
    serves others, too.

    **Returns:** a `Search`.

    **Raises:** `ComputationError` where the force equation has no solution of positive mass.
    """
    left_out = samples_of(brief_forces, records + held)
    if table is None or brief_forces:
        made = table_of(records, drive, catalogue, None, left_out[: len(records)], progress)
    else:
        made = table()
    search = Search(records=records, held=held, rng=rng, progress=progress, drive=drive, table=made)
    search.base = search.fit = made.base
    band = search.equation.series[0].band
    everything = [series_of(r, band, at_rest=True, left_out=mask) for r, mask in zip(records + held, left_out)]
    search.windows = Windows(records + held, everything, window_samples(records + held), left_out)
    search.brief_forces = brief_forces
    search.select(max_effects)
    search.recount()
    return search


def first_trials(table: Table) -> list[Trial]:
    """Trials of the first law, best first, judged by the rows of the equation alone: those that are beyond doubt."""
    trials = table.trials[0] if table.scores.fires else []
    return [trial for trial in trials if trial.delta_bic >= settings.CLEAR_DELTA_BIC and unsound(trial) is None]


def table_of(
    records: list[Record],
    drive: AbstractDrive,
    catalogue: tuple[AbstractEffect, ...],
    mass: np.ndarray | None,
    left_out: list[np.ndarray],
    progress: AbstractProgress,
) -> Table:
    """What a search in the force equation begins with.

    **Arguments:** `records`; `drive`: forces; `catalogue`; `mass`: where it is known, on an accelerated base;
    `left_out`: samples that are, a record; `progress`.

    **Raises:** `ComputationError` where there is no band above the noise, too few rows, or no solution of positive
    mass.
    """
    if mass is not None:
        # There the input is an acceleration: effects of the input do not apply.
        catalogue = tuple(effect for effect in catalogue if effect.places != "input")
    progress.unlimited.stage("setting up the force equation")
    E = np.asarray(drive.input_map)
    band = integrated_band(records)
    series = [series_of(r, band, left_out=mask) for r, mask in zip(records, left_out)]
    entries, rows = len(E) * (len(E) + 1) // 2, min(len(s.rows) for s in series)
    if rows < 4 * entries + 8:
        detail = f"{rows} rows of motion below {band.high:.3g} Hz in the shortest record"
        raise ComputationError(RESULTS.too_short, stage="force equation", detail=detail)
    equation = Equation(series, E, mass)
    progress.unlimited.stage("looking for effects")
    library = Library.of(equation, catalogue, (records[0].input_names, records[0].output_names))
    base = _settled(equation, ())
    if base is None:
        raise ComputationError(RESULTS.nonfinite, stage="force equation", detail="no positive mass fits the record")
    return Table(equation, library, base, progress)


def _settled(equation: Equation, terms: tuple[Term, ...]) -> ForceFit | None:
    """A fit with the weight of its own residual."""
    first = equation.fit(terms, equation.plain())
    return None if first is None else equation.fit(first.terms, equation.weight_of(first.residual))


def _power(fit: ForceFit) -> float:
    return fit.cost / fit.count


def _symbols(term: Term) -> frozenset:
    return frozenset(p.name for p in term.effect.parameters if p.amplitude)
