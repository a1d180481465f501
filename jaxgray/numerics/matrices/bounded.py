"""What an iteration asks of a trial before it computes with it."""

import numpy as np

LARGEST = 1e100
"""Values up to which the product of three is a number."""


def bounded(*arrays: np.ndarray) -> bool:
    """Whether all values (on the host) are finite, and so are the squares and products that a step forms of them."""
    return all(bool(np.all(np.abs(x) <= LARGEST)) for x in arrays)
