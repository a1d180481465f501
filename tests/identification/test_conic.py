"""One step inside the cone: by linear equations where they are enough, by the interior point where not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.identification.refinement.conic import step_inside, undetermined
from jaxgray.numerics.matrices import positive
from jaxgray.numerics.matrices.positive import (
    ClarabelSolver,
    PositiveLeastSquares,
    ProjectedGradientSolver,
    inside_cone,
)
from jaxgray.numerics.outcomes import ComputationError

SIZES = (2, 1, 1, 1)
FLOORS = np.array([0.01, 0.0, 0.1, 0.0])
HERE = np.array([2.0, 0.1, 2.0, 0.3, 0.2, 0.1])


class NoSolver:
    def __call__(self, problem):
        raise AssertionError("the interior point was asked")


def test_numbers_that_stop_at_their_floors_take_no_interior_point():
    rng = np.random.default_rng(1)
    asked = stopped = 0
    for k in range(200):
        rows = rng.standard_normal((len(HERE), 30))
        Q, slope = rows @ rows.T, 20 * rng.standard_normal(len(HERE))
        held = np.zeros(len(HERE), bool)
        held[k % len(HERE)] = k % 2
        values = HERE if held.any() else None
        problem = PositiveLeastSquares(Q, slope - Q @ HERE, FLOORS, SIZES, held if held.any() else None, values)
        right = np.asarray(ClarabelSolver()(problem)) - HERE
        try:
            step = step_inside(NoSolver(), Q, slope, HERE, FLOORS, SIZES, held)
        except AssertionError:
            asked += 1
            continue
        stopped += np.any((HERE + step)[3:] == FLOORS[1:])
        np.testing.assert_allclose(step, right, atol=1e-9)
        assert not np.any(step[held])
    assert stopped > 40 and asked > 10


def test_a_curvature_that_is_all_rounding_gives_no_step():
    # What other parameters take away of an overflowing sensitivity leaves differences of large numbers.
    Q = -1e9 * np.eye(len(HERE)) + 1e8
    assert step_inside(NoSolver(), Q, np.ones(len(HERE)), HERE, FLOORS, SIZES, None) is None
    # One such entry among sound ones is the interior point's.
    Q = np.diag([-1e-9, 1.0, 1.0, 1.0, 1.0, 1.0])
    step = step_inside(ClarabelSolver(), Q, np.ones(len(HERE)), HERE, FLOORS, SIZES, None)
    assert step is None or np.all(np.isfinite(step))


def test_what_a_null_direction_moves_is_undetermined():
    rows = np.random.default_rng(4).standard_normal((5, 40))
    rows[1] = 3 * rows[0]
    rows[4] = 0.0
    assert list(undetermined(rows @ rows.T)) == [True, True, False, False, True]


@pytest.fixture(scope="module")
def traced():
    """The traceable solver, compiled once."""
    return jax.jit(lambda problem: ProjectedGradientSolver()(problem))


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e308])
@pytest.mark.parametrize("where", ["slope", "across", "diagonal"])
def test_a_problem_that_overflows_has_no_solution_and_no_step(traced, where, value):
    rows = np.random.default_rng(2).standard_normal((len(HERE), 30))
    Q, slope = rows @ rows.T, np.ones(len(HERE))
    if where == "slope":
        slope[3] = value
    elif where == "across":
        Q[1, 4] = Q[4, 1] = value
    else:
        Q[2, 2] = value
    problem = PositiveLeastSquares(Q, slope, FLOORS, SIZES)
    with pytest.raises(ComputationError, match="not finite"):
        ClarabelSolver()(problem)
    assert step_inside(ClarabelSolver(), Q, slope, HERE, FLOORS, SIZES, None) is None
    # In traced code nothing can be raised: it ends, and says that there is no answer.
    found = np.asarray(traced(jax.tree_util.tree_map(jnp.asarray, problem)))
    assert np.isfinite(value) or np.all(np.isnan(found))


def test_what_newton_steps_leave_outside_of_the_cone_is_brought_back(monkeypatch):
    # The minimiser without the cone has the eigenvalue -1.
    target = np.array([1.0, 0.0, -1.0])
    problem = PositiveLeastSquares(np.eye(3), -target, np.zeros(1), (2,), None, np.array([1.0, 0.0, 1.0]))
    monkeypatch.setattr(positive, "_polished", lambda problem, z: (z - np.array([0.0, 0.0, 1e-6]), 0.0))
    end = ClarabelSolver()(problem)
    assert inside_cone(end, (2,), np.full(1, -1e-15))
    np.testing.assert_allclose(end, [1.0, 0.0, 0.0], atol=1e-5)
