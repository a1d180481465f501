"""What must be set before jax computes: 64-bit floats, a cache of what was compiled before, memory that is kept."""

import ctypes
import hashlib
import os
from pathlib import Path

from ..numerics.backend import processor

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of `mallopt` in glibc."""


def prepare(*, verbose: bool = False) -> None:
    """Turn on 64-bit floats and the compilation cache in the user's cache directory.

    **Arguments:** `verbose`: leave the messages of the compiler on; default off.
    """
    if not verbose:
        # The CPU backend calls it an error that cached code names features which are hints, not instructions.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    keep_memory()
    import jax

    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:
        folder = cache_folder()
        if folder is not None:
            jax.config.update("jax_compilation_cache_dir", str(folder))
            # Most of what is compiled is small, and together it takes as long as the large parts.
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def keep_memory() -> None:
    """Have the C library keep memory that is freed, for the next array, where it can be told so.

    By default glibc gives every large array back to the system, which clears the pages of the next one: a tenth of
    the time of a diagnosis and more. Whoever has set a `MALLOC_` variable has chosen already.
    """
    if any(name.startswith("MALLOC_") for name in os.environ):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    for setting in (TRIM_THRESHOLD, MMAP_THRESHOLD):
        mallopt(setting, ctypes.c_int(2**31 - 1))


def cache_folder() -> Path | None:
    """`jaxgray/xla` in the user's cache directory, one folder a kind of processor; None where not writable.

    Compiled code holds the instructions of the processor it was made on, and a home directory may be shared.
    """
    return user_cache("xla", hashlib.sha256(processor().encode()).hexdigest()[:12])


def user_cache(*parts: str) -> Path | None:
    """A folder below `jaxgray` in the user's cache directory, made if it is not there; None where not writable."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(base).joinpath("jaxgray", *parts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
