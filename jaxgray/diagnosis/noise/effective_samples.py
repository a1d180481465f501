"""How many independent samples a correlated residual is worth."""

import numpy as np
from jaxtyping import Float

from ...numerics.responses.filters import correlation

LAGS = 100


def independent_share(e: Float[np.ndarray, "rows channels"]) -> float:
    """Share of rows that count as independent: 1/Σ ρ_k² over all lags of their correlation, mean over the channels."""
    sums = []
    for x in e.T:
        lags = min(LAGS, len(x) // 4)
        full = correlation(x, x, lags)[lags:]
        rho = full[1:] / max(full[0], 1e-300)
        # A correlation estimated from so many rows is this large by chance alone.
        sums.append(1 + 2 * max(float(np.sum(rho**2)) - lags / len(x), 0.0))
    return 1.0 / float(np.mean(sums))
