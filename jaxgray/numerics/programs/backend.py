"""What the CPU backend is told before it starts: enough threads, the emitter of loops that compiles sooner, and loops
over samples in one piece.

It reads its environment once, when it starts, which the first array may do. What the user has set there stays.
"""

import importlib.metadata
import os
import platform
import re
import sys

SWITCH = "JAXGRAY_BACKEND"
"""Environment variable that, set to 0, has the environment left as it is."""

LEAST_THREADS = 4
"""Threads of the pool for each device. More get in each other's way: idle ones look for work before they sleep."""

DEVICES_FLAG = "xla_force_host_platform_device_count"

EMITTER_FLAG = "xla_cpu_use_fusion_emitters"

LOOP_FLAG = "xla_backend_extra_options"

WHOLE_LOOPS = "xla_cpu_small_while_loop_byte_threshold=1000000000"
"""Bytes that a loop may touch to be compiled in one piece, with nothing to dispatch between its operations."""

EMITTER_VERSIONS = ((0, 9), (0, 11))
"""Releases of jaxlib, from the first to below the second, that know the flags; one that does not would end the process.
Tried with 0.9.2 and 0.10.1."""


def prepare() -> None:
    """Set the environment of the backend, where the user has not: nothing where it runs already, or where
    `JAXGRAY_BACKEND` is 0."""
    if os.environ.get(SWITCH) == "0" or runs_already():
        return
    widen()
    compile_sooner()
    run_sooner()


def runs_already() -> bool:
    """Whether the backend has started: it reads its environment no more, and processes begun later would read it."""
    asked = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", None)
    return bool(asked and asked())


def cores() -> int:
    """Cores that this process may use: those of the machine, or fewer where it has been given a share."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """Kind and features of the processor, where the system tells: compiled code holds its instructions."""
    features = platform.machine() + platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            features += next((line for line in file if line.startswith(("flags", "Features"))), "")
    except OSError:
        pass
    return features


def host_devices() -> int:
    """Devices into which `XLA_FLAGS` splits the CPU; 1 where it says nothing of them."""
    counts = re.findall(rf"--{DEVICES_FLAG}=(\d+)", os.environ.get("XLA_FLAGS", ""))
    return max(int(counts[-1]), 1) if counts else 1


def widen() -> None:
    """Ask for a pool of so many threads for each device where there are fewer cores, unless the user has set its size.

    Batched decompositions (LAPACK within jaxlib 0.9.2 and 0.10.1) share their batch with the pool and wait, each on a
    thread of that pool, until their share is done. Where as many of them run at once as there are threads, all wait for
    ever. Seen with two threads in a loop over batches, with four in two programs at once, and on four host devices.
    """
    wanted = LEAST_THREADS * host_devices()
    if cores() < wanted:
        os.environ.setdefault("NPROC", str(wanted))


def compile_sooner() -> None:
    """Choose the former emitter of fused loops, where this release has both and the user has not chosen.

    It compiles the programs of a diagnosis in half of the time (18 s against 36 s), and they run as fast (sweep,
    refinement and diagnosis within 10 % either way; the Jacobian of a linear simulation loses 1.5 ms).
    """
    _add(EMITTER_FLAG, "false")


def run_sooner() -> None:
    """Have loops over samples compiled in one piece, where this release can and the user has not chosen.

    A run with added forces, 4096 samples of two coordinates, takes 0.8 ms in place of 5.6 ms, with its derivatives
    10.7 ms in place of 17 ms; sweep, refinement and batches are as fast either way.
    """
    _add(LOOP_FLAG, WHOLE_LOOPS)


def _add(flag: str, value: str) -> None:
    flags = os.environ.get("XLA_FLAGS", "").strip()
    # The first: the name of a file with flags.
    if (not flags or flags.startswith("-")) and flag not in flags and flags_are_known():
        os.environ["XLA_FLAGS"] = f"{flags} --{flag}={value}".strip()


def flags_are_known() -> bool:
    """Whether this release of jaxlib is among those whose flags were tried."""
    return EMITTER_VERSIONS[0] <= _release("jaxlib") < EMITTER_VERSIONS[1]


def _release(package: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in re.findall(r"\d+", importlib.metadata.version(package))[:2])
    except importlib.metadata.PackageNotFoundError:
        return ()
