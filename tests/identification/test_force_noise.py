"""Noise at the forces of one mass on a spring: told under output-error, measured under innovations at any scale."""

import independent as data
import numpy as np
import pytest

from jaxgray import Record, identify

H, SAMPLES, OMEGA = 0.02, 1000, 20.0


def record_of(ratio, decibels, forced):
    """A record of this damping ratio with noise of sensor and force (`forced` times), and the noises' ratio."""
    rng = np.random.default_rng(3)
    M, D, K = np.eye(1), np.array([[2 * ratio * OMEGA]]), np.array([[OMEGA**2]])
    u = data.random_steps(rng, SAMPLES, 1, H, (0.04, 0.3))
    clean = data.simulate(M, D, K, u, H)
    sensor = 10 ** (-decibels / 20) * clean.std()
    force = forced * 10 ** (-decibels / 20) * u.std()
    y = data.simulate(M, D, K, u, H, w=force * rng.standard_normal(u.shape)) + sensor * rng.standard_normal(u.shape)
    return Record(u, y, H), force / sensor * clean.std() / u.std()


def said(found, words):
    return any(words in text for text in found.warnings)


@pytest.mark.parametrize("decibels", [20, 100])
def test_noise_at_the_force_is_told_and_measured(decibels):
    quiet, _ = record_of(0.02, decibels, 0.0)
    assert not said(identify(quiet), "answers forces")
    noisy, ratio = record_of(0.02, decibels, 1.0)
    assert said(identify(noisy), "answers forces")
    found = identify(noisy, noise="innovations")
    assert found.noise["force_to_output_noise"][0] == pytest.approx(ratio, rel=0.4)
    assert not said(found, "hardly determined")


def test_a_record_too_short_to_show_it_says_so():
    quiet, _ = record_of(0.02, 20, 0.0)
    assert not said(identify(quiet), "So short a record")
    assert said(identify(quiet[:250]), "So short a record may not show noise at the forces")


def test_noise_that_cannot_be_measured_is_said_to_be_so():
    record, _ = record_of(0.02, 20, 0.0)
    assert said(identify(record, noise="innovations"), "Noise at the forces is hardly determined")
