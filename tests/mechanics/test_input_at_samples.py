"""Accelerometers see the input itself, at the samples: against a simulation in steps so short that no law matters."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.runs.extended import Plant, extended_run
from jaxgray.mechanics.systems.drives import Force

TIME, FINE, SAMPLES = 0.02, 200, 400
MASS, DAMPING, STIFFNESS = 1.0, 2.0, 400.0
LIMIT = 0.8


def accelerations(force):
    """At the samples, of one mass under a force given in short steps."""
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    B = np.array([[0.0], [1 / MASS]])
    plant = scipy.signal.cont2discrete((A, B, A[1:], B[1:]), TIME / FINE, method="foh")
    numerator, denominator = scipy.signal.ss2tf(*plant[:4])
    return scipy.signal.lfilter(numerator[0], denominator, force)[::FINE]


def lag(force, tau):
    """A force in short steps through a first-order lag, from rest at its first value."""
    E = np.exp(-TIME / FINE / tau)
    return force[0] + scipy.signal.lfilter([1 - E], [1, -E], np.append(force[0], force[:-1]) - force[0])


def fine(u, hold):
    """The input in short steps."""
    t = np.arange(SAMPLES * FINE)
    if hold == "zero":
        return u[t // FINE]
    return np.interp(t / FINE, np.arange(SAMPLES), u)


def later(force, part):
    """A force in short steps, so many samples later."""
    steps = int(round(part * FINE))
    return np.concatenate([np.full(steps, force[0]), force[: len(force) - steps]])


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize(
    ("effect", "value", "law"),
    [
        ("input_delay", 0.3 * TIME, lambda f: later(f, 0.3)),
        ("input_delay", 2.6 * TIME, lambda f: later(f, 2.6)),
        ("actuator_lag", 0.4 * TIME, lambda f: lag(f, 0.4 * TIME)),
        ("actuator_lag", 3.0 * TIME, lambda f: lag(f, 3.0 * TIME)),
        ("input_saturation", LIMIT, lambda f: np.clip(f, -LIMIT, LIMIT)),
        ("input_dead_zone", LIMIT, lambda f: f - np.clip(f, -LIMIT, LIMIT)),
        ("input_quadratic", 0.5, lambda f: f + 0.5 * f**2),
    ],
)
def test_acceleration_under_a_changed_input(effect, value, law, hold):
    u = np.random.default_rng(2).standard_normal(SAMPLES)
    u[:3] = 0.0
    plant = Plant(*(jnp.array([[x]]) for x in (MASS, DAMPING, STIFFNESS)), Force(jnp.eye(1)), ("acceleration",))
    term = Term(by_id(effect), Place("u1", 0), jnp.array([value]))
    y = np.asarray(extended_run(plant, (term,), jnp.zeros(2), jnp.asarray(u)[:, None], TIME, hold))[:, 0]
    right = accelerations(law(fine(u, hold)))
    assert np.std(y - right) < 0.01 * np.std(right)


def test_the_hold_comes_before_what_delays():
    # Half a sample late, and straight between the samples, in whichever order the two are found.
    u = np.random.default_rng(3).standard_normal(SAMPLES)
    u[:3] = 0.0
    plant = Plant(*(jnp.array([[x]]) for x in (MASS, DAMPING, STIFFNESS)), Force(jnp.eye(1)), ("displacement",))
    hold = Term(by_id("intersample_hold"), Place("u1", 0), jnp.array([1.0]))
    delay = Term(by_id("input_delay"), Place("u1", 0), jnp.array([0.5 * TIME]))
    runs = [
        np.asarray(extended_run(plant, terms, jnp.zeros(2), jnp.asarray(u)[:, None], TIME, "zero"))[:, 0]
        for terms in ((hold, delay), (delay, hold))
    ]
    assert np.array_equal(*runs)
    straight = np.asarray(extended_run(plant, (delay,), jnp.zeros(2), jnp.asarray(u)[:, None], TIME, "linear"))[:, 0]
    np.testing.assert_allclose(runs[0], straight, atol=1e-12 * np.ptp(straight))


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_limit_cuts_off_nothing_of_what_a_delay_makes_within_a_sample(hold):
    # A limit and a delay commute; the straight line that stands for a step within a sample reaches beyond the limit.
    u = 2 * np.random.default_rng(4).standard_normal(SAMPLES)
    u[:3] = 0.0
    plant = Plant(*(jnp.array([[x]]) for x in (MASS, DAMPING, STIFFNESS)), Force(jnp.eye(1)), ("acceleration",))
    delay, limit = (
        Term(by_id(effect), Place("u1", 0), jnp.array([value]))
        for effect, value in (("input_delay", 2.4 * TIME), ("input_saturation", LIMIT))
    )
    runs = [
        np.asarray(extended_run(plant, terms, jnp.zeros(2), jnp.asarray(u)[:, None], TIME, hold))[:, 0]
        for terms in ((delay, limit), (limit, delay))
    ]
    right = accelerations(later(np.clip(fine(u, hold), -LIMIT, LIMIT), 2.4))
    assert np.array_equal(*runs) and np.std(runs[0] - right) < 0.01 * np.std(right)
