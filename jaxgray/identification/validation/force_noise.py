"""Whether a residual is largest where the system answers forces, as if noise entered there."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from ...mechanics.systems.statespace import StateSpace
from .colour import PIECE, smooth_length


class ForceNoise(NamedTuple):
    """`chance`: probability that white noise of the sensors leaves a residual as large where the system answers forces;
    `samples`: independent samples of that answer; `shown`: how far noise at the forces as large as theirs would raise
    the statistic, in units of what it has by chance once in a hundred times, were M, D, K not bent to explain it."""

    chance: float
    samples: float
    shown: float


def force_noise(
    sensitivities: list[Float[np.ndarray, "samples outputs parameters"]],
    residuals: list[Float[np.ndarray, "samples outputs"]],
    response: Callable[[int], Complex[np.ndarray, "frequencies outputs inputs"]],
) -> ForceNoise:
    """Whether noise at the forces shows in a residual.

    Score test of the variance of white noise at the forces. Its statistic is eᵀRe for the covariance R that such noise
    gives to the outputs. White noise ε of the sensors leaves e = Pε, P = I − J(JᵀJ)⁻¹Jᵀ, so that noise is seen, too,
    which M, D, K were bent to explain: mean and variance of the statistic are tr RP and 2 tr (RP)².

    **Arguments:** `sensitivities` J of every record to all that was fitted, in units of the noise; `residuals` e
    likewise; both zero where samples are missing; `response`: of the outputs, in units of their noise, to forces, at a
    number of frequencies from 0 to half the sampling rate.

    **Returns:** a `ForceNoise`, by a scaled χ² of that mean and variance.

    **Reference:** Zhang & Lin (2003), *Hypothesis testing in semiparametric additive mixed models*, Biostatistics 4.
    """
    parameters = sensitivities[0].shape[2]
    statistic, trace, square = 0.0, 0.0, 0.0
    gram, weighed, twice = (np.zeros((parameters, parameters)) for _ in range(3))
    for J, e in zip(sensitivities, residuals):
        flat = J.reshape(-1, parameters)
        gram += flat.T @ flat
        # Of a long record a piece says enough.
        J, e = J[:PIECE], e[:PIECE]
        n, flat = len(e), J.reshape(-1, parameters)
        length = smooth_length(2 * n)
        F = response(length // 2 + 1)
        spectrum = F @ F.conj().transpose(0, 2, 1)
        rows = np.concatenate([J, e[:, :, None]], axis=2)
        through = np.fft.irfft(spectrum @ np.fft.rfft(rows, length, axis=0), length, axis=0)[:n]
        moved = through[:, :, :-1].reshape(-1, parameters)
        covariances = np.fft.irfft(spectrum, length, axis=0)[:n]
        pairs = np.sum(covariances**2, axis=(1, 2)) * (n - np.arange(n))
        statistic += np.sum(e * through[:, :, -1])
        trace += n * np.trace(covariances[0])
        square += 2 * np.sum(pairs) - pairs[0]
        weighed += flat.T @ moved
        twice += moved.T @ moved
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    inverse = scale[:, None] * np.linalg.pinv(gram * scale[:, None] * scale, rcond=1e-12, hermitian=True) * scale
    taken = inverse @ weighed
    variance = sum(np.sum(e**2) for e in residuals) / max(sum(e.size for e in residuals) - parameters, 1)
    mean = trace - np.trace(taken)
    spread = 2 * (square - 2 * np.sum(inverse * twice) + np.sum(taken * taken.T))
    if not (mean > 0 and spread > 0 and variance > 0):
        return ForceNoise(1.0, np.inf, np.inf)
    samples = float(2 * mean**2 / spread)
    # As large as that of the sensors it has twice their mean square, and its statistic by its own covariance.
    count = sum(e.size for e in residuals) - parameters
    shown = float((samples + count) / 2 / scipy.special.chdtri(samples, 0.01))
    return ForceNoise(float(scipy.special.chdtrc(samples, statistic / variance * samples / mean)), samples, shown)


def response_to_inputs(system: StateSpace, weights: Float[np.ndarray, "outputs outputs"], samples: int) -> Callable:
    """The weighted outputs' response to the inputs of a sampled system, as `force_noise` asks for it.

    Motions are made to fade over the record at least, as no peak shows narrower in it.
    """
    A, B, C, D = (np.asarray(X) for X in (system.A, system.B, system.C, system.D))

    def response(frequencies: int) -> Complex[np.ndarray, "frequencies outputs inputs"]:
        z = (1 + 1 / samples) * np.exp(1j * np.linspace(0, np.pi, frequencies))[:, None, None]
        return weights @ (C @ np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(B, (frequencies, *B.shape))) + D)

    return response
