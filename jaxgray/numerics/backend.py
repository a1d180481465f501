"""What the CPU backend is told before it starts: enough threads, and the emitter of loops that compiles sooner.

It reads its environment once, when it starts, which the first array may do. What the user has set there stays.
"""

import importlib.metadata
import os
import re

LEAST_THREADS = 4

EMITTER_FLAG = "xla_cpu_use_fusion_emitters"

EMITTER_VERSIONS = ((0, 9), (0, 11))
"""Releases of jaxlib, from the first to below the second, that know the flag; one that does not would end the process.
Tried with 0.9.2 and 0.10.1."""


def prepare() -> None:
    """Set the environment of the backend, where the user has not."""
    widen()
    compile_sooner()


def cores() -> int:
    """Cores that this process may use: those of the machine, or fewer where it has been given a share."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def widen() -> None:
    """Ask for a pool of so many threads where there are fewer cores, and the user has not set its size.

    With two threads or fewer, the backend (seen with jaxlib 0.9.2 and 0.10.1) can wait for ever on a loop whose body
    holds batched linear algebra: every thread waits for work that none is left to do. Two such programs at once, from
    threads of Python, did so with four as well, at six coordinates: they run one after the other.
    """
    if cores() < LEAST_THREADS:
        os.environ.setdefault("NPROC", str(LEAST_THREADS))


def compile_sooner() -> None:
    """Choose the former emitter of fused loops, where this release has both and the user has not chosen.

    It compiles the programs of a diagnosis in half of the time (18 s against 36 s), and they run as fast (sweep,
    refinement and diagnosis within 10 % either way; the Jacobian of a linear simulation loses 1.5 ms).
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if flags and not flags.startswith("-"):
        # The name of a file with flags.
        return
    if EMITTER_FLAG not in flags and EMITTER_VERSIONS[0] <= _release("jaxlib") < EMITTER_VERSIONS[1]:
        os.environ["XLA_FLAGS"] = f"{flags} --{EMITTER_FLAG}=false".strip()


def _release(package: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in re.findall(r"\d+", importlib.metadata.version(package))[:2])
    except importlib.metadata.PackageNotFoundError:
        return ()
