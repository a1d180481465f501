"""Load and deflection of a body that stands still at every sample: springs that are not linear, and nothing of mass."""

import hidden
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from found import check_parameter, generator, model_findings, record_findings

import jaxgray
from jaxgray.diagnosis.routing import is_static_curve, plays
from jaxgray.diagnosis.static_gain.regression import Static
from jaxgray.diagnosis.static_gain.springs import is_spring
from jaxgray.mechanics.effects import CATALOGUE, by_id
from jaxgray.mechanics.effects.base import Place, Term

STIFFNESS, NOISE = 1000.0, 2e-4
FORCES = {
    "none": (lambda q: 0.0, {}),
    "cubic_stiffness": (lambda q: 4e4 * q**3, {"k3": 4e4}),
    "end_stop": (lambda q: 5e3 * np.sign(q) * max(abs(q) - 0.06, 0.0), {"ks": 5e3, "gap": 0.06}),
    "dead_zone_stiffness": (lambda q: 3e3 * np.sign(q) * max(abs(q) - 0.01, 0.0), {"k": 3e3, "gap": 0.01}),
    "bilinear_stiffness": (lambda q: 600.0 * max(q, 0.0), {"ks": 600.0}),
}


def load(kind, samples, rng):
    """Forces that move slowly, or in steps after which the motion is over."""
    if kind == "steps":
        return np.repeat(rng.uniform(-100, 100, samples // 20), 20)
    turns = [0, 1, -1, 0.8, -0.8, 1, -1, 0.5, -0.5]
    return 100 * np.interp(np.arange(samples), np.linspace(0, samples - 1, len(turns)), turns)


def recorded(law, kind, *words, samples=2000):
    """A record of load and deflection, every deflection found by bisection."""
    rng = generator("static", law, kind, *words)
    u = load(kind, samples, rng)
    force = FORCES[law][0]
    y = np.array([scipy.optimize.brentq(lambda q, v=v: STIFFNESS * q + force(q) - v, -1.0, 1.0) for v in u])
    return jaxgray.Record(u[:, None], y[:, None] + NOISE * rng.standard_normal((samples, 1)), 0.1)


LATER = {("ramps", "bilinear_stiffness"), ("ramps", "dead_zone_stiffness"), ("steps", "none"), ("steps", "end_stop")}
LATER |= {
    ("steps", "dead_zone_stiffness"),
    ("ramps", "cubic_stiffness"),
    ("ramps", "end_stop"),
    ("steps", "bilinear_stiffness"),
    ("steps", "cubic_stiffness"),
}
CASES = [
    pytest.param(kind, law, marks=[pytest.mark.slow] if (kind, law) in LATER else [])
    for kind in ("ramps", "steps")
    for law in FORCES
]


@pytest.mark.parametrize("kind, law", CASES)
def test_the_law_of_a_spring_is_found_from_load_and_deflection(kind, law):
    diagnosis = jaxgray.diagnose(recorded(law, kind))
    found = model_findings(diagnosis)
    if law == "none":
        assert diagnosis.verdict == "noise" and not found
        return
    (finding,) = found
    assert (finding.effect, finding.location, finding.status) == (law, "y1", "named"), str(diagnosis)
    for name, value in FORCES[law][1].items():
        check_parameter(finding.parameters[name], value, name, str(diagnosis))
    K = np.asarray(diagnosis.extended.model.stiffness)
    assert abs(K[0, 0] / STIFFNESS - 1) < 0.02 and not np.any(diagnosis.extended.model.mass)
    assert diagnosis.white and not record_findings(diagnosis)


def test_what_moves_is_no_static_curve():
    for k in range(8):
        case = hidden.null_case(generator("moves", str(k)), hidden.NULLS[k % 4], dofs=(1,), samples=2000)
        assert not is_static_curve(jaxgray.Record(case.u, case.y, case.sampling_time, hold=case.hold))
    record = recorded("cubic_stiffness", "steps")
    assert is_static_curve(record)
    # One sample late is memory.
    late = jaxgray.Record(record.u[1:], record.y[:-1], 0.1)
    assert not is_static_curve(late)


def test_loops_without_a_time_of_their_own_say_nothing_of_inertia():
    rng = generator("play")
    u = load("ramps", 1200, rng)
    z = plays(u, np.array([25.0]))[:, 0]
    assert np.all(np.abs(u - z) <= 25.0 + 1e-12) and np.ptp(z) == pytest.approx(np.ptp(u) - 50.0)
    y = (u + 0.4 * z) / STIFFNESS + NOISE * rng.standard_normal(len(u))
    assert is_static_curve(jaxgray.Record(u, y, 0.1))
    # What creeps takes its time.
    crept = scipy.signal.lfilter([0.05], [1.0, -0.95], u) / STIFFNESS
    assert not is_static_curve(jaxgray.Record(u, u / STIFFNESS + 0.3 * crept + NOISE * rng.standard_normal(1200), 0.1))


@pytest.mark.slow
def test_play_is_found_in_loops_of_load_and_deflection():
    rng = generator("play found")
    u = load("ramps", 1200, rng)
    y = (u + 0.4 * plays(u, np.array([25.0]))[:, 0]) / STIFFNESS + NOISE * rng.standard_normal(1200)
    (finding,) = model_findings(jaxgray.diagnose(jaxgray.Record(u, y, 0.1)))
    assert (finding.effect, finding.location) == ("play_hysteresis", "u1")


def test_springs_are_the_forces_of_displacement_alone():
    problem = Static([recorded("none", "steps")], np.eye(1))
    scales = problem.displacements(Place("y1", 0))
    springs = {effect.id for effect in CATALOGUE if is_spring(effect, scales)}
    assert springs == {
        "cubic_stiffness",
        "quadratic_stiffness",
        "dead_zone_stiffness",
        "end_stop",
        "bilinear_stiffness",
        "sine_stiffness",
    }


def test_derivatives_are_those_of_the_curve():
    rng = generator("static derivatives")
    u = rng.uniform(-50, 50, (200, 2))
    gain = np.array([[2e-3, 5e-4], [5e-4, 1e-3]])
    record = jaxgray.Record(u, u @ gain.T, 0.1)
    problem = Static([record], np.eye(2))

    def terms(k3, ks, width):
        return (
            Term(by_id("cubic_stiffness"), Place("y1-y2", 0, 1), np.array([k3])),
            Term(by_id("input_quadratic"), Place("u2", 1), np.array([width, 0.0])),
            Term(by_id("bilinear_stiffness"), Place("y1", 0), np.array([ks])),
        )

    offset = np.array([1e-3, -2e-3])
    values = np.array([3e5, 200.0, 1e-3])
    y, J = problem._simulated(offset, gain, terms(*values), record)
    # What the curve says of itself: K q and the springs hold the inputs.
    q1, q2 = y[:, 0], y[:, 1]
    spring = 3e5 * (q1 - q2) ** 3
    held = np.linalg.solve(gain, (y - offset).T).T + np.stack([spring + 200 * np.maximum(q1, 0), -spring], axis=1)
    np.testing.assert_allclose(held[:, 0], u[:, 0], rtol=0, atol=1e-9)
    # Terms in their order, after two offsets and four gains.
    for k, column in enumerate((6, 8, 7)):
        step = 1e-5 * values[k] * np.eye(3)[k]
        up, down = (problem._simulated(offset, gain, terms(*(values + s * step)), record)[0] for s in (1, -1))
        expected = (up - down) / (2 * step[k])
        assert np.linalg.norm(J[:, :, column] - expected) < 1e-4 * np.linalg.norm(expected)
    for k, (r, c) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
        step = 1e-7 * np.eye(2)[r][:, None] * np.eye(2)[c][None]
        up, down = (problem._simulated(offset, gain + s * step, terms(*values), record)[0] for s in (1, -1))
        expected = (up - down) / 2e-7
        assert np.linalg.norm(J[:, :, 2 + k] - expected) < 1e-4 * np.linalg.norm(expected)
