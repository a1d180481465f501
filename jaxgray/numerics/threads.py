"""Enough threads for the CPU backend, seen to before it starts.

With two threads or fewer, the backend (seen with jaxlib 0.9.2 and 0.10.1) can wait for ever on a loop whose body holds
batched linear algebra: every thread waits for work that none is left to do. It reads the size of its pool from the
environment variable NPROC when it starts, which the first array may do.
"""

import os

LEAST_THREADS = 4


def cores() -> int:
    """Cores that this process may use: those of the machine, or fewer where it has been given a share."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def widen() -> None:
    """Ask for a pool of so many threads where there are fewer cores, and the user has not set its size."""
    if cores() < LEAST_THREADS:
        os.environ.setdefault("NPROC", str(LEAST_THREADS))
