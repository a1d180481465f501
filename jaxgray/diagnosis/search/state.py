"""The state of a search: what was accepted and refused, and its model run on data."""

from dataclasses import dataclass, field, replace

import numpy as np

from ...mechanics.effects.base import AbstractEffect
from ...numerics.matrices.bounded import bounded
from ..estimation.context import SearchContext
from ..estimation.gauss_newton import Refit
from ..estimation.multistart import Attempt
from ..findings import Gain, Move, Rejected
from ..model.candidate import Candidate, Data
from ..model.free_run import FreeRun, free_run
from ..screening.linearization import Stage
from ..screening.score_test import Screening

MOST_COMPARED = 4
"""Laws that share a class with a finding, and others that are compared with it again, at most."""


@dataclass(frozen=True)
class Accepted:
    """A finding of the loop: `attempt`, its `rivals` (the rest of the class), `gain`; `runs`: held-out free runs;
    `move`: how it came in; `others`: what was refitted with it and explained less, though not far less, or
    had no sure gain, what it may turn out to be, what it contains, what scored higher, and what is easily taken for
    it."""

    attempt: Attempt
    rivals: tuple[Attempt, ...]
    gain: Gain
    runs: list[FreeRun]
    move: Move = Move.SCORE_TEST
    others: tuple[Attempt, ...] = ()

    @property
    def compared(self) -> tuple[Attempt, ...]:
        """What may take its place beside other findings."""
        return (*self.rivals, *self.others)

    @property
    def stage(self) -> str:
        """Whether it says what the "model" lacks or what is wrong with the "record"."""
        return self.attempt.score.shape.effect.stage


@dataclass(frozen=True)
class Provisional:
    """Where the search was before findings were accepted provisionally: `stage`, its `fit`, the `screening` there,
    whether it left something `unexplained`, and how many findings were `sure`."""

    stage: Stage
    fit: Refit | None
    screening: Screening
    unexplained: bool
    sure: int


@dataclass
class SearchState:
    """How far the loop got: where it began, the model now, what was accepted and rejected, the last refit of what was
    tried, the last look and the first one, the `branches` (states in which rounds began, with the refits of the round,
    best first), what is no longer looked for, how many candidates were judged on held-out data since the last was
    surely accepted, what the last findings owe, and the refit in which all were compared last."""

    start: Stage
    stage: Stage
    fit: Refit | None = None
    accepted: list[Accepted] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    tried: dict[tuple[str, str], Refit] = field(default_factory=dict)
    screening: Screening | None = None
    first: Screening | None = None
    branches: tuple[tuple["SearchState", tuple[Attempt, ...]], ...] = ()
    unexplained: bool = False
    ruled_out: frozenset = frozenset()
    baseline_runs: list[FreeRun] = field(default_factory=list)
    runs: list[FreeRun] = field(default_factory=list)
    trials: int = 0
    provisional: Provisional | None = None
    compared_in: Refit | None = None

    def copied(self) -> "SearchState":
        """One that goes another way from here."""
        lists = {"accepted": list(self.accepted), "rejected": list(self.rejected), "tried": dict(self.tried)}
        return replace(self, **lists)

    @property
    def sure(self) -> Stage:
        """The model without provisional findings."""
        return self.stage if self.provisional is None else self.provisional.stage


def is_local(context: SearchContext, effect: AbstractEffect) -> bool:
    """Whether held-out data do not show an effect."""
    return effect.own_phase or (effect.tied_to_clock and not context.separate)


def runs_seen(context: SearchContext, *residuals: np.ndarray) -> tuple[list[FreeRun], ...]:
    """Free runs on the first record of the fit, one list for each residual that they leave there."""
    return tuple([FreeRun(e, e, context.data[0].kept)] for e in residuals)


def held_out_run(context: SearchContext, candidate: Candidate, data: Data) -> FreeRun:
    """Free run on held-out data, without what belongs to the clock of the estimation record; what has another phase in
    every record has that of these data."""
    terms = (term for term in candidate.terms if term.effect.own_phase or not is_local(context, term.effect))
    return free_run(context.simulator, candidate.with_terms(terms), data)


def held_out_runs(context: SearchContext, candidate: Candidate, before: list[FreeRun]) -> list[FreeRun]:
    """Free runs on all held-out data; those from before where one overflows."""
    runs = [held_out_run(context, candidate, d) for d in context.validation]
    return runs if all(bounded(run.e) for run in runs) else before
