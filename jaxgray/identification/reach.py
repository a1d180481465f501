"""Whether every output is moved by the inputs at all, before any model."""

import numpy as np
import scipy.signal
import scipy.stats

from ..numerics.outcomes import RESULTS, ComputationError
from .preparation import Signals

_POLES = (0.5, 0.9, 0.98)
_ORDERS = 6


def check_reach(signals: list[Signals], input_names, output_names, *, significance: float = 0.01) -> None:
    """Raise where no linear system driven by the inputs explains anything of an output.

    Outputs are regressed on Laguerre-filtered inputs; an F-test against an AR-whitened residual tells whether
    they explain more than chance.

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
            x = scipy.signal.lfilter([1.0 - a], [1.0, -a], u - u.mean(axis=0), axis=0)
            for _ in range(_ORDERS):
                features.append(x)
                x = scipy.signal.lfilter([-a, 1.0], [1.0, -a], x, axis=0)
        table = np.concatenate(features, axis=1)
        for k in range(outputs):
            unexplained[k] &= not _explains(table, y[:, k], significance)
    if np.any(unexplained):
        names = ", ".join(name for name, lost in zip(output_names, unexplained) if lost)
        raise ComputationError(
            RESULTS.unreachable,
            stage="raw record",
            detail=f"input {', '.join(input_names)} does not reach coordinate {names}: nothing in its motion follows "
            "the input",
        )


def _explains(table: np.ndarray, y: np.ndarray, significance: float) -> bool:
    # Differences whiten slow motion enough for a first look; free decay and drift then count for little.
    table, y = np.diff(table, axis=0), np.diff(y)
    table = np.concatenate([np.ones((len(y), 1)), table], axis=1)
    U, s, _ = np.linalg.svd(table / np.maximum(np.linalg.norm(table, axis=0), 1e-300), full_matrices=False)
    U = U[:, s > 1e-9 * s[0]]
    if len(y) <= 2 * U.shape[1]:
        return True
    y = y - y.mean()
    taken = float(np.sum((U.T @ y) ** 2))
    left = max(float(y @ y) - taken, 0.0)
    if left <= 1e-12 * taken:
        return True
    # Differenced white noise is coloured: its spectrum reaches twice the mean, which bounds the statistic.
    statistic = taken / U.shape[1] / (2 * left / (len(y) - U.shape[1]))
    return bool(scipy.stats.f.sf(statistic, U.shape[1], len(y) - U.shape[1]) < significance)
