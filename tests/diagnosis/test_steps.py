"""Steps of added forces: extrapolated where the error goes with their square, as short as the noise asks for."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
from independent import random_steps

import jaxgray
from jaxgray.diagnosis.estimation.continuation import MOST_STEPS, in_short_steps, integration_error
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.free_run import free_run
from jaxgray.diagnosis.model.simulator import Simulator, Steps
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term

M, D, K, H, SAMPLES = 1.0, 0.6, 40.0, 0.05, 400
LAWS = {
    "cubic_stiffness": ((25.0,), lambda q, v: -25.0 * q**3),
    "coulomb_friction": ((0.8, 0.02), lambda q, v: -0.8 * np.tanh(v / 0.02)),
}


def truth(force, u):
    """Displacements under held forces, by an integrator of eighth order."""
    x, q = np.zeros(2), []
    for w in u[:, 0]:
        q.append(x[0])
        rate = lambda t, x, w=w: (x[1], (w - D * x[1] - K * x[0] + force(*x)) / M)  # noqa: E731
        x = scipy.integrate.solve_ivp(rate, (0.0, H), x, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return np.array(q)[:, None]


def posed(law, noise):
    """Context and refit of a spring-mass system with a law at its true values, its record, and the true motion."""
    values, force = LAWS[law]
    rng = np.random.default_rng(4)
    u = 40.0 * random_steps(rng, SAMPLES, 1, H)
    q = truth(force, u)
    record = jaxgray.Record(u, q + noise * np.std(q) * rng.standard_normal(q.shape), H)
    names = {"input_names": record.input_names, "output_names": record.output_names}
    model = jaxgray.MechanicalModel(np.array([[M]]), np.array([[D]]), np.array([[K]]), **names)
    baseline = baseline_of([record], None, model)
    simulator, data = Simulator(baseline.setup, (by_id(law),)), Data.of(record)
    start = dataclasses.replace(baseline.start, x0=(np.zeros(2),))
    candidate = start.with_terms((Term(by_id(law), Place("y1", 0), np.array(values)),))
    return simulator, candidate, data, q


def off(simulator, candidate, data, q, steps):
    """Error of the free run in some steps, relative to the motion."""
    return np.std(simulator.in_steps(steps).run(candidate, data)[:SAMPLES] - q) / np.std(q)


def test_what_goes_with_the_square_of_the_steps_is_extrapolated_away():
    posed_case = posed("cubic_stiffness", 0.0)
    plain = [off(*posed_case, Steps(count)) for count in (8, 16)]
    extrapolated = [off(*posed_case, Steps(count, extrapolated=True)) for count in (8, 16)]
    assert 3.0 < plain[0] / plain[1] < 5.0
    assert extrapolated[0] < plain[1] / 3 and extrapolated[0] / extrapolated[1] > 6.0


@pytest.mark.parametrize("law", LAWS)
def test_a_held_out_run_ends_in_its_own_steps_wherever_they_begin(law, monkeypatch):
    simulator, candidate, data, q = posed(law, 1e-3)
    fine = simulator.in_steps(Steps(16))
    found = free_run(fine, candidate, data)
    assert fine.in_first_steps(fine.plant(candidate), data).steps == Steps(1)
    monkeypatch.setattr(Simulator, "in_first_steps", lambda self, *given: self)
    straight = free_run(fine, candidate, data)
    assert np.allclose(found.simulated, straight.simulated, rtol=0, atol=1e-4 * np.std(q))


def test_where_longer_steps_run_away_a_held_out_run_begins_in_its_own(monkeypatch):
    simulator, candidate, data, q = posed("cubic_stiffness", 1e-3)
    fine, run = simulator.in_steps(Steps(16)), Simulator.run

    def overflows(self, *given):
        return run(self, *given) * (np.inf if self.steps == Steps(1) and given[0].terms else 1.0)

    monkeypatch.setattr(Simulator, "run", overflows)
    found = free_run(fine, candidate, data)
    assert np.std((found.simulated[:SAMPLES] - q)[found.kept[:SAMPLES]]) < 0.01 * np.std(q)


def test_slopes_are_those_of_the_extrapolated_run():
    simulator, candidate, data, _ = posed("cubic_stiffness", 0.0)
    simulator = simulator.in_steps(Steps(4, extrapolated=True))
    y, J = simulator.run_and_jacobian(candidate, data)
    assert np.allclose(y, simulator.run(candidate, data), rtol=0, atol=1e-12 * np.std(y))

    def run(k3):
        (term,) = candidate.terms
        return simulator.run(candidate.with_terms((Term(term.effect, term.place, np.array([k3])),)), data)

    expected = (run(25.01) - run(24.99)) / 0.02
    assert np.allclose(J[..., -1], expected, rtol=0, atol=1e-5 * np.max(np.abs(expected)))


@pytest.mark.parametrize("law, extrapolated", [("cubic_stiffness", True), ("coulomb_friction", False)])
def test_a_refit_takes_steps_as_short_as_the_noise_asks_for(monkeypatch, law, extrapolated):
    noise, one = 1e-3, 1 / np.sqrt(SAMPLES)
    simulator, candidate, data, q = posed(law, noise)
    monkeypatch.setattr("jaxgray.diagnosis.estimation.continuation.at_the_same_steps", lambda context, fit: fit)
    e = np.where(data.kept, data.y - simulator.in_steps(Steps(MOST_STEPS)).run(candidate, data), 0.0)
    context = SimpleNamespace(simulator=simulator, data=[data])
    fit = SimpleNamespace(candidate=candidate, residual=(e,))
    assert in_short_steps(context, fit)[1] > one
    taken = context.simulator.steps
    assert taken.extrapolated is extrapolated and taken.count == 16
    assert integration_error(context, fit) < one
    if extrapolated:
        # As many steps in all, not extrapolated, are too long.
        assert off(simulator, candidate, data, q, taken) < one * noise
        assert off(simulator, candidate, data, q, Steps(MOST_STEPS)) > noise * one / 2
