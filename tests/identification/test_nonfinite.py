"""Trials that overflow are refused by every loop before they are used, on any processor and without a warning."""

import independent as data
import numpy as np
import pytest

import jaxgray
from jaxgray.identification.refinement.cholesky import _step, at_start, cholesky_steps, likelihood_cost, start_cost
from jaxgray.identification.refinement.conic import conic_steps
from jaxgray.identification.refinement.normal_equations import Criterion, Iterate, Normal, Products
from jaxgray.identification.refinement.refine import begin_nuisance, refine
from jaxgray.identification.setup.prediction import Batch, Setting
from jaxgray.identification.setup.preparation import prepare, scaling_of
from jaxgray.identification.setup.structure import Structure
from jaxgray.identification.validation import free_modes as rival
from jaxgray.mechanics.systems.drives import Force

VALUES = [np.inf, -np.inf, np.nan, 1e308]


class Spoiled:
    """A criterion some of whose evaluations overflow."""

    def __init__(self, criterion, value, spoiled):
        self.criterion, self.value, self.spoiled, self.count_of = criterion, value, spoiled, 0

    def __getattr__(self, name):
        return getattr(self.criterion, name)

    def evaluate(self, blocks, nuisance):
        found = self.criterion.evaluate(blocks, nuisance)
        self.count_of += 1
        if self.count_of not in self.spoiled:
            return found
        table = np.array(found.table)
        # Of one pair of outputs alone, as where one output overflows before the other does.
        table[0, 0, -1] = table[0, 0, :, -1] = self.value
        return Products(table, found.counts)


@pytest.fixture(scope="module")
def problem():
    u, y, _ = data.reference_record(3, samples=4000)
    record = jaxgray.Record(u, y, data.REFERENCE_TIME)
    scaling = scaling_of([record])
    drive = Force(np.eye(2)).scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    setting = Setting(drive, record.measured, record.hold)
    batch = Batch.of([prepare(record, scaling)])
    truth = [np.asarray(X) for X in scaling.matrices_in(*data.REFERENCE.values())]
    return batch, setting, truth


def begun(problem, off=1.05):
    batch, setting, truth = problem
    nuisance = begin_nuisance(batch, setting, offset=True, innovations=False)
    blocks = [truth[0], truth[1], off * truth[2]]
    return Iterate(blocks, nuisance, np.eye(2)), Criterion(batch, setting, Structure())


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("spoiled", [{2}, {3, 4}, {2, 5}])
@pytest.mark.parametrize("steps", [cholesky_steps, conic_steps])
def test_steps_refuse_what_overflows(problem, steps, spoiled, value):
    start, criterion = begun(problem)
    clean = steps(start, criterion)
    end = steps(start, Spoiled(criterion, value, spoiled))
    costs = [likelihood_cost(e.products, criterion) for e in (clean, end)]
    assert all(np.all(np.isfinite(block)) for block in end.at.blocks)
    assert abs(costs[1] - costs[0]) < 0.5


@pytest.mark.parametrize("value", VALUES)
def test_an_overflow_has_no_weight_and_no_likelihood(problem, value):
    start, criterion = begun(problem)
    products = Spoiled(criterion, value, {1}).evaluate(start.blocks, start.nuisance)
    assert not products.finite
    assert products.normal(np.diag([2.0, 3.0])).cost == np.inf
    assert np.all(np.isnan(products.whitening(False))) and np.all(np.isnan(products.whitening(True)))
    assert likelihood_cost(products, criterion) == np.inf == start_cost(start, criterion, products)
    end = at_start(start, criterion, products)
    np.testing.assert_array_equal(end.at.nuisance.x0, start.nuisance.x0)


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_refinement_survives_evaluations_that_overflow(problem, monkeypatch, value):
    batch, setting, truth = problem
    start = truth[0], truth[1], 1.05 * truth[2]
    clean = refine(start, batch, setting)
    real, calls = Criterion.evaluate, []

    def evaluate(self, blocks, nuisance):
        found = real(self, blocks, nuisance)
        calls.append(0)
        return Products(found.table * value, found.counts) if len(calls) in (3, 6) else found

    monkeypatch.setattr(Criterion, "evaluate", evaluate)
    with np.errstate(invalid="ignore"):
        found = refine(start, batch, setting)
    np.testing.assert_allclose(found.stiffness, clean.stiffness, rtol=1e-4)
    assert found.cost == pytest.approx(clean.cost, abs=0.5)


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_free_poles_refuse_what_overflows(monkeypatch, value):
    u, y, _ = data.reference_record(5, samples=1000)
    whitened = rival.Whitened.of(y, u, [np.ones(1)] * 2, np.ones(2), direct=False)
    A, _ = data.state_space(*data.REFERENCE.values(), np.eye(2))
    poles = rival.poles_of(1.1 * A * data.REFERENCE_TIME)
    clean = rival.fit_rival(poles, whitened)
    real, calls = rival.at_poles, []

    def at_poles(poles, data):
        import dataclasses

        found = real(poles, data)
        calls.append(0)
        return dataclasses.replace(found, cost=value) if len(calls) in (2, 4) else found

    monkeypatch.setattr(rival, "at_poles", at_poles)
    assert rival.fit_rival(poles, whitened).cost == pytest.approx(clean.cost, rel=1e-3)


def test_factors_that_overflow_are_refused_before_they_are_simulated(problem):
    start, criterion = begun(problem)
    from jaxgray.identification.refinement.cholesky import _Factors

    factors = _Factors.of(start.blocks, criterion)
    assert factors.finite
    assert not factors.stepped(np.full(9, 1e200)).finite


@pytest.mark.parametrize("lost", [0.0, -1e-20])
def test_a_diagonal_that_rounding_has_lost_gives_no_step(lost):
    information = np.array([[lost, 1e10, 0.0], [1e10, lost, 0.0], [0.0, 0.0, 1.0]])
    _, decrement = _step(Normal(1.0, np.ones(3), information), 0.0, np.ones(3))
    assert np.isnan(decrement)
