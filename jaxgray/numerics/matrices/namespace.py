"""One text of the mathematics for both kinds of arrays: NumPy's on the host, jax's in traced code.

Outside a compiled function every single operation of jax is a program of its own, traced, lowered and loaded at its
first use in a process: twenty milliseconds each, for matrices of four entries. What is small and runs on the host
is therefore handed NumPy arrays, and stays there.
"""

import jax
import jax.numpy as jnp
import numpy as np


def namespace(*values):
    """`numpy`, or `jax.numpy` where any of the values is an array of jax's (traced ones included)."""
    return jnp if any(isinstance(value, jax.Array) for value in values) else np
