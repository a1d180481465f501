"""What a diagnosis consists of: findings, gains, summaries and curves, as immutable values."""

import enum
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ..identification import Identification
from ..mechanics.effects.base import Term
from ..mechanics.energy import EnergyBalance
from ..mechanics.model import MechanicalModel
from ..records import Record


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error and unit; a list of values for parameters that come as a list."""

    value: float | tuple[float, ...] | str
    standard_error: float | tuple[float, ...] | None
    unit: str


@dataclass(frozen=True)
class Gain:
    """What a finding takes off the free-run error.

    `per_output`: name → (rmse before, rmse after); `percent` = 100 (RMSE before − after)/RMSE of the baseline, RMSE
    over all outputs in units of their noise floors; `ci95`: interval of the gain on other records of the kind, from the
    jackknife over long pieces and from its difference to the gain on the data of the fit; `ci99_lower`: of the gain on
    this one, by block bootstrap; `held_out`: whether the fit had not seen the data; `together`: how many findings gain
    it only together, each an equal part.
    """

    per_output: dict[str, tuple[float, float]]
    percent: float
    ci95: tuple[float, float]
    ci99_lower: float
    held_out: bool
    together: int = 1

    def parts(self, count: int) -> list["Gain"]:
        """Equal parts of it, for so many findings."""

        def part(k: int) -> dict[str, tuple[float, float]]:
            return {
                name: (before + k / count * (after - before), before + (k + 1) / count * (after - before))
                for name, (before, after) in self.per_output.items()
            }

        interval = self.ci95[0] / count, self.ci95[1] / count
        values = self.percent / count, interval, self.ci99_lower / count, self.held_out, count
        return [Gain(part(k), *values) for k in range(count)]


@dataclass(frozen=True)
class Member:
    """One of a class that the record does not separate; `delta_bic` relative to the best (0 or less)."""

    effect: str
    location: str
    delta_bic: float
    parameters: dict[str, Estimate]


@dataclass(frozen=True)
class Finding:
    """One thing that the simulation gets wrong.

    `effect`, `location`; `status`: named, equivalent, partly or unexplained; `stage`: "model", or "record" for what
    the raw record shows; `members`: the class, the named one first; `parameters` by symbol; `delta_bic` of the refit;
    `gain`; `message`: one sentence; `found_by`: the move by which it came into the model, a value of `Move`.
    """

    effect: str
    location: str
    status: str
    stage: str
    members: tuple[Member, ...]
    parameters: dict[str, Estimate]
    delta_bic: float | None
    gain: Gain | None
    message: str = ""
    found_by: str | None = None


class Move(enum.Enum):
    """How a finding came into the model."""

    SCORE_TEST = "score test"
    SECOND_SCREENING = "score test without laws that do not hold"
    FORCE_EQUATION = "force equation"
    STATIC_GAIN = "static gain"
    HIDDEN_MODE = "line of the residual"
    WITH_ANOTHER = "together with a later one"
    IN_ITS_PLACE = "in the place of another"
    BEGUN_WITH = "taken in the place of another in its round"


class Reason(enum.Enum):
    """Why a candidate is not in the model."""

    NO_EVIDENCE = "too little evidence"
    FEEDBACK = "a closed loop looks the same"
    AT_BOUND = "at a physical bound"
    OTHER_LAW = "another law under this name"
    UNCERTAIN = "amplitude not significant"
    NEGLIGIBLE = "explains too little"
    WORSE = "simulates worse than without it"
    NO_SURE_GAIN = "no sure gain"
    NOT_SIMULATED = "could not be simulated"
    DOMINATED = "far behind another of its round"
    EXPLAINED_BETTER = "explained better by another"
    NEEDLESS = "needless beside others"


@dataclass(frozen=True)
class Refusal:
    """A reason, and its sentence."""

    reason: Reason
    text: str


NOT_SIMULATED = Refusal(Reason.NOT_SIMULATED, "its refit could not be simulated")
NEEDLESS_NOW = Refusal(Reason.NEEDLESS, "needless once the others are in the model")


@dataclass(frozen=True)
class Rejected:
    """A candidate that passed the gate and was not taken: `why` in words, `reason` as a value; `gain` and `parameters`
    of its refit, where there was one."""

    effect: str
    location: str
    delta_bic: float
    why: str
    gain: Gain | None = None
    parameters: dict[str, Estimate] = field(default_factory=dict)
    reason: Reason | None = None

    @classmethod
    def of(cls, name: tuple[str, str], delta_bic: float, refusal: Refusal, gain: Gain | None = None) -> "Rejected":
        """The candidate of this effect and place, refused."""
        return cls(*name, float(delta_bic), refusal.text, gain, reason=refusal.reason)


@dataclass(frozen=True)
class Gated:
    """A candidate at the first look: its evidence by a linear response to the simulated motion."""

    effect: str
    location: str
    delta_bic: float


@dataclass(frozen=True)
class NotFound:
    """A candidate that the record does not call for, with the smallest size that would have been seen."""

    effect: str
    location: str
    min_detectable: dict[str, Estimate]


@dataclass(frozen=True)
class ParameterShift:
    """An entry of M, D, K before and after the extension; or a number of a simulator as given, and as fitted: with all
    that have to change, or, where it need not change, freed beside these."""

    name: str
    before: float
    after: float
    standard_error: float | None

    @property
    def percent(self) -> float:
        """Change in percent of the value before."""
        return 100 * (self.after - self.before) / self.before if self.before else float("nan")


@dataclass(frozen=True)
class ModelSummary:
    """A model with its errors and how well it runs freely.

    `model`; `standard_errors` of mass, damping, stiffness, or None; `fit_percent` and `rmse`: "estimation" and
    "validation", per output.
    """

    model: MechanicalModel
    standard_errors: dict[str, Float[np.ndarray, "dofs dofs"]] | None
    fit_percent: dict[str, dict[str, float]]
    rmse: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Curves:
    """Series behind the figures of one record: outputs measured, simulated by the linear and by the extended model."""

    time: Float[np.ndarray, " samples"]
    measured: Float[np.ndarray, "samples outputs"]
    baseline: Float[np.ndarray, "samples outputs"]
    extended: Float[np.ndarray, "samples outputs"]
    held_out: bool


@dataclass(frozen=True)
class NextExperiment:
    """The input that best separates the members of a class.

    `members`: ids; `input`: samples × inputs; `sampling_time` [s]; `separation`: predicted d²/σ² between the members
    with this input; `separation_now`: with the record's own; `text`.
    """

    members: tuple[str, ...]
    input: Float[np.ndarray, "samples inputs"]
    sampling_time: float
    separation: float
    separation_now: float
    text: str


@dataclass(frozen=True)
class SimulatedOutputs:
    """The model that stands in for a simulation of which only the outputs are known: the `findings` that it has beside
    M, D, K, and what it leaves of the motion of every output [%] (`left_percent`)."""

    findings: tuple[Finding, ...]
    left_percent: dict[str, float]


@dataclass(frozen=True)
class DiagnosisFields:
    """What a `Diagnosis` holds; its docstring says what each field is."""

    verdict: str
    baseline: ModelSummary
    noise_floor: dict[str, float]
    noise_floor_source: str
    findings: tuple[Finding, ...]
    extended: ModelSummary | None
    gain: Gain | None
    excess: float
    baseline_excess: float
    white: bool
    explainable: float | None
    depends_on: tuple[str, ...]
    rejected: tuple[Rejected, ...]
    not_found: tuple[NotFound, ...]
    shifts: tuple[ParameterShift, ...]
    budget: dict[str, float]
    next_experiment: NextExperiment | None
    warnings: tuple[str, ...]
    records: tuple[Record, ...] = field(repr=False)
    validation_records: tuple[Record, ...] = field(repr=False)
    curves: tuple[Curves, ...] = field(repr=False)
    identification: Identification | None = field(repr=False)
    terms: tuple[Term, ...] = ()
    own_model: bool = False
    gate: tuple[Gated, ...] = ()
    beside: Float[np.ndarray, "samples dofs"] | None = field(default=None, repr=False)
    simulated: SimulatedOutputs | None = None
    energy: EnergyBalance | None = None
