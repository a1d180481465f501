"""What must hold before anything is computed: 64-bit floats, enough threads, and a collector that does not disturb."""

import contextlib
import gc
import os
import threading

import jax

LEAST_THREADS = 4

CROWDED = 0.7
"""Share of the memory areas that a process may have from which compiled programs are dropped."""

COLLECT_AFTER = 50_000
"""New objects after which Python's collector looks for cycles while programs are traced."""

_lock = threading.Lock()
_inside = 0
_before = (0, 0, 0)


def ready() -> None:
    """Check that 64-bit floats are on, and widen the thread pool of the CPU backend where it is too narrow.

    With two threads or fewer, the CPU backend (seen with jaxlib 0.9.2 and 0.10.1) can wait for ever on a loop
    whose body holds batched linear algebra: every thread waits for work that none is left to do. The pool's
    size is read from the environment variable NPROC when the backend starts, so it is set here, if the user
    has not set it and no backend is running yet.

    **Raises:** `ValueError` when 64-bit floats are off.
    """
    if not jax.config.jax_enable_x64:
        raise ValueError(
            "jax_enable_x64 is off: 32-bit floats are too coarse for identification. Call "
            "jax.config.update('jax_enable_x64', True) before anything else."
        )
    if (os.cpu_count() or 1) < LEAST_THREADS:
        os.environ.setdefault("NPROC", str(LEAST_THREADS))


def relieve() -> None:
    """Drop what was compiled before the process runs out of memory areas; nothing but Linux counts them.

    Every compiled program keeps some thirty areas of memory; the kernel allows 65 530 in all (vm.max_map_count), and
    the process dies at the next program beyond. Long campaigns over records of many sizes come that far.
    """
    try:
        with open("/proc/sys/vm/max_map_count", encoding="ascii") as file:
            most = int(file.read())
        with open("/proc/self/maps", "rb") as file:
            areas = sum(1 for _ in file)
    except (OSError, ValueError):
        return
    if areas > CROWDED * most:
        jax.clear_caches()
        gc.collect()


@contextlib.contextmanager
def rarely_collecting():
    """Let Python's collector of cycles run less often meanwhile; also a decorator.

    Tracing makes objects by the hundred thousand, none of them garbage yet; at the usual settings looking through them
    again and again takes a sixth of a first identification.
    """
    global _inside, _before
    with _lock:
        if _inside == 0:
            _before = gc.get_threshold()
            # 0 means that the user has switched the collector off.
            if 0 < _before[0] < COLLECT_AFTER:
                gc.set_threshold(COLLECT_AFTER, *_before[1:])
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                gc.set_threshold(*_before)
