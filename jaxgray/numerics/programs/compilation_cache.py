"""JAX's compilation cache in a folder of the user's alone, its entries written whole and read only where a digest fits.

JAX writes entries in place and never again: one that a full disk has cut short stays, and costs a warning and a
compilation in every process from then on.
"""

import hashlib
import os
from pathlib import Path

from .backend import processor
from .kept_files import private_folder, read_kept, write_kept


def keep_compiled(folder: Path | None) -> None:
    """Have JAX keep what it compiles below a folder, one folder a kind of processor, unless the user chose a place.

    Compiled code holds the instructions of the processor it was made on, and a home directory may be shared.

    **Arguments:** `folder`: None keeps nothing.

    **Raises:** `NotPrivate` where others can change the folder.
    """
    import jax

    if folder is None or jax.config.jax_compilation_cache_dir is not None or not _checked():
        return
    try:
        own = private_folder(folder / hashlib.sha256(processor().encode()).hexdigest()[:12])
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", os.fspath(own))
    # Most of what is compiled is small, and together it takes as long as the large parts.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _checked() -> bool:
    """Have JAX make its cache of checked entries; whether this release lets itself be told (0.9.2 to 0.12.0 do)."""
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface
    except ImportError:
        return False
    if not hasattr(compilation_cache, "get_file_cache"):
        return False

    class Checked(CacheInterface):
        """Entries by key."""

        def __init__(self, path: str):
            self._path = Path(path)

        def get(self, key: str) -> bytes | None:
            return read_kept(self._path / key)

        def put(self, key: str, value: bytes) -> None:
            write_kept(self._path / key, value)

    compilation_cache.get_file_cache = lambda path: (Checked(path), path)
    return True
