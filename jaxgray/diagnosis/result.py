"""The diagnosis as one immutable result."""

from dataclasses import dataclass

from ..numerics.data_frames import data_frame
from ..numerics.notebook import Shown
from .findings import DiagnosisFields, Estimate, Finding, Member
from .words.sentences import describe, verdict_sentence


@dataclass(frozen=True, repr=False)
class Diagnosis(DiagnosisFields, Shown):
    """What the simulation gets wrong, why, and what mending it buys.

    `verdict`: the worst over the findings; `baseline`: the linear model (or the user's own); `noise_floor` per output
    and where it comes from; `findings` in order of acceptance; `extended`: the model with all terms, None where nothing
    was found; `gain`: of all findings together; `excess`: RMSE over noise floor of what is left; `white`: whether what
    is left is white; `explainable`: share of the baseline's excess that a flexible competitor could explain on held-out
    data; `depends_on`: variables on which an unexplained rest depends; `rejected`; `not_found`; `shifts` of M, D, K;
    `budget`: share of every term, noise and the unexplained in the baseline's mean square error, in percent;
    `next_experiment`; `warnings`; `curves` for the figures; `identification`: the linear fit, None with the user's own
    model; `terms` accepted; `beside`: where the linear model stands for the user's own simulator, the forces at the
    coordinates that act on it beside its inputs, over the first record; else None; `simulated`: what stands in for a
    simulation of which only the outputs were given, else None; `energy`: where the work of the inputs goes in the model
    with its laws, None where it has none.
    """

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return verdict_sentence(self)

    def to_dataframe(self):
        """The findings as a pandas `DataFrame`, one row a parameter, in order of acceptance.

        **Returns:** `finding`: its number, from 0; `effect`, `location`, `status`, `stage`; `member`: 0 for what is
        named, 1, 2, … for others that the record does not tell from it; `parameter`, `value`, `standard_error` (NaN
        where it was not estimated), `unit`: one empty row for a finding without parameters, `a[0]`, `a[1]`, … for a
        list; `delta_bic`: of the finding, of further members relative to it; `gain_percent`, `ci95_lower`,
        `ci95_upper`, `held_out` of the finding.

        **Raises:** `ImportError` without pandas.
        """
        rows = []
        for number, finding in enumerate(self.findings):
            for k, member in enumerate((finding, *finding.members[1:])):
                rows += [{"finding": number, **row} for row in _rows(finding, member, k)]
        return data_frame(rows, COLUMNS)

    def __repr__(self) -> str:
        return describe(self)


COLUMNS = ("finding", "effect", "location", "status", "stage", "member", "parameter", "value", "standard_error", "unit")
"""Of the findings as a table, those that are there without any finding."""


def _rows(finding: Finding, member: Finding | Member, k: int) -> list[dict]:
    gain = finding.gain
    what = {
        "effect": member.effect,
        "location": member.location,
        "status": finding.status,
        "stage": finding.stage,
        "member": k,
    }
    evidence = {
        "delta_bic": member.delta_bic,
        "gain_percent": None if gain is None else gain.percent,
        "ci95_lower": None if gain is None else gain.ci95[0],
        "ci95_upper": None if gain is None else gain.ci95[1],
        "held_out": None if gain is None else gain.held_out,
    }
    numbers = [row for name, one in member.parameters.items() for row in _parameters(name, one)]
    return [what | row | evidence for row in numbers or [dict.fromkeys(COLUMNS[6:])]]


def _parameters(name: str, one: Estimate) -> list[dict]:
    """A row, or one for every value of a list."""
    if not isinstance(one.value, tuple | list):
        return [{"parameter": name, "value": one.value, "standard_error": one.standard_error, "unit": one.unit}]
    errors = one.standard_error
    return [
        {
            "parameter": f"{name}[{j}]",
            "value": value,
            "standard_error": errors[j] if isinstance(errors, tuple | list) else errors,
            "unit": one.unit,
        }
        for j, value in enumerate(one.value)
    ]
