"""Calls carried out by workers: those of an executor, of a Dask client, or of a local cluster that starts by itself."""

import abc
import concurrent.futures
import contextlib
import os
import queue
import signal
import time
from collections.abc import Callable, Sequence

from ..numerics.programs.backend import cores
from ..numerics.progress import AbstractProgress
from .worker import environment

AHEAD = 2
"""Calls that wait for each worker: enough that none is idle, few enough that little is lost with the scheduler."""

PATIENCE = 10.0
"""Time [s] that a scheduler has to answer at first."""

LOOK_AGAIN = 0.5
"""Time [s] between looks whether the scheduler is still there."""

ROOM = 3
"""Workers that may die on one call before it is taken to be the call's fault."""


MOST_DROPS = 50
"""Calls that a scheduler may drop before it is given up."""


class Lost(RuntimeError):
    """The workers are gone; what they had finished is in the store."""


class Killed(RuntimeError):
    """Workers died while they carried out one call."""


class Dropped(RuntimeError):
    """A call was forgotten on its way; it can be made again."""


class AbstractEngine(abc.ABC):
    """Carries out calls in other processes.

    `workers`: how many calls run at once.
    """

    workers: int

    @abc.abstractmethod
    def submit(self, function: Callable, argument):
        """A future, with `result` and `add_done_callback`."""

    @abc.abstractmethod
    def why_lost(self) -> str | None:
        """Why nothing will come any more, None where the engine runs."""

    @abc.abstractmethod
    def outcome(self, future):
        """What a finished call returned.

        **Raises:** what the call raised; `Killed`; `Dropped`; `Lost`.
        """

    def close(self, *, at_once: bool) -> None:  # noqa: B027
        """End what this engine has started itself; `at_once`: without waiting for calls in work."""


class ExecutorEngine(AbstractEngine):
    """Any executor of `concurrent.futures`, which stays the caller's.

    **Raises:** `ValueError` for processes that are forked.
    """

    def __init__(self, executor: concurrent.futures.Executor):
        context = getattr(executor, "_mp_context", None)
        if context is not None and context.get_start_method() == "fork":
            raise ValueError(
                "client forks its processes, and JAX's threads do not survive that; give "
                "ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn'))."
            )
        self._executor = executor
        self.workers = getattr(executor, "_max_workers", None) or cores()

    def submit(self, function, argument):
        try:
            return self._executor.submit(function, argument)
        except concurrent.futures.BrokenExecutor as error:
            raise Lost(f"a process of the executor died ({error})") from None

    def why_lost(self):
        return None

    def outcome(self, future):
        try:
            return future.result()
        except concurrent.futures.BrokenExecutor as error:
            raise Lost(f"a process of the executor died ({error})") from None
        except concurrent.futures.CancelledError:
            raise Lost("the executor was shut down") from None


class DistributedEngine(AbstractEngine):
    """A Dask client, and the local cluster behind it where there is one of our own."""

    def __init__(self, client, cluster=None):
        self._client, self._cluster = client, cluster
        self.workers = max(1, sum(client.nthreads().values()))
        self._count = 0

    def submit(self, function, argument):
        self._count += 1
        # Not pure: the store knows what has been done, the scheduler need not.
        return self._client.submit(function, argument, pure=False, retries=0)

    def why_lost(self):
        if self._client.status in ("running", "newly-created"):
            return None
        return f"the scheduler at {getattr(self._client, '_start_arg', None) or 'its address'} is gone"

    def outcome(self, future):
        from distributed import KilledWorker

        while True:
            try:
                if future.status in ("cancelled", "lost"):
                    raise concurrent.futures.CancelledError
                return future.result(timeout=PATIENCE)
            except KilledWorker:
                raise Killed(f"{ROOM + 1} workers died while it was in work, perhaps for want of memory") from None
            except (concurrent.futures.CancelledError, TimeoutError) as error:
                why = self.why_lost()
                if why is not None:
                    raise Lost(why) from None
                if not isinstance(error, TimeoutError):
                    raise Dropped("the scheduler has dropped a call") from None
                # What a worker had returned died with it, and is being made again.

    def close(self, *, at_once: bool):
        if self._cluster is None:
            return
        if at_once:
            # Asked to close, a worker would finish what it is at.
            for nanny in list(self._cluster.workers.values()):
                nanny.auto_restart = False
                with contextlib.suppress(OSError, TypeError):
                    os.kill(nanny.pid, signal.SIGKILL)
        with contextlib.suppress(Exception):
            self._client.close(timeout=1 if at_once else 10)
        with contextlib.suppress(Exception):
            self._cluster.close(timeout=2 if at_once else 20)


def engine_of(client, scheduler: str | None, workers: int | None) -> AbstractEngine:
    """The engine for a client, an address, or nothing.

    **Arguments:** `client`: an executor, a `distributed.Client`, or None; `scheduler`: address of a Dask scheduler;
    `workers`: how many processes to start where neither is given, default one a core.

    **Raises:** `ValueError` for another kind of client, or a scheduler that does not answer; `ImportError` naming the
    extra to install.
    """
    if client is not None:
        if isinstance(client, concurrent.futures.Executor):
            return ExecutorEngine(client)
        if hasattr(client, "submit") and hasattr(client, "nthreads"):
            return DistributedEngine(client)
        raise ValueError(
            f"client is a {type(client).__name__}; give a distributed.Client, an executor of concurrent.futures, or "
            "nothing for workers of this machine."
        )
    if workers is not None and workers < 1:
        raise ValueError(f"workers={workers} is no number of processes; give 1 or more.")
    try:
        import dask
        import distributed
    except ImportError:
        raise ImportError("a fleet needs dask: pip install 'jaxgray[fleet]'.") from None
    # Workers are begun with this configuration; looking at itself a hundred times a second takes a part of a core.
    quiet = {"distributed.admin.tick.interval": "500ms", "distributed.worker.profile.enabled": False}
    dask.config.set({"distributed.scheduler.allowed-failures": ROOM} | quiet)
    if scheduler is not None:
        try:
            found = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, TimeoutError, ValueError):
            raise ValueError(
                f"scheduler: {scheduler} does not answer within {PATIENCE:g} s; start one with `dask scheduler` and "
                "`dask worker ADDRESS --nthreads 1`, or leave it out for workers of this machine."
            ) from None
        if not found.nthreads():
            found.close()
            raise ValueError(f"scheduler: {scheduler} has no workers; start some with `dask worker {scheduler}`.")
        return _Joined(found)
    cluster = distributed.LocalCluster(
        n_workers=cores() if workers is None else workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        silence_logs=50,
        env=environment(),
        preload=["jaxgray.fleets.worker"],
    )
    client = distributed.Client(cluster, set_as_default=False)
    return DistributedEngine(client, cluster)


@contextlib.contextmanager
def engines(client, scheduler: str | None, workers: int | None):
    """A function that gives the engine, made at its first call and closed at the end; arguments as `engine_of`."""
    made: list[AbstractEngine] = []

    def engine() -> AbstractEngine:
        if not made:
            made.append(engine_of(client, scheduler, workers))
        return made[0]

    try:
        yield engine
    except BaseException:
        for one in made:
            one.close(at_once=True)
        raise
    for one in made:
        one.close(at_once=False)


class _Joined(DistributedEngine):
    """A client of our own to a scheduler of somebody else."""

    def close(self, *, at_once: bool):
        with contextlib.suppress(Exception):
            self._client.close(timeout=1 if at_once else 10)


def carry_out(
    engine: AbstractEngine,
    function: Callable,
    arguments: Sequence,
    weights: Sequence[int],
    arrived: Callable,
    progress: AbstractProgress,
    behind: int = 0,
    split: Callable | None = None,
    found: Callable | None = None,
    what: str = "records",
) -> None:
    """Carry out a function for every argument, so many at a time as there are workers and a few.

    **Arguments:** `engine`; `function`, `arguments`; `weights`: records in each; `arrived`: called with the argument,
    and None or the error of a call on which workers died; `progress`; `behind`: records done before; `split`: of an
    argument on which workers died, the arguments to try instead with their weights, none where there are none; `found`:
    called with what each call returned; `what` the weights count.

    **Raises:** `Lost` where the workers are gone; what a call raised.
    """
    waiting = list(zip(arguments, weights))[::-1]
    total, done, drops = behind + sum(weights), 0, 0
    finished: queue.SimpleQueue = queue.SimpleQueue()
    running: dict = {}
    first: tuple[float, int] | None = None
    _tell(progress, behind, total, None, what)
    try:
        while waiting or running:
            while waiting and len(running) < AHEAD * engine.workers:
                argument, weight = waiting.pop()
                future = engine.submit(function, argument)
                running[id(future)] = future, argument, weight
                future.add_done_callback(finished.put)
            try:
                future = finished.get(timeout=LOOK_AGAIN)
            except queue.Empty:
                why = engine.why_lost()
                if why is not None:
                    raise Lost(why) from None
                continue
            _, argument, weight = running.pop(id(future))
            error = None
            try:
                value = engine.outcome(future)
                if found is not None:
                    found(value)
            except Dropped as dropped:
                drops += 1
                if drops > MOST_DROPS:
                    raise Lost(str(dropped)) from None
                waiting.append((argument, weight))
                continue
            except Killed as killed:
                parts = () if split is None else split(argument)
                if parts:
                    waiting += parts
                    continue
                error = killed
            arrived(argument, error)
            done += weight
            # What comes first has waited for compilations.
            first = (time.monotonic(), done) if first is None else first
            left = None
            if done > first[1]:
                left = (time.monotonic() - first[0]) / (done - first[1]) * (total - behind - done)
            _tell(progress, behind + done, total, left, what)
    except BaseException:
        for future, _, _ in running.values():
            with contextlib.suppress(Exception):
                future.cancel()
        raise


def refuse(_, error: Exception | None) -> None:
    """For `carry_out` as `arrived`, where every part is needed: raises the error of a call on which workers died."""
    if error is not None:
        raise error


def _tell(progress: AbstractProgress, done: int, total: int, left: float | None, what: str) -> None:
    text = f"{done} of {total} {what}"
    if left is not None and done < total:
        text += f", {_duration(left)} left"
    progress.stage(text, fraction=done / max(total, 1))


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
