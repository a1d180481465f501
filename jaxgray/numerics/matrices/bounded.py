"""What an iteration asks of a trial before it computes with it."""

import numpy as np
from jaxtyping import Float

LARGEST = 1e100
"""Values up to which, and down to the inverse of which, the product of three is a number."""


def bounded(*arrays: np.ndarray) -> bool:
    """Whether all values (on the host) are finite, and so are the squares and products that a step forms of them."""
    return all(bool(np.all(np.abs(x) <= LARGEST)) for x in arrays)


def column_sizes(table: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """Norms of the columns; 1 for one so small that the inverse of its square is no number: it shows nothing."""
    size = np.linalg.norm(table, axis=0)
    return np.where(size * LARGEST > 1.0, size, 1.0)
