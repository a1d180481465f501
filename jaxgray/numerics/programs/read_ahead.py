"""Files read ahead of their first use, in a second thread, in the order in which the process before wanted them."""

import atexit
import collections
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TypeVar

from .kept_files import read_kept, write_kept

T = TypeVar("T")

LONGEST = 200
"""Files that are remembered, the first that were wanted; what comes later is read when it is asked for."""


class ReadAhead:
    """`read(path)` as told, begun early for what usually follows the first path of a process.

    A process leaves the order of its paths beside the first of them; the next one that begins with that path reads
    the others in a thread of its own, while it computes.

    **Arguments:** `read`: what a path gives; called once a path, in either thread.
    """

    def __init__(self, read: Callable[[Path], T]):
        self._read = read
        self._wanted: dict[Path, None] = {}
        self._left: tuple[Path, ...] = ()
        self._begun: dict[Path, Future] = {}

    def __call__(self, path: Path) -> T:
        """What `read` gives for the path: read already, awaited, or read now."""
        if not self._wanted:
            self._start(path)
        if len(self._wanted) < LONGEST:
            self._wanted.setdefault(path)
        begun = self._begun.pop(path, None)
        return self._read(path) if begun is None or begun.cancel() else begun.result()

    def _start(self, first: Path) -> None:
        atexit.register(self.remember)
        names = (read_kept(_order(first)) or b"").decode(errors="replace").split()
        # Names alone: nothing outside of the folder is read.
        self._left = tuple(first.parent / name for name in names if Path(name).name == name)
        self._begun = {path: Future() for path in self._left if path != first and path.exists()}
        if self._begun:
            threading.Thread(target=self._work, args=(collections.deque(self._begun.items()),)).start()

    def _work(self, queue: collections.deque) -> None:
        # The thread ends with the main one, at a whole file: who is torn out of a compiler's code leaves a crash.
        while queue and threading.main_thread().is_alive():
            path, future = queue.popleft()
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(self._read(path))
                except Exception as error:
                    future.set_exception(error)

    def remember(self) -> None:
        """Write the order of the paths beside the first, whole or not at all, where it is not there already."""
        wanted = tuple(self._wanted)
        if not wanted or wanted == self._left:
            return
        write_kept(_order(wanted[0]), "\n".join(path.name for path in wanted).encode())


def _order(first: Path) -> Path:
    return first.with_suffix(".order")
