"""Where the work of the inputs goes, against SciPy's integrator with every work as a state of its own."""

import numpy as np
import pytest
import scipy.integrate

from jaxgray import BaseAcceleration, BaseDisplacement, ComputationError, MechanicalModel, Record, energy_balance
from jaxgray.mechanics import energy
from jaxgray.mechanics.effects.actuator import InputPositionGain
from jaxgray.mechanics.effects.base import AbstractForceEffect, Parameter, Place, Term
from jaxgray.mechanics.effects.coupling import CirculatoryCoupling, GyroscopicCoupling
from jaxgray.mechanics.effects.disturbance import PeriodicDisturbance
from jaxgray.mechanics.effects.friction import CoulombFriction, LoadFriction, QuadraticDrag
from jaxgray.mechanics.effects.hysteresis import BoucWenHysteresis
from jaxgray.mechanics.effects.stiffness import ConstantForce, CubicStiffness, EndStop
from jaxgray.mechanics.effects.structure import MassStep
from jaxgray.mechanics.passivity import violations

M = np.array([[2.0, -0.3], [-0.3, 1.0]])
D = np.array([[0.8, -0.2], [-0.2, 0.5]])
K = np.array([[60.0, -20.0], [-20.0, 80.0]])
H, SAMPLES = 0.05, 100
FIRST, SECOND, BETWEEN = Place("y1", 0), Place("y2", 1), Place("y1-y2", 0, 1)


def record(hold, inputs=2, samples=SAMPLES):
    u = np.random.default_rng(3).standard_normal((samples, inputs)) * 20
    # Held over four samples, or straight over as many.
    u = np.repeat(u, 4, axis=0)[:samples] if hold == "zero" else u
    return Record(u, np.zeros((samples, 2)) + np.arange(samples)[:, None], H, hold=hold)


def term(effect, place, *values):
    return Term(effect, place, np.array(values))


class SpringWithGain(AbstractForceEffect):
    """Pushes harder on the way back than it was pressed on the way out."""

    id = "spring_with_gain"
    family = "own"
    law = "f = k q (1 - g sign(q v))"
    parameters = (Parameter("k", (1, -1, 0), amplitude=True), Parameter("g"))
    signature = "a loop that runs the other way round"
    reference = "none"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0, 0.1])]

    def force(self, p, here, z):
        return p[0] * here.q * (1 - p[1] * _sign(here.q * here.v))


class NegativeFriction(AbstractForceEffect):
    """Pushes along the way that the body goes."""

    id = "negative_friction"
    family = "own"
    law = "f = -F v/(|v| + w)"
    parameters = (Parameter("F", (1, 0, 0), amplitude=True), Parameter("w", (0, 1, -1), counts=False))
    signature = "swings that grow"
    reference = "none"
    places = "spring"

    def shapes(self, scales):
        return [np.array([1.0, 0.1])]

    def force(self, p, here, z):
        return -p[0] * here.v / (abs(here.v) + p[1])


def _sign(x):
    return x / (abs(x) + 1e-9)


SIZES = {"cubic": 300.0, "drag": 3.0, "coulomb": 1.5, "turn": 0.05, "A": 40.0, "beta": 15.0, "gamma": 5.0}
TERMS = (
    term(CubicStiffness(), FIRST, SIZES["cubic"]),
    term(QuadraticDrag(), BETWEEN, SIZES["drag"]),
    term(CoulombFriction(), SECOND, SIZES["coulomb"], SIZES["turn"]),
    term(BoucWenHysteresis(), FIRST, SIZES["A"], SIZES["beta"], SIZES["gamma"]),
)


def by_scipy(given, x0):
    """Supplied, damped, and taken by each law; and the rise of the energy."""
    u, hold = given.u, given.hold
    after = u if hold == "zero" else np.vstack([u[1:], u[-1:]])

    def forces(q, v, z):
        return np.array(
            [
                SIZES["cubic"] * q[0] ** 3,
                SIZES["drag"] * abs(v[0] - v[1]) * (v[0] - v[1]),
                SIZES["coulomb"] * np.clip(v[1] / SIZES["turn"], -1, 1),
                SIZES["A"] * z,
            ]
        )

    arms = np.array([[1.0, 0.0], [1.0, -1.0], [0.0, 1.0], [1.0, 0.0]])

    def slope(t, x, first, rise):
        q, v, z = x[:2], x[2:4], x[4]
        push = first + rise * t / H
        f = forces(q, v, z)
        a = np.linalg.solve(M, push - D @ v - K @ q - arms.T @ f)
        change = v[0] - SIZES["beta"] * abs(v[0]) * z - SIZES["gamma"] * v[0] * abs(z)
        return np.concatenate([v, a, [change, v @ push, v @ D @ v], f * (arms @ v)])

    x = np.concatenate([x0, [0.0], np.zeros(6)])
    start = x.copy()
    for k in range(len(u) - 1):
        run = scipy.integrate.solve_ivp(slope, (0, H), x, args=(u[k], after[k] - u[k]), rtol=1e-6, atol=1e-8)
        x = run.y[:, -1]
    rise = sum(sign * (y[2:4] @ M @ y[2:4] + y[:2] @ K @ y[:2]) / 2 for sign, y in ((1, x), (-1, start)))
    return x[5], rise, x[6], x[7:]


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_every_work_is_that_of_an_independent_integration(hold):
    given, x0 = record(hold), np.array([0.3, -0.2, 0.0, 1.0])
    found = energy_balance(MechanicalModel(M, D, K, effects=TERMS), given, x0=x0)
    supplied, stored, damped, laws = by_scipy(given, x0)
    got = [found.supplied, found.stored, found.damped, *(law.work for law in found.laws)]
    np.testing.assert_allclose(got, [supplied, stored, damped, *laws], atol=2e-3 * found.entered)
    assert found.error < 1e-3 and found.circulated == 0.0
    assert [law.effect for law in found.laws] == [one.effect.id for one in TERMS]
    assert not any(law.creates for law in found.laws)


def test_a_wrong_force_does_not_balance():
    """The two sides are computed apart: a motion under other forces than the laws' own leaves a gap."""
    given = record("linear")
    found = energy_balance(MechanicalModel(M, D, K, effects=TERMS), given)
    other = energy_balance(MechanicalModel(M, D, K, effects=TERMS[:3]), given)
    gap = found.supplied - found.stored - found.damped - sum(law.work for law in other.laws)
    assert abs(gap) > 20 * abs(found.residual)


@pytest.mark.parametrize("h", [0.01, 0.05, 0.2])
def test_the_linear_balance_closes_at_any_sampling_time(h):
    given = record("zero")
    given = Record(given.u, given.y, h, hold="zero")
    assert energy_balance(MechanicalModel(M, D, K), given).error < 1e-5


def test_under_a_moving_base_the_inertia_forces_work():
    given = record("linear", inputs=1)
    model = MechanicalModel(M, D, K, drive=BaseAcceleration(np.ones((2, 1)), relative=True))
    as_forces = Record(given.u @ -(M @ np.ones((2, 1))).T, given.y, H, hold="linear")
    found, same = energy_balance(model, given), energy_balance(MechanicalModel(M, D, K), as_forces)
    assert found.supplied == pytest.approx(same.supplied) and found.error < 1e-4
    moved = MechanicalModel(M, D, K, drive=BaseDisplacement(np.ones((2, 1))))
    with pytest.raises(ValueError, match="base displacement"):
        energy_balance(moved, given)


def test_circulatory_terms_work_and_gyroscopic_ones_do_not():
    given = record("linear")
    found = energy_balance(MechanicalModel(M, D, K, effects=(term(CirculatoryCoupling(), BETWEEN, 8.0),)), given)
    assert abs(found.circulated) > 0.01 * found.entered and found.error < 1e-3
    turned = energy_balance(MechanicalModel(M, D, K, effects=(term(GyroscopicCoupling(), BETWEEN, 3.0),)), given)
    assert turned.circulated == 0.0 and turned.error < 1e-3


@pytest.mark.parametrize(
    ("law", "creates"),
    [
        (term(NegativeFriction(), FIRST, 1.0, 0.05), True),
        (term(NegativeFriction(), FIRST, -1.0, 0.05), False),
        (term(SpringWithGain(), FIRST, 20.0, 0.2), True),
        (term(SpringWithGain(), FIRST, 20.0, -0.2), False),
        (term(CubicStiffness(), FIRST, -5.0), False),
        (term(EndStop(), FIRST, 500.0, 0.1), False),
        (term(ConstantForce(), FIRST, 5.0), False),
        # It gives energy, too: from outside.
        (term(PeriodicDisturbance(), FIRST, 8.0, 0.9, 0.0), False),
    ],
)
def test_laws_that_create_energy_are_named(law, creates):
    found = energy_balance(MechanicalModel(M, D, K, effects=(law,)), record("linear", samples=400))
    (one,) = found.laws
    assert one.creates == creates and one.cycles > 5 and found.error < 0.01
    if law.effect.id == "periodic_disturbance":
        assert one.outside and one.over_cycles < 0


def test_a_free_decay_takes_what_was_stored():
    given = Record(np.zeros((400, 2)), np.arange(800.0).reshape(400, 2), H)
    found = energy_balance(MechanicalModel(M, D, K), given, x0=np.array([0.5, 0.0, 0.0, 0.0]))
    assert found.supplied == 0.0 and found.damped == pytest.approx(-found.stored, rel=1e-4)
    assert found.entered == pytest.approx(0.5 * 60.0 * 0.25, rel=0.01)


@pytest.mark.parametrize(("x0", "inputs"), [(np.zeros(3), 2), (np.full(4, np.nan), 2), (None, 1)])
def test_arguments_that_do_not_fit_are_refused(x0, inputs):
    with pytest.raises(ValueError, match="x0 is|record has 1 inputs"):
        energy_balance(MechanicalModel(M, D, K), record("zero", inputs), x0=x0)


def test_a_motion_without_bound_has_no_balance():
    runaway = MechanicalModel(M, D, K, effects=(term(CubicStiffness(), FIRST, -300.0),))
    with pytest.raises(ComputationError, match="without bound"):
        energy_balance(runaway, record("linear"), x0=np.array([5.0, 0.0, 0.0, 0.0]))


def test_units_are_those_of_a_work():
    names = {"input_units": ("N", "N"), "output_units": ("m/s^2", "m/s^2"), "measured": "acceleration"}
    assert energy_balance(MechanicalModel(M, D, K, **names), record("zero")).unit == "N m"
    mixed = names | {"output_units": ("m/s^2", "rad/s^2")}
    assert energy_balance(MechanicalModel(M, D, K, **mixed), record("zero")).unit == ""


SKEW = np.array([[0.0, 3.0], [-3.0, 0.0]])


@pytest.mark.parametrize(
    ("matrices", "found"),
    [
        ((M, D, K), []),
        ((M, 0 * D, 0 * K), []),
        ((M, D, np.array([[1.0, -1.0], [-1.0, 1.0]])), []),
        ((M, D - np.diag([0.0, 0.7]), K), [("damping", "negative", (1,))]),
        ((M, D, K - np.diag([70.0, 0.0])), [("stiffness", "negative", (0,))]),
        ((np.diag([1.0, 0.0]), D, K), [("mass", "negative", (1,))]),
        ((M, D + SKEW, K), [("damping", "asymmetric", (0, 1))]),
        ((M, D, K + SKEW), [("stiffness", "asymmetric", (0, 1))]),
    ],
)
def test_matrices_of_structures_that_are_not_passive_or_reciprocal_are_told(matrices, found):
    assert [(one.matrix, one.kind, one.at) for one in violations(*matrices)] == found
    # In other units of the second coordinate the same.
    units = np.array([1.0, 1e3])
    assert [(one.matrix, one.kind) for one in violations(*(X / np.outer(units, units) for X in matrices))] == [
        one[:2] for one in found
    ]


def test_of_a_record_too_long_the_first_part_is_followed(monkeypatch):
    given, model = record("zero"), MechanicalModel(M, D, K)
    steps = energy.steps_per_sample(model, H)
    monkeypatch.setattr(energy, "MOST_ROWS", 60 * steps)
    assert energy_balance(model, given) == energy_balance(model, given[:60]) != energy_balance(model, given[:59])


@pytest.mark.parametrize(
    "law",
    [
        term(LoadFriction(), Place("u1", 0), 0.1, 1e-3),
        term(InputPositionGain(), Place("u1", 0), 0.5, 0.0),
        term(MassStep(), FIRST, 0.6, 2.0, 0.1),
    ],
)
def test_laws_that_jump_with_the_input_balance_too(law):
    # Another input at every sample, and slow motion between two: few steps are taken.
    given = Record(np.random.default_rng(5).standard_normal((2000, 2)) * 20, np.arange(4000.0).reshape(2000, 2), 0.008)
    found = energy_balance(MechanicalModel(M, D, K, effects=(law,)), given)
    assert energy.steps_per_sample(MechanicalModel(M, D, K), 0.008) == 2
    assert found.error < 2e-3 and found.laws[0].moved > 0.02 * found.entered
