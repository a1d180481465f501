"""Calls on several threads."""

import threading

import jax
import jax.numpy as jnp
import pytest

from jaxgray.numerics.programs import side_by_side as module
from jaxgray.numerics.programs.side_by_side import side_by_side


def test_results_come_in_order_and_failures_reach_the_caller(monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 3)
    together = threading.Barrier(3, timeout=20)

    def slow(k):
        # None of the three would come back if they did not run at the same time.
        return (together.wait(), k)[1]

    assert side_by_side(slow, range(3)) == [0, 1, 2]
    assert side_by_side(slow, []) == []
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda k: 1 / (3 - k), range(5))


def test_no_part_goes_on_after_a_failure_has_reached_the_caller(monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 2)
    ended, failed = [], threading.Event()

    def part(k):
        if k == 0:
            failed.set()
            raise ZeroDivisionError
        assert failed.wait(20)
        threading.Event().wait(0.2)
        ended.append(k)

    with pytest.raises(ZeroDivisionError):
        side_by_side(part, range(2))
    assert ended == [1]


def test_parts_of_parts_wait_for_no_other_thread(monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 2)

    def part(k):
        return [threading.get_ident()] + side_by_side(lambda _: threading.get_ident(), range(2))

    # All threads at once inside of parts: any that waited for another would wait for ever.
    assert all(len(set(threads)) == 1 for threads in side_by_side(part, range(8)))


def test_what_is_set_for_one_thread_holds_for_its_parts(monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 2)
    kept = jax.config.jax_enable_x64
    with jax.enable_x64(not kept):
        found = side_by_side(lambda _: str(jnp.asarray(1.5).dtype), range(4))
    assert found == ["float32" if kept else "float64"] * 4
