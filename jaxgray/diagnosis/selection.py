"""Forward selection under one likelihood whose refits cost little: every candidate of a round is refitted.

    Refit    every candidate; the best end of each counts
    Test     each by the one rule of acceptance; those that pass go on, in the order of the likelihood
    Judge    by free runs on held-out data: the first whose gain is sure is accepted
    Class    of those that passed and were not refused there, whatever lies within ΔBIC 6 of it
    Drop     what it made needless, and look again

The simulation error, whose refits cost much, has a search of its own (`search/`).
"""

import abc
import dataclasses
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..mechanics.effects.base import Term
from ..numerics.progress import AbstractProgress, BudgetSpent
from ..records import Record
from . import settings
from .acceptance import AbstractEvidence, negligible, unproven, unsound
from .findings import Gain, Reason, Refusal, Rejected
from .model.free_run import FreeRun, rms_of
from .model.held_out_gain import gain_of

Runs = tuple[list[FreeRun], list[FreeRun]]
"""Free runs over the data of the fit, and over the held-out data."""

MOST_RIVALS = 3
"""Laws that a finding shares its class with, at most."""


class AbstractTrial(AbstractEvidence):
    """A refitted candidate: the last term of its `fit`."""

    fit: Any

    @property
    def term(self) -> Term:
        """The term that was added."""
        return self.fit.terms[-1]

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        return self.term.effect.id, self.term.place.name


@dataclass(frozen=True)
class Selected:
    """An accepted law: `trial`, the `fit` of all laws with it, the `rivals` of its class, `gain`, and free `runs` with
    it; `stood_in`: what had stood in for it before, with its ΔBIC against it."""

    trial: AbstractTrial
    fit: Any
    rivals: tuple[AbstractTrial, ...]
    gain: Gain
    runs: Runs
    stood_in: tuple[tuple[AbstractTrial, float], ...] = ()


@dataclass(kw_only=True)
class AbstractSelection(abc.ABC):
    """How far a selection got, and what it works with.

    `records`, `held`: to fit, and to judge; `base`, `fit`: without effects, and with those `taken`, and their runs;
    `strong`: whether something passed every test and was not taken. `residual`, `judged_on`: words for what a model
    leaves, and for the held-out data.
    """

    residual: ClassVar[str] = "what is left"
    judged_on: ClassVar[str] = "held-out data"

    records: list[Record]
    held: list[Record]
    rng: np.random.Generator
    progress: AbstractProgress
    base: Any = None
    fit: Any = None
    base_runs: Runs = ((), ())
    runs: Runs = ((), ())
    taken: list[Selected] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    strong: bool = False

    @abc.abstractmethod
    def trials(self) -> list[AbstractTrial]:
        """Candidates beside those that were taken, refitted, best first."""

    @abc.abstractmethod
    def run(self, fit) -> Runs:
        """Free runs of a fit."""

    def looks(self, last: bool) -> bool:
        """Whether there is anything to refit candidates for; `last`: no more may be taken."""
        return True

    def needless(self, trial: AbstractTrial) -> Refusal | None:
        """Whether a trial only repeats what was taken."""
        return None

    def ordered(self, trials: list[AbstractTrial]) -> list[AbstractTrial]:
        """Trials that passed, in the order in which they are judged."""
        return trials

    def settled(self, trial: AbstractTrial) -> Any:
        """The fit to go on with where a trial is taken; None for no such."""
        return trial.fit

    def alike(self, trial: AbstractTrial, other: AbstractTrial) -> bool:
        """Whether two trials that explain as much are of one class."""
        return True

    def drop(self) -> None:
        """Drop a law that newer ones have made needless."""
        return None

    def select(self, max_effects: int) -> None:
        """Take laws one by one until nothing more is found."""
        self.runs = self.base_runs = self.run(self.base)
        for turn in range(max_effects + 1):
            self.strong, last = False, turn == max_effects
            if not self.looks(last):
                break
            self.progress.unlimited.stage("looking for effects" if turn == 0 else f"looking further ({turn} found)")
            try:
                found = self._round(last)
            except BudgetSpent:
                # What was seen and not all tried is left.
                self.strong = True
                break
            if not found:
                break
            self.drop()

    def gain_over(self, before: Runs, after: Runs, floor: np.ndarray | None = None, *, trials: int = 1) -> Gain:
        """Gain from one set of runs to the next, held out where there are such data; `floor`: default what the linear
        model leaves; `trials`: judged in this round so far."""
        old, new, base = (runs[1] or runs[0] for runs in (before, after, self.base_runs))
        floor = rms_of(base) if floor is None else floor
        options = {"held_out": bool(self.held), "rng": self.rng, "trials": trials}
        return gain_of(old, new, base, floor, self.records[0].output_names, **options)

    def _round(self, last: bool) -> bool:
        """Take the first trial that holds, unless this is but a last look; whether one was taken."""
        passed = []
        for trial in self.trials():
            why = unsound(trial) or self.needless(trial) or negligible(trial, self.residual)
            if why is None:
                passed.append(trial)
            elif trial.delta_bic > 0:
                self.rejected.append(Rejected.of(trial.name, trial.delta_bic, why))
        self.strong = bool(passed)
        refused: list[AbstractTrial] = []
        for trial in [] if last else self.ordered(passed):
            self.progress.stage(f"judging {trial.name[0]} at {trial.name[1]}")
            fit = self.settled(trial)
            if fit is None:
                continue
            runs, gain = self.run(fit), None
            if not all(np.all(np.isfinite(run.e)) for run in runs[1] or runs[0]):
                why = Refusal(Reason.NOT_SIMULATED, f"its free run on {self.judged_on} overflows")
            else:
                gain = self.gain_over(self.runs, runs, trials=len(refused) + 1)
                why = unproven(gain, self.judged_on)
            if why is None:
                self._take(trial, fit, [other for other in passed if other not in refused], gain, runs)
                return True
            refused.append(trial)
            self.rejected.append(Rejected.of(trial.name, trial.delta_bic, why, gain))
        return False

    def _take(self, trial: AbstractTrial, fit, passed: list[AbstractTrial], gain: Gain, runs: Runs) -> None:
        rivals = []
        for other in passed:
            difference = trial.delta_bic - other.delta_bic
            if other is trial:
                continue
            if abs(difference) < settings.CLASS_DELTA_BIC and self.alike(trial, other):
                rivals.append(other)
                continue
            words = f"explained better by {' at '.join(trial.name)} (by {difference:.0f})"
            if difference < 0:
                words = f"explains little more than {' at '.join(trial.name)}, with more parameters"
            why = Refusal(Reason.EXPLAINED_BETTER, words)
            self.rejected.append(Rejected.of(other.name, other.delta_bic, why))
        self.fit, self.runs = fit, runs
        self.taken.append(Selected(trial, fit, tuple(rivals[:MOST_RIVALS]), gain, runs))

    def recount(self) -> None:
        """Gains that add up: of every law over what the laws before it leave, in units of what the last one leaves."""
        before, floor = self.base_runs, rms_of(self.runs[0])
        for k, taken in enumerate(self.taken):
            self.taken[k] = dataclasses.replace(taken, gain=self.gain_over(before, taken.runs, floor))
            before = taken.runs
