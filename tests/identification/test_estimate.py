"""Record to M, D, K as one pure function: the same answer as on the host, and right derivatives everywhere."""

import independent as data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from jaxgray import Record, RowWeights, estimate, identify, sweep
from jaxgray.identification.estimate import Options, from_factor
from jaxgray.identification.setup.units import Scaling
from jaxgray.identification.subspace.realization import MAPS
from jaxgray.mechanics.systems.drives import Force

H, TAU, ROWS, SAMPLES = 0.02, 0.06, 4, 1000
EYE = np.eye(2)
LOOK = np.random.default_rng(3).standard_normal((3, 2, 2))


def regular():
    """Two coupled coordinates."""
    return noisy(data.random_system(np.random.default_rng(0), 2))


def edge():
    """One direction is fed with energy: the nearest damping matrix is singular."""
    return noisy((np.diag([1.0, 2.0]), np.diag([1.0, -0.08]), np.array([[90.0, -20.0], [-20.0, 60.0]])))


def meeting():
    """M = I, D = dI, K = kI, and one coordinate after the other sees the same force and the same noise."""
    rng = np.random.default_rng(7)
    one, noise = np.zeros((500, 1)), np.zeros((500, 1))
    one[120:240] = np.repeat(rng.choice([-1.0, 1.0], (20, 1)), 6, axis=0)
    one[120:240] -= one[120:240].mean()
    y = data.simulate([[1.0]], [[12.0]], [[60.0]], one, H)
    noise[120:380] = 0.02 * y.std() * rng.standard_normal((260, 1))
    noise[120:380] -= noise[120:380].mean()
    rest = np.zeros((500, 1))
    return tuple(np.block([[X, rest], [rest, X]]) for X in (one, y + noise))


def noisy(truth):
    rng = np.random.default_rng(1)
    u = data.random_steps(rng, SAMPLES, 2, H, (0.1, 0.6))
    y = data.simulate(*truth, u, H)
    return u, y + 0.03 * y.std(axis=0) * rng.standard_normal(y.shape)


CASES = (regular, meeting, edge)
SIZES = np.array([[1.0, 1.0, 90.0], [1.0, 12.0, 60.0], [1.0, 1.0, 90.0]])


def value(u, y, tau, samples, rows, size, steps=0):
    found = estimate(
        u, y, H, tau, block_rows=ROWS, weight=RowWeights(rows), sample_weights=samples, refinement_steps=steps
    )
    parts = (found.mass, found.damping, found.stiffness)
    return sum(jnp.sum(w * X) / s for w, X, s in zip(LOOK, parts, size)), found


def place(case):
    return (*case(), np.array(TAU), np.ones(SAMPLES), np.ones((ROWS, 2)))


def directions(at):
    """One direction for each argument, alone."""
    rng = np.random.default_rng(11)
    sizes = [0.01 * np.std(at[0]), 0.01 * np.std(at[1]), 0.3 * TAU, 0.3, 1.5]
    moves = [size * rng.standard_normal(X.shape) for size, X in zip(sizes, at)]
    return [[move if j == k else 0 * move for j, move in enumerate(moves)] for k in range(len(at))]


@pytest.fixture(scope="module")
def forward():
    """Values and derivatives along every direction, of all cases at once: jit, vmap over records and forward mode."""

    def one(at, along, size):
        f = lambda *at: value(*at, size)  # noqa: E731
        return jax.vmap(lambda d: jax.jvp(f, at, d, has_aux=True))(along)

    return jax.jit(jax.vmap(one))


def stacked(trees):
    return jax.tree.map(lambda *X: np.stack(X), *trees)


@pytest.mark.slow
def test_the_host_finds_the_same_and_derivatives_are_those_of_finite_differences(forward):
    at = stacked([place(case) for case in CASES])
    along = stacked([stacked([tuple(d) for d in directions(place(case))]) for case in CASES])
    _, slope, found = forward(at, along, SIZES)

    def moved(step):
        # Every direction from a place of its own.
        count = along[0].shape[1]
        places = tuple(np.repeat(X[:, None], count, axis=1) + step * d for X, d in zip(at, along))
        flat = tuple(X.reshape(-1, *X.shape[2:]) for X in places)
        rows = [
            forward(tuple(X[k : k + 3] for X in flat), along, np.repeat(SIZES, count, axis=0)[k : k + 3])[0][:, 0]
            for k in range(0, 3 * count, 3)
        ]
        return np.concatenate(rows).reshape(3, count)

    # Central differences, the error of second order taken out.
    coarse, fine = ((moved(s) - moved(-s)) / (2 * s) for s in (0.02, 0.01))
    numerical = (4 * fine - coarse) / 3
    np.testing.assert_allclose(np.asarray(slope), numerical, rtol=1e-5)
    values = np.asarray(found.singular_values)[CASES.index(meeting), 0]
    assert abs(values[0] - values[1]) < 1e-9 * values[0] and abs(values[2] - values[3]) < 1e-9 * values[0]
    damping = np.linalg.eigvalsh(np.asarray(found.damping)[CASES.index(edge), 0])
    assert abs(damping[0]) < 1e-9 * damping[1]
    # On the host the same.
    for k in (CASES.index(regular), CASES.index(edge)):
        table = sweep(Record(at[0][k], at[1][k], H), [TAU], [ROWS])
        host = table.mass[0, 0], table.damping[0, 0], table.stiffness[0, 0]
        traced = [np.asarray(X)[k, 0] for X in (found.mass, found.damping, found.stiffness)]
        assert data.relative_errors(traced, host).max() < 1e-6, CASES[k].__name__
    # Backwards the same, case by case.
    backward = jax.jit(jax.grad(lambda at, size: value(*at, size)[0]))
    for k in range(len(CASES)):
        gradient = backward(tuple(X[k] for X in at), SIZES[k])
        total = [sum(np.sum(g * d[k, j]) for g, d in zip(gradient, along)) for j in range(len(at))]
        np.testing.assert_allclose(total, slope[k], rtol=1e-8, err_msg=CASES[k].__name__)


def test_refinement_steps_reach_what_identify_does():
    u, y = regular()
    host = identify(Record(u, y, H))
    found = estimate(u, y, H, TAU, block_rows=ROWS, refinement_steps=3)
    errors = host.uncertainty.standard_errors()
    for name in ("mass", "damping", "stiffness"):
        assert np.all(np.abs(getattr(found, name) - getattr(host, name)) < 0.01 * errors[name]), name


def primitives(jaxpr):
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jaxprs_in_params(equation.params):
            yield from primitives(inner)


def test_factor_to_matrices_is_one_program_without_the_host():
    options = Options(("displacement",) * 2, "zero", ROWS, MAPS["exact"], "factor", True, False, 0)
    scaling = Scaling.of(jnp.ones(2), jnp.ones(2), jnp.asarray(H), options.measured)
    program = jax.make_jaxpr(
        lambda R, a: from_factor(R, a, scaling, RowWeights(jnp.ones((ROWS, 2))), Force(jnp.eye(2)), options)
    )(jnp.eye(8 * ROWS), jnp.asarray(0.8))
    outer = [e for e in program.eqns if e.primitive.name in ("jit", "pjit")]
    assert [e.params["name"] for e in outer] == ["from_factor"]
    assert set(program.jaxpr.outvars) <= set(outer[0].outvars)
    whole = jax.make_jaxpr(lambda *at: value(*at, SIZES[0], steps=1))(*place(regular))
    names = set(primitives(program.jaxpr)) | set(primitives(whole.jaxpr))
    assert "cholesky" in names and not any("callback" in name or "infeed" in name for name in names), names


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"y": np.zeros((90, 2))}, "u has 100 samples, y has 90"),
        ({"block_rows": 2}, "block_rows=2 must be"),
        ({"block_rows": 20}, "needs? more than 200"),
        ({"measured": "force"}, "measured="),
        ({"hold": "first"}, "hold='first'"),
        ({"weight": "mosp"}, "did you mean 'moesp'"),
        ({"weight": RowWeights(jnp.ones((3, 2)))}, "3, 2.*6 block rows"),
        ({"sample_weights": np.ones(3)}, "sample_weights has shape"),
        ({"input_map": np.eye(2, 1)}, "u has 2 channels, the input map 1"),
    ],
)
def test_wrong_arguments_are_named(changed, message):
    given = {"u": np.zeros((100, 2)), "y": np.zeros((100, 2)), "sampling_time": H, "time_constant": TAU}
    with pytest.raises(ValueError, match=message):
        estimate(**{**given, **changed})
