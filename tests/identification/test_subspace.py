"""The subspace start without noise: exact for every hold, measured quantity, weight and choice of τ and i."""

import independent as data
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray import Record, identify, sweep
from jaxgray.identification.subspace.filter_bank import cascade, lambda_powers, lambda_shift, past_rows
from jaxgray.identification.subspace.input_matrix import InputFit
from jaxgray.identification.subspace.physical import from_inverse_mass, jointly
from jaxgray.identification.subspace.realization import Realization
from jaxgray.numerics.matrices.positive import ClarabelSolver, ProjectedGradientSolver

H = 0.01
MIXED = ("displacement", "velocity", "acceleration")
# All combinations are a row of benchmarks/identification_accuracy.py; every one is a program of its own.
CASES = [
    (2, "zero", "displacement", "moesp"),
    (2, "linear", MIXED[:2], "n4sid"),
    (2, "zero", "acceleration", "cva"),
    (1, "linear", "velocity", "past-inputs"),
    (3, "linear", MIXED, "moesp"),
]


def noise_free(n, hold, measured, seed=0):
    rng = np.random.default_rng(seed + n)
    M, D, K = data.random_system(rng, n)
    u = data.random_steps(rng, 3000, n, H, (0.1, 1.0)) if hold == "zero" else data.smooth_noise(rng, 3000, n)
    x0 = rng.standard_normal(2 * n) * np.repeat([0.01, 0.1], n)
    y = data.simulate(M, D, K, u, H, hold=hold, measured=measured, x0=x0) + 0.01
    return (M, D, K), Record(u, y, H, hold=hold, measured=measured)


@pytest.mark.parametrize(("n", "hold", "measured", "weight"), CASES)
def test_noise_free_record_gives_the_truth(n, hold, measured, weight):
    truth, record = noise_free(n, hold, measured)
    table = sweep(record, [0.01, 0.05, 0.3], [4, 8], weight=weight)
    for k in np.ndindex(3, 2):
        found = (table.mass[k], table.damping[k], table.stiffness[k])
        assert data.relative_errors(found, truth).max() < 1e-7, (
            table.time_constants[k[0]],
            table.block_rows[k[1]],
        )


def test_input_matrix_from_the_record_and_slow_filters():
    truth, record = noise_free(2, "zero", "displacement")
    for way in ("record", "factor"):
        found = identify(record, refine=False, time_constants=1.0, block_rows=4, input_matrix_from=way)
        assert found.start.method == "subspace"
        assert data.relative_errors((found.mass, found.damping, found.stiffness), truth).max() < 1e-7


def test_paper_map_is_the_limit_of_the_exact_one():
    errors = []
    for h in (0.01, 0.003):
        rng = np.random.default_rng(0)
        truth = data.random_system(rng, 2)
        u = data.random_steps(rng, 3000, 2, h, (0.2, 1.0))
        record = Record(u, data.simulate(*truth, u, h), h)
        # As many choices as above: most of what is compiled then serves here.
        table = sweep(record, [0.05, 0.06, 0.07], [4, 8], map="paper")
        found = (table.mass[0, 0], table.damping[0, 0], table.stiffness[0, 0])
        errors.append(data.relative_errors(found, truth).max())
    assert errors[1] < 0.5 * errors[0]
    assert errors[0] > 1e-3


def test_multiplication_by_lambda_is_bidiagonal():
    a, size = 0.8, 6
    A, b = (np.asarray(X) for X in jax.jit(cascade, static_argnums=1)(a, size))
    x = np.random.default_rng(0).standard_normal(200)
    family = np.zeros((200, size + 1))
    family[:, 0] = x
    for k in range(199):
        family[k + 1, 1:] = A @ family[k, 1:] + b * x[k]
    filtered = np.zeros_like(family)
    for k in range(199):
        filtered[k + 1] = a * filtered[k] + (1 - a) * family[k]
    shift = np.asarray(jax.jit(lambda_shift, static_argnums=1)(a, size))
    np.testing.assert_allclose(filtered[:, :size], family @ shift.T, atol=1e-13)


def test_past_rows_span_the_powers():
    powers = np.asarray(jax.jit(lambda_powers, static_argnums=1)(0.9, 12))[4:8]
    rows = np.asarray(jax.jit(past_rows, static_argnums=(1, 2, 3, 4))(0.9, 4, 4, 6, 12))
    np.testing.assert_allclose(rows @ rows.T, np.diag([1, 1, 1, 1, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(powers @ rows.T @ rows, powers, atol=1e-12)


def problem_at(M, D, K, B2, seed=0):
    """Realisation and least squares for B₂ of a system, time counted in samples of 0.05."""
    h = 0.05
    A21, A22 = -np.linalg.solve(M, K) * h**2, -np.linalg.solve(M, D) * h
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((12, 4))
    eye = jnp.eye(4)
    realization = Realization(jnp.asarray(A21), jnp.asarray(A22), eye, eye[:2], jnp.ones(()), jnp.ones(4))
    return realization, InputFit(jnp.asarray(factor), jnp.asarray(factor @ (B2 * h**2).ravel()))


@pytest.mark.parametrize("indefinite", [False, True])
def test_twins_give_the_same_model(indefinite):
    M, D, K = (X.copy() for X in data.REFERENCE.values())
    if indefinite:
        D = np.array([[1.0, 2.0], [2.0, 1.0]])
    realization, fit = problem_at(M, D, K, np.linalg.inv(M))
    exact = from_inverse_mass(realization, fit, jnp.eye(2), ClarabelSolver())
    traced = jax.jit(lambda r, f: from_inverse_mass(r, f, jnp.eye(2), ProjectedGradientSolver()))(realization, fit)
    assert data.relative_errors(traced, [np.asarray(X) for X in exact]).max() < 1e-6
    assert np.linalg.eigvalsh(np.asarray(exact[1]))[0] > -1e-9
    if not indefinite:
        joint, reach = jointly(realization, (jnp.asarray(np.linalg.inv(M) * 0.05**2), jnp.eye(2)), ClarabelSolver())
        assert reach > 1e-6
        assert data.relative_errors(joint, [np.asarray(X) for X in exact]).max() < 1e-9


def test_gradient_at_repeated_eigenvalues():
    """M = I, K = kI: the cone projections meet repeated eigenvalues, where eigenvectors have no derivative."""
    eye = np.eye(2)
    realization, fit = problem_at(eye, 0.5 * eye, 40 * eye, eye)
    weights = np.random.default_rng(1).standard_normal((3, 2, 2))
    direction = np.random.default_rng(2).standard_normal((2, 2)) * 1e-3

    def value(change):
        moved = Realization(
            realization.A21 + change,
            realization.A22 - change,
            realization.A_lambda,
            realization.C_lambda,
            realization.basis_condition,
            realization.singular_values,
        )
        M, D, K = from_inverse_mass(moved, fit, jnp.eye(2), ProjectedGradientSolver())
        return sum(jnp.sum(w * X) for w, X in zip(weights, (M * 0.05**2, D, K)))

    step = 1e-4
    both = jax.jit(jax.value_and_grad(value))
    numerical = (both(step * direction)[0] - both(-step * direction)[0]) / (2 * step)
    gradient = both(jnp.zeros((2, 2)))[1]
    assert np.all(np.isfinite(gradient))
    assert np.isclose(np.sum(gradient * direction), numerical, rtol=1e-5)


def test_inverse_mass_may_be_the_symmetric_part_of_the_input_matrix():
    B2 = np.array([[2.0, 0.3], [0.1, 1.0]])
    weights = np.diag([1.0, 2.0, 3.0, 4.0])
    fit = InputFit(weights, weights @ B2.ravel())
    zero = np.zeros((2, 2))
    realization = Realization(-B2 @ np.diag([50.0, 80.0]), -B2, zero, zero, np.ones(()), np.ones(2))
    mean, fitted = (
        np.linalg.inv(from_inverse_mass(realization, fit, np.eye(2), ClarabelSolver(), averaged=a)[0])
        for a in (True, False)
    )
    np.testing.assert_allclose(mean, (B2 + B2.T) / 2, rtol=1e-6)
    # Of the two off-diagonal entries, which the fit knows with weights 2 and 3.
    np.testing.assert_allclose(fitted[0, 1], (4 * 0.3 + 9 * 0.1) / 13, rtol=1e-6)
