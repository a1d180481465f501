"""Files are the old or the new ones, whole, whatever ends the writing."""

import errno
import os
import random
import signal
import socket
import subprocess
import sys
import time

import pytest

from jaxgray.numerics.whole_files import PART, check_place, replacing, write_together, write_whole


def listed(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def full(monkeypatch):
    """A disk that takes one more file, and no second one."""
    taken = []

    def fsync(_):
        taken.append(1)
        if len(taken) > 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)


def test_all_or_none_on_a_disk_that_becomes_full(tmp_path, full):
    for name in "ab":
        (tmp_path / name).write_text("old")
    with pytest.raises(OSError, match="No space left on device: '.*b'"):
        write_together({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert listed(tmp_path) == ["a", "b"] and {(tmp_path / name).read_text() for name in "ab"} == {"old"}


def test_a_library_that_fails_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(RuntimeError), replacing(tmp_path / "a") as part:
        part.write_text("half")
        raise RuntimeError
    assert listed(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"
    with replacing(tmp_path / "a") as part:
        part.write_text("new")
    assert listed(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "new"


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, words in (
        (tmp_path, "is a folder"),
        (tmp_path / "pipe", "is no regular file"),
        ("/dev/null", "is no regular file"),
        (tmp_path / "no" / "a", "the folder .* is not there"),
    ):
        with pytest.raises(ValueError, match=words):
            write_whole(b"new", path)
    assert listed(tmp_path) == ["pipe"]
    check_place(tmp_path / "a")


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path):
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    here = socket.gethostname()
    dead = f"{PART}{here}@{done.pid}-a"
    others = [f"{PART}{here}@{os.getpid()}-a", f"{PART}elsewhere@{done.pid}-a", f"{PART}mine", "b"]
    for name in (dead, *others):
        (tmp_path / name).touch()
    write_whole(b"new", tmp_path / "a")
    assert listed(tmp_path) == sorted(["a", *others])


WRITER = """
import itertools, pathlib, sys
from jaxgray.numerics.whole_files import write_together
folder = pathlib.Path(sys.argv[1])
for k in itertools.count():
    write_together({folder / name: (b"%08d" % k) * 20_000 for name in "ab"})
"""


def test_a_killed_writer_leaves_whole_files(tmp_path):
    """A short form of `benchmarks/kills.py`."""
    draw = random.Random(1)
    for _ in range(5):
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stderr=subprocess.DEVNULL)
        while not (tmp_path / "b").exists():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(draw.uniform(0.0, 0.05))
        process.send_signal(draw.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT)))
        process.wait()
        for name in "ab":
            content = (tmp_path / name).read_bytes()
            assert len(content) == 160_000 and content == content[:8] * 20_000
    assert listed(tmp_path)[-2:] == ["a", "b"]
