"""Files read ahead in the order of the process before: the same results, whoever reads first."""

import threading
import time

import pytest

from jaxgray.numerics.programs.kept_files import write_kept
from jaxgray.numerics.programs.read_ahead import ReadAhead


class Reading:
    """A `read` that says which thread read what, and cannot read "broken"."""

    def __init__(self):
        self.threads = {}

    def __call__(self, path):
        self.threads[path.name] = threading.current_thread()
        if path.name == "broken":
            raise ValueError(path.name)
        return path.read_text()


@pytest.fixture
def files(tmp_path):
    for name in ("first", "second", "third", "broken"):
        (tmp_path / name).write_text(name)
    return tmp_path


def process(folder, *names):
    """What a process that wants these files gets, and in which threads they were read."""
    reading = Reading()
    ahead = ReadAhead(reading)
    found = []
    for name in names:
        found.append(ahead(folder / name))
        # Time for the other thread, as a computation would give it.
        deadline = time.monotonic() + 5
        while any(not begun.done() for begun in ahead._begun.values()) and time.monotonic() < deadline:
            time.sleep(0.001)
    ahead.remember()
    return found, {name for name, thread in reading.threads.items() if thread is not threading.current_thread()}


def test_the_next_process_finds_them_read(files):
    wanted = "first", "second", "third"
    assert process(files, *wanted) == ([*wanted], set())
    assert process(files, *wanted) == ([*wanted], {"second", "third"})
    assert process(files, "second", "third") == (["second", "third"], set())


def test_what_is_wanted_otherwise_is_read_all_the_same(files):
    process(files, "first", "second", "third")
    found, ahead = process(files, "first", "third", "third")
    assert found == ["first", "third", "third"] and ahead == {"second"}
    # The third is asked for twice, and read here the second time.
    assert process(files, "first", "second")[1] == {"third"}
    assert process(files, "first")[1] == {"second"}


def test_files_that_are_gone_or_broken_are_told_where_they_are_wanted(files):
    with pytest.raises(ValueError, match="broken"):
        process(files, "broken")
    ahead = ReadAhead(Reading())
    ahead(files / "first")
    ahead._wanted |= {files / "broken": None, files / "second": None}
    ahead.remember()
    (files / "second").unlink()
    with pytest.raises(ValueError, match="broken"):
        process(files, "first", "broken")
    with pytest.raises(FileNotFoundError):
        process(files, "first", "second")
    assert process(files, "first")[0] == ["first"]


@pytest.mark.parametrize("content", [b"\xff\xfe", b"second", b"", None])
def test_a_damaged_order_is_replaced(files, content):
    process(files, "first", "second")
    (order,) = files.glob("*.order")
    if content is None:
        order.unlink()
        order.mkdir()
        assert process(files, "first", "second") == (["first", "second"], set())
        return
    order.write_bytes(content)
    assert process(files, "first", "second") == (["first", "second"], set())
    assert process(files, "first", "second") == (["first", "second"], {"second"})


def test_an_order_names_nothing_outside_of_its_folder(files):
    process(files, "first", "second")
    (order,) = files.glob("*.order")
    (files.parent / "outside").write_text("outside")
    write_kept(order, b"first ../outside second")
    assert process(files, "first", "second") == (["first", "second"], {"second"})
