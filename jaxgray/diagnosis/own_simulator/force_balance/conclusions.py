"""What is said of a simulator by its balance of forces."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from ....mechanics.effects.base import Term
from ... import settings
from ...acceptance import unproven
from ...conclusions.equation_error import curves_of, force_diagnosis, summary_of_windows
from ...equation_error.regression import ForceFit, Weight
from ...findings import Estimate, Finding, Gain, Member, ParameterShift
from ...model.free_run import overall, rms_of
from ...result import Diagnosis
from ...selection import Runs
from ..runs.tracking import is_white
from .equation import BalanceEquation
from .search import BalanceSearch

ALONG = (
    "A run of the simulator over the whole record departs from it at once, as where a controller holds the machine: "
    "decided by the balance of its forces along the measured motion"
)


def balance_diagnosis(search: BalanceSearch) -> Diagnosis:
    """The diagnosis of a simulator by a search in its balance of forces."""
    records = search.records
    equation = search.equation
    as_given, fitted = equation.unmoved(), search.base_runs
    before = search.base_runs = search.run(as_given)
    judged = _Judged(search, equation, equation.weight_of(search.fit.residual))
    free, gains = judged.proven(equation.free_only(search.fit.terms, judged.weight))
    fit, runs = judged.fit(free), judged.runs(free)
    for k, taken in enumerate(search.taken):
        # Beside the numbers, of what the laws before it leave.
        search.taken[k] = dataclasses.replace(taken, gain=judged.gain(fitted, taken.runs))
        fitted = taken.runs
    search.fit, search.runs = fit, runs
    found = force_diagnosis(search, None)
    noise = tuple(one for one in found.findings if one.stage != "model")
    laws = tuple(one for one in found.findings if one.stage == "model" and one.effect != "unexplained")
    wrong = tuple(judged.finding(free, k, gains[k]) for k in np.flatnonzero(free))
    findings = wrong + laws
    verdict = found.verdict
    if findings:
        left = verdict in ("unexplained", "partly")
        several = any(one.status == "equivalent" for one in findings)
        verdict = "partly" if left else "equivalent" if several else "named"
    else:
        findings = tuple(one for one in found.findings if one.effect == "unexplained")
    floor = np.array([found.noise_floor[name] for name in records[0].output_names])
    errors = search.error(as_given), search.error(fit)
    window = search.windows.samples * records[0].sampling_time
    return dataclasses.replace(
        found,
        verdict=verdict,
        baseline=summary_of_windows(search, as_given, before),
        findings=noise + findings,
        extended=summary_of_windows(search, fit, runs) if wrong or laws else None,
        gain=search.gain_over(before, runs, floor) if wrong or laws else None,
        baseline_excess=overall(rms_of(before[0]), floor),
        white=verdict not in ("partly", "unexplained") and is_white(runs[0]),
        shifts=judged.shifts(free),
        warnings=(
            f"{ALONG}, below {equation.series[0].band.high:.3g} Hz; fits and errors are those of runs over windows of "
            f"{window:.3g} s, the first state of each estimated.",
            f"Relative force error where the machine moves: {errors[0]:.3g} before, {errors[1]:.3g} after.",
        ),
        budget=_budget(errors, found, search),
        curves=curves_of(search, before, runs),
        own_model=True,
    )


def _budget(errors: tuple[float, float], found: Diagnosis, search: BalanceSearch) -> dict[str, float]:
    """Shares in the power of the force that the simulator lacks, in percent."""
    numbers = 1 - (search.error(search.base) / errors[0]) ** 2
    rest = {name: share * (1 - numbers) for name, share in found.budget.items()}
    return {"numbers": 100 * numbers, **rest}


@dataclasses.dataclass(frozen=True)
class _Judged:
    """Numbers beside the laws that a search found: what each of them gains, by runs of the simulator over windows."""

    search: BalanceSearch
    equation: BalanceEquation
    weight: Weight

    @property
    def terms(self) -> tuple[Term, ...]:
        """The laws that were found."""
        return self.search.fit.terms

    def fit(self, free: Bool[np.ndarray, " numbers"]) -> ForceFit:
        """The fit with some numbers free, the others as they were given."""
        return self.equation.with_free(free).fit(self.terms, self.weight)

    def runs(self, free: Bool[np.ndarray, " numbers"]) -> Runs:
        """Its runs."""
        return self.search.run(self.fit(free))

    def gain(self, one: Runs, other: Runs) -> Gain:
        """Gain from some runs to others."""
        return self.search.gain_over(one, other, rms_of(self.search.runs[0]))

    def proven(self, free: Bool[np.ndarray, " numbers"]) -> tuple[np.ndarray, dict[int, Gain]]:
        """The numbers of those that surely gain by being other, and what each gains."""
        while free.any():
            runs = self.runs(free)
            gains = {int(k): self.gain(self.runs(_without(free, k)), runs) for k in np.flatnonzero(free)}
            needless = [k for k in gains if unproven(gains[k]) is not None]
            if not needless:
                return free, gains
            free = _without(free, min(needless, key=lambda k: gains[k].percent))
        return free, {}

    def finding(self, free: Bool[np.ndarray, " numbers"], k: int, gain: Gain) -> Finding:
        """What is said of a number, with those that serve in its place."""
        evidence = self.equation.missed(self.terms, self.weight, free, k)
        members = [self._member(free, k, 0.0)]
        for j in np.flatnonzero(self.equation.known & ~free):
            behind = self.equation.missed(self.terms, self.weight, free, k, other=int(j))
            if behind < settings.CLASS_DELTA_BIC:
                members.append(self._member(_without(free, k) | (np.arange(len(free)) == j), int(j), -max(behind, 0.0)))
        status = "named" if len(members) == 1 else "equivalent"
        what = "parameter_error", members[0].location, status, "model"
        return Finding(*what, tuple(members), members[0].parameters, evidence, gain)

    def _member(self, free: Bool[np.ndarray, " numbers"], k: int, difference: float) -> Member:
        fit = self.fit(free)
        value, error = float(self.equation.numbers(fit)[k]), float(self.equation.errors(fit)[k])
        delta = Estimate(value - float(self.equation.given[k]), error, "")
        parameters = {"delta": delta, "value": Estimate(value, error, "")}
        return Member("parameter_error", self.equation.names[k], difference, parameters)

    def shifts(self, free: Bool[np.ndarray, " numbers"]) -> tuple[ParameterShift, ...]:
        """Every number as it was given, and as it would be beside those that have to be other."""
        made = []
        for k, (name, old) in enumerate(zip(self.equation.names, self.equation.given)):
            fit = self.fit((free | (np.arange(len(free)) == k)) & self.equation.known)
            new, error = self.equation.numbers(fit)[k], self.equation.errors(fit)[k]
            made.append(ParameterShift(name, float(old), float(new), float(error) if error > 0 else None))
        return tuple(made)


def _without(free: Bool[np.ndarray, " numbers"], k: int) -> Bool[np.ndarray, " numbers"]:
    return free & (np.arange(len(free)) != k)
