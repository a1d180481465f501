"""Where laws are looked for in a simulator: its linear plant about a run that is near the records, and its numbers.

Where its run is near, forces along the records give the numbers; where it is far, the numbers alone are fitted first,
over growing parts of the records, and forces then lead the run there.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...numerics.outcomes import ComputationError
from ...numerics.progress import AbstractProgress, BudgetSpent
from .. import settings
from ..estimation.context import SearchContext
from ..model.candidate import Candidate
from ..model.simulator import steps_of
from .growing_parts import Ended, Grown, bettered, grown, nearly_followed
from .runs.calls import Call
from .runs.linearized import Linearized
from .runs.numbers import NumbersSimulator
from .runs.problem import Linear, Problem, Runs, parts_of
from .runs.tracking import is_white, near_until
from .settling import NEARER, STILL, Settled, foreseen_by, left_by, left_of, refit_of_numbers, settle

MAX_RELINEARIZATIONS, MAX_LEADS = 8, 2
"""Times that a simulator is linearized about a led run to lead it further; and times that it is led anew with other
numbers."""

ALIKE = 0.1
"""Change of every number, in units of it, up to which it moves runs along the same motion as it did."""

REST = 4
"""Part of a run that is looked at for how a simulator answers at rest, one in so many."""

GROWING = "fitting the simulator's numbers over parts that grow"
"""What is said while the simulator's own runs fit them."""


@dataclass(frozen=True)
class Beginning:
    """Where laws are looked for: the `plant` about a run, which numbers are `idle` there, the `linear` simulator and
    records for it (`wholes`), numbers alone in the simulator (`fitted`; None where it does not run with them), whether
    its own runs found them (`by_runs`), runs that forces lead along the records (`followed`), and the `candidate` to
    begin with, None for the numbers as they were given."""

    plant: Linearized
    idle: np.ndarray
    linear: NumbersSimulator
    wholes: Linear
    fitted: Settled | None
    by_runs: bool
    followed: Runs
    candidate: Candidate | None = None


@dataclass(frozen=True)
class Beginner:
    """What finds it: the `problem`; `context_of`: the context of a search by a linear simulator and its records; `rng`;
    `progress`."""

    problem: Problem
    context_of: Callable[[NumbersSimulator, Linear], SearchContext]
    rng: np.random.Generator
    progress: AbstractProgress

    def begin(self, baseline: Runs, start: np.ndarray, balanced: Callable) -> Beginning | None:
        """Where laws are looked for, from runs with the numbers as they were given, as entries `start`; None where
        `balanced`, asked where no run follows the records, says that the balance of forces explains them.

        **Raises:** `ComputationError` where the simulator fails with the numbers as they were given.
        """
        problem = self.problem
        found = failure = None
        runs = baseline
        if problem.away:
            # Forces that lead a run to a record from far away need many more runs than numbers do.
            self.progress.unlimited.stage(GROWING)
            parts = grown(problem, start)
            again = self._by_own_runs(parts)
            if again is not None:
                # Of a motion that is not stable numbers follow whatever the fit sees, exact to many more digits than
                # they are known.
                return again if problem.follow(again.followed.y) or not balanced() else None
            # Numbers that follow a part alone may stand for a law: then those that were given are nearer.
            if parts.runs is not None and problem.followed_until(parts.runs) > problem.followed_until(runs):
                runs, start = parts.runs, parts.entries
        try:
            followed = self._followed(runs)
            if not problem.follow(followed.y) and balanced():
                return None
            followed = problem.with_forces(followed)
            if not followed.along:
                found, runs, start = self._anew_by_numbers(followed, runs, start)
            found = found or self._begun(followed, start)
        except ComputationError as error:
            failure = error
        if found is not None and runs is not baseline:
            states = found.wholes.states[: sum(span.fit is not None for span in problem.spans)]
            found = dataclasses.replace(found, candidate=Candidate(start, states))
        if found is None or not _settled(problem, found.fitted):
            again = None if problem.away else self._by_own_runs(grown(problem, start))
            if again is not None:
                return again
            if found is None:
                raise failure
            problem.plant, problem.idle = found.plant, found.idle
        found, runs = self._led_further(found, runs)
        found = self._moved_on(found, runs)
        problem.plant, problem.idle = found.plant, found.idle
        return found

    def better(self, found: Beginning, start: np.ndarray) -> Beginning | None:
        """The same where the simulator's own runs find other numbers, as those that explain it all in the linear plant
        do not in the simulator; None where they do, or its runs find none. They begin at the entries as they were given
        (`start`), but for those of which nothing was given, and where that leads to no end, at those that were fitted:
        some of these may have gone astray to make up for a gap that is open or shut for too long."""
        problem, numbers = self.problem, found.fitted
        if numbers is None or found.by_runs or is_white(parts_of(problem, numbers.y)[0]) or self._law_is_missing(found):
            return None
        best, entries = found, numbers.candidate.entries
        with contextlib.suppress(BudgetSpent):
            for begin in (np.where(start > 0.0, start, entries), entries):
                self.progress.stage(GROWING)
                runs = problem.tried(problem.called(begin))
                if runs is None or not problem.follow(runs.y):
                    continue
                own = bettered(problem, begin, runs)
                if own is None:
                    # Where the slopes of one near run promise nothing, those of another do not either.
                    break
                made = self._by_own_runs(own)
                if made is not None and left_by(problem, made.fitted.y) <= left_by(problem, best.fitted.y):
                    best = made
                    if is_white(parts_of(problem, made.fitted.y)[0]):
                        break
        problem.plant, problem.idle = best.plant, best.idle
        return best if best is not found else None

    def again(self, found: Beginning) -> Beginning | None:
        """Where laws are looked for once more if no law explains anything: with the plant about the numbers that were
        fitted, as one about others errs in proportion to what these are off. None where it is about them already, or
        runs with them are not near."""
        problem, fitted = self.problem, found.fitted
        if fitted is None or found.by_runs or is_white(parts_of(problem, fitted.y)[0]):
            return None
        here, entries = found.linear.setup.here, fitted.candidate.entries
        errors = np.sqrt(np.diag(fitted.fit.covariance)[: len(entries)])
        if not np.any(np.abs(entries - here) > STILL * errors):
            return None
        made = None
        with contextlib.suppress(BudgetSpent):
            self.progress.stage("linearizing the simulator about the fitted numbers")
            made = self._about_numbers(found)
        if made is None:
            problem.plant, problem.idle = found.plant, found.idle
        return made

    def _led_further(self, found: Beginning, runs: Runs) -> tuple[Beginning, Runs]:
        """From far away numbers come nearer at a time: led with these a simulator answers more as it does along the
        record."""
        problem = self.problem
        for _ in range(MAX_LEADS):
            fitted = found.fitted
            if fitted is None or problem.follow(runs.y) or problem.follow(fitted.y):
                break
            if found.followed.along and _lacking(fitted):
                # What no numbers explain in the linear plant along the records is for a law to explain.
                break
            further = problem.tried(problem.called(fitted.candidate.entries))
            if further is None or problem.followed_until(further) <= problem.followed_until(runs):
                break
            try:
                led = problem.with_forces(self._followed_again(further), self._known(found.followed, fitted))
                again = self._begun(led, fitted.candidate.entries)
            except ComputationError:
                break
            if again.fitted is None:
                break
            found, runs = dataclasses.replace(again, candidate=fitted.candidate), further
        return found, runs

    def _moved_on(self, found: Beginning, runs: Runs) -> Beginning:
        """With the plant about the numbers, where these have led the simulator to where it may answer otherwise: from
        far away, or much nearer; not where the next run is foretold to leave as much as the last one."""
        problem, fitted = self.problem, found.fitted
        if fitted is None or not problem.follow(fitted.y):
            return found
        left, foretold = left_by(problem, fitted.y), left_of(foreseen_by(fitted.fit, fitted.data))
        much = left < left_by(problem, runs.y) + 2 * problem.record.outputs * np.log(settings.MUCH_NEARER)
        otherwise = abs(left - foretold) > NEARER and (much or not problem.follow(runs.y))
        moved = otherwise and not self._law_is_missing(found)
        again = self._about_numbers(found) if moved else None
        return again if again is not None and left_by(problem, again.fitted.y) <= left else found

    def _about_numbers(self, found: Beginning) -> Beginning | None:
        """The same with the plant about the numbers that were fitted; None where runs with them are not near."""
        problem, fitted = self.problem, found.fitted
        there = problem.tried(problem.called(fitted.candidate.entries))
        if there is None or not problem.follow(there.y):
            return None
        again = self._anew(there, fitted.candidate.entries, slopes=self._known(found.followed, fitted))
        return again and dataclasses.replace(again, followed=found.followed, candidate=fitted.candidate)

    def _known(self, led: Runs, fitted: Settled) -> tuple[np.ndarray, ...] | None:
        """How numbers move a run along the records with fitted ones, as they do in led runs, where these have nearly
        the same; else None."""
        far = np.abs(led.calls[0].numbers / self.problem.units - fitted.candidate.entries)
        return led.slopes if led.along and np.all(far <= ALIKE) else None

    def _law_is_missing(self, found: Beginning) -> bool:
        """Whether numbers alone leave more than noise in the linear plant, and that is for a law to explain: they leave
        much, or are nearly those of the runs that the plant was first about. With others it may answer otherwise, as
        where a gap opens in a gear."""
        fitted = found.fitted
        much = not nearly_followed(self.problem, fitted.y)
        return _lacking(fitted) and (much or self._known(found.followed, fitted) is not None)

    def _begun(self, about: Runs, entries: np.ndarray, by_runs: Grown | None = None) -> Beginning:
        """That about some runs, with the forces that numbers take there."""
        self.progress.unlimited.stage("fitting the simulator's numbers")
        linear, wholes, context, candidate = self._asked(about, entries)
        fitted = _numbers_alone(self.problem, context, candidate, wholes, by_runs)
        return Beginning(self.problem.plant, self.problem.idle, linear, wholes, fitted, by_runs is not None, about)

    def _asked(self, about: Runs, entries: np.ndarray) -> tuple[NumbersSimulator, Linear, SearchContext, Candidate]:
        """The linear simulator about some runs, records for it, the context of a search there, and the candidate with
        these entries."""
        problem = self.problem
        problem.idle = problem.idle_by(about.by_number)
        linear = problem.linear_simulator(entries, steps_of(problem.linear_model(), problem.record.sampling_time))
        wholes = problem.linear_data(linear, about).near(about.y)
        context = self.context_of(linear, wholes)
        return linear, wholes, context, Candidate(entries, wholes.states[: len(context.data)])

    def _anew(
        self,
        runs: Runs,
        entries: np.ndarray,
        *,
        by_runs: Grown | None = None,
        slopes: tuple[np.ndarray, ...] | None = None,
    ) -> Beginning | None:
        """That with the plant as it is about these runs, and what the numbers take there, or along the records, where
        it is known how they move a run there (`slopes`); None where that cannot be."""
        problem = self.problem
        with contextlib.suppress(ComputationError):
            with contextlib.suppress(ComputationError):
                problem.plant = problem.linearized(runs, self.rng)
            if problem.plant is None:
                return None
            if slopes is None:
                runs = problem.with_forces(runs, None if by_runs is None else by_runs.slopes)
            else:
                runs = problem.with_forces(problem.led(runs), slopes)
            again = self._begun(runs, entries, by_runs)
            return again if again.fitted is not None else None
        return None

    def _by_own_runs(self, made: Grown | Ended | None) -> Beginning | None:
        """That with numbers that the simulator's own runs found; None where they found none that alone explain the
        data."""
        if not isinstance(made, Grown):
            return None
        found = self._anew(made.runs, made.entries, by_runs=made)
        # Runs with them are near as they are.
        return found and dataclasses.replace(found, followed=made.runs, candidate=found.fitted.candidate)

    def _anew_by_numbers(self, led: Runs, runs: Runs, entries: np.ndarray) -> tuple[Beginning | None, Runs, np.ndarray]:
        """As `_anew`, with the runs and numbers it is about, where the numbers that led runs ask for bring the
        simulator near the records; None with `runs` and `entries` as they are, where they do not."""
        problem, plant = self.problem, self.problem.plant
        with contextlib.suppress(ComputationError):
            _, _, context, candidate = self._asked(led, entries)
            asked = refit_of_numbers(context, candidate).candidate.entries
            there = problem.tried(problem.called(asked))
            if there is not None and problem.follow(there.y):
                again = self._anew(there, asked)
                if again is not None:
                    return dataclasses.replace(again, followed=led), there, asked
        problem.plant = plant
        return None, runs, entries

    def _followed(self, baseline: Runs) -> Runs:
        """Runs that forces lead along the records, and the linear plant about the first of them.

        **Raises:** `ComputationError` where the simulator does not answer to forces as a mechanical system does.
        """
        problem, samples = self.problem, self.problem.record.samples
        if problem.follow(baseline.y):
            return self._led(baseline, baseline)[0]
        # Far from the record it may answer otherwise than there, and to small forces by large motions; at rest it does
        # not.
        ends, failure = [], None
        for about, end in ((baseline, None), (None, samples // REST)):
            if about is None:
                about = problem.tried([Call(0.0 * call.u, call.w, call.numbers) for call in baseline.calls])
            try:
                ends += [] if about is None else [self._led_on(*self._led(about, baseline, end))]
            except ComputationError as error:
                failure = failure or error
            if ends and problem.follow(ends[-1][0].y):
                break
        if not ends:
            raise failure
        followed, problem.plant = max(ends, key=lambda end: problem.followed_until(end[0]))
        return followed

    def _led(self, about: Runs, begin: Runs, end: int | None = None) -> tuple[Runs, Linearized]:
        """Some runs led further by the plant about others, up to a sample of these; and that plant."""
        self.progress.unlimited.stage("linearizing the simulator")
        self.problem.plant = self.problem.linearized(about, self.rng, end)
        self.progress.unlimited.stage("looking for the force that it lacks")
        return self.problem.led(begin), self.problem.plant

    def _led_on(self, followed: Runs, plant: Linearized) -> tuple[Runs, Linearized]:
        """Led runs, further as long as the plant about them leads there; and the plant about the end."""
        problem = self.problem
        with contextlib.suppress(ComputationError):
            for _ in range(MAX_RELINEARIZATIONS):
                before = problem.followed_until(followed)
                if problem.follow(followed.y):
                    return followed, problem.linearized(followed, self.rng)
                # As it answers up to where it was led, it is led further.
                further, about_it = self._led(followed, followed, near_until(problem.record, followed.y[0]))
                if problem.followed_until(further) <= before:
                    break
                followed, plant = further, about_it
        return followed, plant

    def _followed_again(self, runs: Runs) -> Runs:
        """As `_followed`, by the linear plant as it is where that leads these runs along the whole records."""
        problem = self.problem
        followed = problem.led(runs)
        if not problem.follow(followed.y):
            return self._followed(runs)
        problem.plant = problem.linearized(followed, self.rng)
        return followed


def _settled(problem: Problem, fitted: Settled | None) -> bool:
    """Whether numbers alone stand still, or leave nothing but noise, or something that no numbers explain in the linear
    plant itself."""
    if fitted is None:
        return False
    return fitted.still or _lacking(fitted) or is_white(parts_of(problem, fitted.y)[0])


def _lacking(fitted: Settled) -> bool:
    """Whether numbers alone leave more than noise in the linear plant itself."""
    return not is_white(foreseen_by(fitted.fit, fitted.data))


def _numbers_alone(
    problem: Problem, context: SearchContext, begin: Candidate, wholes: Linear, by_runs: Grown | None
) -> Settled | None:
    """The numbers without any law, those that runs found or the settled ones; None where the simulator does not run
    with them."""
    try:
        fit = refit_of_numbers(context, begin)
        if by_runs is None:
            return settle(problem, context, fit, wholes)
        fit = dataclasses.replace(by_runs.fit(problem, fit), candidate=begin)
        return Settled(begin, fit, context.simulator, wholes, tuple(context.data), by_runs.runs.y, True, by_runs.pushed)
    except ComputationError:
        return None
