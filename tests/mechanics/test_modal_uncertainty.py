"""The delta method against Monte Carlo with NumPy alone."""

import numpy as np
import pytest

from jaxgray.mechanics.modal_uncertainty import frequency_response_band, modal_uncertainty, stacked_entries
from jaxgray.mechanics.model import MechanicalModel

DRAWS = 2000
OMEGA = np.array([0.5, 4.4, 8.0, 11.3, 25.0])


@pytest.fixture(scope="module")
def draws(matrices, covariance):
    """Mass, damping and stiffness, one matrix a draw."""
    rng = np.random.default_rng(0)
    mean = np.concatenate([[X[0, 0], X[0, 1], X[1, 1]] for X in matrices])
    entries = rng.multivariate_normal(mean, covariance, DRAWS, method="cholesky")
    return [entries[:, 3 * k + np.array([[0, 1], [1, 2]])] for k in range(3)]


@pytest.fixture(scope="module")
def found(model, covariance):
    return modal_uncertainty(model, covariance)


def test_order_of_the_entries(model, matrices):
    expected = np.concatenate([[X[0, 0], X[0, 1], X[1, 1]] for X in matrices])
    np.testing.assert_array_equal(stacked_entries(model), expected)


def test_frequencies_and_shapes(found, draws):
    M, _, K = draws
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    squared, U = np.linalg.eigh(inverse @ K @ inverse.swapaxes(1, 2))
    spread = np.std(np.sqrt(squared) / (2 * np.pi), axis=0)
    np.testing.assert_allclose(found.natural_frequency_hz, spread, rtol=0.15)
    V = inverse.swapaxes(1, 2) @ U
    V = V * np.sign(np.stack([V[:, 0, 0], V[:, 1, 1]], axis=1))[:, None, :]
    np.testing.assert_allclose(found.mode_shapes, np.std(V, axis=0), rtol=0.15)


def test_damping_ratios(found, draws):
    M, D, K = draws
    lower = -np.linalg.solve(M, np.concatenate([K, D], axis=2))
    upper = np.broadcast_to(np.eye(4)[2:], lower.shape)
    s = np.linalg.eigvals(np.concatenate([upper, lower], axis=1))
    s = np.sort(s[s.imag > 0].reshape(DRAWS, 2).imag, axis=1) * 1j + np.take_along_axis(
        s[s.imag > 0].reshape(DRAWS, 2).real, np.argsort(s[s.imag > 0].reshape(DRAWS, 2).imag, axis=1), axis=1
    )
    np.testing.assert_allclose(found.damping_ratio, np.std(-s.real / np.abs(s), axis=0), rtol=0.15)


def test_antiresonances(found, draws):
    # From input i to output o the zeros are those of the entry that is left when its row and column go.
    M, _, K = draws
    assert set(found.antiresonance_hz) == {(f"u{i}", f"y{o}") for i in (1, 2) for o in (1, 2)}
    for (source, place), error in found.antiresonance_hz.items():
        entry = (slice(None), 2 - int(place[1]), 2 - int(source[1]))
        np.testing.assert_allclose(error, np.std(np.sqrt(K[entry] / M[entry])) / (2 * np.pi), rtol=0.15)


@pytest.mark.parametrize(("kind", "order"), [("receptance", 0), ("accelerance", 2)])
def test_response_band(model, covariance, draws, kind, order):
    M, D, K = (X[:, None] for X in draws)
    s = 1j * OMEGA[:, None, None]
    H = s**order * np.linalg.inv(s * s * M + s * D + K)
    band = frequency_response_band(model, OMEGA, covariance, kind)
    np.testing.assert_allclose(band.response, model.frequency_response(OMEGA, kind=kind))
    np.testing.assert_allclose(band.magnitude, np.std(np.abs(H), axis=0), rtol=0.15)
    np.testing.assert_allclose(band.phase, np.std(np.angle(H / band.response), axis=0), rtol=0.15)


def test_repeated_and_rigid_modes_stay_finite(covariance):
    twins = modal_uncertainty(MechanicalModel(np.eye(2), 0.1 * np.eye(2), 100 * np.eye(2)), covariance)
    np.testing.assert_allclose(
        twins.natural_frequency_hz[0] * 4 * np.pi * 10,
        np.sqrt(covariance[6, 6] + 1e4 * covariance[0, 0] - 200 * covariance[0, 6]),
    )
    assert np.isfinite(twins.damping_ratio).all() and np.isfinite(twins.mode_shapes).all()
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    free = modal_uncertainty(MechanicalModel(np.eye(2), 0.1 * spring, 50 * spring), covariance)
    assert np.isnan(free.natural_frequency_hz[0]) and np.isnan(free.damping_ratio[0])
    assert np.isfinite(free.natural_frequency_hz[1]) and np.isfinite(free.mode_shapes).all()
    assert "antiresonances" in repr(free)


def test_covariance_must_fit(model):
    with pytest.raises(ValueError, match="give 9 × 9"):
        modal_uncertainty(model, np.eye(8))
    with pytest.raises(ValueError, match="not finite"):
        frequency_response_band(model, OMEGA, np.full((9, 9), np.nan))
