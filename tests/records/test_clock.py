"""Time columns: units, gaps, jitter; and measured records."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgray.records import RecordWarning, read_record

MEASURED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@pytest.mark.parametrize(
    "unit, seconds", [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("min", 60.0), ("", 1.0)]
)
@pytest.mark.parametrize("name", ["t", "T", "time", "Time", "TIME"])
def test_time_is_found_and_becomes_seconds(write, name, unit, seconds):
    header = f"u,{name} [{unit}],y" if unit else f"u,{name},y"
    record = read_record(write(f"{header}\n1,10,2\n3,12,4\n5,14,6\n"), inputs="u", outputs="y")
    assert record.sampling_time == pytest.approx(2 * seconds) and record.start_time == pytest.approx(10 * seconds)


def test_sampling_time_needs_no_column_and_time_may_be_any(write):
    path = write("clock,u,y,t\n5,1,2,0\n7,3,4,9\n9,5,6,1\n")
    assert read_record(path, inputs="u", outputs="y", sampling_time=0.25).sampling_time == 0.25
    assert read_record(path, inputs="u", outputs="y", time="clock").sampling_time == 2.0
    both = read_record(path, inputs="u", outputs="y", time="clock", sampling_time=2.0005)
    assert both.sampling_time == 2.0005 and both.start_time == 5.0
    assert read_record(path, inputs="t", outputs="y", time="clock").input_names == ("t",)


@given(
    st.sets(st.integers(1, 98), min_size=1, max_size=40),
    st.sampled_from([1e-3, 0.02, 1 / 300]),
    st.integers(0, 9),
)
@settings(max_examples=40, deadline=None)
def test_rows_missing_from_the_clock_become_missing_outputs(text, tmp_path_factory, dropped, step, seed):
    rng = np.random.default_rng(seed)
    kept = np.setdiff1d(np.arange(100), list(dropped))
    u, y = rng.standard_normal(100), rng.standard_normal(100)
    t = 3.0 + step * (kept + rng.uniform(-1e-3, 1e-3, len(kept)))
    path = tmp_path_factory.mktemp("gaps") / "gaps.csv"
    path.write_text(text("t,u,y", t, u[kept], y[kept]))
    with pytest.warns(RecordWarning, match=f"gaps.csv: {len(dropped)} of 100 samples are missing in the time column"):
        record = read_record(path, inputs="u", outputs="y")
    assert record.samples == 100 and record.sampling_time == pytest.approx(step, rel=1e-4)
    np.testing.assert_array_equal(np.flatnonzero(record.missing[:, 0]), sorted(dropped))
    np.testing.assert_array_equal(record.y[kept, 0], y[kept])
    held = kept[np.searchsorted(kept, np.arange(100), side="right") - 1]
    np.testing.assert_array_equal(record.u[:, 0], u[held])


@pytest.mark.parametrize(
    "jitter, noise, said, kept",
    [
        (0.002, 10.0, [], False),
        (
            0.05,
            100.0,
            ["up to 5 % of a sampling time off a uniform grid of 1 s, which is used"],
            False,
        ),
        (0.05, 0.01, ["the rows have times of their own, up to 0.0"], True),
        (0.3, 0.01, ["the rows have times of their own, up to 0.3"], True),
    ],
)
def test_jitter_is_judged_by_what_it_does_to_the_outputs(text, write, jitter, noise, said, kept):
    t = np.arange(100.0)
    y = 10.0 * np.sin(0.1 * t) + noise * np.random.default_rng(0).standard_normal(100)
    t[37] += jitter
    path = write(text("t,u,y", t, t, y))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        record = read_record(path, inputs="u", outputs="y")
    assert record.sampling_time == pytest.approx(1.0, rel=1e-3) and record.has_own_times == kept
    assert [found for found in said if found in str(caught[0].message)] == said and len(caught) == len(said)


@pytest.mark.parametrize(
    "t",
    [np.cumsum(np.random.default_rng(0).uniform(0.2, 1.8, 200)), np.arange(100.0) ** 1.2],
    ids=["random", "slowing"],
)
def test_rows_that_follow_no_clock_keep_their_times(text, write, t):
    path = write(text("t,u,y", t, t, t))
    with pytest.warns(RecordWarning, match="record.csv: the rows have times of their own"):
        record = read_record(path, inputs="u", outputs="y")
    np.testing.assert_array_equal(record.stamps.time, t)
    with pytest.raises(ValueError, match="time column 't' of record.csv: time is not uniform"):
        read_record(path, inputs="u", outputs="y", own_times=False)


def test_a_gap_out_of_all_proportion_is_an_error(text, write):
    t = np.concatenate([np.arange(10.0), [1e6]])
    with pytest.raises(ValueError, match="time column 't' of record.csv: the rows leave gaps too long"):
        read_record(write(text("t,u,y", t, t, t)), inputs="u", outputs="y")


@pytest.mark.parametrize("rate_hz", [300, 700, 150])
def test_a_uniform_clock_in_whole_milliseconds_is_no_gap(text, write, rate_hz):
    t = np.round(1000.0 * np.arange(400) / rate_hz)
    path = write(text("t [ms],u,y", t, t, t))
    with pytest.warns(RecordWarning, match="off a uniform grid"):
        record = read_record(path, inputs="u", outputs="y")
    assert record.samples == 400 and record.sampling_time == pytest.approx(1.0 / rate_hz, rel=1e-2)


# Measured records

MOTOR = ("current", ("motor_angle", "load_angle"), 0.0004, 25000, ("A",), ("rad", "rad"))
FILES = {
    "emps.csv": ("force", "position", 0.001, 24841, ("N",), ("m",)),
    "motor_bench_estimation.csv": (
        "current",
        ("motor_angle", "load_angle"),
        0.0004,
        25000,
        ("A",),
        ("rad", "rad"),
    ),
    "motor_bench_validation.csv": (
        "current",
        ("motor_angle", "load_angle"),
        0.0004,
        25000,
        ("A",),
        ("rad", "rad"),
    ),
    "pendulum_energy.csv": ("torque", "angle", 0.005, 4000, ("N m",), ("rad",)),
    "pendulum_pd.csv": ("torque", "angle", 1 / 300, 1170, ("N m",), ("rad",)),
    "piezo.csv": ("drive", "displacement", 0.005, 8027, ("V",), ("um",)),
}


@pytest.mark.parametrize("name", FILES)
def test_measured_records(name):
    path = MEASURED / name
    if not path.exists():
        pytest.skip(f"{name} is not here")
    inputs, outputs, sampling_time, samples, input_units, output_units = FILES[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        record = read_record(path, inputs=inputs, outputs=outputs)
    assert record.samples == samples and record.sampling_time == pytest.approx(sampling_time, rel=1e-3)
    assert (record.input_units, record.output_units) == (input_units, output_units)
    assert not record.has_missing
    assert len(caught) == (1 if name.startswith("pendulum") else 0)
    if name.startswith("motor"):
        assert record.detect_period() == 2500
