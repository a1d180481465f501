"""The time that a search may take: what was accepted until then is kept, and it is said what was not tried."""

import pytest
from found import diagnosed, hidden_case, model_findings

from jaxgray.numerics import progress
from jaxgray.numerics.progress import AbstractProgress, Budgeted, BudgetSpent, Silent

LAWS = ("coulomb_friction", "quadratic_drag", "cubic_stiffness")


class Clock(AbstractProgress):
    """A second passes with every stage that begins."""

    def __init__(self):
        self.stages = []

    def stage(self, name, *, fraction=None):
        self.stages.append(name)

    def monotonic(self):
        return float(len(self.stages))


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


def test_stages_are_refused_once_the_time_is_over(clock):
    told = Budgeted(clock, 2.0)
    told.stage("one")
    told.stage("two")
    for name in ("three", "four"):
        with pytest.raises(BudgetSpent):
            told.stage(name)
    told.unlimited.stage("summing up")
    assert clock.stages == ["one", "two", "summing up"] and told.ended == "three"
    without = Budgeted(Silent(), None)
    without.stage("one")
    assert without.ended is None


@pytest.mark.parametrize("stage", ["refitting", "judging", "looking further"])
def test_a_search_ends_with_what_was_accepted_until_then(clock, stage):
    case = hidden_case("coulomb_friction")
    whole = diagnosed(case, only=LAWS, progress=clock)
    at = next(k for k, name in enumerate(clock.stages) if name.startswith(stage))
    clock.stages.clear()
    cut = diagnosed(case, only=LAWS, progress=clock, budget=float(at))
    accepted = stage == "looking further"
    assert [f.effect for f in model_findings(whole)] == ["coulomb_friction"]
    assert cut.verdict == (whole.verdict if accepted else "unexplained")
    if accepted:
        assert model_findings(cut)[0].parameters == model_findings(whole)[0].parameters
    # Where nothing was left to try, nothing was cut off.
    ended = [text for text in cut.warnings if "budget" in text]
    assert len(ended) == (not accepted) and all(stage in text for text in ended), cut.warnings
    assert not [text for text in whole.warnings if "budget" in text]


@pytest.mark.parametrize("budget", [0, -1.0, float("nan")])
def test_a_budget_that_is_no_time_is_refused(budget):
    with pytest.raises(ValueError, match="budget=.*positive time in seconds"):
        diagnosed(hidden_case("coulomb_friction"), only=LAWS, budget=budget)
