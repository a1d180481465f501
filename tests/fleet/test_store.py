"""The store: results are whole or not there, and their keys hold all that they depend on."""

import errno
import os
import socket
import subprocess
import sys

import pytest

from jaxgray.fleets import store as stores
from jaxgray.fleets.store import Store
from jaxgray.fleets.tasks import Options, batches, content_hash, key_of, listed
from jaxgray.fleets.worker import failed_result
from jaxgray.numerics.whole_files import PART


@pytest.fixture
def store(tmp_path):
    made = Store(tmp_path / "out")
    made.open()
    return made


def failed(reason):
    return failed_result("a.csv", "identify", "Killed", reason)


def test_a_result_comes_back_and_the_same_key_twice_is_harmless(store):
    for reason in ("first", "second"):
        store.write("k", failed(reason))
    assert store.keys() == {"k"}
    assert store.read("k")["failure"]["reason"] == "second"
    store.remove("k")
    assert store.keys() == set() and store.read("k") is None


def test_what_is_not_whole_is_not_there(store):
    (store.results / "half.json").write_text('{"document": {"x"')
    assert store.read("half") is None and store.keys() == set()


def test_a_failed_write_leaves_the_old_result_and_no_file_beside(store, monkeypatch):
    store.write("k", failed("first"))

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(stores.os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        store.write("k", failed("second"))
    assert caught.value.filename.endswith("k.json")
    assert store.read("k")["failure"]["reason"] == "first"
    assert [path.name for path in store.results.iterdir()] == ["k.json"]


def test_files_of_dead_processes_are_removed_and_those_of_living_ones_left(store):
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    here = socket.gethostname()
    dead = store.results / f"{PART}{here}@{done.pid}-abc"
    alive = store.results / f"{PART}{here}@{os.getpid()}-abc"
    elsewhere = store.results / f"{PART}another-host@{done.pid}-abc"
    for path in (dead, alive, elsewhere):
        path.write_text("half")
    store.open()
    assert not dead.exists() and alive.exists() and elsewhere.exists()
    assert store.keys() == set()


def test_a_place_that_cannot_be_written_is_said_at_the_door(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="out: .* cannot be written .*give a folder"):
        Store(tmp_path / "file" / "out").open()


def test_keys_depend_on_bytes_options_and_version(tmp_path, monkeypatch):
    options = Options("identify", {"inputs": ["u"], "outputs": ["y"]})
    keys = {key_of("bytes", options.digest()), key_of("others", options.digest())}
    for changed in (
        Options("diagnose", options.reading),
        Options("identify", options.reading | {"hold": "linear"}),
        Options("identify", options.reading, {"block_rows": [6]}),
        Options("identify", options.reading, {}, ("temperature",)),
    ):
        keys.add(key_of("bytes", changed.digest()))
    keys.add(key_of("bytes", options.digest(), {"mass": [[1.0]]}))
    monkeypatch.setattr("jaxgray.report.page.whole.own_version", lambda: "another")
    keys.add(key_of("bytes", options.digest()))
    assert len(keys) == 8
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"1")
    assert content_hash(tmp_path / "a") == content_hash(tmp_path / "b")


def test_paths_and_patterns(tmp_path):
    for name in ("b.csv", "a.csv", "c.txt"):
        (tmp_path / name).write_text(name)
    found = listed([f"{tmp_path}/*.csv", tmp_path / "c.txt", tmp_path / "a.csv"])
    assert [path.name for path in found] == ["a.csv", "b.csv", "c.txt"]
    for wrong, text in (
        ([], "paths is empty"),
        (f"{tmp_path}/*.npz", "no file matches"),
        (tmp_path / "x.csv", "x.csv is no file"),
    ):
        with pytest.raises(ValueError, match=text):
            listed(wrong)


def test_files_of_nearly_one_length_go_together(tmp_path):
    for k, size in enumerate((10, 500, 12, 480, 11)):
        (tmp_path / str(k)).write_bytes(bytes(size))
    groups = batches([(str(tmp_path / str(k)), str(k), {}) for k in range(5)], 2)
    assert [[key for _, key, _ in group] for group in groups] == [["1", "3"], ["2", "4"], ["0"]]
