"""Set-up that every test needs: 64-bit floats, enough threads, compilations shared by all workers."""

import os
import pathlib
import tempfile

os.environ.setdefault("NPROC", "4")
# The threads of BLAS and of jax would take the few cores from each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Cached binaries are announced at length on the terminal otherwise.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax

jax.config.update("jax_enable_x64", True)
cache = pathlib.Path(tempfile.gettempdir()) / f"jaxgray-tests-{os.getuid()}"
jax.config.update("jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(cache)))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
