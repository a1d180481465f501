"""Excitation signals against what they promise."""

import numpy as np
import pytest

from jaxgray.records import chirp, multisine, prbs, random_steps, white


def test_random_steps_hold_as_long_as_told_and_differ_between_channels():
    u = random_steps(20_000, 3, 0.01, hold_times=(0.5, 3.0), amplitude=2.0, rng=4)
    assert u.shape == (20_000, 3) and set(np.unique(u)) == {-2.0, 2.0}
    for channel in u.T:
        held = 0.01 * np.diff(np.flatnonzero(np.diff(channel)))
        assert held.min() >= 0.5 - 1e-9 and held.max() <= 3.0 + 1e-9
        assert held.mean() == pytest.approx(1.75, abs=0.3)
    correlation = np.corrcoef(u.T) - np.eye(3)
    assert np.abs(correlation).max() < 0.3


@pytest.mark.parametrize("hold_times", [(0.001, 0.001), (0.004, 0.02), (50.0, 60.0)])
def test_random_steps_fill_the_record_for_any_hold_times(hold_times):
    u = random_steps(1000, 2, 0.01, hold_times=hold_times)
    assert u.shape == (1000, 2) and set(np.unique(u)) <= {-1.0, 1.0}


@pytest.mark.parametrize("order", [2, 5, 9])
def test_prbs_is_of_maximum_length(order):
    period = 2**order - 1
    u = prbs(2 * period, order=order)[:, 0]
    np.testing.assert_array_equal(u[:period], u[period:])
    # A maximum-length sequence has the autocorrelation of an impulse, but for −1.
    x = u[:period]
    correlation = [float(x @ np.roll(x, k)) for k in range(period)]
    np.testing.assert_allclose(correlation, [period] + [-1.0] * (period - 1))


def test_prbs_holds_for_a_clock_period_and_shifts_its_channels():
    u = prbs(1000, 2, 0.01, clock_period=0.04, amplitude=3.0)
    assert set(np.unique(u)) == {-3.0, 3.0}
    assert np.all(np.flatnonzero(np.diff(u[:, 0])) % 4 == 3)
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.1


@pytest.mark.parametrize("kind", ["random_phase", "schroeder"])
@pytest.mark.parametrize("odd", [True, False])
@pytest.mark.parametrize("detection", [0, 4])
def test_a_multisine_excites_its_lines_and_no_others(kind, odd, detection):
    result = multisine(
        3000,
        3,
        0.001,
        band_hz=(5.0, 80.0),
        period_samples=1000,
        kind=kind,
        odd=odd,
        detection_lines=detection,
    )
    u = result.signal
    assert u.shape == (3000, 3) and result.base_frequency_hz == pytest.approx(1.0)
    np.testing.assert_allclose(u[:1000], u[2000:], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.mean(u[:1000] ** 2, axis=0)), 1.0, rtol=1e-12)
    magnitude = np.abs(np.fft.rfft(u[:1000], axis=0))
    for channel in magnitude.T:
        np.testing.assert_array_equal(np.flatnonzero(channel > 1e-6), result.excited_lines)
    assert result.excited_lines.min() >= 5 and result.excited_lines.max() <= 80
    assert (len(result.detection_lines) > 0) == (detection > 0)
    assert not set(result.detection_lines) & set(result.excited_lines)
    if odd:
        assert np.all(result.excited_lines % 2 == 1) and np.all(result.detection_lines % 2 == 1)
    assert np.abs(np.corrcoef(u.T) - np.eye(3)).max() < 0.5


def test_schroeder_phases_lower_the_crest_factor():
    common = {"band_hz": (5.0, 80.0), "detection_lines": 0, "odd": False}
    schroeder = np.abs(multisine(1000, 1, 0.001, kind="schroeder", **common).signal).max()
    random = [np.abs(multisine(1000, 1, 0.001, rng=seed, **common).signal).max() for seed in range(20)]
    assert schroeder < 2.0 < min(random)


@pytest.mark.parametrize("logarithmic", [True, False])
@pytest.mark.parametrize("band", [(1.0, 20.0), (20.0, 1.0)])
def test_a_chirp_sweeps_from_the_first_to_the_last_frequency(logarithmic, band):
    h, n = 1e-3, 20_000
    u = chirp(n, 2, h, band_hz=band, logarithmic=logarithmic, amplitude=2.0)
    assert np.abs(u).max() == pytest.approx(2.0, rel=1e-3) and u[0, 0] == 0.0
    crossings = h * np.flatnonzero(np.diff(np.sign(u[:, 1])))
    frequency, middle = 0.5 / np.diff(crossings), (crossings[1:] + crossings[:-1]) / 2 / (n * h)
    law = band[0] * (band[1] / band[0]) ** middle if logarithmic else band[0] + (band[1] - band[0]) * middle
    np.testing.assert_allclose(frequency, law, rtol=0.06)
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.1


@pytest.mark.parametrize("samples", [4000, 4001])
@pytest.mark.parametrize("band", [None, (1.0, 5.0), (10.0, 50.0)])
def test_white_noise_has_its_deviation_and_its_band(samples, band):
    u = white(samples, 2, 0.01, band_hz=band, amplitude=3.0, rng=1)
    np.testing.assert_allclose(u.std(axis=0), 3.0, rtol=0.15)
    if band is not None:
        frequency = np.fft.rfftfreq(samples, 0.01)
        outside = (frequency < band[0]) | (frequency > band[1])
        assert np.abs(np.fft.rfft(u, axis=0)[outside]).max() < 1e-9


@pytest.mark.parametrize("make", [random_steps, white, lambda *a, rng: multisine(*a, rng=rng).signal])
def test_a_seed_and_its_generator_give_the_same_and_another_seed_another(make):
    one = make(500, 2, 0.1, rng=3)
    np.testing.assert_array_equal(one, make(500, 2, 0.1, rng=np.random.default_rng(3)))
    assert not np.array_equal(one, make(500, 2, 0.1, rng=4))


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda: white(1), "samples 1, channels 1"),
        (lambda: white(10, 0), "channels 0"),
        (lambda: white(10, 1, 0.0), "sampling_time 0.0"),
        (
            lambda: white(10, 1, 0.1, band_hz=(1.0, 6.0)),
            "half the sampling rate, 5 Hz",
        ),
        (lambda: white(10, 1, 0.1, band_hz=(0.1, 0.2)), "narrower than one line"),
        (lambda: chirp(10, 1, 0.1, band_hz=(1.0, 1.0)), "two different positive frequencies"),
        (lambda: random_steps(10, hold_times=(3.0, 1.0)), r"hold_times is \(3.0, 1.0\)"),
        (lambda: prbs(100, 1, 0.01, clock_period=0.025), "clock_period is 0.025 s; give a whole number"),
        (lambda: prbs(100, 1, 0.01, clock_period=0.001), "clock_period is 0.001 s"),
        (lambda: prbs(100, order=1), "order is 1; give 2 to 32 bits"),
        (lambda: multisine(100, period_samples=200), "period_samples is 200; give 4 to 100"),
        (lambda: multisine(100, kind="best"), "kind is 'best'"),
        (lambda: multisine(100, detection_lines=1), "detection_lines is 1"),
        (lambda: multisine(100, 1, 0.01, band_hz=(2.1, 2.9)), "holds no line of the base frequency 1 Hz"),
    ],
)
def test_what_does_not_fit_is_an_error(bad, match):
    with pytest.raises(ValueError, match=match):
        bad()
