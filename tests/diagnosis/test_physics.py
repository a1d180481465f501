"""What no passive machine does is said of a model: negative matrices, laws that create energy, a balance with a gap."""

import dataclasses

import numpy as np
import pytest

import jaxgray
from jaxgray import BaseDisplacement, MechanicalModel, Record
from jaxgray.diagnosis.conclusions.physics import energy_of, unphysical
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.effects.coupling import DampingError
from jaxgray.mechanics.effects.friction import CoulombFriction, QuadraticDrag
from jaxgray.mechanics.effects.sensor import SensorOffset

M, D, K = np.diag([2.0, 1.0]), np.diag([0.8, 0.5]), np.array([[60.0, -20.0], [-20.0, 80.0]])
PLACE = Place("y1", 0)
REST = np.zeros(4)


def record(samples=300):
    u = np.random.default_rng(2).standard_normal((samples, 2)) * 20
    return Record(u, u.cumsum(axis=0), 0.05, hold="linear", input_units=("N", "N"), output_units=("m", "m"))


def model(*terms, damping=D, stiffness=K, **more):
    units = {"input_units": ("N", "N"), "output_units": ("m", "m")}
    return MechanicalModel(M, damping, stiffness, effects=terms, **units | more)


def test_a_passive_model_with_friction_gives_no_cause_for_complaint():
    sound = model(Term(CoulombFriction(), PLACE, np.array([1.0, 1e-3])))
    balance = energy_of(sound, record(), REST)
    assert balance.unit == "N m" and balance.laws[0].work > 0 and unphysical(sound, balance) == ()


def test_a_law_that_creates_energy_is_named():
    driven = model(Term(QuadraticDrag(), PLACE, np.array([-0.2])))
    (told,) = unphysical(driven, energy_of(driven, record(), REST))
    assert told.startswith("Quadratic drag at y1 creates energy: over ") and " N m. No passive" in told


def test_negative_matrices_are_told_with_the_terms_that_make_them():
    assert unphysical(model(damping=D - np.diag([0.0, 0.6])), None) == (
        "Damping is negative where mostly y2 moves: motion gains energy there by itself, as in chatter or flutter, or "
        "the cause is another.",
    )
    assert "unstable" in unphysical(model(stiffness=K - np.diag([90.0, 0.0])), None)[0]
    changed = model(Term(DampingError(), PLACE, np.array([-1.0])))
    (told,) = unphysical(changed, energy_of(changed, record(), REST))
    assert told.startswith("Damping is negative where mostly y1")


def test_a_gap_in_the_balance_is_told():
    sound = model(Term(CoulombFriction(), PLACE, np.array([1.0, 1e-3])))
    balance = energy_of(sound, record(), REST)
    (told,) = unphysical(sound, dataclasses.replace(balance, supplied=1.1 * balance.supplied))
    assert "misses 9.1 % of what came in" in told


@pytest.mark.parametrize(
    "without",
    [
        model(),
        model(Term(SensorOffset(), PLACE, np.array([0.1]))),
        MechanicalModel(
            M,
            D,
            K,
            drive=BaseDisplacement(np.ones((2, 2))),
            effects=(Term(CoulombFriction(), PLACE, np.array([1.0, 1e-3])),),
        ),
    ],
)
def test_where_there_is_nothing_to_balance_there_is_none(without):
    assert energy_of(without, record(), REST) is None


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"damping": D - np.diag([0.0, 0.6])}, "model: damping is negative where mostly y2 moves"),
        ({"stiffness": K - np.diag([70.0, 0.0])}, "model: stiffness is negative where mostly y1 moves"),
        ({"damping": D + [[0, 1], [-1, 0]]}, r"damping\[0,1\] and damping\[1,0\] differ by 2; .* gyroscopic_coupling"),
        ({"stiffness": K + [[0, 1], [-1, 0]]}, "circulatory_coupling among its effects"),
    ],
)
def test_a_model_that_could_not_be_judged_as_it_is_is_refused(changed, told):
    with pytest.raises(ValueError, match=told):
        jaxgray.diagnose(record(), model=model(**changed))


def test_digits_that_were_left_out_are_no_fault_of_a_model():
    written = model(stiffness=np.array([[33.333, -66.667], [-66.667, 133.333]]))
    assert baseline_of([record()], None, written).own
