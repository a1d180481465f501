"""First state and free run of models with effects, against SciPy's integrator."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Term, places_of
from jaxgray.mechanics.fitted_run import fitted_run
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.runs.simulate import initial_state, predict, simulate
from jaxgray.numerics.outcomes import ComputationError
from jaxgray.records import Record

H = 0.02
SAMPLES = 300
X0 = np.array([0.6, -0.4, 1.0, 0.5])
OFFSET = np.array([0.05, -0.02])


def term(id, place, *values):
    effect = by_id(id)
    (where,) = [p for p in places_of(effect, ("u1", "u2"), ("y1", "y2")) if p.name == place]
    return Term(effect, where, np.array(values, dtype=float))


CUBIC = term("cubic_stiffness", "y1", 200.0)
FRICTION = term("coulomb_friction", "y2", 0.3, 0.02)


@pytest.fixture(scope="module")
def record(matrices):
    """A record that starts far from rest, of the system with both effects; SciPy in steps that no edge crosses."""
    M, D, K = matrices
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], (SAMPLES // 20, 2)), 20, axis=0)
    x, rows = X0, []
    for force in u:
        rows.append(x[:2])

        def rates(_, x, force=force):
            friction = 0.3 * np.tanh(x[3] / 0.02)
            left = D @ x[2:] + K @ x[:2] + np.array([200.0 * x[0] ** 3, friction])
            return np.concatenate([x[2:], np.linalg.solve(M, force - left)])

        x = scipy.integrate.solve_ivp(rates, (0, H), x, method="LSODA", rtol=1e-9, atol=1e-11).y[:, -1]
    y = np.array(rows) + OFFSET
    y[40:45, 0] = np.nan
    return Record(u, y, H)


def test_the_first_state_is_that_of_the_whole_model(matrices, record):
    model = MechanicalModel(*matrices, effects=(CUBIC, FRICTION))
    x0, offset = initial_state(model, record.u, record.y, H, substeps=8)
    np.testing.assert_allclose(x0, X0, atol=4e-3)
    np.testing.assert_allclose(offset, OFFSET, atol=1e-3)
    # The linear part alone begins elsewhere, and its start serves the whole model badly.
    linear, _ = initial_state(MechanicalModel(*matrices), record.u, record.y, H)
    assert np.max(np.abs(linear - X0)) > 0.1

    def error(x0):
        run = simulate(model, record.u, H, x0=x0, offset=offset, substeps=8)
        return np.sqrt(np.nanmean((record.y - run) ** 2))

    assert error(x0) < 1e-3 < 0.02 * error(linear)


def test_a_fitted_run_follows_its_forces_in_fine_enough_steps(matrices, record):
    model = MechanicalModel(*matrices, effects=(CUBIC, FRICTION))
    found = fitted_run(model, record)
    assert found.substeps > 1
    left = np.sqrt(np.nanmean((record.y - found.simulated) ** 2, axis=0))
    assert np.all(left < 1e-3)
    linear = fitted_run(MechanicalModel(*matrices), record)
    assert linear.substeps == 1
    assert np.sqrt(np.nanmean((record.y - linear.simulated) ** 2)) > 0.02


@pytest.mark.parametrize(
    "effects",
    [(term("unmodelled_mode", "y1", 2.0, 0.05, 0.1),), (term("sensor_delay", "y1", 0.03),)],
    ids=["one coordinate more", "an output"],
)
def test_other_kinds_of_effects_have_a_first_state_too(matrices, effects):
    model = MechanicalModel(*matrices, effects=effects)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (10, 2)), 20, axis=0)
    y = simulate(model, u, H, x0=X0, offset=OFFSET)
    found = fitted_run(model, Record(u, y, H))
    np.testing.assert_allclose(found.simulated, y, atol=1e-6)
    np.testing.assert_allclose(found.x0, X0, atol=1e-4)


def test_the_scheduling_channel_is_asked_for_and_taken(matrices, record):
    model = MechanicalModel(*matrices, effects=(term("position_dependent_stiffness", "y1", 20.0),))
    with pytest.raises(ValueError, match="scheduling is missing, and position_dependent_stiffness"):
        simulate(model, record.u, H)
    with pytest.raises(ValueError, match="scheduling is missing"):
        fitted_run(model, record)
    p = np.sin(0.1 * np.arange(SAMPLES))
    y = simulate(model, record.u, H, x0=X0, scheduling=p)
    found, _ = initial_state(model, record.u, y, H, scheduling=p)
    np.testing.assert_allclose(found, X0, atol=1e-6)
    np.testing.assert_array_equal(model.predict(Record(record.u, y, H, scheduling=p), x0=X0), y)


def test_one_step_prediction_is_linear_only(matrices, record):
    model = MechanicalModel(*matrices, effects=(CUBIC,))
    with pytest.raises(ValueError, match="effects .cubic_stiffness at y1., and one-step prediction is linear only"):
        model.predict(record, force_noise_ratio=0.1)
    free = model.simulate(record, x0=X0)
    np.testing.assert_array_equal(model.predict(record, x0=X0), free)
    np.testing.assert_array_equal(predict(model, record.u, record.y, H, x0=X0), free)


def test_unbounded_motion_is_a_named_failure(matrices, record):
    M, D, K = matrices
    model = MechanicalModel(M, -2000 * D, K, effects=(CUBIC,))
    with pytest.raises(ComputationError, match="grows without bound"):
        initial_state(model, jnp.asarray(record.u), record.y, H)
