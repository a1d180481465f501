"""Triangular factors of chunks, made without knowing the filters' states at their starts, and joined exactly after.

A chunk is filtered from rest, and the factor R of its rows has the responses p(t) = A^t b of the cascade to an impulse
among its columns. The cascade being the same for every signal and A lower triangular Toeplitz, what a state x at the
start would have added to filter j, (A^t x)_j, is T(x) T(b)⁻¹ p(t), T(·) the lower triangular Toeplitz matrix of a
vector. So the rows that one pass over the whole record would have made are those of the chunk times a matrix that is
known once the state is, R_true = R S(x), and the states follow from chunk to chunk, x⁺ = A^n x + r. Factors that are
corrected in this way are joined by QR, two at a time.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ...identification.setup.padding import CHUNK_BLOCKS
from ...identification.subspace.compression import RANK_TOLERANCE, FactorState, absorb, begin
from ...identification.subspace.correlation import add_samples, gram, no_moments
from ...identification.subspace.filter_bank import cascade
from ...numerics.responses.lifting import BLOCK
from .source import Source

STEP = 2**14
"""Samples that are correlated at a time."""

LEAST_PIVOT = 1e-5
"""Smallest squared pivot, relative, from which correlations are as exact as filtered rows: rounding grows with its
inverse."""


@dataclass(frozen=True)
class Part:
    """What a chunk leaves, for every time constant.

    `factor` of its rows [responses to an impulse | 1 | f_0 | f_1 | …]; `states` of the filters at its end, from rest at
    its start; `sums` and `squares` of the signals; `samples`.
    """

    factor: Float[np.ndarray, "time_constants columns columns"]
    states: Float[np.ndarray, "time_constants orders signals"]
    sums: Float[np.ndarray, " signals"]
    squares: Float[np.ndarray, " signals"]
    samples: int


@dataclass(frozen=True)
class Chunk:
    """What a worker reduces: `source`, `first` sample and `count`; `poles`, `block_rows`; `level` and `sizes` of the
    signals, taken off and divided by; `householder`: filter the rows in any case; `index` of the chunk."""

    source: Source
    first: int
    count: int
    poles: tuple[float, ...]
    block_rows: int
    level: tuple[float, ...]
    sizes: tuple[float, ...]
    householder: bool
    index: int


_add = jax.jit(add_samples)
_gram = jax.jit(gram)
_absorb = jax.jit(absorb)


def reduced(chunk: Chunk) -> tuple[int, Part]:
    """The part of one chunk; runs on a worker."""
    jax.config.update("jax_enable_x64", True)
    signals = (chunk.source.read(chunk.first, chunk.count) - np.array(chunk.level)) / np.array(chunk.sizes)
    poles = jnp.asarray(chunk.poles)
    made = None if chunk.householder else _by_correlations(signals, poles, chunk.block_rows)
    factor, states = _by_rows(signals, poles, chunk.block_rows) if made is None else made
    part = Part(factor, states, signals.sum(axis=0), (signals**2).sum(axis=0), len(signals))
    return chunk.index, part


def _by_correlations(signals, poles, block_rows: int):
    """Factors from Gram matrices; None where the columns are too nearly dependent for these."""
    moments = no_moments(poles, signals.shape[1], block_rows)
    for first in range(0, len(signals), STEP):
        piece = signals[first : first + STEP]
        kept = (np.arange(STEP) < len(piece)).astype(float)
        moments = _add(moments, poles, np.pad(piece, ((0, STEP - len(piece)), (0, 0))), kept)
    factors = []
    for G in np.asarray(_gram(moments, poles)):
        size = np.sqrt(np.diag(G))
        scale = np.where(size > 0, size, 1.0)
        try:
            upper = np.linalg.cholesky(G / scale[:, None] / scale).T
        except np.linalg.LinAlgError:
            return None
        if not np.min(np.diag(upper)) ** 2 > LEAST_PIVOT:
            return None
        factors.append(upper * scale)
    return np.array(factors), np.asarray(moments.states)[:, :, :-1]


def _by_rows(signals, poles, block_rows: int):
    """Factors by filtering the rows and reducing them, exact for dependent columns."""
    size = CHUNK_BLOCKS * BLOCK
    length = -(-min(len(signals), STEP) // size) * size
    factors, states = [], []
    for a in poles:
        state = begin(a, signals.shape[1], block_rows)
        for first in range(0, len(signals), length):
            piece = signals[first : first + length]
            whole = len(piece) == length
            kept = (np.arange(length) < len(piece)).astype(float)
            after = _absorb(state, a, jnp.asarray(np.pad(piece, ((0, length - len(piece)), (0, 0)))), kept)
            # Beyond the last sample the filters go on; their state is taken at that sample.
            filters = after.filters if whole else _moved(state.filters[:, :-1], float(a), piece)
            state = FactorState(filters, after.accumulated)
        factors.append(np.asarray(state.accumulated))
        states.append(np.asarray(state.filters)[:, : signals.shape[1]])
    return np.array(factors), np.array(states)


def _moved(states, a: float, signals: np.ndarray) -> np.ndarray:
    """States of the filters after some samples."""
    A, b = (np.asarray(x) for x in cascade(a, states.shape[0]))
    x = np.asarray(states)
    for row in signals:
        x = A @ x + np.outer(b, row)
    return x


@functools.cache
def _cascade(a: float, orders: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, b, and the inverse of T(b)."""
    A, b = (np.asarray(x) for x in cascade(a, orders))
    return A, b, (np.eye(orders) + a * np.eye(orders, k=-1)) / np.sqrt(1 - a * a)


def _lower(x: np.ndarray) -> np.ndarray:
    return scipy.linalg.toeplitz(x, np.zeros(len(x)))


class Seam:
    """States of all filters between two chunks: of the signals, and of the response to the record's first state.

    **Arguments:** `poles`; `orders` of the cascade; `signals`.
    """

    def __init__(self, poles: tuple[float, ...], orders: int, signals: int):
        self._poles, self._orders, self._count = poles, orders, signals
        self._states = np.zeros((len(poles), orders, signals))
        self._impulse = np.array([_cascade(a, orders)[1] for a in poles])

    def joined(self, part: Part) -> Float[np.ndarray, "time_constants columns columns"]:
        """The part's factors as one pass over the whole record would have made them; the seam moves to its end."""
        factors = []
        for k, a in enumerate(self._poles):
            A, _, inverse = _cascade(a, self._orders)
            R = part.factor[k]
            first = R[:, : self._orders]
            true = R.copy()
            true[:, : self._orders] = first @ (_lower(self._impulse[k]) @ inverse).T
            for c in range(self._count):
                places = self._orders + 1 + self._count * np.arange(1, self._orders + 1) + c
                true[:, places] += first @ (_lower(self._states[k, :, c]) @ inverse).T
            factors.append(np.linalg.qr(true, mode="r"))
            power = np.linalg.matrix_power(A, part.samples)
            self._states[k] = power @ self._states[k] + part.states[k]
            self._impulse[k] = power @ self._impulse[k]
        return np.array(factors)


class Tree:
    """Factors joined two at a time, those of equally many chunks with each other; a handful are kept."""

    def __init__(self):
        self._levels: list[tuple[int, np.ndarray]] = []

    def add(self, factors: Float[np.ndarray, "time_constants columns columns"]) -> None:
        """One more chunk's."""
        level = 0
        while self._levels and self._levels[-1][0] == level:
            factors = _stacked(self._levels.pop()[1], factors)
            level += 1
        self._levels.append((level, factors))

    def whole(self) -> Float[np.ndarray, "time_constants columns columns"]:
        """That of all chunks."""
        found = self._levels[-1][1]
        for _, factors in self._levels[-2::-1]:
            found = _stacked(factors, found)
        return found


def _stacked(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    return np.array([np.linalg.qr(np.vstack(pair), mode="r") for pair in zip(above, below)])


def trusted(pivots: np.ndarray) -> np.ndarray:
    """Which factors have independent columns."""
    return pivots > RANK_TOLERANCE**2
