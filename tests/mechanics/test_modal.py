"""Modes, MAC and frequency-response functions against closed forms and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.systems.drives import BaseAcceleration, BaseDisplacement, Force
from jaxgray.mechanics.systems.modal import frequency_response, mac, modes, natural_frequencies_hz_and_damping

OMEGA = np.linspace(0.3, 30.0, 40)


def chain(m, k, beta):
    """Two equal masses between three equal springs: ω² = k/m and 3k/m, damping ratios βω/2."""
    K = k * np.array([[2.0, -1.0], [-1.0, 2.0]])
    return MechanicalModel(m * np.eye(2), beta * K, K)


# A building, a micro-manipulator: the units must not matter.
@pytest.mark.parametrize(("m", "k", "beta"), [(2e5, 8e7, 1e-3), (3e-6, 1.2, 1e-5)])
def test_closed_form_of_a_chain(m, k, beta):
    found = modes(chain(m, k, beta))
    omega = np.sqrt(np.array([1.0, 3.0]) * k / m)
    np.testing.assert_allclose(found.natural_frequency_hz, omega / (2 * np.pi), rtol=1e-12)
    np.testing.assert_allclose(found.damping_ratio, beta * omega / 2, rtol=1e-9)
    shapes = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2 * m)
    np.testing.assert_allclose(np.abs(found.mode_shapes), np.abs(shapes), rtol=1e-9)
    np.testing.assert_allclose(found.mode_shapes.T @ found.mode_shapes * m, np.eye(2), atol=1e-12)
    zeta = beta * omega / 2
    poles = np.repeat(-zeta * omega, 2) + 1j * np.repeat(omega * np.sqrt(1 - zeta**2), 2) * [1, -1, 1, -1]
    np.testing.assert_allclose(found.poles, poles, rtol=1e-9)


def test_undamped_shapes_are_those_of_scipy(model, matrices):
    M, _, K = matrices
    squared, V = scipy.linalg.eigh(K, M)
    found = modes(model)
    np.testing.assert_allclose(found.natural_frequency_hz, np.sqrt(squared) / (2 * np.pi), rtol=1e-12)
    np.testing.assert_allclose(np.abs(found.mode_shapes), np.abs(V), rtol=1e-10)
    np.testing.assert_allclose(np.diag(mac(V, found.mode_shapes)), 1.0, rtol=1e-12)


def test_poles_and_complex_shapes_solve_the_quadratic_problem(model, matrices):
    M, D, K = matrices
    found = modes(model)
    np.testing.assert_allclose(found.poles[::2], [-0.468 + 4.393j, -0.780 + 11.277j], atol=6e-4)
    for s, phi in zip(found.poles, found.complex_mode_shapes.T):
        np.testing.assert_allclose((s * s * M + s * D + K) @ phi, 0.0, atol=1e-10)
        assert np.max(np.abs(phi)) == pytest.approx(1.0)
    first = found.poles[::2]
    np.testing.assert_allclose(found.damping_ratio, -first.real / np.abs(first), rtol=1e-10)


def test_free_and_overdamped_modes():
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    free = modes(MechanicalModel(np.eye(2), 0.1 * spring, 50 * spring))
    assert free.natural_frequency_hz[0] == 0.0 and np.isnan(free.damping_ratio[0])
    assert free.damping_ratio[1] == pytest.approx(0.1 * 2 / (2 * 10.0))
    mixed = modes(MechanicalModel(np.eye(2), np.diag([50.0, 0.1]), np.diag([100.0, 400.0])))
    np.testing.assert_allclose(mixed.damping_ratio, [2.5, 0.0025], rtol=1e-9)
    assert "frequency [Hz]" in repr(mixed) and len(repr(mixed).splitlines()) == 5


def test_mass_must_be_positive():
    with pytest.raises(ValueError, match="positive definite"):
        modes(MechanicalModel(np.diag([1.0, 0.0]), np.eye(2), np.eye(2)))


def test_mac():
    rng = np.random.default_rng(0)
    Q, _ = np.linalg.qr(rng.standard_normal((4, 4)) + 1j * rng.standard_normal((4, 4)))
    np.testing.assert_allclose(mac(Q, Q * (2.0 - 3.0j)), np.eye(4), atol=1e-12)
    assert mac([1.0, 0.0], [1.0, 1.0])[0, 0] == pytest.approx(0.5)
    with pytest.raises(ValueError, match="shapes_a has 4 rows, shapes_b has 3"):
        mac(Q, np.eye(3))


@jax.jit
def directional(matrices, step):
    """Frequencies and damping ratios, and their derivative along a step."""
    return jax.jvp(natural_frequencies_hz_and_damping, tuple(matrices), tuple(step))


@pytest.mark.parametrize("damping", [np.diag([0.4, 0.9]), np.array([[40.0, -3.0], [-3.0, 0.5]])])
def test_derivatives_of_frequency_and_damping(matrices, damping):
    M, _, K = matrices
    rng = np.random.default_rng(1)
    step = [X + X.T for X in rng.standard_normal((3, 2, 2))]

    def at(t):
        return directional([X + t * dX for X, dX in zip((M, damping, K), step)], step)

    _, slope = at(0.0)
    for k in range(2):
        difference = (at(1e-6)[0][k] - at(-1e-6)[0][k]) / 2e-6
        np.testing.assert_allclose(slope[k], difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("kind", "order"), [("receptance", 0), ("mobility", 1), ("accelerance", 2)])
def test_response_to_forces(matrices, kind, order):
    M, D, K = matrices
    E = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])
    model = MechanicalModel(M, D, K, drive=Force(jnp.asarray(E)), measured="velocity")
    found = frequency_response(model, OMEGA, kind=kind)
    s = 1j * OMEGA[:, None, None]
    np.testing.assert_allclose(found, s**order * np.linalg.solve(s * s * M + s * D + K, E), rtol=1e-9)


# Accelerance per unit base acceleration is receptance per unit base displacement.
@pytest.mark.parametrize(
    ("drive", "relative", "measured", "kind"),
    [
        (BaseDisplacement, True, "displacement", "receptance"),
        (BaseDisplacement, False, "displacement", "receptance"),
        (BaseAcceleration, False, "acceleration", "accelerance"),
    ],
)
def test_response_to_the_base(matrices, drive, relative, measured, kind):
    M, D, K = matrices
    r = np.array([[1.0], [0.5]])
    s = 1j * OMEGA[:, None, None]
    expected = np.linalg.solve(s * s * M + s * D + K, (s * D + K) @ r) - relative * r
    model = MechanicalModel(M, D, K, drive=drive(jnp.asarray(r), relative), measured=measured)
    np.testing.assert_allclose(frequency_response(model, OMEGA, kind=kind), expected, rtol=1e-9)


def test_bad_frequency_response_arguments(model):
    with pytest.raises(ValueError, match="choose one of receptance, mobility, accelerance"):
        model.frequency_response(OMEGA, kind="compliance")
    with pytest.raises(ValueError, match="omega"):
        model.frequency_response([[1.0]])
