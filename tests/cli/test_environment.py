"""What the command sets before it computes."""

import ctypes
import os

import pytest

from jaxgray.cli import environment


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
