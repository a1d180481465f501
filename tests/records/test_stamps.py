"""Rows at times of their own: the grid beside them, several rates, several files, bad times."""

import warnings

import numpy as np
import pytest

from jaxgray.records import Record, RecordWarning, preflight, read_record


def generator(name):
    return np.random.default_rng(list(name.encode()))


def jittered(rng, samples=400, step=0.01, wander=0.3):
    t = np.sort(step * (np.arange(samples) + rng.uniform(-wander, wander, samples)))
    u = np.repeat(rng.standard_normal(samples // 20), 20)
    return t, u, np.sin(3 * t) + 1e-4 * rng.standard_normal(samples)


@pytest.mark.parametrize("wander", [0.1, 0.3, 0.9])
def test_rows_of_a_wandering_clock_lie_on_its_grid_in_their_order(wander):
    t, u, y = jittered(generator("wander"), wander=wander)
    record = Record.from_stamps(t, u, y)
    assert record.sampling_time == pytest.approx(0.01, rel=1e-3) and record.stamps.jitter < wander + 0.1
    placed = record.stamps.place[:, 0] >= 0
    assert placed.sum() >= 396 and record.samples - placed.sum() <= 3
    np.testing.assert_array_equal(record.y[record.stamps.place[placed, 0], 0], y[placed])
    assert not record.lost.any()


def test_random_rows_find_places_near_their_times():
    rng = generator("random")
    t = np.cumsum(rng.exponential(0.01, 3000))
    record = Record.from_stamps(t, np.ones(3000), np.sin(t))
    stamps = record.stamps
    placed = stamps.place[:, 0] >= 0
    places = stamps.place[placed, 0]
    assert placed.mean() > 0.99 and np.all(np.diff(places) > 0)
    off = (t[placed] - record.start_time) / record.sampling_time - places
    assert np.sqrt(np.mean(off**2)) < 0.8


def test_held_inputs_have_their_means_over_the_steps():
    t, u, y = jittered(generator("means"))
    record = Record.from_stamps(t, u, y)
    end = record.start_time + record.sampling_time * record.samples
    inside = (t > record.start_time) & (t < end)
    edges = np.concatenate([[record.start_time], t[inside], [end]])
    levels = u[np.maximum(np.searchsorted(t, edges[:-1], side="right") - 1, 0)]
    assert record.u.sum() * record.sampling_time == pytest.approx(np.diff(edges) @ levels, rel=1e-9)


def test_several_rates_in_one_table(text, write):
    rng = generator("rates")
    t = np.arange(600) * 0.01
    u = np.where(np.arange(600) % 40 == 0, rng.standard_normal(600), np.nan)
    slow = np.where(np.arange(600) % 3 == 0, np.cos(t), np.nan)
    path = write(text("t,u,fast,slow", t, u, np.sin(t), slow))
    with pytest.raises(ValueError, match="inputs: column 'u' of record.csv has 585 missing values"):
        read_record(path, inputs="u", outputs="fast,slow".split(","))
    with pytest.warns(RecordWarning, match="times of their own"):
        record = read_record(path, inputs="u", outputs=["fast", "slow"], own_times=True)
    assert record.missing.sum(axis=0).tolist() == [0, 400] and not record.lost.any()
    np.testing.assert_allclose(record.u[::40, 0], u[::40])
    assert not [finding for finding in preflight(record) if finding.effect == "dropped_samples"]


def test_rows_of_several_files_join(text, tmp_path):
    t, u, y = jittered(generator("files"))
    first, second, repeated = (tmp_path / name for name in ("encoder.csv", "force.csv", "repeated.csv"))
    first.write_text(text("time [ms],y", 1e3 * t, y))
    second.write_text(text("t,u [N]", t[::20] - 1e-4, u[::20]))
    repeated.write_text(text("t,u", np.zeros(9), np.ones(9)))
    with pytest.warns(RecordWarning, match="encoder.csv: the rows have times of their own"):
        record = read_record(first, inputs="u", outputs="y", also=f"{second}:u")
    assert record.input_units == ("N",) and len(record.stamps.time) == 420 and record.stamps.other_clocks == [1]
    np.testing.assert_allclose(record.stamps.u[:, 0], u[::20])
    for also, said in (
        (str(second), "also is .*; give a file and its columns"),
        (f"{second}:force", "also: force.csv has no column 'force'"),
        (f"{repeated}:u", "time column 't' of repeated.csv: time does not increase at line 3"),
        (f"{first}:y", "a column 'y' is in two files"),
    ):
        with pytest.raises(ValueError, match=said):
            read_record(first, inputs="u", outputs="y", also=also)


def test_slices_and_selections_keep_their_rows():
    t, u, y = jittered(generator("slices"))
    record = Record.from_stamps(t, u, np.stack([y, 2 * y], axis=1))
    part = record[100:300]
    rows = np.flatnonzero(part.stamps.place[:, 0] >= 0)
    assert 198 <= len(rows) <= 200 and np.all(part.stamps.time[rows] >= part.start_time)
    np.testing.assert_array_equal(part.y[part.stamps.place[rows, 0], 0], y[rows])
    assert record.select(outputs="y2").stamps.y[:, 0].tolist() == (2 * y).tolist()
    assert record.has_own_times and not record.on_grid.has_own_times and record.on_grid.stamps is not None


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda t: t[::-1], "time does not increase at row 1"),
        (lambda t: np.where(np.arange(len(t)) == 7, t[6], t), "time does not increase at row 7"),
        (lambda t: np.where(np.arange(len(t)) == 7, np.nan, t), "time is not finite at row 7"),
        (lambda t: t[:-1], "time has 399 rows, u 400 and y 400"),
    ],
)
def test_bad_times_are_one_clear_line(change, said):
    t, u, y = jittered(generator("bad"))
    with pytest.raises(ValueError, match=said):
        Record.from_stamps(change(t), u, y)


@pytest.mark.parametrize("digits", [2, 3])
def test_times_that_were_rounded_may_be_uniform(text, write, digits):
    t = np.round(np.arange(500) / 300.0, digits + 1)
    y = np.sin(2 * np.arange(500) / 300.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert not read_record(write(text("t,u,y", t, t, y)), inputs="u", outputs="y").has_own_times
