"""Error bars under coloured noise: those of the sandwich with the true colour, computed here."""

import independent as data
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from jaxgray import Record, identify
from jaxgray.identification.validation.colour import autoregression, score_covariance
from jaxgray.identification.validation.force_noise import force_noise

H = data.REFERENCE_TIME * 4
TRUTH = tuple(data.REFERENCE.values())
POLE = 0.9


def coloured(rng, samples, covariance):
    white = rng.standard_normal((samples + 200, len(covariance))) @ np.linalg.cholesky(covariance).T
    return scipy.signal.lfilter([1.0], [1.0, -POLE], white, axis=0)[200:]


def test_an_autoregression_of_two_outputs_is_found_and_its_scores():
    rng = np.random.default_rng(0)
    covariance = np.array([[1.0, 0.5], [0.5, 2.0]])
    e = coloured(rng, 40000, covariance)
    gaps = e.copy()
    gaps[rng.random(len(e)) < 0.02] = np.nan
    time = np.arange(700)
    rows = np.stack([np.sin(0.3 * time), np.ones(700), np.cos(0.02 * time)], axis=1)
    J = rows[:, None, :] * np.array([1.0, -0.5])[:, None]
    R = scipy.linalg.toeplitz(POLE**time) / (1 - POLE**2)
    exact = np.einsum("top,ts,oq,sqr->pr", J, R, covariance, J, optimize=True)
    size = np.sqrt(np.diag(exact))
    for residual in (e, gaps):
        coefficients, spread = autoregression([residual])
        assert np.abs(coefficients[0] - POLE * np.eye(2)).max() < 0.02
        assert np.abs(coefficients[1:]).max(initial=0.0) < 0.02
        assert np.abs(spread - covariance).max() < 0.05
        off = (score_covariance([J], [residual]) - exact) / size / size[:, None]
        assert np.abs(off).max() < 0.12, off


def test_white_and_short_residuals_have_no_colour():
    rng = np.random.default_rng(1)
    assert len(autoregression([rng.standard_normal((2000, 2))])[0]) == 0
    coefficients, covariance = autoregression([rng.standard_normal((9, 2))])
    assert len(coefficients) == 0 and covariance.shape == (2, 2)


def test_standard_errors_under_coloured_noise():
    """Noise slower than the motion: frequencies and damping suffer little, stiffness much."""
    rng = np.random.default_rng(2)
    u = data.random_steps(rng, 4000, 2, H, (0.2, 1.5))
    noise = data.REFERENCE_NOISE * coloured(rng, 4000, (1 - POLE**2) * np.eye(2))
    found = identify(Record(u, data.simulate(*TRUTH, u, H) + noise, H))
    assert any("not white" in text for text in found.misfits) and set(found.misfits) <= set(found.warnings)
    J = data.sensitivities(TRUTH, u, H)
    felt = scipy.signal.lfilter([np.sqrt(1 - POLE**2)], [1.0, -POLE], J[::-1], axis=0)
    J, felt = J.reshape(-1, 15), felt.reshape(-1, 15)
    inverse = np.linalg.inv(J.T @ J)
    exact = data.REFERENCE_NOISE * np.sqrt(np.diag(inverse @ felt.T @ felt @ inverse)[:9])
    stated = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(stated, exact, rtol=0.2)


def answered(frequency, ratio):
    """Response of one output to one force through a mode with this frequency and damping."""
    pole = np.exp(frequency * (-ratio + 1j * np.sqrt(1 - ratio**2)))
    return [0.0, pole.imag], [1.0, -2 * pole.real, abs(pole) ** 2]


@pytest.mark.parametrize("ratio", [0.005, 0.2])
def test_noise_at_the_forces_is_told_from_noise_of_the_sensors(ratio):
    """Also where the fit bends to it; white noise, fitted likewise, is told as such as often as it should be."""
    samples, chances = 300, []
    b, a = answered(0.4, ratio)

    def response(frequencies):
        return scipy.signal.freqz(b, a, np.linspace(0, np.pi, frequencies))[1][:, None, None]

    time = np.arange(samples)
    free = np.exp(-0.4 * ratio * time)[:, None] * np.stack([np.cos(0.4 * time), np.sin(0.4 * time)], axis=1)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        motion = scipy.signal.lfilter(b, a, rng.choice([-1.0, 1.0], samples))
        moved = scipy.signal.lfilter(b, a, motion)
        J = np.concatenate([free, np.stack([motion, moved, np.gradient(moved)], axis=1)], axis=1)
        Q, _ = np.linalg.qr(J)
        sensors = rng.standard_normal(samples)
        forces = scipy.signal.lfilter(b, a, rng.standard_normal(samples))
        pair = []
        for noise in (sensors, sensors + 2 * forces / forces.std()):
            e = noise - Q @ (Q.T @ noise)
            pair.append(force_noise([J[:, None, :]], [e[:, None]], response).chance)
        chances.append(pair)
    white, forced = np.array(chances).T
    assert np.sum(forced < 0.01) >= 36
    assert np.mean(white < 0.01) <= 0.05
    assert 0.3 < np.mean(white < 0.5) < 0.7
