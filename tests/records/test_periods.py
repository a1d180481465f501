"""Finding a period and averaging over periods."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgray.records import Record, multisine, prbs, random_steps, white


@given(st.integers(10, 300), st.integers(2, 9), st.integers(1, 3), st.floats(0.0, 1.0), st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_the_exact_period_is_found(period, periods, channels, rest, seed):
    one = np.random.default_rng(seed).standard_normal((period, channels))
    samples = period * periods + int(rest * period)
    u = np.resize(one, (samples, channels))
    assert Record(u, np.zeros(samples), 0.01).detect_period() == period


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("kind", ["random_phase", "schroeder"])
def test_a_noisy_multisine_has_its_period(noise, kind):
    u = multisine(5000, 2, 0.001, period_samples=500, band_hz=(2.0, 60.0), kind=kind).signal
    u = u + noise * np.random.default_rng(0).standard_normal(u.shape)
    assert Record(u, u[:, 0], 0.001).detect_period() == 500


def slow_binary(samples=4000):
    return np.resize(prbs(15 * 8, clock_period=8.0, order=4), (samples, 1))


def test_a_slow_binary_sequence_and_a_step_in_one_of_two_inputs():
    assert Record(slow_binary(), np.zeros(4000), 1.0).detect_period() == 120
    constant = np.ones((4000, 1))
    assert Record(np.hstack([slow_binary(), constant]), np.zeros(4000), 1.0).detect_period() == 120


t = np.arange(3000.0)
APERIODIC = {
    "white": white(3000),
    "steps": random_steps(3000, sampling_time=0.01),
    "two incommensurate sines": np.sin(0.05 * t) + np.sin(0.05 * np.sqrt(2.0) * t),
    "a sine whose period is no whole number": np.sin(2 * np.pi * t / 97.3717),
    "constant": np.ones(3000),
    "one step": (t > 1000) * 1.0,
    "one pulse": ((t > 2000) & (t < 2100)) * 1.0,
    "ramp": t,
    "one period and a half": np.resize(white(2000), 3000),
    "swept sine": np.sin(1e-5 * t**2),
}


@pytest.mark.parametrize("name", APERIODIC)
def test_no_period_where_nothing_repeats(name):
    assert Record(APERIODIC[name], np.zeros(3000), 0.01).detect_period() is None


def test_the_average_leaves_the_noise_behind_and_measures_it():
    rng = np.random.default_rng(3)
    period, periods = 250, 40
    one = rng.standard_normal((period, 1))
    y = np.tile(np.hstack([np.cumsum(one, 0), one]), (periods + 2, 1))
    y[:period] += 50.0  # A transient in the period that is skipped.
    noise = np.array([0.5, 2.0])
    measured = y + noise * rng.standard_normal(y.shape)
    measured[3 * period + 7, 0] = np.nan
    u = np.tile(one, (periods + 2, 1))
    record = Record(u, measured, 0.01, start_time=1.0, scheduling=u[:, 0])[: -period + 100]

    result = record.average_periods(skip=1)
    assert result.periods == periods and result.record.samples == period
    np.testing.assert_allclose(result.record.u, one, atol=1e-12)
    np.testing.assert_allclose(result.record.scheduling, one[:, 0], atol=1e-12)
    assert result.record.start_time == pytest.approx(1.0 + period * 0.01)
    error = np.sqrt(np.mean((result.record.y - y[period : 2 * period]) ** 2, axis=0))
    np.testing.assert_allclose(error, noise / np.sqrt(periods), rtol=0.15)
    np.testing.assert_allclose(result.noise_variance.mean(axis=0), noise**2, rtol=0.05)
    assert not result.record.has_missing


def test_a_sample_missing_in_every_period_stays_missing():
    y = np.tile([1.0, np.nan, 2.0, 3.0], 5)
    result = Record(np.tile([0.0, 1.0, 0.0, -1.0], 5), y, 1.0).average_periods(4)
    np.testing.assert_array_equal(result.record.missing[:, 0], [False, True, False, False])
    np.testing.assert_array_equal(np.isnan(result.noise_variance[:, 0]), [False, True, False, False])
