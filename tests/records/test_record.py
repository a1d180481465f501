"""The record and its methods."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxgray
from jaxgray.records import Record, check_compatible, concatenate


def make(samples=100, inputs=2, outputs=3, sampling_time=0.01, **extra):
    rng = np.random.default_rng(0)
    return Record(
        rng.standard_normal((samples, inputs)),
        rng.standard_normal((samples, outputs)),
        sampling_time,
        **extra,
    )


def test_defaults_and_properties():
    record = make(start_time=2.0)
    assert (record.samples, record.inputs, record.outputs, len(record)) == (100, 2, 3, 100)
    assert record.input_names == ("u1", "u2") and record.output_names == ("y1", "y2", "y3")
    assert record.input_units == ("", "") and record.measured == ("displacement",) * 3
    assert record.duration == pytest.approx(1.0) and record.sampling_rate_hz == pytest.approx(100.0)
    np.testing.assert_allclose(record.time, 2.0 + 0.01 * np.arange(100), rtol=1e-15)
    assert not record.has_missing and record.missing.shape == (100, 3)


def test_one_dimension_is_one_column_and_data_is_copied_and_read_only():
    u = np.arange(5.0)
    record = Record(u, [5, 4, 3, 2, 1], 1, measured="velocity", input_names="force", input_units="N")
    u[0] = 99.0
    assert record.u.shape == (5, 1) and record.u[0, 0] == 0.0 and record.y.dtype == np.float64
    assert record.input_names == ("force",) and record.input_units == ("N",) and record.measured == ("velocity",)
    with pytest.raises(ValueError, match="read-only"):
        record.u[0, 0] = 1.0
    with pytest.raises(AttributeError):
        record.hold = "linear"


GOOD = {"u": np.zeros((4, 1)), "y": np.zeros((4, 2)), "sampling_time": 0.1}


@pytest.mark.parametrize(
    "change, match",
    [
        ({"u": np.zeros((5, 1))}, "u has 5 samples and y has 4"),
        ({"u": np.zeros((4, 1, 1))}, r"u has shape \(4, 1, 1\)"),
        ({"u": np.zeros((4, 0))}, "at least one channel"),
        ({"u": ["a", "b", "c", "d"]}, "u holds"),
        ({"y": np.zeros((4, 2), dtype=complex)}, "y holds complex128"),
        ({"u": np.array([0, 1, np.nan, 2])}, "u is NaN at sample 2 of input 0"),
        ({"y": np.array([0, 1, np.inf, 2])}, "y is infinite at sample 2 of channel 0"),
        ({"y": np.array([0, 1, 1e200, 2])}, r"y reaches 1e\+200, beyond 1e\+150"),
        ({"u": [1.0], "y": [1.0]}, "have 1 samples; a record needs at least 2"),
        ({"sampling_time": 0.0}, "sampling_time is 0.0; give a positive number of seconds"),
        ({"sampling_time": -1.0}, "sampling_time is -1.0"),
        ({"sampling_time": np.nan}, "sampling_time is nan"),
        ({"sampling_time": "fast"}, "sampling_time is 'fast'"),
        ({"start_time": np.inf}, "start_time is inf; give a number of seconds"),
        ({"hold": "cubic"}, "hold is 'cubic'; give one of zero, linear"),
        (
            {"measured": "position"},
            "measured is 'position'; give one of displacement, velocity, acceleration",
        ),
        ({"measured": ("velocity",) * 3}, "for each of the 2 outputs"),
        ({"output_names": ("a",)}, "output_names has 1 entries"),
        ({"output_names": ("a", "a")}, "a name of its own"),
        ({"input_names": ("y1",)}, "a name of its own"),
        ({"input_names": ("",)}, "a name of its own"),
        ({"input_units": ("N", "N")}, "input_units has 2 entries"),
        ({"scheduling": np.zeros(3)}, r"scheduling has shape \(3,\)"),
        ({"scheduling": np.array([0, 1, np.nan, 2])}, "holds NaN"),
        ({"scheduling_name": "p"}, "scheduling is missing"),
    ],
)
def test_what_does_not_fit_is_an_error_of_one_line(change, match):
    with pytest.raises(ValueError, match=match) as caught:
        Record(**(GOOD | change))
    assert "\n" not in str(caught.value)


def test_missing_outputs_are_marked():
    y = np.arange(8.0).reshape(4, 2)
    y[1, 0] = np.nan
    record = Record(np.zeros(4), y, 0.1)
    assert record.has_missing and record.missing.sum() == 1 and record.missing[1, 0]


def test_slices_keep_the_clock_and_the_channels():
    record = make(start_time=1.0, scheduling=np.arange(100.0), scheduling_name="position", hold="linear")
    part = record[20:50]
    np.testing.assert_array_equal(part.u, record.u[20:50])
    np.testing.assert_array_equal(part.scheduling, np.arange(20.0, 50.0))
    assert part.start_time == pytest.approx(1.2) and part.hold == "linear" and part.scheduling_name == "position"
    np.testing.assert_array_equal(record[-10:].y, record.y[-10:])
    np.testing.assert_array_equal(record.between(1.2, 1.5).u, part.u)
    np.testing.assert_array_equal(record.between(stop=1.5).u, record.u[:50])
    np.testing.assert_array_equal(record.between(1.9).u, record.u[90:])


@given(st.integers(0, 98), st.integers(2, 100), st.sampled_from([1e-4, 0.001, 1 / 3, 0.02]))
def test_between_agrees_with_samples_in_spite_of_rounding(first, length, sampling_time):
    record = make(sampling_time=sampling_time)
    last = min(100, first + length)
    part = record.between(first * sampling_time, last * sampling_time)
    np.testing.assert_array_equal(part.u, record.u[first:last])


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda r: r[3], "give a range of samples"),
        (lambda r: r[::2], "without a step"),
        (lambda r: r[5:6], "leaves 1 of 100 samples"),
        (lambda r: r.between(0.5, 0.505), "leaves 1 samples; the record runs from 0 to 1 s"),
        (lambda r: r.split(0.0), "fraction is 0.0"),
        (lambda r: r.split(1.5), "fraction is 1.5"),
        (lambda r: r.split(0.001), "each part needs at least 2"),
        (lambda r: r.detrend("cubic"), "kind is 'cubic'"),
        (lambda r: r.select(outputs="z"), "outputs: there is no 'z'; the record has y1, y2, y3"),
        (lambda r: r.select(inputs=5), "inputs: there is no 5"),
        (lambda r: r.select(inputs=[]), "inputs is empty"),
        (lambda r: r.average_periods(), "the inputs do not repeat"),
        (lambda r: r.average_periods(60), "leave 1 whole periods"),
        (lambda r: r.average_periods(1), "at least 2 samples"),
        (lambda r: r.average_periods(10, skip=-1), "skip is -1"),
    ],
)
def test_methods_refuse_what_does_not_fit(bad, match):
    with pytest.raises(ValueError, match=match):
        bad(make())


def test_a_record_is_no_sequence_of_samples():
    with pytest.raises(TypeError):
        iter(make())


def test_split_holds_out_the_last_part():
    record = make()
    estimation, validation = record.split(0.3)
    assert (estimation.samples, validation.samples) == (70, 30)
    assert validation.start_time == pytest.approx(0.7)
    np.testing.assert_array_equal(np.vstack([estimation.y, validation.y]), record.y)


@pytest.mark.parametrize("kind, degree", [("constant", 0), ("linear", 1)])
def test_detrend_takes_the_trend_out_of_what_is_there(kind, degree):
    t = np.arange(200.0)
    rng = np.random.default_rng(1)
    wiggle = rng.standard_normal(200)
    wiggle -= np.polyval(np.polyfit(t, wiggle, degree), t)
    y = wiggle + 5.0 + (0.3 * t if degree else 0.0)
    record = Record(y, y, 0.1).detrend(kind)
    np.testing.assert_allclose(record.y[:, 0], wiggle, atol=1e-12)
    np.testing.assert_allclose(record.u[:, 0], wiggle, atol=1e-12)
    np.testing.assert_array_equal(Record(y, y, 0.1).detrend(kind, inputs=False).u[:, 0], y)
    np.testing.assert_array_equal(Record(y, y, 0.1).detrend(kind, outputs=False).y[:, 0], y)

    gaps = np.zeros(200, dtype=bool)
    gaps[[3, 50, 51]] = True
    holed = np.where(gaps, np.nan, y)
    left = Record(y, holed, 0.1).detrend(kind).y[:, 0]
    expected = y[~gaps] - np.polyval(np.polyfit(t[~gaps], y[~gaps], degree), t[~gaps])
    np.testing.assert_allclose(left[~gaps], expected, atol=1e-10)
    assert np.isnan(left[gaps]).all()


def test_select_by_name_and_place_keeps_what_belongs_to_a_channel():
    record = make(
        output_names=("a", "b", "c"),
        output_units=("m", "rad", "m/s^2"),
        measured=("displacement", "displacement", "acceleration"),
    )
    part = record.select(inputs=1, outputs=("c", "a"))
    assert part.input_names == ("u2",) and part.output_names == ("c", "a")
    assert part.output_units == ("m/s^2", "m") and part.measured == ("acceleration", "displacement")
    np.testing.assert_array_equal(part.y, record.y[:, [2, 0]])
    np.testing.assert_array_equal(part.u, record.u[:, [1]])
    np.testing.assert_array_equal(record.select(outputs=-1).y, record.y[:, [2]])


def test_clean_stretches_longest_first():
    y = np.arange(40.0).reshape(20, 2)
    y[3, 0] = y[12, 1] = y[13, 0] = np.nan
    stretches = Record(np.zeros(20), y, 1.0).clean_stretches(4)
    assert stretches == [slice(4, 12), slice(14, 20)]
    assert Record(np.zeros(20), y, 1.0).clean_stretches()[-1] == slice(0, 3)
    assert make().clean_stretches() == [slice(0, 100)]
    assert not make()[slice(0, 100)].has_missing


def test_concatenate_puts_pieces_back():
    record = make(scheduling=np.arange(100.0))
    whole = concatenate([record[:30], record[30:60], record[60:]])
    np.testing.assert_array_equal(whole.u, record.u)
    np.testing.assert_array_equal(whole.scheduling, record.scheduling)
    with pytest.raises(ValueError, match=r"records\[1\] starts at 0.4 s and the one before ends at 0.3 s"):
        concatenate([record[:30], record[40:]])
    with pytest.raises(ValueError, match="records is empty"):
        concatenate([])


@pytest.mark.parametrize(
    "change, match",
    [
        ({"input_names": ("a", "b")}, r"records\[1\] has input_names \('a', 'b'\) and records\[0\]"),
        ({"output_names": ("a", "b", "c")}, "output_names"),
        ({"measured": "velocity"}, "measured"),
        ({"hold": "linear"}, "hold"),
        ({"sampling_time": 0.02}, "sampling_time 0.02"),
        ({"input_units": ("N", "kN")}, "input_units"),
        ({"outputs": 2}, "output_names"),
        ({"scheduling": np.zeros(100)}, "scheduling_name"),
    ],
)
def test_incompatible_records_are_named(change, match):
    first = make(input_units=("N", "N"))
    with pytest.raises(ValueError, match=match):
        check_compatible([first, make(**change)])


def test_compatible_records_may_lack_units_and_differ_in_length():
    check_compatible([make(input_units=("N", "N")), make(samples=50), make(sampling_time=0.01 * (1 + 1e-6))])


def test_repr_is_one_screen():
    y = np.array([[1.0, 2.0], [np.nan, 4.0], [3.0, -6.0]])
    text = repr(Record([1, 2, 2], y, 0.5, input_names="force", input_units="N", measured="velocity", start_time=3.0))
    lines = text.splitlines()
    assert lines[0] == "Record: 3 samples, 1.5 s at 2 Hz, zero hold, from 3 s"
    assert lines[2].split() == ["input", "force", "N", "1.732", "1", "2", "0"]
    assert lines[3].split() == ["output", "y1", "2.236", "1", "3", "1", "velocity"]
    assert len(lines) == 5
    assert "nan" in repr(Record([1, 2], [np.nan, np.nan], 1.0))


TAKING_RECORDS = {
    "identify": jaxgray.identify,
    "sweep": jaxgray.sweep,
    "diagnose": jaxgray.diagnose,
    "stabilisation": jaxgray.stabilisation,
    "preflight": jaxgray.preflight,
    "energy_balance": lambda record: jaxgray.energy_balance(jaxgray.MechanicalModel([[1.0]], [[1.0]], [[1.0]]), record),
    "write_simulation": lambda record: jaxgray.write_simulation(
        jaxgray.MechanicalModel([[1.0]], [[1.0]], [[1.0]]), record, "never.csv"
    ),
}


@pytest.mark.parametrize("taking", TAKING_RECORDS.values(), ids=TAKING_RECORDS)
@pytest.mark.parametrize(
    "given, shown", [(5, "5"), ("axis.csv", "'axis.csv'"), ([], "[]"), (np.ones((3, 2)), "ndarray")]
)
def test_what_is_no_record_is_one_clear_error(taking, given, shown):
    with pytest.raises(ValueError, match=r"^record must be a Record") as error:
        taking(given)
    assert shown in str(error.value) and "read_record" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("taking", [jaxgray.identify, jaxgray.sweep, jaxgray.diagnose])
def test_held_out_records_that_are_none_are_named(taking):
    record = Record(np.ones(50), np.zeros(50), 0.1)
    with pytest.raises(ValueError, match=r"^validation must be a Record or a list of them, at least one; here is 3\."):
        taking(record, validation=3)
