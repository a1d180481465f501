"""Loops that estimate a first state refuse runs that overflow, without a warning."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_first_state import CUBIC, X0, H

from jaxgray.mechanics import fitted_run
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.runs import first_state
from jaxgray.mechanics.runs.first_state import refined_state
from jaxgray.numerics.outcomes import ComputationError
from jaxgray.records import Record

VALUES = [np.inf, -np.inf, np.nan, 1e308]


def bent(rows, x0):
    """Outputs that are no straight line in the first state."""
    return rows @ (x0 + 0.3 * x0**2)


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    rows, truth = rng.standard_normal((40, 2, 2)), np.array([0.8, -0.5])
    y = np.asarray(bent(rows, truth)) + np.array([0.1, -0.2])
    run = eqx.Partial(bent, jnp.asarray(rows))
    return run, [(np.zeros(2), np.zeros(2)), (np.ones(2), np.zeros(2))], y, np.ones(y.shape), truth


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("spoiled", [{1}, {3}, {4, 5}])
def test_a_first_state_is_found_past_runs_that_overflow(problem, monkeypatch, spoiled, value):
    run, starts, y, weight, truth = problem
    plain, calls = first_state._run, []

    def spoiling(*arguments):
        calls.append(0)
        simulated = np.array(plain(*arguments))
        simulated[len(simulated) // 2 :] = value if len(calls) in spoiled else simulated[len(simulated) // 2 :]
        return simulated

    monkeypatch.setattr(first_state, "_run", spoiling)
    x0, offset = refined_state(run, starts, y, weight, True)
    assert len(calls) > max(spoiled)
    np.testing.assert_allclose(x0, truth, atol=1e-6)
    np.testing.assert_allclose(offset, [0.1, -0.2], atol=1e-6)


@pytest.mark.parametrize("value", VALUES)
def test_slopes_that_overflow_end_the_steps_at_the_best_state_so_far(problem, monkeypatch, value):
    run, starts, y, weight, truth = problem
    plain, calls = first_state._run_and_slopes, []

    def spoiling(*arguments):
        calls.append(0)
        simulated, slopes = map(np.array, plain(*arguments))
        slopes[3] = value if len(calls) == 2 else slopes[3]
        return simulated, slopes

    monkeypatch.setattr(first_state, "_run_and_slopes", spoiling)
    x0, offset = refined_state(run, starts, y, weight, True)
    assert len(calls) >= 2
    left = [np.sum((y - np.asarray(run(x)) - shift) ** 2) for x, shift in ((x0, offset), starts[1])]
    assert np.all(np.isfinite(x0)) and left[0] < left[1]


@pytest.mark.parametrize("value", VALUES)
def test_no_start_that_can_be_simulated_is_a_named_failure(problem, monkeypatch, value):
    run, starts, y, weight, _ = problem
    monkeypatch.setattr(first_state, "_run", lambda *_: np.full(y.shape, value))
    with pytest.raises(ComputationError, match="grows without bound"):
        refined_state(run, starts, y, weight, True)


@pytest.mark.parametrize("value", VALUES)
def test_finer_steps_that_overflow_are_no_answer(matrices, monkeypatch, value):
    model = MechanicalModel(*matrices, effects=(CUBIC,))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (15, 2)), 20, axis=0)
    record = Record(u, np.asarray(model.simulate(Record(u, u, H), x0=X0)), H)
    plain = fitted_run.free_run

    def spoiling(*arguments, substeps, **options):
        found = plain(*arguments, substeps=substeps, **options)
        return found if int(substeps) < 2 else jnp.full_like(found, value)

    monkeypatch.setattr(fitted_run, "free_run", spoiling)
    with pytest.raises(ComputationError, match="grow without bound"):
        fitted_run.fitted_run(model, record)
