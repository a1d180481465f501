"""Set-up that every test needs: 64-bit floats, compilations shared by all workers."""

import os
import pathlib
import tempfile

# The threads of BLAS and of jax would take the few cores from each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Cached binaries are announced at length on the terminal otherwise.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# In the environment, so that commands and notebooks that tests start share it too.
cache = pathlib.Path(tempfile.gettempdir()) / f"jaxgray-tests-{os.getuid()}"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")

import jax  # noqa: E402

# Sets what the backend reads when it starts, for the processes that tests start too.
import jaxgray  # noqa: E402, F401

jax.config.update("jax_enable_x64", True)
