"""What must be set before jax computes: 64-bit floats, a cache of what was compiled before, memory that is kept."""

import ctypes
import os
import sys
from pathlib import Path

from ..numerics.programs.compilation_cache import keep_compiled
from ..numerics.programs.kept_files import NotPrivate, private_folder

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Of `mallopt` in glibc."""


def prepare(*, verbose: bool = False, quiet: bool = False) -> None:
    """Turn on 64-bit floats and the compilation cache in the user's cache directory.

    A cache directory that others can change is left alone, and said so on the error stream: nothing is kept then.

    **Arguments:** `verbose`: leave the messages of the compiler on; default off. `quiet`: no warning; default off.
    """
    if not verbose:
        # The CPU backend calls it an error that cached code names features which are hints, not instructions.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    keep_memory()
    import jax

    jax.config.update("jax_enable_x64", True)
    from ..numerics.programs.stored_programs import programs_folder

    try:
        keep_compiled(user_cache("xla"))
        if jax.config.jax_compilation_cache_dir is not None:
            # One of the user's choice serves jax as it is, and programs where nobody else can change it.
            programs_folder(jax.config.jax_compilation_cache_dir)
    except NotPrivate as refused:
        if not quiet:
            print(f"warning: {refused}: what is compiled is not kept.", file=sys.stderr)


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


def user_cache(*parts: str) -> Path | None:
    """A folder below `jaxgray` in the user's cache directory, made for the user alone if it is not there.

    **Returns:** the folder; None where there is no home, or one that cannot be written.

    **Raises:** `NotPrivate` where others can change it.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    # As the specification of these variables has it, a relative path does not count.
    if not os.path.isabs(base):
        base = os.path.join(os.path.expanduser("~"), ".cache")
    if not os.path.isabs(base):
        return None
    try:
        return private_folder(Path(base).joinpath("jaxgray", *parts))
    except OSError:
        return None
