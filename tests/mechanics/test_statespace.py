"""Holds and logarithm against SciPy, and similarity transforms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxgray.mechanics.systems.drives import Force
from jaxgray.mechanics.systems.statespace import continuous_matrix, hold_matrices, sampled

H = 0.05

logarithm = jax.jit(continuous_matrix)


@pytest.fixture(scope="module")
def continuous(model):
    return model.state_space()


def held(A, B, h, linear):
    """A_d, B_0, B_1 by numerical integration of the flow that `expm` gives."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    nodes, weights = h * (nodes + 1) / 2, h * weights / 2
    flow = [scipy.linalg.expm(A * (h - t)) @ B for t in nodes]
    rising = nodes / h if linear else np.zeros(20)
    B0 = sum(w * (1 - r) * F for w, r, F in zip(weights, rising, flow))
    B1 = sum(w * r * F for w, r, F in zip(weights, rising, flow))
    return scipy.linalg.expm(A * h), B0, B1


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_hold_matrices_are_the_integrals(continuous, hold):
    found = jax.jit(hold_matrices, static_argnums=3)(continuous.A, continuous.B, H, hold)
    for X, Y in zip(found, held(np.asarray(continuous.A), np.asarray(continuous.B), H, hold == "linear")):
        np.testing.assert_allclose(X, Y, rtol=1e-11, atol=1e-14)


def test_unknown_hold():
    with pytest.raises(ValueError, match="choose 'zero'"):
        hold_matrices(jnp.eye(2), jnp.eye(2), H, "cubic")


@pytest.mark.parametrize("h", [0.001, 0.05, 0.2])
def test_logarithm_inverts_the_exponential(continuous, h):
    Ad = scipy.linalg.expm(np.asarray(continuous.A) * h)
    found = logarithm(Ad, h)
    np.testing.assert_allclose(found, scipy.linalg.logm(Ad).real / h, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found, continuous.A, rtol=1e-9, atol=1e-9)


def test_logarithm_derivative(continuous):
    # SciPy's Fréchet derivative of expm is the inverse of that of the logarithm.
    A = np.asarray(continuous.A) * H
    direction = np.random.default_rng(0).standard_normal(A.shape)
    Ad, moved = scipy.linalg.expm_frechet(A, direction)
    _, back = jax.jit(lambda X, dX: jax.jvp(lambda Y: continuous_matrix(Y, 1.0), (X,), (dX,)))(Ad, moved)
    np.testing.assert_allclose(back, direction, rtol=1e-8, atol=1e-8)


def test_transformed_has_the_same_transfer_function(continuous):
    T = np.random.default_rng(1).standard_normal((4, 4))
    found = continuous.transformed(jnp.asarray(T))
    for s in (0.1j, 4.0j, 20.0j, 1.0):
        G, F = (S.C @ np.linalg.solve(s * np.eye(4) - S.A, S.B) + S.D for S in (continuous, found))
        np.testing.assert_allclose(F, G, rtol=1e-9)


def test_time_unit_leaves_the_samples_alone(model):
    T = 0.05
    u = jnp.asarray(np.random.default_rng(2).standard_normal((40, 2)))

    @eqx.filter_jit
    def response(unit):
        return sampled(model.state_space(T * unit), 1 / unit, "linear").response(u)

    np.testing.assert_allclose(response(jnp.asarray(1.0)), response(jnp.asarray(20.0)), rtol=1e-9, atol=1e-13)


def test_an_input_map_may_be_lists():
    assert np.array_equal(Force([[1.0, 0.0], [0.0, -1.0]]).input_map, np.diag([1.0, -1.0]))
    for wrong in ([1.0, 2.0], [[1.0], [2.0, 3.0]], [["a"]], np.ones(2)):
        with pytest.raises(ValueError, match="give a row per coordinate"):
            Force(wrong)
