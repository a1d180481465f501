"""The one rule by which a candidate becomes a finding, and what laws say of themselves."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis.acceptance import AbstractEvidence, bound_of, negligible, unproven, unsound
from jaxgray.diagnosis.findings import Gain, Reason
from jaxgray.diagnosis.search.confusable import commonest_first, look_alikes, needless, resemble
from jaxgray.diagnosis.search.state import is_local
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.effects.friction import AsymmetricFriction, CoulombFriction, LoadFriction, StribeckFriction
from jaxgray.mechanics.effects.stiffness import CubicStiffness, EndStop


@dataclasses.dataclass(frozen=True)
class Evidence(AbstractEvidence):
    delta_bic: float = 50.0
    parameter: str | None = None
    law: str | None = None
    errors: float = 8.0
    share: float = 0.4
    feedback: bool = False

    def bound(self):
        return self.parameter

    def other_law(self):
        return self.law

    def size(self):
        return self.errors

    def explained(self):
        return self.share

    def follows_inputs(self):
        return self.feedback


@pytest.mark.parametrize(
    "evidence, reason",
    [
        (Evidence(), None),
        (Evidence(delta_bic=9.0), Reason.NO_EVIDENCE),
        (Evidence(feedback=True), Reason.FEEDBACK),
        (Evidence(parameter="gap"), Reason.AT_BOUND),
        (Evidence(law="a spring without memory"), Reason.OTHER_LAW),
        (Evidence(errors=3.0), Reason.UNCERTAIN),
        # A shape that an amplitude moves along with widens its error, however clear the likelihood.
        (Evidence(errors=3.0, delta_bic=200.0), None),
        (Evidence(errors=1.0, delta_bic=200.0), Reason.UNCERTAIN),
    ],
)
def test_what_speaks_against_a_candidate(evidence, reason):
    refusal = unsound(evidence)
    assert (refusal and refusal.reason) == reason


def test_what_explains_or_gains_too_little_is_refused():
    assert negligible(Evidence(share=0.09), "the excess").reason is Reason.NEGLIGIBLE
    assert negligible(Evidence(share=0.11), "the excess") is None
    gain = Gain({}, 12.0, (1.0, 20.0), -0.5, True)
    assert unproven(gain).reason is Reason.NO_SURE_GAIN
    assert unproven(dataclasses.replace(gain, ci99_lower=0.5)) is None
    loss = unproven(dataclasses.replace(gain, ci99_lower=0.5, ci95=(-503.0, 94.0)))
    assert loss.reason is Reason.NO_SURE_GAIN and "-503 %" in loss.text


def test_a_parameter_at_a_physical_bound_is_named():
    stop = EndStop()
    names = [p.name for p in stop.parameters]
    inside, outside = (
        np.full(len(names), 0.5),
        np.array([p.lower if np.isfinite(p.lower) else 0.5 for p in stop.parameters]),
    )
    every = list(range(len(names)))
    assert bound_of(Term(stop, Place("y1", 0), inside), every) is None
    assert bound_of(Term(stop, Place("y1", 0), outside), every) in names


def test_a_list_of_which_a_part_is_at_its_bound_is_shorter():
    law = next(effect for effect in jaxgray.CATALOGUE if effect.id == "play_hysteresis")
    free = list(range(len(law.parameters)))
    some = Term(law, Place("u1", 0), np.array([0.2, 0.0, 0.1, 0.5, 0.0, 0.0]))
    assert bound_of(some, free) is None
    assert bound_of(Term(law, Place("u1", 0), np.array([0.2, 0.0, 0.1, 0.0, 0.0, 0.0])), free) == "r"
    stop = Term(EndStop(), Place("y1", 0), np.array([10.0, 0.0]))
    assert bound_of(stop, [0, 1]) == "gap"


class MySpring(CubicStiffness):
    """A law that somebody else adds to the catalogue."""

    id = "my_spring"
    resembles = "hardening"
    tied_to_clock = True


def test_a_law_of_ones_own_has_look_alikes_and_a_clock():
    catalogue = (*jaxgray.CATALOGUE, MySpring())
    assert {"cubic_stiffness", "end_stop"} <= look_alikes(MySpring(), catalogue)
    assert "my_spring" in look_alikes(CubicStiffness(), catalogue)
    by_id = {effect.id: effect for effect in catalogue}
    assert not resemble(by_id["coulomb_friction"], by_id["cubic_stiffness"])
    one_record, other_record = SimpleNamespace(separate=False), SimpleNamespace(separate=True)
    assert is_local(one_record, MySpring()) and not is_local(other_record, MySpring())
    assert is_local(other_record, by_id["periodic_disturbance"])


@pytest.mark.parametrize("effect", jaxgray.CATALOGUE, ids=lambda effect: effect.id)
def test_every_law_names_others_and_parameters_that_exist(effect):
    ids = {one.id for one in jaxgray.CATALOGUE}
    assert {*effect.contains, *effect.renamed, *effect.becomes} <= ids
    assert set(effect.onset) <= {p.name for p in effect.parameters} and len(effect.onset) in (0, 2)
    assert not effect.own_phase or effect.tied_to_clock
    assert not effect.resembles or sum(one.resembles == effect.resembles for one in jaxgray.CATALOGUE) > 1


def attempt(law, values, errors, criterion):
    """A refit of one law, its free parameters with some standard errors."""
    free = sum(p.counts for p in law.parameters)
    shape = SimpleNamespace(effect=law, place=Place("y1", 0), free=free)
    candidate = SimpleNamespace(terms=(Term(law, Place("y1", 0), np.array(values)),))
    fit = SimpleNamespace(candidate=candidate, covariance=np.diag(np.square([1.0, 1.0, *errors])))
    return SimpleNamespace(
        score=SimpleNamespace(shape=shape), fit=fit, criterion=criterion, penalty=9.0 * free, name=(law.id, "y1")
    )


@pytest.mark.parametrize(
    "wide, same",
    [
        # More at rest than in motion by hardly more than its error, and hardly ahead.
        (attempt(StribeckFriction(), [2.0, 2.1, 0.1, 1e-3], [0.05, 0.05, 0.1], 85.0), True),
        (attempt(StribeckFriction(), [2.0, 2.1, 0.1, 1e-3], [0.001, 0.001, 0.1], 85.0), False),
        # Ahead by far, whatever the error of one size.
        (attempt(StribeckFriction(), [2.0, 2.1, 0.1, 1e-3], [0.05, 0.05, 0.1], 40.0), False),
        (attempt(AsymmetricFriction(), [2.0, 0.1, 1e-3], [0.05, 0.1], 85.0), True),
        (attempt(AsymmetricFriction(), [2.0, 0.1, 1e-3], [0.05, 0.01], 85.0), False),
        # What does not pay is needless, however sure it is.
        (attempt(AsymmetricFriction(), [2.0, 0.1, 1e-3], [0.05, 0.01], 93.0), True),
    ],
)
def test_a_wider_law_that_says_nothing_more_is_needless(wide, same):
    simple = attempt(CoulombFriction(), [2.0, 1e-3], [0.05], 90.0)
    assert needless(wide, simple) == same


@pytest.mark.parametrize(("behind", "first"), [(1.0, "coulomb_friction"), (3.0, "load_friction")])
def test_of_laws_that_explain_as_much_the_commonest_stands_first(behind, first):
    ranked = [
        attempt(LoadFriction(), [2.0, 1e-3], [0.05], 90.0),
        attempt(CubicStiffness(), [2.0], [0.05], 90.5),
        attempt(CoulombFriction(), [2.0, 1e-3], [0.05], 90.0 + behind),
    ]
    found = commonest_first(ranked, jaxgray.CATALOGUE)
    assert found[0].name[0] == first and len(found) == 3
    assert commonest_first(ranked, (CubicStiffness(),)) == ranked
    assert commonest_first([], jaxgray.CATALOGUE) == []
