"""The suite with its numbers shaken: another machine's rounding, made on this one.

`JAXGRAY_SHAKEN=1e-13 python -m pytest` multiplies every sample that `identify`, `identify_many` and `diagnose` are
called with by 1 + 1e-13 ξ, ξ between −1 and 1; `JAXGRAY_SHAKEN_SEED=1` (2, …) draws other ξ. ξ depends on the value
of the sample alone: equal samples stay equal (a repeated, clipped or constant one is still found), and two calls with
the same record see the same numbers. A test that passes only without hangs on the last digits of one machine.

`XLA_FLAGS=--xla_cpu_max_isa=SSE4_2` (AVX, AVX2) in the environment compiles for older processors: `conftest` keeps the
flags of the environment. `taskset -c 0` before the command leaves one core, on which nothing runs side by side. (Not
`NPROC=1`: batched decompositions wait for ever on a pool of one thread, see `numerics/programs/backend.py`.) All of
these can be combined.
"""

import dataclasses
import functools
import os
import sys
import threading

import numpy as np

import jaxgray

SWITCH, SEED = "JAXGRAY_SHAKEN", "JAXGRAY_SHAKEN_SEED"

_inside = threading.local()


def shaken_values(x: np.ndarray, size: float, seed: int = 0) -> np.ndarray:
    """Values with relative noise of a size, equal where they were; zero and what is not finite as they are."""
    with np.errstate(over="ignore"):
        bits = np.ascontiguousarray(x, dtype=float).view(np.uint64) + np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
        # The finaliser of splitmix64: neighbouring values get unrelated noise.
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    noise = (bits >> np.uint64(11)).astype(float) / 2.0**52 - 1.0
    return np.where(np.isfinite(x), np.where(np.isfinite(x), x, 0.0) * (1.0 + size * noise), x)


def shaken(records, size: float, seed: int = 0):
    """A record, or a list of them, with all samples shaken; anything else as it is."""
    if isinstance(records, list | tuple):
        return type(records)(shaken(one, size, seed) for one in records)
    if not isinstance(records, jaxgray.Record):
        return records
    u, y = shaken_values(records.u, size, seed), shaken_values(records.y, size, seed)
    return dataclasses.replace(records, u=u, y=y)


def shake_everything(size: float, seed: int = 0) -> None:
    """From now on all that is identified or diagnosed is shaken first, once; modules of the package that are imported
    later get the same functions."""

    def shaking(function):
        @functools.wraps(function)
        def called(record, *rest, **options):
            if getattr(_inside, "shaken", False):
                return function(record, *rest, **options)
            _inside.shaken = True
            try:
                if "validation" in options:
                    options["validation"] = shaken(options["validation"], size, seed)
                return function(shaken(record, size, seed), *rest, **options)
            finally:
                _inside.shaken = False

        return called

    for name in ("identify", "identify_many", "diagnose"):
        plain = getattr(jaxgray, name)
        other = shaking(plain)
        for module in [m for n, m in sys.modules.items() if n.split(".")[0] == "jaxgray"]:
            for attribute, value in list(vars(module).items()):
                if value is plain:
                    setattr(module, attribute, other)


def shake_if_asked() -> None:
    """Shake as the environment says."""
    size = float(os.environ.get(SWITCH, "0"))
    if size:
        shake_everything(size, int(os.environ.get(SEED, "0")))
