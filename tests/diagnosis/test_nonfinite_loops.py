"""Loops of the diagnosis beside the refit refuse trials that overflow, without a warning, and go on."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from independent import smooth_noise

from jaxgray import Record
from jaxgray.diagnosis.conclusions.next_experiment import separation
from jaxgray.diagnosis.equation_error import regression, windows
from jaxgray.diagnosis.equation_error.band import band_of
from jaxgray.diagnosis.equation_error.regression import Equation
from jaxgray.diagnosis.equation_error.rows import series_of
from jaxgray.diagnosis.equation_error.windows import Windows
from jaxgray.diagnosis.estimation.gauss_newton import Refit, with_states
from jaxgray.diagnosis.model.candidate import Candidate, Data
from jaxgray.diagnosis.model.free_run import free_run
from jaxgray.diagnosis.noise import whitening
from jaxgray.diagnosis.noise.whitening import estimate_noise_model
from jaxgray.diagnosis.static_gain import regression as static_regression
from jaxgray.diagnosis.static_gain.regression import Static
from jaxgray.identification.setup.padding import padded_samples
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Term, places_of
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.systems.statespace import StateSpace
from jaxgray.numerics.programs.runtime import ready

VALUES = [np.inf, -np.inf, np.nan, 1e308]
H = 0.01


def term(id, place, *values):
    effect = by_id(id)
    (where,) = [p for p in places_of(effect, ("u1",), ("y1",)) if p.name == place]
    return Term(effect, where, np.array(values, dtype=float))


def spoiled(x, value):
    x = np.array(x, dtype=float)
    x[len(x) // 2 :] = value
    return x


class Counter:
    """Spoils some of the calls of a function: what is finite in its second half becomes a value."""

    def __init__(self, function, spoiled_calls, value):
        self.function, self.calls, self.value, self.count, self.hits = function, spoiled_calls, value, 0, 0

    def __call__(self, *arguments, **options):
        found = self.function(*arguments, **options)
        self.count += 1
        if self.count not in self.calls:
            return found
        self.hits += 1
        return spoiled(found, self.value)


@pytest.fixture(scope="module")
def body():
    """A record of one mass with friction on a rail, and one whose output follows its input through a threshold."""
    ready()
    rng = np.random.default_rng(2)
    u = 3.0 * smooth_noise(rng, 800, 1, bandwidth=0.05)
    x, rows = np.zeros(2), []
    for force in u[:, 0]:
        rows.append(x[0])
        for _ in range(20):
            x = x + H / 20 * np.array([x[1], force - 0.4 * x[1] - 0.8 * np.tanh(x[1] / 0.05)])
    y = np.array(rows)[:, None] + 1e-5 * rng.standard_normal((800, 1))
    return Record(u, y, H, hold="zero")


@pytest.mark.parametrize("value", VALUES)
def test_the_force_equation_refuses_laws_that_overflow(body, monkeypatch, value):
    def fitted(calls):
        counter = Counter(regression.contribution, (), value)

        def contribution(*arguments, slopes=False):
            found = counter.function(*arguments, slopes=slopes)
            if slopes:
                return found
            counter.count += 1
            if counter.count not in calls:
                return found
            counter.hits += 1
            return spoiled(found, value)

        with monkeypatch.context() as patch:
            patch.setattr(regression, "contribution", contribution)
            equation = Equation([series_of(body, band_of([body]))], np.eye(1))
            return equation.fit((term("coulomb_friction", "y1", 0.4, 0.1),), equation.plain(), whole=True), counter

    clean, _ = fitted(())
    found, counter = fitted((2, 4))
    assert counter.hits == 2
    np.testing.assert_allclose(found.terms[0].values, clean.terms[0].values, rtol=1e-3)
    np.testing.assert_allclose(found.matrices[0], clean.matrices[0], rtol=1e-3)


@pytest.mark.parametrize("value", VALUES)
def test_windows_refuse_runs_that_overflow(body, monkeypatch, value):
    model = MechanicalModel([[1.0]], [[0.4]], [[0.0]], effects=(term("coulomb_friction", "y1", 0.8, 0.05),))
    series = [series_of(body, band_of([body]), at_rest=True)]

    def run(calls):
        counter = Counter(windows._windows, calls, value)
        with monkeypatch.context() as patch:
            patch.setattr(windows, "_windows", counter)
            (found,) = Windows([body], series, 100, [np.zeros(body.samples, bool)]).run(model)
        return found, counter

    clean, _ = run(())
    found, counter = run((1, 3))
    assert counter.hits == 2 and np.all(np.isfinite(found.simulated))
    assert found.rmse[0] < 1.05 * clean.rmse[0]
    never, _ = run(range(100))
    assert not np.any(np.isfinite(never.simulated[-100:]))


@pytest.mark.parametrize("value", VALUES)
def test_a_static_gain_refuses_laws_that_overflow(monkeypatch, value):
    ready()
    rng = np.random.default_rng(0)
    u = smooth_noise(rng, 600, 1, bandwidth=0.02)
    dead = u - np.clip(u, -0.4, 0.4)
    record = Record(u, 2.0 * dead + 0.3 + 1e-3 * rng.standard_normal(u.shape), H, hold="linear")
    start = (term("input_dead_zone", "u1", 0.25),)
    clean = Static([record]).fit(start)
    assert abs(clean.terms[0].values[0] - 0.4) < 0.01
    plain, count = static_regression._applied, []

    def applied(*arguments):
        count.append(0)
        found = plain(*arguments)
        return tuple(map(lambda x: spoiled(x, value), found)) if len(count) in (2, 4) else found

    monkeypatch.setattr(static_regression, "_applied", applied)
    found = Static([record]).fit(start)
    assert len(count) > 4
    np.testing.assert_allclose(found.terms[0].values, clean.terms[0].values, rtol=1e-4)


class Fake:
    """A simulator of one line in the first state, some of whose runs overflow."""

    class Setup:
        dofs = 1

    setup = Setup()

    def __init__(self, rows, calls, value):
        self.rows, self.calls, self.value, self.count, self.hits = rows, calls, value, 0, 0

    @property
    def coarse(self):
        return self

    def _y(self, candidate, k):
        x = candidate.x0[k]
        y = self.rows @ (x + 0.2 * x**2)
        self.count += 1
        self.hits += self.count in self.calls
        return self._spoiled(y) if self.count in self.calls else y

    def _spoiled(self, x):
        """From early on, where first states are estimated."""
        x = np.array(x, dtype=float)
        x[len(x) // 100 :] = self.value
        return x

    def run(self, candidate, data, k=0):
        return self._y(candidate, k)

    def completed(self, candidate):
        return candidate

    def without_forces(self, candidate):
        return None

    def run_and_jacobian(self, candidate, data, k=0):
        x = candidate.x0[k]
        y, J = self._y(candidate, k), self.rows * (1 + 0.4 * x)
        return y, self._spoiled(J) if self.count in self.calls else J


@pytest.fixture(scope="module")
def line():
    """Rows by which a first state shows in one output, the data, and the state."""
    rng = np.random.default_rng(1)
    samples = padded_samples(1000)
    rows, truth = rng.standard_normal((samples, 1, 2)), np.array([0.7, -0.4])
    y = rows @ (truth + 0.2 * truth**2)
    return rows, Data.of(Record(np.zeros((samples, 1)), y, H)), truth


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("calls", [{1}, {3}, {4}, {4, 5}])
def test_a_held_out_run_refuses_first_states_that_overflow(line, calls, value):
    rows, data, truth = line
    simulator = Fake(rows, calls, value)
    found = free_run(simulator, Candidate(np.zeros(0), (np.zeros(2),), ()), data)
    assert simulator.hits == len(calls)
    assert np.all(np.isfinite(found.simulated))


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("calls", [{1}, {2}])
def test_first_states_after_a_refit_refuse_what_overflows(line, calls, value):
    rows, data, truth = line
    x0 = np.array([0.3, 0.0])
    y = rows @ (x0 + 0.2 * x0**2)
    e, J = np.where(data.kept, data.y - y, 0.0), rows * (1 + 0.4 * x0)
    candidate = Candidate(np.zeros(0), (x0,), ())
    fit = Refit(
        candidate, (e,), (J,), np.zeros((2, 2)), 1.0, len(e), 1, True, 1.0, np.zeros(2, bool), np.zeros(2, bool)
    )
    simulator = Fake(rows, calls, value)
    found = with_states(simulator, fit, [data], steps=3)
    assert simulator.hits == 1 and np.all(np.isfinite(found.residual[0]))
    assert np.sum(found.residual[0] ** 2) <= np.sum(e**2)
    if 1 not in calls:
        assert np.linalg.norm(found.candidate.x0[0] - truth) < np.linalg.norm(x0 - truth)


@pytest.mark.parametrize("value", VALUES)
def test_a_noise_model_leaves_out_ratios_that_overflow(monkeypatch, value):
    ready()
    rng = np.random.default_rng(4)
    A = np.array([[1.0, H], [-20 * H, 1.0 - 0.5 * H]])
    system = StateSpace(A, np.array([[0.0], [H]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    x, rows = np.zeros(2), []
    for push in rng.standard_normal(1500):
        rows.append(x[:1] + 1e-3 * rng.standard_normal(1))
        x = A @ x + system.B[:, 0] * push
    e, kept = np.array(rows), np.ones((1500, 1), bool)
    clean = estimate_noise_model(e, kept, system, np.ones(1))
    plain = whitening._over_ratios

    def spoiling(*arguments):
        gains, products = map(np.array, plain(*arguments))
        # One of a batch; what overflows does so in the filter, its gain, or both.
        gains[1], products[1] = value, value
        products[2] = value
        return gains, products

    monkeypatch.setattr(whitening, "_over_ratios", spoiling)
    found = estimate_noise_model(e, kept, system, np.ones(1))
    assert clean.ratio > 0 and found.ratio > 0 and np.all(np.isfinite(found.coefficients))
    assert found.cost < clean.cost + 50


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("calls", [{1}, {2}])
def test_an_experiment_under_which_a_law_overflows_is_none(line, calls, value):
    rows, data, truth = line
    members = [Candidate(np.zeros(0), (x0,), ()) for x0 in (truth, -truth)]
    # Samples that do not count weigh nothing, and nothing times an overflow is no number.
    data = dataclasses.replace(data, kept=np.arange(len(data.kept))[:, None] < 900)
    plain = separation(SimpleNamespace(simulator=Fake(rows, (), value)), members, data, np.ones(1))
    assert plain == 0.0
    simulator = Fake(rows, calls, value)
    assert separation(SimpleNamespace(simulator=simulator), members, data, np.ones(1)) is None
    assert simulator.hits == 1
