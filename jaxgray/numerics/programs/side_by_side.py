"""Independent calls of compiled programs on all cores: such a program runs on one, and lets others run meanwhile."""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait

import jax

from .backend import cores

MOST = 4
"""Threads at most: beyond, memory is what they would wait for."""


_here = threading.local()


@functools.cache
def _pool(_: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="jaxgray")


def side_by_side(function: Callable, parts: Iterable) -> list:
    """What a function gives for each of some parts, in their order; where it calls this again, one after the other.

    **Arguments:** `function`; `parts`.

    **Raises:** what the function raises for the first part that fails, once all have ended.
    """
    parts = list(parts)
    if len(parts) < 2 or cores() < 2 or getattr(_here, "busy", False):
        return [function(part) for part in parts]
    wide = jax.config.jax_enable_x64

    def alike(part):
        _here.busy = True
        # What was set for the calling thread alone, another does not have.
        with contextlib.nullcontext() if jax.config.jax_enable_x64 == wide else jax.enable_x64(wide):
            return function(part)

    # A process that was forked has no threads of its parent.
    pool = _pool(os.getpid(), min(cores(), MOST))
    calls = [pool.submit(alike, part) for part in parts]
    # Where one fails, the others come to their end before the caller goes on: they work on what is its own.
    wait(calls)
    return [call.result() for call in calls]
