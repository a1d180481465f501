"""The fewest of a simulator's numbers that have to be other, and which of them stand for one another.

A record may determine a sum of two numbers (the damping on either side of a stiff gear) far better than each of them:
none of the two is off for sure, though one of them is. So numbers are reset to what they were given as, one after the
other, the one that the record misses least first, until the record would miss any further one; the rest of the fit is
adjusted to first order. The last ones are asked of the simulator itself: what it leaves with a number as it was given,
and what it gains on held-out data by moving it. Where another number serves in the place of one as well, this record
does not tell them apart.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse
from .. import settings
from ..acceptance import unproven
from ..findings import Gain
from ..model.free_run import rms_of
from ..model.parameter_vector import Layout
from .growing_parts import sharpened
from .runs.problem import Outputs, Problem, parts_of
from .settling import STILL, Settled, left_by, left_of, shown_by

SLOPES = 0.1
"""By how much slopes may be wrong, relative to what a number does."""

CORRECTIONS = 2
"""Gauss-Newton steps in which the rest of a fit comes to where it is best beside numbers as they were given."""

FURTHER = 4 / 3
"""How much more of what runs leave a step may mend than slopes foretell."""


@dataclass(frozen=True)
class Moved:
    """A number that has to be other: which (`k`), the `evidence` that it has, `value` and `error` in its unit of the
    entries, others that serve in its place and how far they are `behind`, and what moving it gains (None where the
    simulator was not asked)."""

    k: int
    evidence: float
    value: float
    error: float
    rivals: tuple["Moved", ...] = ()
    gain: Gain | None = None
    behind: float = 0.0


@dataclass(frozen=True)
class Necessary:
    """What is `settled` with no more numbers `moved` than have to be; and for every number its entry (`values`) and
    error beside those, 0 of one that the record does not determine."""

    settled: Settled
    moved: tuple[Moved, ...]
    values: Float[np.ndarray, " numbers"]
    errors: Float[np.ndarray, " numbers"]


class _Ellipsoid:
    """The sum of squares about a fit, to second order, with some entries as they were given. Along what the record does
    not determine it is flat: of numbers whose sum alone is known one stands for another."""

    def __init__(self, settled: Settled, start: Float[np.ndarray, " numbers"], samples: int):
        self.layout = Layout(settled.linear.setup, settled.candidate)
        self.theta, self.covariance = self.layout.vector(settled.candidate), settled.fit.covariance
        self.information = pseudo_inverse(self.covariance)
        self.start, self.off, self.count = start, self.theta[: len(start)] - start, len(start)
        self.samples, self.penalty = samples, float(np.log(samples))
        self.known = (np.diag(self.covariance)[: self.count] > 0) & ~settled.fit.undetermined[: self.count]

    def cost(self, free: Bool[np.ndarray, " numbers"]) -> float:
        """What it costs that all other numbers are as they were given; infinite where free ones surely change their
        sign."""
        theta, covariance = self.conditional(free)
        if np.any(theta[: self.count] < -np.sqrt(np.maximum(np.diag(covariance)[: self.count], 0.0))):
            return np.inf
        return float((theta - self.theta) @ self.information @ (theta - self.theta))

    def conditional(self, free: Bool[np.ndarray, " numbers"]) -> tuple[np.ndarray, np.ndarray]:
        """All parameters, and their covariance, where only some numbers are free."""
        at, theta, covariance = self._given(free), self.theta.copy(), np.zeros_like(self.covariance)
        moving = np.setdiff1d(np.flatnonzero(np.diag(self.covariance) > 0.0), at)
        within = np.ix_(moving, moving)
        covariance[within] = pseudo_inverse(self.information[within])
        theta[at] = self.start[at]
        theta[moving] += covariance[within] @ self.information[np.ix_(moving, at)] @ self.off[at]
        return theta, covariance

    def free_only(self) -> Bool[np.ndarray, " numbers"]:
        """The numbers that a record misses where they are as they were given."""
        free, gate = self.known.copy(), self.penalty + settings.MIN_DELTA_BIC
        while free.any():
            costs = {k: self.cost(_without(free, k)) for k in np.flatnonzero(free)}
            least = min(costs, key=costs.__getitem__)
            if costs[least] - self.cost(free) >= gate:
                break
            free[least] = False
        for k in np.flatnonzero(free):
            swapped = [free, *(other for _, other in self.swapped(free, k))]
            free = min(swapped, key=self.cost)
        return free

    def apart(self, free: Bool[np.ndarray, " numbers"], k: int) -> float:
        """The share of what a free number does to the runs that nothing else that is free does."""
        _, covariance = self.conditional(free)
        both = self.information[k, k] * covariance[k, k]
        return float(1 / np.sqrt(both)) if both > 0.0 else 0.0

    def moved(self, free: Bool[np.ndarray, " numbers"], k: int) -> Moved:
        """A number of those that are free."""
        theta, covariance = self.conditional(free)
        evidence = self.cost(_without(free, k)) - self.cost(free) - self.penalty
        return Moved(int(k), evidence, float(theta[k]), float(np.sqrt(max(covariance[k, k], 0.0))))

    def chance(self, free: Bool[np.ndarray, " numbers"], k: int) -> float:
        """Probability that a number is other as well that is not among the free ones, by its BIC. So likely it is that
        these are where they are with that one free: their errors are averaged over both models.

        **Reference:** Hoeting, Madigan, Raftery & Volinsky, Statistical Science 14 (1999) 382-417.
        """
        evidence = self.cost(free) - self.cost(free | (np.arange(self.count) == k)) - self.penalty
        return _chance(evidence)

    def swapped(self, free: Bool[np.ndarray, " numbers"], k: int) -> list[tuple[int, np.ndarray]]:
        """Every number that could be free in the place of one, and which are free then."""
        others = np.flatnonzero(self.known & ~free)
        return [(int(j), _without(free, k) | (np.arange(self.count) == j)) for j in others]

    def _given(self, free: Bool[np.ndarray, " numbers"]) -> np.ndarray:
        return np.flatnonzero(self.known & ~free)


def necessary(
    problem: Problem,
    settled: Settled,
    start: Float[np.ndarray, " numbers"],
    samples: int,
    gain: Callable[[Outputs, Outputs], Gain] | None,
) -> Necessary:
    """What is settled, with the numbers that need not be other as they were given.

    **Arguments:** `problem`; `settled`; `start`: the numbers as they were given; `samples` of the fit; `gain` from one
    run to another, None where something is left unexplained: numbers make up for it and errors say little, so that all
    stay as they were fitted. So they do where the simulator itself misses those that went back.
    """
    about = _Ellipsoid(settled, start, samples)
    search = None if gain is None else _Fewer(problem, settled, about, gain)
    first = None if search is None else search.first()
    runs_alone = not (settled.pushed or settled.candidate.terms)
    if first is not None and runs_alone and search.leaves_less(first[1]):
        # All of them could do that: the linear plant did not lead them to their best.
        further = _by_own_runs(problem, first[1], np.ones(about.count, bool), ())
        if further is not first[1] and left_by(problem, further.y) < left_by(problem, settled.y):
            return necessary(problem, further, start, samples, gain)
    fewer = None if first is None else search.found(*first)
    if fewer is None:
        errors = np.where(about.known, np.sqrt(np.maximum(np.diag(about.covariance)[: about.count], 0.0)), 0.0)
        sizes = np.where(errors > 0, np.abs(about.off) / np.where(errors > 0, errors, 1.0), 0.0)
        clear = np.flatnonzero(sizes**2 - about.penalty >= settings.MIN_DELTA_BIC)
        entries = settled.candidate.entries
        moved = (Moved(int(k), float(sizes[k] ** 2 - about.penalty), entries[k], errors[k]) for k in clear)
        return Necessary(settled, tuple(moved), entries, errors)
    shown, free, gains, rivals, gone = fewer
    shown = _sharpened(problem, shown, free)
    values, errors, spread = start.copy(), np.zeros(about.count), np.zeros(len(about.theta))
    # Slopes of runs that hang sharply on the numbers tell nothing of those that stay: runs without them do.
    for k in () if settled.pushed else np.flatnonzero(about.known):
        theta, covariance = about.conditional(free | (np.arange(about.count) == k))
        values[k], errors[k] = max(theta[k], 0.0), np.sqrt(max(covariance[k, k], 0.0))
        if not free[k]:
            gone[k] = about.chance(free, k) * (theta - about.conditional(free)[0]) ** 2
    for k, asked in gone.items():
        # What serves in the place of a number is said beside it.
        apart = [all(one.k != k for one in rivals.get(j, ())) for j in range(len(spread))]
        spread += np.where(apart, asked, 0.0)
    # Laws are no surer than the numbers beside them.
    covariance = shown.fit.covariance + np.diag(np.where(np.diag(shown.fit.covariance) > 0.0, spread, 0.0))
    shown = dataclasses.replace(shown, fit=dataclasses.replace(shown.fit, covariance=covariance))
    values[free] = shown.candidate.entries[free]
    errors[free] = np.sqrt(np.maximum(np.diag(covariance)[: about.count], 0.0))[free]
    moved = (
        dataclasses.replace(
            about.moved(free, k), value=float(values[k]), error=float(errors[k]), rivals=rivals[k], gain=gains.get(k)
        )
        for k in np.flatnonzero(free)
    )
    return Necessary(shown, tuple(moved), values, errors)


def _sharpened(problem: Problem, shown: Settled, free: Bool[np.ndarray, " numbers"]) -> Settled:
    """What is settled by runs that hang sharply on the numbers, where these are best with no others beside them."""
    return _by_own_runs(problem, shown, free, shown.pushed) if shown.pushed and not free.all() else shown


def _by_own_runs(
    problem: Problem, shown: Settled, free: Bool[np.ndarray, " numbers"], pushed: tuple[np.ndarray, ...]
) -> Settled:
    """What is settled, with free numbers where the simulator's own runs lead them, if these leave less."""
    again = sharpened(problem, shown.candidate.entries, free, pushed)
    if again is None or left_by(problem, again.runs.y) > left_by(problem, shown.y):
        return shown
    candidate = shown.candidate.with_entries(again.entries)
    fit = dataclasses.replace(again.fit(problem, shown.fit), candidate=candidate)
    return dataclasses.replace(shown, candidate=candidate, fit=fit, y=again.runs.y, pushed=again.pushed)


@dataclass(frozen=True)
class _Fewer:
    """A search for the numbers that the simulator itself misses."""

    problem: Problem
    settled: Settled
    about: _Ellipsoid
    gain: Callable[[Outputs, Outputs], Gain]

    def first(self) -> tuple[Bool[np.ndarray, " numbers"], Settled] | None:
        """Which they are by slopes, and what is settled with them; None where runs with these leave more than the
        others are worth."""
        free = self.about.free_only()
        given = self._worth(self.about.known & ~free)
        shown = self._with(free, given) if np.any(self.about.known & ~free) else self.settled
        return None if shown is None or not self._left(shown, self.settled) <= given else (free, shown)

    def leaves_less(self, shown: Settled) -> bool:
        """Whether runs with fewer numbers leave surely less than those with all of them."""
        return self._left(self.settled, shown) >= settings.MIN_DELTA_BIC

    def found(
        self, free: Bool[np.ndarray, " numbers"], shown: Settled
    ) -> tuple[Settled, Bool[np.ndarray, " numbers"], dict, dict, dict]:
        """What is settled with them, which they are, what each gains and which others serve in its place; and of runs
        that hang sharply on the numbers, for every one that went back, the squares by which that moved all parameters,
        times its chance to be other after all.

        **Arguments:** as `first` gives them.
        """
        needless, gone = True, {}
        while needless:
            gains, needless = {}, False
            for k in self._doubtful(free):
                other = self._with(_without(free, k), self._left(shown, self.settled) + self._worth(1))
                gains[k] = None if other is None else self.gain(other.y, shown.y)
                if needless := other is not None and not self._missed(other, shown, gains[k]):
                    if self.settled.pushed:
                        one, two = (self.about.layout.vector(settled.candidate) for settled in (shown, other))
                        gone[k] = _chance(self._left(other, shown) - self.about.penalty) * (two - one) ** 2
                    free, shown = _without(free, k), other
                    break
        return shown, free, gains, {k: self._rivals(shown, free, k) for k in np.flatnonzero(free)}, gone

    def _doubtful(self, free: Bool[np.ndarray, " numbers"]) -> list[int]:
        """Numbers of which the simulator is asked whether they have to be other, those with least evidence first: of
        which slopes say little beside the others, or all where these are of runs that hang sharply on the numbers."""
        evidence = {int(k): self.about.moved(free, k).evidence for k in np.flatnonzero(free)}
        asked = (k for k in evidence if self.settled.pushed or not self._clear(evidence[k], free, k))
        return sorted(asked, key=evidence.__getitem__)

    def _clear(self, evidence: float, free: Bool[np.ndarray, " numbers"], k: int) -> bool:
        """Whether evidence by slopes that a number is other is clear, however wrong these are: what it alone does may
        be less by that."""
        sure = max(1 - SLOPES / max(self.about.apart(free, k), SLOPES), 0.0)
        return evidence * sure**2 >= settings.CLEAR_DELTA_BIC

    def _rivals(self, shown: Settled, free: Bool[np.ndarray, " numbers"], k: int) -> tuple[Moved, ...]:
        """Numbers that serve in the place of one in the simulator itself, the best first. Of two that do the same the
        slopes differ by their rounding alone, in which there is no information."""
        near, within = {}, self._left(shown, self.settled) + settings.CLASS_DELTA_BIC
        for j, other in self.about.swapped(free, k):
            if not self._clear(self.about.cost(other) - self.about.cost(free), free | other, k):
                there = self._with(other, within)
                behind = np.inf if there is None else self._left(there, shown)
                if behind < settings.CLASS_DELTA_BIC:
                    one, value = self.about.moved(other, j), float(there.candidate.entries[j])
                    near[j] = behind, dataclasses.replace(one, value=value, behind=max(behind, 0.0))
        return tuple(one for _, one in sorted(near.values(), key=lambda one: one[0]))

    def _missed(self, without: Settled, shown: Settled, gain: Gain) -> bool:
        """Whether runs without a number leave surely more: of the data of the fit, and of others by what it gains there
        or, of a number that explains little, by their likelihood."""
        evidence = self._left(without, shown) - self.about.penalty
        beyond = settings.MIN_DELTA_BIC
        return evidence >= beyond and (unproven(gain) is None or self._left_unseen(without, shown) >= beyond)

    def _worth(self, given: Bool[np.ndarray, " numbers"] | int) -> float:
        """What runs may leave more with these numbers, or so many, as they were given."""
        return float(np.sum(given)) * (self.about.penalty + settings.MIN_DELTA_BIC)

    def _left(self, one: Settled, other: Settled) -> float:
        """How much more runs leave than others, in units of the noise variance."""
        return self.about.samples * (left_by(self.problem, one.y) - left_by(self.problem, other.y))

    def _left_unseen(self, one: Settled, other: Settled) -> float:
        """The same on held-out data."""
        here, there = (parts_of(self.problem, settled.y)[1] for settled in (one, other))
        return sum(len(run.e) for run in here) * (left_of(here) - left_of(there)) if here else 0.0

    def _with(self, free: Bool[np.ndarray, " numbers"], within: float) -> Settled | None:
        """What is settled with only some numbers moved, to first order where nothing brings runs `within` of what is
        settled; None where the simulator does not run so."""
        theta, covariance = self.about.conditional(free)
        step = theta - self.about.theta
        best = self._moved(step, covariance, within)
        for _ in range(CORRECTIONS):
            if best is None or self._hopeless(best.y, covariance, within):
                break
            left, slope = self._left(best, self.settled), self._slope(best.y)
            further = covariance @ slope
            fall = float(slope @ further)
            if fall < STILL:
                break
            ahead = self._moved(step + further, covariance, within)
            # Where the slopes foretell little, the least of a parabola through both runs along the first one's slope.
            bend = np.inf if ahead is None else self._left(ahead, best) + 2 * fall
            if not bend <= fall and bend > 0.0:
                further = further * (fall / bend if np.isfinite(bend) else 0.1)
                ahead = self._moved(step + further, covariance, within)
            if ahead is None or not self._left(ahead, self.settled) < left:
                break
            best, step = ahead, step + further
        return best

    def _moved(self, step: Float[np.ndarray, " parameters"], covariance: np.ndarray, within: float) -> Settled | None:
        """What is settled after a step from it; None where the simulator does not run so, or runs beyond all bounds."""
        about, candidate = self.about, self.settled.candidate
        vector = about.layout.moved(about.theta, step, candidate)
        vector[: about.count] = np.maximum(vector[: about.count], 0.0)
        candidate = about.layout.candidate(vector, candidate)
        y = shown_by(self.problem, self.settled, candidate, hopeless=lambda y: self._hopeless(y, covariance, within))
        if y is None or not np.isfinite(left_by(self.problem, y)):
            return None
        fit = dataclasses.replace(self.settled.fit, candidate=candidate, covariance=covariance)
        return dataclasses.replace(self.settled, candidate=candidate, fit=fit, y=y)

    def _hopeless(self, y: Outputs, covariance: np.ndarray, within: float) -> bool:
        """Whether no step brings runs `within` of what is settled."""
        slope = self._slope(y)
        here, there = (rms_of(parts_of(self.problem, one)[0]) for one in (y, self.settled.y))
        left = self.about.samples * float(np.sum((here / there) ** 2 - 1))
        return not left - FURTHER * slope @ covariance @ slope <= within

    def _slope(self, y: Outputs) -> Float[np.ndarray, " parameters"]:
        """Slope of the sum of squares that runs leave, in units of the noise variance, by all parameters."""
        fit, g = self.settled.fit, 0.0
        parts = parts_of(self.problem, y)[0]
        scale = rms_of(parts_of(self.problem, self.settled.y)[0])
        for record, (part, J) in enumerate(zip(parts, fit.jacobian)):
            J = self.about.layout.widened(J, record)[: len(part.e)]
            g = g + np.einsum("noj,no->j", J / scale[:, None], part.e / scale)
        return g


def _chance(evidence: float) -> float:
    """Probability of a model beside one without a number of its own, by the evidence for it, a difference of BIC."""
    return float(scipy.special.expit(evidence / 2))


def _without(free: Bool[np.ndarray, " numbers"], k: int) -> Bool[np.ndarray, " numbers"]:
    return free & (np.arange(len(free)) != k)
