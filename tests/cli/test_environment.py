"""What the command sets before it computes."""

import ctypes
import os
import pathlib
import subprocess
import sys

import pytest

from jaxgray.cli import environment
from jaxgray.numerics.programs.kept_files import NotPrivate
from jaxgray.numerics.programs.stored_programs import FOLDER


class Library:
    """A C library that says what it was told."""

    def __init__(self):
        self.told = {}

    def mallopt(self, setting, value):
        self.told[setting] = value.value


@pytest.fixture
def library(monkeypatch):
    for name in [name for name in os.environ if name.startswith("MALLOC_")]:
        monkeypatch.delenv(name)
    made = Library()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: made)
    return made


def test_freed_memory_is_kept_unless_the_user_chose_otherwise(library, monkeypatch):
    environment.keep_memory()
    assert library.told == {environment.TRIM_THRESHOLD: 2**31 - 1, environment.MMAP_THRESHOLD: 2**31 - 1}
    library.told.clear()
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "131072")
    environment.keep_memory()
    assert not library.told


def test_libraries_that_cannot_be_told_are_left_alone(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    environment.keep_memory()

    def none(name):
        raise OSError("no such library")

    monkeypatch.setattr(ctypes, "CDLL", none)
    environment.keep_memory()


def test_the_cache_directory_is_that_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert environment.user_cache("xla") == tmp_path / ".cache" / "jaxgray" / "xla"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert environment.user_cache("xla") == tmp_path / "other" / "jaxgray" / "xla"
    tmp_path.chmod(0o777)
    with pytest.raises(NotPrivate, match="others may write"):
        environment.user_cache("xla")


def test_without_a_home_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    # As `expanduser` leaves it for a user whom the system does not know.
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert environment.user_cache("xla") is None
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_text("")
    assert environment.user_cache("xla") is None


PROGRAM = """
from jaxgray.cli.environment import prepare
prepare()
import jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None)
print(float(jax.jit(lambda x: jax.numpy.sin(x) / 3)(2.0)), len(hits))
"""


def process(home, **more):
    """What a new process computes, how much it has from the cache, and what it says on the error stream."""
    settings = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XDG_"))}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=settings | {"HOME": str(home)} | more,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ran.returncode == 0, ran.stderr
    value, hits = ran.stdout.split()
    return value, int(hits), ran.stderr


def test_what_jax_compiles_is_kept_and_damaged_entries_are_replaced(tmp_path):
    value, hits, said = process(tmp_path)
    assert hits == 0 and not said
    assert process(tmp_path) == (value, 1, "")
    kept = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert kept and all(path.stat().st_mode & 0o077 == 0 for path in kept)
    for path in kept:
        path.write_bytes(path.read_bytes()[:-20])
    assert process(tmp_path) == (value, 0, "")
    assert process(tmp_path) == (value, 1, "")


def test_a_folder_of_others_costs_one_warning_and_nothing_else(tmp_path):
    value, _, _ = process(tmp_path / "home")
    tmp_path.chmod(0o777)
    again, hits, said = process(tmp_path / "home")
    assert again == value and hits == 0
    assert said.startswith("warning: others may write to") and said.count("\n") == 1
    assert process(pathlib.Path("/proc/nothing")) == (value, 0, "")


def test_a_folder_of_the_users_choice_is_no_exception_for_programs(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    _, _, said = process(tmp_path / "home", JAX_COMPILATION_CACHE_DIR=str(shared))
    assert said.startswith(f"warning: others may write to {shared}") and said.count("\n") == 1
    assert not (shared / FOLDER).exists()
