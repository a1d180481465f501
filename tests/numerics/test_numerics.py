import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from threadpoolctl import threadpool_info, threadpool_limits

from jaxgray.numerics.matrices.bounded import column_sizes
from jaxgray.numerics.matrices.linear_algebra import (
    dominant_subspace,
    duplication,
    from_symmetric_vector,
    inverse_root,
    orthonormal_basis,
    project_positive,
    symmetric_vector,
    triangular_factor,
)
from jaxgray.numerics.matrices.matrix_exponential import matrix_exponential
from jaxgray.numerics.matrices.matrix_logarithm import matrix_logarithm
from jaxgray.numerics.matrices.positive import ClarabelSolver, PositiveLeastSquares, ProjectedGradientSolver
from jaxgray.numerics.matrices.riccati import kalman_gain
from jaxgray.numerics.outcomes import ComputationError
from jaxgray.numerics.programs.runtime import COLLECT_AFTER, undisturbed
from jaxgray.numerics.responses.filters import correlation, filtered
from jaxgray.numerics.responses.lifting import free_response, respond, scaled_free_response


@pytest.mark.parametrize("samples", [1, 31, 32, 500, 5000])
def test_blocked_response_equals_sample_by_sample(samples):
    rng = np.random.default_rng(0)
    A = scipy.linalg.expm(0.05 * np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-9, 2, -0.3, 0], [2, -20, 0, -0.5]]))
    B, C, D = rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
    u, x0 = rng.standard_normal((samples, 2)), rng.standard_normal(4)
    if samples == 1:
        expected = (C @ x0 + D @ u[0])[None]
    else:
        expected = scipy.signal.dlsim((A, B, C, D, 1.0), u, x0=x0)[1]
    np.testing.assert_allclose(respond(A, B, C, D, u, x0), expected, atol=1e-11)
    free = free_response(A, jnp.asarray(C), samples) @ x0
    zero = respond(A, B, C, D, 0 * u, x0)
    np.testing.assert_allclose(free, zero, atol=1e-11)


def test_a_first_state_that_moves_no_output_is_no_hole():
    # An accelerometer on a mass without a spring: where it begins shows nowhere.
    A, C = jnp.array([[1.0, 0.9], [0.0, 0.8]]), jnp.array([[0.0, -0.3]])
    free = np.asarray(scaled_free_response(A, C, 200))
    assert np.allclose(np.sqrt(np.mean(free**2, axis=(0, 1))), [0.0, 1.0])
    slope = jax.grad(lambda x: jnp.sum(scaled_free_response(A.at[1, 1].set(x), C, 200) ** 2))(0.8)
    assert np.isfinite(slope)


@pytest.mark.parametrize("rows", [5, 48, 200])
def test_triangular_factor_by_blocks_has_the_products_of_the_matrix(rows):
    X = np.random.default_rng(0).standard_normal((rows, 3)) * [1.0, 1e-6, 1e3]
    R = np.asarray(triangular_factor(jnp.asarray(X)))
    assert R.shape == (3, 3) and np.all(np.tril(R, -1) == 0)
    np.testing.assert_allclose(np.abs(R), np.abs(np.linalg.qr(X, mode="r")), rtol=1e-12)


def test_a_column_that_is_next_to_nothing_has_no_size():
    # The product of two such sizes is no number any more, and its inverse overflows.
    table = np.array([[3.0, 0.0, 3e-160, 3e-90], [4.0, 0.0, 4e-160, 4e-90]])
    np.testing.assert_allclose(column_sizes(table), [5.0, 1.0, 1.0, 5e-90])


@pytest.mark.parametrize("norm", [1e-6, 0.1, 3.0, 200.0])
def test_exponential_and_logarithm(norm):
    rng = np.random.default_rng(1)
    A = rng.standard_normal((4, 4))
    A = A / np.linalg.norm(A) * norm - norm * np.eye(4)
    np.testing.assert_allclose(
        matrix_exponential(A), scipy.linalg.expm(A), atol=1e-12 * np.abs(scipy.linalg.expm(A)).max()
    )
    if norm < 5:
        # Rounding of the exponential is amplified by its condition.
        np.testing.assert_allclose(matrix_logarithm(scipy.linalg.expm(A)), A, atol=1e-11 * max(norm, 1e-3))


def test_symmetric_vectors_are_isometric():
    X = np.array([[1.0, 2.0, 3.0], [2.0, 5.0, 6.0], [3.0, 6.0, 9.0]])
    x = symmetric_vector(jnp.asarray(X))
    assert np.isclose(x @ x, np.sum(X**2))
    np.testing.assert_allclose(from_symmetric_vector(x), X)
    np.testing.assert_allclose(duplication(3) @ x, X.ravel())


@pytest.mark.parametrize("householder", [False, True])
def test_basis_leaves_out_masked_columns(householder):
    rng = np.random.default_rng(2)
    X = rng.standard_normal((20, 6))
    kept = jnp.array([True, True, False, True, False, True])
    Q = np.asarray(orthonormal_basis(jnp.asarray(X), kept, householder=householder))
    np.testing.assert_allclose(Q.T @ Q, np.diag(np.asarray(kept, float)), atol=1e-14)
    inside = X[:, np.asarray(kept)]
    np.testing.assert_allclose(Q @ Q.T @ inside, inside, atol=1e-12)


@pytest.mark.parametrize("shape", [(6, 9), (9, 6)])
def test_derivative_of_dominant_subspace(shape):
    rng = np.random.default_rng(3)
    U, _ = np.linalg.qr(rng.standard_normal((shape[0], shape[0])))
    V, _ = np.linalg.qr(rng.standard_normal((shape[1], shape[1])))
    s = np.array([3.0, 3.0, 3.0, 1.0, 0.5, 0.2])
    X = U[:, :6] @ np.diag(s) @ V[:, :6].T
    dX, W = rng.standard_normal(shape), rng.standard_normal((shape[1], shape[1]))

    def value(X):
        basis = dominant_subspace(X, 3)[0]
        return jnp.sum(W * (basis @ basis.T))

    step = 1e-6
    numerical = (value(X + step * dX) - value(X - step * dX)) / (2 * step)
    forward = jax.jvp(value, (X,), (dX,))[1]
    backward = jnp.sum(jax.grad(value)(X) * dX)
    np.testing.assert_allclose([forward, backward], numerical, rtol=1e-6)


@pytest.mark.parametrize("values", [(2.0, 2.0, 2.0), (1.0, -1.0, 0.5), (1.0, 1.0, -2.0)])
def test_derivative_of_positive_projection(values):
    rng = np.random.default_rng(4)
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    X = Q @ np.diag(values) @ Q.T
    dX = rng.standard_normal((3, 3))
    dX = dX + dX.T
    numerical = (project_positive(X + 1e-6 * dX) - project_positive(X - 1e-6 * dX)) / 2e-6
    np.testing.assert_allclose(jax.jvp(project_positive, (X,), (dX,))[1], numerical, atol=1e-8)


@pytest.mark.parametrize("values", [(2.0, 2.0, 1.0), (1.0, 0.5, 0.0)])
def test_derivative_of_inverse_root(values):
    rng = np.random.default_rng(6)
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    X = Q @ np.diag(values) @ Q.T
    # Within the range of X: what is left out stays left out.
    P = Q @ np.diag(np.sign(values)) @ Q.T
    dX = P @ rng.standard_normal((3, 3)) @ P
    dX = dX + dX.T

    def root(X):
        return inverse_root(X, 1e-8)

    np.testing.assert_allclose(root(X) @ X @ root(X), P, atol=1e-12)
    numerical = (root(X + 1e-5 * dX) - root(X - 1e-5 * dX)) / 2e-5
    np.testing.assert_allclose(jax.jvp(root, (X,), (dX,))[1], numerical, atol=1e-8)


def problems(count):
    rng = np.random.default_rng(5)
    for _ in range(count):
        F = rng.standard_normal((30, 9))
        wanted = [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(2)]
        target = F @ np.concatenate([symmetric_vector(jnp.asarray(X)) for X in wanted])
        target = target + 0.1 * rng.standard_normal(30)
        yield PositiveLeastSquares.from_residual(jnp.asarray(F), jnp.asarray(target), (2, 2, 2), (1e-3, 0.0, 0.0))


def test_twins_agree():
    twin = jax.jit(lambda problem: ProjectedGradientSolver()(problem))
    for problem in problems(10):
        exact = ClarabelSolver()(problem)
        assert min(np.linalg.eigvalsh(X)[0] for X in problem.blocks(jnp.asarray(exact))) > -1e-8
        np.testing.assert_allclose(twin(problem), exact, atol=1e-6)


def test_twin_has_derivatives_with_an_active_cone():
    problem = next(problems(1))
    direction = np.random.default_rng(6).standard_normal(9)

    @jax.jit
    def value(linear):
        moved = PositiveLeastSquares(problem.quadratic, linear, problem.floors, problem.sizes)
        return jnp.sum(ProjectedGradientSolver()(moved) ** 3)

    linear = problem.linear
    numerical = (value(linear + 1e-4 * direction) - value(linear - 1e-4 * direction)) / 2e-4
    forward = jax.jit(lambda linear, change: jax.jvp(value, (linear,), (change,))[1])
    assert np.isclose(forward(linear, direction), numerical, rtol=1e-5)
    assert np.isclose(jax.jit(jax.grad(value))(linear) @ direction, numerical, rtol=1e-5)


def test_held_variables_keep_their_value():
    problem = next(problems(1))
    held = np.zeros(9, bool)
    held[4] = True
    fixed = PositiveLeastSquares(
        problem.quadratic, problem.linear, problem.floors, problem.sizes, jnp.asarray(held), jnp.full(9, 0.25)
    )
    found = ClarabelSolver()(fixed)
    assert np.isclose(found[4], 0.25, atol=1e-9)
    assert min(np.linalg.eigvalsh(X)[0] for X in problem.blocks(jnp.asarray(found))) > -1e-8


def test_solver_says_what_went_wrong():
    bad = PositiveLeastSquares(jnp.eye(3) * jnp.nan, jnp.ones(3), jnp.zeros(1), (2,))
    with pytest.raises(ComputationError, match="semidefinite fit"):
        ClarabelSolver()(bad)


def test_kalman_gain_solves_the_riccati_equation():
    rng = np.random.default_rng(7)
    A = scipy.linalg.expm(0.1 * np.array([[0.0, 1.0], [-4.0, -0.1]]))
    C, B = np.array([[1.0, 0.0], [0.3, 1.0]]), rng.standard_normal((2, 1))
    D = np.array([[0.0], [0.4]])
    Q, S, R = B @ B.T, B @ D.T, np.diag([0.5, 0.2]) + D @ D.T
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
    innovation = C @ P @ C.T + R
    gain, found = kalman_gain(A, C, Q, S, R)
    np.testing.assert_allclose(found, innovation, rtol=1e-9)
    np.testing.assert_allclose(gain, np.linalg.solve(innovation, (A @ P @ C.T + S).T).T, rtol=1e-8)


@pytest.mark.parametrize(
    "numerator, denominator", [([1.0], [1.0, -1.9, 0.95]), ([0.0, 2.0, -1.0], [2.0, -1.8]), ([1.0, -0.7, 0.2], [1.0])]
)
def test_filters_equal_those_of_scipy(numerator, denominator):
    x = np.random.default_rng(0).standard_normal((300, 2, 3))
    for axis in (0, 2):
        expected = scipy.signal.lfilter(numerator, denominator, x, axis=axis)
        np.testing.assert_allclose(filtered(numerator, denominator, x, axis=axis), expected, atol=1e-12)


@pytest.mark.parametrize("samples", [6, 257])
def test_correlation_equals_that_of_scipy(samples):
    a, b = np.random.default_rng(0).standard_normal((2, samples))
    expected = scipy.signal.correlate(a, b)[samples - 1 - 5 : samples + 5]
    np.testing.assert_allclose(correlation(a, b, 5), expected, atol=1e-12)


def test_arrays_on_the_host_stay_there_with_the_same_result():
    X = np.random.default_rng(0).standard_normal((3, 3))
    X = X + X.T
    for function in (project_positive, symmetric_vector, lambda M: from_symmetric_vector(symmetric_vector(M))):
        here, there = function(X), function(jnp.asarray(X))
        assert isinstance(here, np.ndarray) and isinstance(there, jax.Array)
        np.testing.assert_allclose(here, there, atol=1e-14)
    np.testing.assert_allclose(here, X, atol=1e-14)


def test_collector_runs_rarely_only_meanwhile():
    usual = gc.get_threshold()
    try:
        gc.set_threshold(700, 11, 12)
        with undisturbed():
            with undisturbed():
                assert gc.get_threshold() == (COLLECT_AFTER, 11, 12)
            assert gc.get_threshold() == (COLLECT_AFTER, 11, 12)
        assert gc.get_threshold() == (700, 11, 12)
    finally:
        gc.set_threshold(*usual)


def test_products_have_one_thread_only_meanwhile():
    def threads():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        with undisturbed():
            with undisturbed():
                assert threads() == {1}
            assert threads() == {1}
        assert threads() == {2}
