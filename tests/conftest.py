"""Set-up that every test needs: 64-bit floats, enough threads, a compilation cache."""

import os

os.environ.setdefault("NPROC", "4")

import jax

jax.config.update("jax_enable_x64", True)
