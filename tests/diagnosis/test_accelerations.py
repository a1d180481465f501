"""What lies between command and force, seen by an accelerometer, to which the force comes through directly."""

import hidden
import numpy as np
import pytest
import scipy.signal
from found import SAMPLES, generator, model_findings

import jaxgray

TIME, FINE = 0.02, 50
MASS, DAMPING, STIFFNESS = 1.0, 2.0, 400.0
TAU = 0.4 * TIME


def responded(system, force):
    """Through a linear system, the force straight between its short steps."""
    sampled = scipy.signal.cont2discrete(system, TIME / FINE, method="foh")
    numerator, denominator = scipy.signal.ss2tf(*sampled[:4])
    return scipy.signal.lfilter(numerator[0], denominator, force)


def lagged(force):
    """Through a first-order lag."""
    return responded((np.array([[-1 / TAU]]), np.array([[1 / TAU]]), np.eye(1), np.zeros((1, 1))), force)


def delayed(force):
    """So much later."""
    steps = int(round(TAU / TIME * FINE))
    return np.concatenate([np.zeros(steps), force[:-steps]])


def record(rng, law):
    """Acceleration of one mass under a command that is straight between its samples."""
    u = hidden.draws.excitation(rng, "noise", SAMPLES, np.array([15.0]))[:, 0]
    force = law(np.interp(np.arange(SAMPLES * FINE) / FINE, np.arange(SAMPLES), u))
    A, B = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]]), np.array([[0.0], [1 / MASS]])
    y = responded((A, B, A[1:], B[1:]), force)[::FINE]
    y = y + 0.01 * y.std() * rng.standard_normal(SAMPLES)
    return jaxgray.Record(u, y, TIME, hold="linear", measured="acceleration")


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "law"), [("input_delay", delayed), ("actuator_lag", lagged)])
def test_a_late_force_is_found_from_accelerations(effect, law):
    rng = generator("accelerations", effect)
    diagnosis = jaxgray.diagnose(
        record(rng, law), validation=record(rng, law), only=["input_delay", "actuator_lag", "cubic_stiffness"]
    )
    (found,) = model_findings(diagnosis)
    assert found.effect == effect and found.status == "named", str(diagnosis)
    tau = found.parameters["tau"]
    assert abs(tau.value - TAU) < 4 * tau.standard_error < 0.05 * TAU, str(diagnosis)
    for shift, true in zip(diagnosis.shifts, (MASS, DAMPING, STIFFNESS)):
        assert abs(shift.after - true) < 4 * shift.standard_error < 0.05 * true, str(diagnosis)
