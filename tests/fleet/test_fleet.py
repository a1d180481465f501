"""A fleet from files to tables and pages, on an executor of this process; spoilt records say why."""

import dataclasses
import json
import shutil

import duckdb
import fleet_records as made
import numpy as np
import pandas
import polars
import pytest
import xarray
from independent import REFERENCE

import jaxgray
from jaxgray.cli import main
from jaxgray.fleets import fleet
from jaxgray.fleets.store import Store

CHANNELS = {"inputs": ["u1", "u2"], "outputs": ["y1", "y2"]}
STIFFNESS = 0.97, 1.0, 1.03, 1.01
FIT = {"time_constants": [0.1], "block_rows": [6]}


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Four good records, one of them twice, and four spoilt ones, two of them of the same bytes."""
    folder = tmp_path_factory.mktemp("records")
    for k, scale in enumerate(STIFFNESS):
        made.write(folder / f"m{k % 2}_{k}.npz", *made.record(k, stiffness=scale), temperature=20.0 + k)
    shutil.copy(folder / "m0_0.npz", folder / "m0_9.npz")
    for name in ("m2_corrupt.npz", "m2_corrupt_too.npz"):
        (folder / name).write_bytes(b"PK\x03\x04 this is no archive")
    np.savez(folder / "m2_others.npz", time=np.arange(9.0), force=np.arange(9.0))
    made.write(folder / "m2_slower.npz", *made.record(7), h=2 * made.H)
    return folder


def run(records, out, executor, **options):
    return fleet(
        f"{records}/*.npz",
        **CHANNELS,
        out=out,
        client=executor,
        fitting=FIT,
        machine="{machine}_{when}.npz",
        covariates="temperature",
        **options,
    )


@pytest.fixture(scope="module")
def done(records, tmp_path_factory):
    """The fleet, identified."""
    import concurrent.futures

    out = tmp_path_factory.mktemp("fleet") / "out"
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        return run(records, out, pool)


def test_every_record_has_an_outcome_and_spoilt_ones_a_reason(done):
    assert done.outcomes == {"identified": 5, "failed": 4}
    reasons = {path.rsplit("/", 1)[1]: reason for path, reason in done.failures.items()}
    for name in ("m2_corrupt.npz", "m2_corrupt_too.npz"):
        assert reasons[name].split(" ", 1)[0].rsplit("/", 1)[-1] == name
    assert "no column 'u1'" in reasons["m2_others.npz"]
    assert "sampling time 0.04 s, and 0.02 s in the fleet" in reasons["m2_slower.npz"]
    assert "5 identified" in repr(done) and "no column 'u1'" in repr(done)
    assert done.computed == 7 and len(set(done.keys)) == 7


def test_the_table_reads_alike_everywhere_and_holds_the_truth(done):
    table = pandas.read_parquet(done.table)
    assert polars.read_parquet(done.table).shape == table.shape
    count = duckdb.sql(f"select count(*) from '{done.table}' where outcome = 'identified'").fetchall()[0]
    assert count == (5,)
    good = table[table.outcome == "identified"]
    for name, true in (("mass_y1", 5.0), ("mass_y1_y2", -1.0), ("damping_y2", 1.0)):
        assert np.all(np.abs(good[name] - true) < 5 * good[f"{name}_error"])
    scales = np.array([*STIFFNESS, STIFFNESS[0]])
    order = good.file.str.extract(r"_(\d)\.npz")[0].astype(int).map({0: 0, 1: 1, 2: 2, 3: 3, 9: 4})
    assert np.all(np.abs(good.stiffness_y1 - 100 * scales[order]) < 5 * good.stiffness_y1_error)
    assert np.all(np.abs(good.excess - 1) < 0.1) and np.all(good.fit_percent_y1 > 95)
    assert np.all(good.temperature == 20 + order % 4) and set(good.machine) == {"m0", "m1"}
    assert np.all(good.frequency_1_hz_error > 0)


def test_matrices_open_with_xarray(done):
    with xarray.open_dataset(done.matrices) as data:
        assert data.stiffness.dims == ("record", "coordinate", "with_coordinate")
        good = data.sel(record=data.record.str.contains("_1.npz"))
        error = good.stiffness.values[0] - REFERENCE["K"]
        assert np.all(np.abs(error) < 5 * good.stiffness_error.values[0])
        variance = good.covariance.sel(entry="stiffness[1,1]", with_entry="stiffness[1,1]").values[0]
        assert np.isclose(np.sqrt(variance), good.stiffness_error.values[0, 1, 1])
        assert int(np.isnan(data.mass).all(("coordinate", "with_coordinate")).sum()) == 4


def test_pages_are_there_and_linked(done):
    page = done.page.read_text()
    good = [key for file, key in zip(done.files, done.keys) if file not in done.failures]
    for key in set(good):
        assert f'href="pages/{key}.html"' in page
        assert "Natural frequencies" in (done.folder / "pages" / f"{key}.html").read_text()
    assert "no column &#39;u1&#39;" in page and "sampling time 0.04 s" in page


def test_a_second_call_does_what_is_left(done, records, executor):
    before = pandas.read_parquet(done.table)
    store = Store(done.folder)
    store.remove(done.keys[1])
    again = run(records, done.folder, executor)
    assert again.computed == 1
    after = pandas.read_parquet(again.table)
    pandas.testing.assert_frame_equal(before.drop(columns="seconds"), after.drop(columns="seconds"), rtol=1e-6)
    assert run(records, done.folder, executor).computed == 0
    assert run(records, done.folder, executor, again=True).computed == 3
    document = done.result(done.files[0])["document"]
    assert document["schema"] == "jaxgray/identification/1"


def test_a_full_disk_is_one_clear_line_and_nothing_is_lost(done, records, executor, monkeypatch):
    from jaxgray.fleets import store as stores

    def full(*_):
        raise OSError(28, "No space left on device")

    Store(done.folder).remove(done.keys[2])
    kept = Store(done.folder).keys()
    with monkeypatch.context() as patch:
        patch.setattr(stores.os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            run(records, done.folder, executor)
    assert Store(done.folder).keys() == kept
    assert not list(done.folder.rglob(".part-*"))
    assert run(records, done.folder, executor).computed == 1


def test_bad_arguments_are_one_line(records, tmp_path, capsys, monkeypatch):
    base = ["fleet", f"{records}/*.npz", "--inputs", "u1,u2", "--outputs", "y1,y2", "--out", str(tmp_path / "o")]
    (tmp_path / "file").write_text("")
    for changed, text in (
        (["--task", "guess"], "task is 'guess'; give identify or diagnose"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "--workers and --scheduler are both given"),
        (["--machine", "x.npz"], "machine is 'x.npz'; give a pattern"),
        (["--validation", "x.csv"], "--validation is about one record"),
        (["--out", str(tmp_path / "file" / "o")], "cannot be written"),
        (["--workers", "0"], "workers=0 is no number"),
        (["--task", "diagnose", "--only", "coulomb"], "--only"),
    ):
        assert main([*base, *changed]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1 and said.err.startswith("error: ")
        assert text in said.err, said.err
    with pytest.raises(ValueError, match="fitting has 'model'"):
        fleet(f"{records}/*.npz", **CHANNELS, out=tmp_path / "o", fitting={"model": 1})
    with pytest.raises(ValueError, match="which can be kept as JSON"):
        fleet(f"{records}/*.npz", **CHANNELS, out=tmp_path / "o", fitting={"weight": object()})
    assert not (tmp_path / "o" / "results").exists() or not list((tmp_path / "o" / "results").iterdir())


def test_ctrl_c_says_what_is_kept(records, tmp_path, capsys, monkeypatch):
    from jaxgray.fleets import run as runs

    class Idle:
        workers = 1

        def close(self, *, at_once):
            assert at_once

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxgray.fleets.runner.engine_of", lambda *_: Idle())
    monkeypatch.setattr(runs, "_planned", lambda *_: {})
    monkeypatch.setattr(runs, "carry_out", stopped)
    argv = ["fleet", f"{records}/*.npz", "--inputs", "u1,u2", "--outputs", "y1,y2", "--out", str(tmp_path / "o")]
    assert main(argv) == 130
    said = capsys.readouterr().err
    assert said.startswith("error: interrupted; the results of 0 of 9 records are kept in") and said.count("\n") == 1


def test_the_command_starts_workers_of_its_own(records, tmp_path):
    """On records that all fail, so that nothing is compiled."""
    spoilt = [str(records / name) for name in ("m2_corrupt.npz", "m2_others.npz")]
    out = tmp_path / "out"
    argv = ["fleet", *spoilt, "--inputs", "u1,u2", "--outputs", "y1,y2", "--out", str(out), "--workers", "1"]
    assert main([*argv, "--json", str(tmp_path / "s.json"), "--quiet"]) == 0
    told = json.loads((tmp_path / "s.json").read_text())
    assert told["outcomes"] == {"failed": 2} and told["computed"] == 2
    assert jaxgray.fleet is fleet


def test_a_worker_is_handed_several_batches_where_all_have_enough_to_do():
    from jaxgray.fleets.run import BATCH, BATCHES_A_CALL, CALLS_A_WORKER, _batches_a_call

    assert _batches_a_call(1, 2) == _batches_a_call(BATCH * CALLS_A_WORKER * 2, 2) == 1
    assert _batches_a_call(3 * BATCH * CALLS_A_WORKER, 1) == 3
    assert _batches_a_call(10**6, 2) == BATCHES_A_CALL


def test_a_call_of_several_batches_does_all_of_them(records, done, tmp_path):
    from jaxgray.fleets.tasks import Job, Options
    from jaxgray.fleets.worker import plan, work

    files = tuple((str(records / f"m{k % 2}_{k}.npz"), f"key{k}", {}) for k in range(4))
    Store(tmp_path).open()
    reading = {name: list(columns) for name, columns in CHANNELS.items()}
    job = Job(str(tmp_path), Options("identify", reading, FIT), files, {}, None, False, 2)
    job = dataclasses.replace(job, plan=plan(job))
    assert work(job) == [key for _, key, _ in files]
    for path, key, _ in files:
        found, before = Store(tmp_path).read(key), done.result(path)
        assert found["failure"] is None
        np.testing.assert_allclose(
            found["document"]["model"]["stiffness"], before["document"]["model"]["stiffness"], rtol=1e-6
        )
