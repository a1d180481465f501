"""Lengths that records are padded to: few, so that little is compiled."""

import numpy as np

from ...numerics.responses.lifting import BLOCK

CHUNK_BLOCKS = 32
"""Blocks filtered at a time; the chunk's rows stay in cache."""

LEAST_STEP = 1
"""Chunks by which the lengths that records are padded to differ at least; more where records of many lengths are each
computed with once, and compiling takes longer."""


def padded_samples(samples: int) -> int:
    """A whole number of chunks, from a few sizes (steps of about 12 %), so that few lengths are compiled."""
    chunk = CHUNK_BLOCKS * BLOCK
    chunks = -(-samples // chunk)
    step = max(LEAST_STEP, 2 ** max(0, int(np.log2(chunks)) - 3))
    return -(-chunks // step) * step * chunk
