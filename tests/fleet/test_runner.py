"""Workers that come, go and die; schedulers that do not answer."""

import concurrent.futures
import multiprocessing
import threading
import time

import pytest

from jaxgray.fleets import runner
from jaxgray.fleets.runner import AbstractEngine, Dropped, ExecutorEngine, Killed, Lost, carry_out, engine_of
from jaxgray.numerics.progress import AbstractProgress, Silent


class Told(AbstractProgress):
    """Keeps what it is told."""

    def __init__(self):
        self.stages = []

    def stage(self, name, *, fraction=None):
        self.stages.append((name, fraction))


class Dying(AbstractEngine):
    """Calls whose argument holds a bad item lose their workers."""

    workers, dropped = 2, False

    def __init__(self, pool):
        self._pool, self.most, self._running, self._lock = pool, 0, 0, threading.Lock()

    def submit(self, function, argument):
        with self._lock:
            self._running += 1
            self.most = max(self.most, self._running)
        return self._pool.submit(function, argument)

    def why_lost(self):
        return None

    def outcome(self, future):
        with self._lock:
            self._running -= 1
        value = future.result()
        if "shy" in value and not self.dropped:
            self.dropped = True
            raise Dropped("forgotten")
        if "bad" in value:
            raise Killed("4 workers died")
        return value


def test_calls_are_taken_a_few_at_a_time_and_progress_says_how_many_are_left(executor):
    told, values, engine = Told(), [], Dying(executor)
    arguments = [[str(k)] for k in range(30)]
    carry_out(engine, lambda x: x, arguments, [1] * 30, lambda *_: None, told, behind=10, found=values.append)
    assert sorted(values) == sorted(arguments)
    assert engine.most <= runner.AHEAD * engine.workers
    assert told.stages[0] == ("10 of 40 records", 0.25)
    assert told.stages[-1] == ("40 of 40 records", 1.0)
    assert all(name.endswith("s left") for name, _ in told.stages[2:-1])


def test_a_record_on_which_workers_die_is_found_among_its_batch_and_a_dropped_call_made_again(executor):
    arrived = []

    def split(argument):
        return [([item], 1) for item in argument] if len(argument) > 1 else []

    def heard(argument, error):
        arrived.append((argument, None if error is None else str(error)))

    carry_out(Dying(executor), lambda x: x, [["a", "bad", "b"], ["shy"]], [3, 1], heard, Silent(), split=split)
    assert sorted(arrived) == [(["a"], None), (["b"], None), (["bad"], "4 workers died"), (["shy"], None)]


def test_an_error_of_the_store_ends_all(executor):
    def full(_):
        raise OSError(28, "No space left on device", "out/results/k.json")

    with pytest.raises(OSError, match="No space left"):
        carry_out(ExecutorEngine(executor), full, list(range(9)), [1] * 9, lambda *_: None, Silent())


def test_workers_that_are_gone_are_noticed(monkeypatch, executor):
    monkeypatch.setattr(runner, "LOOK_AGAIN", 0.01)
    engine, free = ExecutorEngine(executor), threading.Event()
    monkeypatch.setattr(engine, "why_lost", lambda: "the scheduler at tcp://… is gone")
    with pytest.raises(Lost, match="scheduler at .* is gone"):
        carry_out(engine, lambda _: free.wait(5), [1, 2], [1, 1], lambda *_: None, Silent())
    free.set()


def test_a_stop_cancels_what_waits(executor):
    started = []

    def slow(k):
        started.append(k)
        time.sleep(0.02)

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        carry_out(ExecutorEngine(executor), slow, list(range(50)), [1] * 50, stop, Silent())
    time.sleep(0.1)
    assert len(started) <= 3


def test_clients_that_cannot_serve():
    with pytest.raises(ValueError, match="client is a str; give a distributed.Client"):
        engine_of("tcp://127.0.0.1:1", None, None)
    with pytest.raises(ValueError, match="workers=0 is no number of processes"):
        engine_of(None, None, 0)
    context = multiprocessing.get_context("fork")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        with pytest.raises(ValueError, match="forks its processes"):
            engine_of(pool, None, None)


def test_a_scheduler_that_does_not_answer_is_one_clear_line(monkeypatch):
    monkeypatch.setattr(runner, "PATIENCE", 0.3)
    with pytest.raises(ValueError, match="scheduler: tcp://127.0.0.1:9 does not answer within 0.3 s; start one"):
        engine_of(None, "tcp://127.0.0.1:9", None)
