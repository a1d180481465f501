"""Whether every output is moved by the inputs at all, before any model."""

import numpy as np
import scipy.special

from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.responses.filters import filtered
from ..setup.preparation import Signals
from .residuals import AR_ORDER, ar_coefficients

_POLES = (0.8, 0.97)
_ORDERS = 4

AVERAGED = (1, 4, 16)
"""Numbers of samples that are averaged into one before the test: whitening leaves little but the noise of a slow motion
that is sampled fast."""

HIDDEN_SHARE = 0.02
"""Share of an output's power that the test must be able to see; shorter records are given the benefit of doubt."""


def check_reach(signals: list[Signals], input_names, output_names, *, significance: float = 0.05) -> None:
    """Raise where no linear system driven by the inputs explains anything of an output.

    Outputs are regressed on Laguerre-filtered inputs, sample by sample and in averages; an F-test against an
    AR-whitened residual tells whether they explain more than chance.

    **Arguments:** `signals`: scaled records without gaps; `input_names`, `output_names`: for the message;
    `significance`: probability with which an unreached output passes.

    **Raises:** `ComputationError` (unreachable), naming the outputs.
    """
    outputs = signals[0].y.shape[1]
    unexplained = np.ones(outputs, bool)
    for record in signals:
        n = record.samples
        u, y = np.asarray(record.u)[:n], np.asarray(record.y)[:n]
        features = []
        for a in _POLES:
            x = filtered([1.0 - a], [1.0, -a], u - u.mean(axis=0), axis=0)
            for _ in range(_ORDERS):
                features.append(x)
                x = filtered([-a, 1.0], [1.0, -a], x, axis=0)
        table = np.concatenate(features, axis=1)
        if _few(table.shape[1], n):
            return
        for count in AVERAGED:
            slow, motion = _averages(table, count), _averages(y, count)
            for k in np.flatnonzero(unexplained):
                unexplained[k] = not _explains(slow, motion[:, k], significance / len(AVERAGED))
    if np.any(unexplained):
        names = ", ".join(name for name, lost in zip(output_names, unexplained) if lost)
        raise ComputationError(
            RESULTS.unreachable,
            stage="raw record",
            detail=f"input {', '.join(input_names)} does not reach coordinate {names}: nothing in its motion follows "
            "the input",
        )


def _few(features: int, samples: int) -> bool:
    """Whether the test could miss so much that nothing should be concluded from it."""
    return (features + 4 * np.sqrt(2 * features) + 10) / samples > HIDDEN_SHARE


def _averages(X: np.ndarray, count: int) -> np.ndarray:
    """Means of so many samples each, in turn."""
    whole = len(X) // count
    return X[: whole * count].reshape(whole, count, X.shape[1]).mean(axis=1)


def _explains(table: np.ndarray, y: np.ndarray, significance: float) -> bool:
    # Under the null y is noise alone: whitened by its own AR model, the statistic has its textbook distribution.
    coefficients = ar_coefficients(y - y.mean())
    columns = np.concatenate([table, np.ones((len(y), 1)), y[:, None]], axis=1)
    columns = filtered(coefficients, [1.0], columns, axis=0)[AR_ORDER:]
    table, y = columns[:, :-1], columns[:, -1]
    U, s, _ = np.linalg.svd(table / np.maximum(np.linalg.norm(table, axis=0), 1e-300), full_matrices=False)
    U = U[:, s > 1e-9 * s[0]]
    count = U.shape[1]
    taken = float(np.sum((U.T @ y) ** 2))
    left = max(float(y @ y) - taken, 0.0)
    if left <= 1e-12 * taken:
        return True
    statistic = taken / count / (left / (len(y) - count))
    return bool(scipy.special.fdtrc(count, len(y) - count, statistic) < significance)
