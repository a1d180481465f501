"""Traced loops, and those that begin an identification, refuse trials that overflow and steps that go astray."""

import independent as data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import io_callback

import jaxgray
from jaxgray.identification.batch import many
from jaxgray.identification.batch import steps as many_steps
from jaxgray.identification.batch.steps import One, refine_one
from jaxgray.identification.initialization import start
from jaxgray.identification.initialization.start import total_deviation
from jaxgray.identification.refinement import refine_traced
from jaxgray.identification.refinement.normal_equations import Criterion, Iterate, Products
from jaxgray.identification.refinement.refine import begin_nuisance, levenberg_marquardt, refine
from jaxgray.identification.refinement.structured_start import nearest_structured, relaxed
from jaxgray.identification.setup.prediction import Batch, Setting
from jaxgray.identification.setup.preparation import prepare, scaling_of
from jaxgray.identification.setup.structure import Structure, structure_of
from jaxgray.mechanics.systems.drives import Force
from jaxgray.numerics.outcomes import RESULTS

VALUES = [np.inf, -np.inf, np.nan, 1e308]


class Meddling:
    """Stands between a loop in compiled code and what it evaluates. Some evaluations overflow, or all steps are
    multiplied: set from outside, so that one compilation serves every case."""

    def __init__(self):
        self.begin()

    def begin(self, spoiled=(), value=0.0, factor=1.0):
        self.spoiled, self.value, self.factor, self.count, self.hits = spoiled, value, factor, 0, 0

    def _evaluation(self):
        self.count += 1
        hit = self.count in self.spoiled
        self.hits += hit
        return np.array(hit), np.array(self.value)

    def evaluated(self, clean):
        """What was evaluated, or the value in all its places."""
        shapes = jax.ShapeDtypeStruct((), bool), jax.ShapeDtypeStruct((), float)
        hit, value = io_callback(self._evaluation, shapes, ordered=True)
        return jax.tree_util.tree_map(lambda x: jnp.where(hit, value, x), clean)

    def stepped(self, step):
        """The step, times the factor."""
        return step * io_callback(lambda: np.array(self.factor), jax.ShapeDtypeStruct((), float), ordered=True)


@pytest.fixture(scope="module")
def problem():
    """Record and its parts, scaled, and the true M, D, K."""
    rng, h = np.random.default_rng(3), 4 * data.REFERENCE_TIME
    u = data.random_steps(rng, 1500, 2, h, (0.2, 1.5))
    y = data.simulate(*data.REFERENCE.values(), u, h)
    record = jaxgray.Record(u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape), h)
    scaling = scaling_of([record])
    drive = Force(np.eye(2)).scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    truth = [np.asarray(X) for X in scaling.matrices_in(*data.REFERENCE.values())]
    return prepare(record, scaling), Setting(drive, record.measured, record.hold), truth


def off(truth):
    return truth[0], truth[1], 1.03 * truth[2]


def distance(found, clean):
    """Largest difference of M, D, K, relative to the largest entry of each."""
    return max(np.max(np.abs(np.asarray(a) - b)) / np.max(np.abs(b)) for a, b in zip(found, clean))


def many_records(signals, setting, meddling, patch):
    """The steps for many records side by side."""
    one = One(signals.u, signals.y, signals.kept, jnp.ones(len(signals.u)))
    products, damped = many_steps.response_products, many_steps._step

    def step(point, damping):
        step, decrement = damped(point, damping)
        return meddling.stepped(step), decrement

    patch.setattr(many_steps, "response_products", lambda *a, **k: meddling.evaluated(products(*a, **k)))
    patch.setattr(many_steps, "_step", step)
    return lambda start: refine_one(start, one, setting, Structure(), gaps=False)


def over_the_cone(signals, setting, meddling, patch):
    """A fixed number of steps over the cone."""
    batch, plain = Batch.of([signals]), Criterion.products

    class Solver(refine_traced.ProjectedGradientSolver):
        def __call__(self, problem):
            return meddling.stepped(super().__call__(problem))

    def products(self, blocks, nuisance):
        found = plain(self, blocks, nuisance)
        return Products(meddling.evaluated(found.table), found.counts)

    patch.setattr(Criterion, "products", products)
    patch.setattr(refine_traced, "ProjectedGradientSolver", Solver)
    return lambda start: refine_traced.gauss_newton(start, batch, setting, 7)


def marquardt(signals, setting, meddling, patch):
    """optimistix's Levenberg-Marquardt."""
    batch, plain = Batch.of([signals]), Criterion.errors
    criterion = Criterion(batch, setting, Structure())
    quiet = begin_nuisance(batch, setting, offset=True, innovations=False)

    def errors(self, at):
        e, system = plain(self, at)
        return meddling.evaluated(e), system

    patch.setattr(Criterion, "errors", errors)
    run = levenberg_marquardt.__wrapped__
    return lambda start: run(Iterate(list(start), quiet, jnp.eye(2)), criterion)[0]


LOOPS = [many_records, over_the_cone, marquardt]


@pytest.fixture(scope="module")
def loop(request, problem):
    """A compiled loop from a start that is off, what meddles with it, and its end without that."""
    signals, setting, truth = problem
    meddling, start = Meddling(), tuple(map(jnp.asarray, off(truth)))
    with pytest.MonkeyPatch.context() as patch:
        compiled = jax.jit(request.param(signals, setting, meddling, patch))
        clean = jax.device_get(compiled(start))
    return lambda: jax.device_get(compiled(start)), meddling, clean


def matrices_of(end):
    return end.matrices if isinstance(end, many_steps.Refined) else end


@pytest.mark.parametrize("loop", LOOPS, indirect=True)
@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("spoiled", [{3}, {4, 5}])
def test_traced_loops_refuse_what_overflows(loop, spoiled, value):
    run, meddling, clean = loop
    meddling.begin(spoiled, value)
    found = run()
    assert meddling.hits == len(spoiled)
    assert distance(matrices_of(found), matrices_of(clean)) < 1e-4


@pytest.mark.parametrize("loop", [many_records], indirect=True)
def test_steps_of_a_batch_that_go_astray_are_no_answer(problem, loop):
    run, meddling, _ = loop
    meddling.begin(factor=0.0)
    start = run()
    meddling.begin(factor=-5.0)
    astray = run()
    stacked = jax.tree_util.tree_map(lambda x: np.asarray(x)[None], astray)
    assert many._outcome(stacked, 0)[0] == RESULTS.refinement_diverged
    assert np.all(astray.deviation <= start.deviation * (1 + 2e-5))


@pytest.mark.parametrize("loop", [over_the_cone], indirect=True)
def test_steps_of_an_estimate_that_go_astray_are_taken_back(problem, loop):
    signals, setting, truth = problem
    run, meddling, clean = loop
    left, best = (total_deviation(m, setting, [signals]) for m in (off(truth), clean))
    assert np.all(best < left)
    meddling.begin(factor=30.0)
    np.testing.assert_allclose(total_deviation(run(), setting, [signals]), left, rtol=1e-6)


@pytest.mark.parametrize("value", VALUES)
def test_the_nearest_structured_model_refuses_what_overflows(problem, monkeypatch, value):
    signals, setting, truth = problem
    form = structure_of(("chain", "modal-damping"))
    free = refine(off(truth), Batch.of([signals]), setting, structure=relaxed(form))
    fixed = np.zeros(sum(n * (n + 1) // 2 for n in form.sizes(2)), bool)
    clean = nearest_structured(free, form, fixed)
    real, seen = Structure.matrices, []

    def matrices(self, blocks, dofs):
        found = real(self, blocks, dofs)
        if self is not form:
            return found
        seen.append(0)
        # The first evaluation is the start, the next two for every parameter are slopes, then comes a trial.
        parameters = len(fixed)
        trial = (len(seen) - 1) % (2 * parameters + 1) == 0 and len(seen) > 1
        return tuple(np.full_like(np.asarray(X), value) for X in found) if trial and len(seen) < 30 else found

    monkeypatch.setattr(Structure, "matrices", matrices)
    found = nearest_structured(free, form, fixed)
    assert all(np.all(np.isfinite(X)) for X in found)
    assert distance(found, clean) < 1e-6


@pytest.mark.parametrize("value", VALUES)
def test_a_regression_start_refuses_runs_that_overflow(problem, monkeypatch, value):
    signals, setting, truth = problem
    h = 4 * data.REFERENCE_TIME
    taus = np.geomspace(2, 40, 6) * h
    clean = start.regression_start([signals], setting, taus, h)
    real, calls = start.model_run, []

    def model_run(*arguments):
        run, deviation = real(*arguments)
        calls.append(0)
        return (run * value, deviation * value) if len(calls) in (2, 5) else (run, deviation)

    monkeypatch.setattr(start, "model_run", model_run)
    found = start.regression_start([signals], setting, taus, h)
    assert len(calls) > 5 and np.isfinite(found.score)
    assert found.score > clean.score - 1.0
