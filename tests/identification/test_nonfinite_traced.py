"""Traced loops, and those that begin an identification, refuse trials that overflow; without a warning."""

import independent as data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import io_callback

import jaxgray
from jaxgray.identification import many_steps, start
from jaxgray.identification.many_steps import One, refine_one
from jaxgray.identification.normal import Criterion, Iterate, Products
from jaxgray.identification.prediction import Batch, Setting
from jaxgray.identification.preparation import prepare, scaling_of
from jaxgray.identification.refine import begin_nuisance, levenberg_marquardt, refine
from jaxgray.identification.refine_traced import gauss_newton
from jaxgray.identification.structure import Structure, structure_of
from jaxgray.identification.structured_start import nearest_structured, relaxed
from jaxgray.mechanics.drives import Force

VALUES = [np.inf, -np.inf, np.nan, 1e308]
DOFS = 2


class Spoiling:
    """Counts evaluations of compiled code, and says of each whether it is to overflow and to what: compiled once, the
    code serves every case."""

    def __init__(self):
        self.begin((), 0.0)

    def begin(self, spoiled, value):
        self.spoiled, self.value, self.count, self.hits = spoiled, value, 0, 0

    def __call__(self):
        self.count += 1
        hit = self.count in self.spoiled
        self.hits += hit
        return np.array(hit), np.array(self.value)

    def of(self, clean):
        """What was evaluated, or the value in all its places."""
        shapes = jax.ShapeDtypeStruct((), bool), jax.ShapeDtypeStruct((), float)
        hit, value = io_callback(self, shapes, ordered=True)
        return jax.tree_util.tree_map(lambda x: jnp.where(hit, value, x), clean)


@pytest.fixture(scope="module")
def problem():
    """Record and its parts, scaled, and the true M, D, K."""
    rng, h = np.random.default_rng(3), 4 * data.REFERENCE_TIME
    u = data.random_steps(rng, 1500, DOFS, h, (0.2, 1.5))
    matrices = [X[:DOFS, :DOFS] for X in data.REFERENCE.values()]
    y = data.simulate(*matrices, u, h)
    record = jaxgray.Record(u, y + data.REFERENCE_NOISE * rng.standard_normal(y.shape), h)
    scaling = scaling_of([record])
    drive = Force(np.eye(DOFS)).scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)
    truth = [np.asarray(X) for X in scaling.matrices_in(*matrices)]
    return prepare(record, scaling), Setting(drive, record.measured, record.hold), truth


def off(truth):
    return truth[0], truth[1], 1.03 * truth[2]


def distance(found, clean):
    """Largest difference of M, D, K, relative to the largest entry of each."""
    return max(np.max(np.abs(np.asarray(a) - b)) / np.max(np.abs(b)) for a, b in zip(found, clean))


def many_records(signals, setting, spoiling, patch):
    """The steps for many records side by side."""
    one, plain = One(signals.u, signals.y, signals.kept, jnp.ones(len(signals.u))), many_steps.response_products
    patch.setattr(many_steps, "response_products", lambda *a, **k: spoiling.of(plain(*a, **k)))
    return lambda start: refine_one(start, one, setting, Structure(), gaps=False).matrices


def over_the_cone(signals, setting, spoiling, patch):
    """A fixed number of steps over the cone."""
    batch, plain = Batch.of([signals]), Criterion.products

    def products(self, blocks, nuisance):
        found = plain(self, blocks, nuisance)
        return Products(spoiling.of(found.table), found.counts)

    patch.setattr(Criterion, "products", products)
    return lambda start: gauss_newton(start, batch, setting, 7)


def marquardt(signals, setting, spoiling, patch):
    """optimistix's Levenberg-Marquardt."""
    batch, plain = Batch.of([signals]), Criterion.errors
    criterion = Criterion(batch, setting, Structure())
    quiet = begin_nuisance(batch, setting, offset=True, innovations=False)

    def errors(self, at):
        e, system = plain(self, at)
        return spoiling.of(e), system

    patch.setattr(Criterion, "errors", errors)
    run = levenberg_marquardt.__wrapped__
    return lambda start: run(Iterate(list(start), quiet, jnp.eye(DOFS)), criterion)[0]


@pytest.fixture(scope="module", params=[many_records, over_the_cone, marquardt])
def loop(request, problem):
    """A compiled loop from a start that is off, what spoils it, and its end without that."""
    signals, setting, truth = problem
    spoiling = Spoiling()
    with pytest.MonkeyPatch.context() as patch:
        compiled = jax.jit(request.param(signals, setting, spoiling, patch))
        clean = jax.device_get(compiled(tuple(map(jnp.asarray, off(truth)))))
    return compiled, spoiling, clean


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("spoiled", [{3}, {4, 5}])
def test_traced_loops_refuse_what_overflows(problem, loop, spoiled, value):
    compiled, spoiling, clean = loop
    spoiling.begin(spoiled, value)
    found = compiled(tuple(map(jnp.asarray, off(problem[2]))))
    assert spoiling.hits == len(spoiled)
    assert distance(found, clean) < 1e-4


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
