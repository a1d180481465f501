"""What must hold while anything is computed: 64-bit floats, and nothing of the process that disturbs."""

import contextlib
import ctypes
import gc
import threading

import jax
from threadpoolctl import threadpool_limits

from .stored_programs import forget

CROWDED = 0.7
"""Share of the memory areas that a process may have from which compiled programs are dropped."""

COLLECT_AFTER = 50_000
"""New objects after which Python's collector looks for cycles while programs are traced."""

_lock = threading.Lock()
_inside = 0
_before = (0, 0, 0)
_limits: threadpool_limits | None = None


def ready() -> None:
    """Check that 64-bit floats are on.

    **Raises:** `ValueError` where they are off.
    """
    if not jax.config.jax_enable_x64:
        raise ValueError(
            "jax_enable_x64 is off: 32-bit floats are too coarse for identification. Call "
            "jax.config.update('jax_enable_x64', True) before anything else."
        )


def relieve() -> None:
    """Drop what was compiled before the process runs out of memory areas; nothing but Linux counts them.

    Every compiled program keeps some thirty areas of memory; the kernel allows 65 530 in all (vm.max_map_count), and
    the process dies at the next program beyond. Long campaigns over records of many sizes come that far.
    """
    try:
        with open("/proc/sys/vm/max_map_count", encoding="ascii") as file:
            most = int(file.read())
        with open("/proc/self/maps", "rb") as file:
            areas = file.read().count(b"\n")
    except (OSError, ValueError):
        return
    if areas > CROWDED * most:
        jax.clear_caches()
        forget()
        gc.collect()


def give_back() -> None:
    """Hand memory that was freed back to the system; nothing but the C library of GNU keeps it.

    Buffers that come and go by the chunk would leave holes between them, and the process grow with the record.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):
        return


@contextlib.contextmanager
def undisturbed():
    """One thread of BLAS, and Python's collector of cycles less often meanwhile; also a decorator.

    Products of tall matrices are small here, and their threads wait for one another and for those that the package
    runs beside one another: on a busy machine of two cores JᵀJ of 32 000 × 50 numbers takes 1 s with two, 14 ms with
    one. Tracing makes objects by the hundred thousand, none of them garbage yet; at the usual settings looking through
    them again and again takes a sixth of a first identification. Both settings are the process's: other threads of it
    have them meanwhile, too.
    """
    global _inside, _before, _limits
    with _lock:
        if _inside == 0:
            _limits = threadpool_limits(limits=1, user_api="blas")
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
                _limits.restore_original_limits()
