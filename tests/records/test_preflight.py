"""Findings on raw records: silent on clean ones, awake on real defects."""

import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import cont2discrete, lfilter

from jaxgray.records import (
    Record,
    RecordFinding,
    chirp,
    multisine,
    prbs,
    preflight,
    random_steps,
    read_record,
    white,
)
from jaxgray.records.defects import clipped, fast_noise, grid_step, spikes, stuck

STEP = 0.01
MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def impulses(n, rng):
    u = np.zeros((n, 1))
    u[rng.integers(0, n, 5)] = 1.0 / STEP
    return u


def several_sines(n, period, rng):
    return multisine(n, 1, STEP, band_hz=(0.2, 10.0), period_samples=period, rng=rng).signal


INPUTS = {
    "steps": lambda n, rng: random_steps(n, 1, STEP, hold_times=(0.2, 2.0), rng=rng),
    "prbs": lambda n, rng: prbs(n, 1, STEP, clock_period=STEP * int(rng.integers(1, 10))),
    "multisine": lambda n, rng: several_sines(n, n // int(rng.integers(1, 5)), rng),
    "chirp": lambda n, rng: chirp(n, 1, STEP, band_hz=(0.3, 10.0)),
    "white": lambda n, rng: white(n, 1, STEP, rng=rng),
    "impulses": impulses,
    "one step": lambda n, rng: 1.0 * (np.arange(n) > n // 5)[:, None],
    "sine": lambda n, rng: np.sin(2 * np.pi * np.arange(n) / int(rng.integers(5, 300)))[:, None],
}


def response(u, rng):
    """One or two modes, seen as displacement, velocity or acceleration, by zero-order hold and filters."""
    measured = rng.integers(3)
    y = np.zeros(len(u))
    for frequency in rng.uniform(1.0, 6.0, rng.integers(1, 3)):
        w, zeta = 2 * np.pi * frequency, rng.uniform(0.01, 0.9 if rng.random() < 0.3 else 0.2)
        A, B = np.array([[0.0, 1.0], [-w * w, -2 * zeta * w]]), np.array([[0.0], [1.0]])
        C = [[[1.0, 0.0]], [[0.0, 1.0]], [A[1].tolist()]][measured]
        D = [[1.0 if measured == 2 else 0.0]]
        Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, np.array(C), np.array(D)), STEP)
        poles = np.poly(Ad)
        zeros = np.poly(Ad - Bd @ Cd) - poles + Dd[0, 0] * poles
        y += lfilter(zeros, poles, u[:, 0])
    return y


@cache
def clean(seed):
    """Noise, coloured noise, or the response of a random system to one of the inputs, more or less noisy."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(800, 4000))
    kind = rng.random()
    if kind < 0.15:
        return white(n, rng=rng), rng.standard_normal(n)
    if kind < 0.25:
        y = lfilter([1.0], [1.0, -rng.uniform(0.5, 0.999)], rng.standard_normal(n))
        return white(n, rng=rng), y
    u = list(INPUTS.values())[seed % len(INPUTS)](n, rng)
    y = response(u, rng)
    y += rng.choice([0.0, 1e-5, 1e-3, 0.02, 0.1]) * y.std() * rng.standard_normal(n)
    return u, y


def test_clean_records_are_left_alone():
    found = {}
    for seed in range(300):
        u, y = clean(seed)
        findings = preflight(Record(u, y, STEP))
        if findings:
            found[seed] = [finding.effect for finding in findings]
    assert len(found) <= 3, found


@pytest.mark.parametrize("form", ["%.6g", "%.5g", "%.6f"])
def test_clean_records_are_left_alone_when_written_as_text(form):
    found = {}
    for seed in range(100):
        u, y = clean(seed)
        y = np.array([float(form % value) for value in y / y.std()])
        findings = preflight(Record(u, y, STEP))
        if findings:
            found[seed] = [finding.effect for finding in findings]
    assert len(found) <= 1, found


def moving(y, length):
    """Places where the signal moves visibly before and during a stretch."""
    during = np.ptp(sliding_window_view(y, length), axis=1)
    before = np.ptp(sliding_window_view(y, 8), axis=1)
    places = np.arange(20, len(y) - 2 * length)
    return places[(during[places] > 0.5 * y.std()) & (before[places - 8] > 0.1 * y.std())]


def clip_both(y, rng):
    return np.clip(y, *np.quantile(y, [0.03, 0.97]))


def clip_above(y, rng):
    return np.minimum(y, np.quantile(y, 0.96))


def quantise(y, rng):
    step = y.std() * rng.uniform(0.05, 0.3)
    return step * np.rint(y / step)


def spike(y, rng):
    y = y.copy()
    size = max(0.3 * y.std(), 0.5 * np.abs(np.diff(y)).max())
    places = rng.choice(np.arange(10, len(y) - 10), 5, replace=False)
    y[places] += size * rng.uniform(8, 15, 5) * rng.choice([-1, 1], 5)
    return y


def freeze(y, rng):
    y, places = y.copy(), moving(y, 30)
    if places.size == 0:
        return None
    k = rng.choice(places)
    y[k : k + 30] = y[k - 1]
    return y


def repeat(y, rng):
    y, fast = y.copy(), np.flatnonzero(np.abs(np.diff(y)) > 0.3 * np.sqrt(np.mean(np.diff(y) ** 2)))
    fast = fast[(fast > 10) & (fast < len(y) - 10)]
    if len(fast) < 60:
        return None
    for k in np.sort(rng.choice(fast, 40, replace=False)):
        y[k + 1] = y[k]
    return y


def lose(y, rng):
    y = y.copy()
    y[rng.integers(0, len(y), 7)] = np.nan
    return y


def kill(y, rng):
    return np.full_like(y, rng.standard_normal())


DEFECTS = {
    "sensor_clipping": [clip_both, clip_above],
    "sensor_quantization": [quantise],
    "outliers": [spike],
    "dropped_samples": [freeze, repeat, lose],
    "dead_channel": [kill],
}


@pytest.mark.parametrize("effect, defect", [(e, d) for e, many in DEFECTS.items() for d in many])
def test_defects_of_visible_size_are_found(effect, defect):
    outcome, others = Counter(), Counter()
    for seed in range(110):
        u, y = clean(seed)
        if np.ptp(y[len(y) // 2 :]) < 1e-3 * np.ptp(y):
            continue  # Settled for most of the record: there is little to clip, freeze or repeat.
        damaged = defect(y, np.random.default_rng(seed + 10_000))
        if damaged is None:
            continue
        effects = {finding.effect for finding in preflight(Record(u, damaged, STEP))}
        outcome[effect in effects] += 1
        others.update(effects - {effect})
    assert outcome[True] + outcome[False] >= 80
    assert outcome[True] >= 0.95 * (outcome[True] + outcome[False]), outcome
    assert sum(others.values()) <= 0.02 * outcome[True] + 1, others


def test_figures_of_the_findings():
    rng = np.random.default_rng(5)
    u = random_steps(3000, 2, STEP, rng=rng)
    y = np.column_stack([response(u[:, :1], rng), response(u[:, 1:], rng)])
    y = y / y.std(axis=0) + 1e-3 * rng.standard_normal(y.shape)

    limited = np.minimum(y[:, 0], 1.0)
    (finding,) = preflight(Record(u, np.column_stack([limited, y[:, 1]]), STEP))
    assert (finding.effect, finding.location) == ("sensor_clipping", "y1")
    assert finding.values["upper"] == 1.0 and "lower" not in finding.values
    assert finding.values["count"] == np.sum(limited == 1.0)

    (finding,) = preflight(Record(u, np.column_stack([y[:, 0], 0.07 * np.rint(y[:, 1] / 0.07)]), STEP))
    assert (finding.effect, finding.location) == ("sensor_quantization", "y2")
    assert finding.values["step"] == pytest.approx(0.07)

    spiked = y.copy()
    spiked[[100, 2000], 1] += [5.0, -4.0]
    spiked[1500:1502, 1] += 6.0
    (finding,) = preflight(Record(u, spiked, STEP))
    assert (finding.effect, finding.location) == ("outliers", "y2")
    assert finding.values == {"count": 4, "indices": [100, 1500, 1501, 2000]}

    lost = y.copy()
    lost[10:13] = lost[50] = np.nan
    lost[70, 1] = np.nan
    rows, channel = preflight(Record(u, lost, STEP))
    assert (rows.effect, rows.location) == ("dropped_samples", "record")
    assert rows.values == {"count": 4, "gaps": 2, "longest": 3, "first": 10}
    assert (channel.effect, channel.location, channel.values["count"]) == ("dropped_samples", "y2", 1)


def test_dead_doubled_and_short_channels_come_first():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((500, 2))
    record = Record(
        np.column_stack([rng.standard_normal(500), np.full(500, 2.0)]),
        np.column_stack([y, -2.5 * y[:, 0] + 1.0, np.full(500, np.nan)]),
        STEP,
        output_names=("a", "b", "c", "d"),
    )
    findings = preflight(record)
    assert [(f.effect, f.location) for f in findings if f.severity == "error"] == [
        ("constant_input", "u2"),
        ("dead_channel", "d"),
        ("identical_outputs", "c"),
    ]
    assert findings[2].values["factor"] == pytest.approx(-2.5) and findings[2].values["other"] == "a"
    short = preflight(Record(np.arange(30.0), rng.standard_normal(30), STEP))
    assert [(f.effect, f.location) for f in short] == [("record_too_short", "record")]
    doubled = preflight(Record(y[:, [0, 0]], y, STEP))
    assert [(f.effect, f.location) for f in doubled] == [("identical_inputs", "u2")]


def test_binary_and_stepped_inputs_are_no_defects():
    rng = np.random.default_rng(0)
    for name in ("prbs", "steps", "one step", "impulses"):
        u = INPUTS[name](2000, rng)
        assert preflight(Record(u, rng.standard_normal(2000), STEP)) == [], name


def test_an_applied_impulse_is_no_outlier():
    rng = np.random.default_rng(1)
    u, y = np.zeros(2000), 0.01 * rng.standard_normal(2000)
    u[[300, 900]] = 10.0
    y[[300, 901]] += 10.0
    assert preflight(Record(u, y, STEP)) == []
    assert [f.effect for f in preflight(Record(np.roll(u, 50), y, STEP))] == ["outliers"]


@pytest.mark.parametrize("scale", [1e-100, 1e-12, 1.0, 1e12, 1e140])
def test_findings_do_not_depend_on_the_unit(scale):
    u, y = clean(0)
    for defect in (clip_both, quantise, spike):
        damaged = defect(y, np.random.default_rng(0))
        expected = [finding.effect for finding in preflight(Record(u, damaged, STEP))]
        assert [finding.effect for finding in preflight(Record(u, damaged * scale, STEP))] == expected


@pytest.mark.parametrize("samples", [2, 3, 5, 12, 25, 60])
@pytest.mark.parametrize("kind", ["noise", "constant", "nothing", "holes", "step", "tiny"])
def test_any_record_can_be_looked_at(samples, kind):
    rng = np.random.default_rng(samples)
    y = {
        "noise": rng.standard_normal(samples),
        "constant": np.ones(samples),
        "nothing": np.full(samples, np.nan),
        "holes": np.where(np.arange(samples) % 2, np.nan, np.arange(samples)),
        "step": 1.0 * (np.arange(samples) > samples // 2),
        "tiny": 1e-300 * rng.standard_normal(samples),
    }[kind]
    findings = preflight(Record(rng.standard_normal(samples), y, 1.0))
    assert {"record_too_short"} <= {finding.effect for finding in findings}
    assert all("\n" not in finding.message for finding in findings)


@pytest.mark.parametrize(
    "name, inputs, outputs, expected",
    [
        ("emps.csv", "force", "position", []),
        ("motor_bench_estimation.csv", "current", ("motor_angle", "load_angle"), []),
        ("pendulum_energy.csv", "torque", "angle", []),
        ("pendulum_pd.csv", "torque", "angle", ["sensor_quantization"]),
        ("piezo.csv", "drive", "displacement", []),
    ],
)
def test_measured_records_of_working_sensors(name, inputs, outputs, expected):
    if not (MEASURED / name).exists():
        pytest.skip(f"{name} is not here")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        record = read_record(MEASURED / name, inputs=inputs, outputs=outputs)
    assert [finding.effect for finding in preflight(record)] == expected


def test_a_severity_that_is_none_is_refused():
    with pytest.raises(ValueError, match="severity is 'fatal'; give one of note, warning, error"):
        RecordFinding("outliers", "y1", "…", "fatal")


# The detectors one by one


@pytest.mark.parametrize("step", [1e-3, 0.00030517578125, 7.0])
@pytest.mark.parametrize("offset", [0.0, 0.37])
def test_the_step_of_a_grid_survives_offset_sparse_levels_and_rounding(step, offset):
    rng = np.random.default_rng(0)
    y = step * (np.rint(30 * rng.standard_normal(2000)) + offset)
    assert grid_step(y) == pytest.approx(step, rel=1e-6)
    assert grid_step(step * (2 * rng.integers(0, 50, 500) + 3 * rng.integers(0, 2, 500))) == pytest.approx(step)
    printed = np.array([float(f"{value:.6g}") for value in y])
    assert grid_step(printed) == pytest.approx(step, rel=1e-3)
    assert grid_step(rng.standard_normal(2000)) is None
    assert grid_step(np.sin(0.1 * np.arange(1000))) is None


def test_fast_noise_sees_the_noise_on_a_slow_signal():
    rng = np.random.default_rng(0)
    y = np.sin(0.05 * np.arange(4000)) + 0.02 * rng.standard_normal(4000)
    y[::500] += 10.0
    assert fast_noise(y) == pytest.approx(0.02, rel=0.1)
    assert fast_noise(np.arange(5.0)) == 0.0


t = np.arange(3000)


@pytest.mark.parametrize(
    "y",
    [
        np.sin(2 * np.pi * t / 50),
        np.rint(1000 * np.sin(2 * np.pi * t / 1013)),
        np.rint(50 * np.sin(2 * np.pi * t / 1013)),
        1.0 - np.exp(-t / 20.0),
        np.rint(100 * (1.0 - np.exp(-t / 100.0))),
        np.where(t % 600 < 300, 1 - np.exp(-(t % 300) / 9.0), np.exp(-(t % 300) / 9.0)),
    ],
)
def test_rest_and_rounded_peaks_are_neither_clipped_nor_stuck(y):
    assert clipped(y).size == 0 and clipped(y, upper=False).size == 0
    assert stuck(y) == []


@pytest.mark.parametrize("top", [1.0, 0.97], ids=["as far", "not as far"])
def test_a_limit_on_one_side_is_looked_for_on_the_other(top):
    # Cut off below at speed; reached above so slowly that it might be a rest.
    t = 0.01 * np.arange(1000)
    y = np.clip(1.5 * np.sin(7.0 * t) - 0.6, -1.0, 1.0)
    slow = t > 8.0
    y[slow] = np.minimum(0.95 + 0.07 * (t[slow] - 8.0), top)
    assert clipped(y, upper=False).size > 100
    np.testing.assert_array_equal(clipped(y), np.flatnonzero(y == 1.0))
    assert clipped(y).size == (np.sum(y == 1.0) if top == 1.0 else 0)


def test_clipped_and_stuck_samples_are_placed():
    y = np.sin(2 * np.pi * t / 200) + 0.3 * np.sin(2 * np.pi * t / 71)
    np.testing.assert_array_equal(clipped(np.minimum(y, 1.1)), np.flatnonzero(y >= 1.1))
    np.testing.assert_array_equal(clipped(np.maximum(y, -1.0), upper=False), np.flatnonzero(y <= -1.0))
    frozen = y.copy()
    frozen[1001:1040] = y[1000]
    assert stuck(frozen) == [(1000, 1039)]


def test_steps_and_kinks_are_no_spikes():
    rng = np.random.default_rng(0)
    steps = np.where(t % 100 < 50, 1.0, -1.0) + 1e-3 * rng.standard_normal(3000)
    assert spikes(steps).size == 0
    assert spikes(np.cumsum(steps)).size == 0
    assert spikes(np.cumsum(np.cumsum(steps))).size == 0
