"""Findings on raw records: silent on clean ones, awake on real defects."""

import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import independent
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline
from scipy.linalg import expm
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
from jaxgray.records.checks.answers import least_lead
from jaxgray.records.checks.defects import clipped, fast_noise, grid_step, spikes, stuck
from jaxgray.records.checks.looked import Looked
from jaxgray.records.checks.relations import mains_line

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
}


def sine(n, rng):
    return np.sin(2 * np.pi * np.arange(n) / int(rng.integers(5, 300)))[:, None]


def response(u, rng, measured):
    """One or two modes, seen as displacement (0), velocity or acceleration, by zero-order hold and filters."""
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
    """The response of a random system to one of the inputs, more or less noisy, and what is measured."""
    rng = np.random.default_rng(seed)
    n, measured = int(rng.integers(800, 4000)), int(rng.integers(3))
    u = list(INPUTS.values())[seed % len(INPUTS)](n, rng)
    y = response(u, rng, measured)
    y += rng.choice([0.0, 1e-5, 1e-3, 0.02, 0.1]) * y.std() * rng.standard_normal(n)
    return u, y, ("displacement", "velocity", "acceleration")[measured]


def noise(seed):
    """Outputs that have nothing to do with the input: white or coloured noise."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(800, 4000))
    y = lfilter([1.0], [1.0, -rng.uniform(0.5, 0.999)], rng.standard_normal(n)) if seed % 2 else rng.standard_normal(n)
    return white(n, rng=rng), y


def test_clean_records_are_left_alone():
    found = {}
    for seed in range(70):
        u, y, measured = clean(seed)
        findings = preflight(Record(u, y, STEP, measured=measured))
        if findings:
            found[seed] = [finding.effect for finding in findings]
    assert len(found) <= 1, found


def test_noise_is_an_output_without_a_relation_and_nothing_else():
    outcome = Counter(tuple(f.effect for f in preflight(Record(*noise(seed), STEP))) for seed in range(20))
    assert outcome[("dead_channel",)] >= 19, outcome


def test_a_single_sine_is_too_little():
    outcome = Counter()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = sine(4000, rng)
        y = response(u, rng, 0)
        y += 1e-2 * y.std() * rng.standard_normal(4000)
        outcome[tuple(f.effect for f in preflight(Record(u[2000:], y[2000:], STEP)))] += 1
    assert outcome[("little_excitation",)] >= 19, outcome


@pytest.mark.parametrize("form", ["%.6g", "%.5g", "%.6f"])
def test_clean_records_are_left_alone_when_written_as_text(form):
    found = {}
    for seed in range(60):
        u, y, measured = clean(seed)
        y = np.array([float(form % value) for value in y / y.std()])
        findings = preflight(Record(u, y, STEP, measured=measured), relations=False)
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
    for seed in range(100):
        u, y, measured = clean(seed) if seed % 4 else (*noise(seed), "displacement")
        if np.ptp(y[len(y) // 2 :]) < 1e-3 * np.ptp(y):
            continue  # Settled for most of the record: there is little to clip, freeze or repeat.
        damaged = defect(y, np.random.default_rng(seed + 10_000))
        if damaged is None:
            continue
        # What is wrong between channels is looked for in other tests: most of the time goes there.
        findings = preflight(Record(u, damaged, STEP, measured=measured), relations=False)
        effects = {finding.effect for finding in findings}
        outcome[effect in effects] += 1
        others.update(effects - {effect})
    assert outcome[True] + outcome[False] >= 60
    assert outcome[True] >= 0.95 * (outcome[True] + outcome[False]), outcome
    assert sum(others.values()) <= 0.02 * outcome[True] + 1, others


def test_figures_of_the_findings():
    rng = np.random.default_rng(5)
    u = random_steps(3000, 2, STEP, rng=rng)
    y = np.column_stack([response(u[:, :1], rng, 0), response(u[:, 1:], rng, 0)])
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
        y = response(u, rng, 0) + 1e-9 * rng.standard_normal(2000)
        assert preflight(Record(u, y, STEP)) == [], name


def test_an_applied_impulse_is_no_outlier():
    rng = np.random.default_rng(1)
    u, y = np.zeros(2000), 0.01 * rng.standard_normal(2000)
    u[[300, 900]] = 10.0
    y[[300, 901]] += 10.0
    assert "outliers" not in {f.effect for f in preflight(Record(u, y, STEP))}
    assert "outliers" in {f.effect for f in preflight(Record(np.roll(u, 50), y, STEP))}


@pytest.mark.parametrize("scale", [1e-100, 1e-12, 1.0, 1e12, 1e140])
def test_findings_do_not_depend_on_the_unit(scale):
    u, y, measured = clean(0)
    for defect in (clip_both, quantise, spike):
        damaged = defect(y, np.random.default_rng(0))
        expected = [finding.effect for finding in preflight(Record(u, damaged, STEP, measured=measured))]
        scaled = Record(u, damaged * scale, STEP, measured=measured)
        assert [finding.effect for finding in preflight(scaled)] == expected


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
        # Controllers close the loop of the positioning system and of both pendulums; the actuator follows one sine.
        ("emps.csv", "force", "position", ["closed_loop"]),
        ("motor_bench_estimation.csv", "current", ("motor_angle", "load_angle"), []),
        ("pendulum_energy.csv", "torque", "angle", ["closed_loop"]),
        ("pendulum_pd.csv", "torque", "angle", ["sensor_quantization", "closed_loop"]),
        ("piezo.csv", "drive", "displacement", ["little_excitation"]),
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


# How outputs follow inputs

CHAIN = np.diag([2.0, 1.0]), np.array([[8.0, -3.0], [-3.0, 4.0]]), 1e4 * np.array([[3.0, -1.0], [-1.0, 1.5]])
FAST = 0.0045


def related(seed=0, samples=6000):
    """Forces on both masses of a chain and their motion, with noise."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, 2))
    y = independent.simulate(*CHAIN, u, FAST)
    return u, y + 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape), rng


def changed(array, column, rows, factor):
    array = array.copy()
    array[rows, column] *= factor
    return array


def drifted(y, total):
    n = len(y)
    return CubicSpline(np.arange(n), y)(np.arange(n - 50) * (1.0 + total / n))


def humming(y, frequency):
    y = y.copy()
    y[:, 0] += 0.02 * y[:, 0].std() * np.sin(2 * np.pi * frequency * FAST * np.arange(len(y)) + 1.0)
    return y


def folded(rng):
    """The chain's motion under a force up to the sampling rate, of which every twelfth sample is kept."""
    u = rng.standard_normal((72_000, 2))
    y = independent.simulate(*CHAIN, u, FAST, measured="acceleration")
    return u[::12], y[::12], {"sampling_time": 12 * FAST, "measured": "acceleration"}


def looped(rng):
    """Forces of a controller that holds the chain in place by its noisy motion, against forces nobody records."""
    A, B = independent.state_space(*CHAIN, np.eye(2))
    flow = expm(np.block([[A, B], [np.zeros((2, 6))]]) * FAST)
    x, before, u, y = np.zeros(4), np.zeros(2), np.empty((4000, 2)), np.empty((4000, 2))
    reference = np.repeat(rng.choice([-1e-3, 1e-3], (40, 2)), 100, axis=0)
    for k in range(4000):
        y[k] = x[:2] + 1e-5 * rng.standard_normal(2)
        u[k] = 5e3 * (reference[k] - y[k]) - 20.0 * (y[k] - before) / FAST
        before, x = y[k], flow[:4, :4] @ x + flow[:4, 4:] @ (u[k] + rng.standard_normal(2))
    return u, y, {}


RELATIONS = {
    "unit_change": ("y2", lambda u, y, rng: (u, changed(y, 1, slice(3500, None), 1000.0), {})),
    "unit_change, by far": ("y2", lambda u, y, rng: (u, changed(y, 1, slice(2000, None), 1e-3), {})),
    "unit_change of an input": ("u1", lambda u, y, rng: (changed(u, 0, slice(2500), 9.81), y, {})),
    "sign_error": ("y1", lambda u, y, rng: (u, changed(y, 0, slice(None), -1.0), {})),
    "sign_error of an input": ("y2", lambda u, y, rng: (changed(u, 1, slice(None), -1.0), y, {})),
    "swapped_channels": ("y1", lambda u, y, rng: (u, y[:, ::-1], {})),
    "swapped_channels, input and output": (
        "y2",
        lambda u, y, rng: (np.column_stack([u[:, 0], y[:, 1]]), np.column_stack([y[:, 0], u[:, 1]]), {}),
    ),
    "time_shift": ("record", lambda u, y, rng: (u[:-5], y[5:], {})),
    "time_shift of one output": ("y2", lambda u, y, rng: (u[5:], np.column_stack([y[5:, 0], y[:-5, 1]]), {})),
    "clock_drift": ("y1", lambda u, y, rng: (u[:-50], np.column_stack([drifted(y[:, 0], 4.0), y[:-50, 1]]), {})),
    "mains_hum": ("y1", lambda u, y, rng: (u, humming(y, 50.0), {})),
    "mains_hum, folded": ("y1", lambda u, y, rng: (u, humming(y, 60.0 + 1.0 / FAST), {})),
    "aliasing": ("y1", lambda u, y, rng: folded(rng)),
    "closed_loop": ("u1", lambda u, y, rng: looped(rng)),
    "dead_channel": ("y2", lambda u, y, rng: (u, np.column_stack([y[:, 0], rng.standard_normal(len(y))]), {})),
    "little_excitation": ("u2", lambda u, y, rng: (u[:, [0, 0]] + 1e-3 * u, y, {})),
    "little_excitation for the noise": (
        "y1",
        lambda u, y, rng: (u, y + 3.0 * y.std(axis=0) * rng.standard_normal(y.shape), {}),
    ),
}


def test_outputs_that_follow_their_inputs_are_left_alone():
    for seed in range(10):
        u, y, _ = related(seed)
        assert preflight(Record(u, y, FAST)) == []


@pytest.mark.parametrize("kind", RELATIONS)
def test_what_is_wrong_between_channels_is_found(kind):
    location, spoil = RELATIONS[kind]
    for seed in range(3):
        u, y, options = spoil(*related(seed))
        options = {"sampling_time": FAST} | options
        findings = {(f.effect, f.location) for f in preflight(Record(u, y, **options))}
        assert (kind.split()[0].rstrip(","), location) in findings, (seed, findings)


def test_figures_of_what_is_wrong_between_channels():
    def values(kind):
        u, y, options = RELATIONS[kind][1](*related(0))
        (finding,) = preflight(Record(u, y, **{"sampling_time": FAST} | options))
        return finding.values

    assert values("unit_change")["factor"] == pytest.approx(1000.0, rel=0.02)
    assert values("unit_change")["sample"] == pytest.approx(3500, abs=250)
    assert values("unit_change of an input")["factor"] == pytest.approx(1.0 / 9.81, rel=0.02)
    assert values("time_shift")["samples"] == -5.0
    assert values("time_shift of one output")["samples"] == 5.0
    assert values("clock_drift")["samples"] == pytest.approx(-4.0, rel=0.05)
    assert values("mains_hum")["frequency_hz"] == pytest.approx(50.0, abs=0.05)
    y = related(0)[1]
    assert values("mains_hum")["amplitude"] == pytest.approx(0.02 * y[:, 0].std(), rel=0.1)


@pytest.mark.parametrize("early", [6, 9])
def test_inputs_are_put_off_by_as_much_as_an_output_comes_too_early(early):
    for seed in range(3):
        u, y, _ = related(seed)
        lead, best = Looked(Record(u[:-early], y[early:], FAST)).aligned["y1"]
        assert lead > early and best.share < 2e-3
        assert least_lead(u[:-early], y[early:, 0], lead, best.share) == pytest.approx(early, abs=1)
        assert Looked(Record(u, y, FAST)).early == {}


def test_a_line_beside_a_resonance_is_seen_where_that_is_whitened():
    n, h = 8000, 0.002
    pole = np.exp((-1.0 + 2j * np.pi * 52.0) * h)
    a = np.poly([pole, pole.conjugate()])
    for seed in range(3):
        rng = np.random.default_rng(seed)
        left = lfilter([1.0], a, rng.standard_normal(n))
        u, line = rng.standard_normal((n, 1)), np.sin(2 * np.pi * 50.0 * h * np.arange(n))
        amplitude = 0.4 * left.std()
        assert mains_line(left, a, u, h, 50.0) is None
        assert mains_line(left + amplitude * line, np.array([1.0]), u, h, 50.0) is None
        seen, size, above = mains_line(left + amplitude * line, a, u, h, 50.0)
        assert abs(seen - 50.0) < 0.05 and above > 4.0
        assert size == pytest.approx(amplitude, rel=0.3)


def test_a_line_that_an_input_holds_too_is_no_hum():
    u, y, rng = related(0)
    u[:, 0] += np.sin(2 * np.pi * 50.0 * FAST * np.arange(len(u)))
    y = independent.simulate(*CHAIN, u, FAST)
    assert preflight(Record(u, y + 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape), FAST)) == []


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
