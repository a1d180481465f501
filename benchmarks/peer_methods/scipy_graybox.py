"""A gray-box fit as one would tune it in SciPy: `least_squares` over an exact, vectorised simulation.

The sampled model is diagonalised, so that a run is one first-order `lfilter` a conjugate pair of modes; Cholesky
factors keep M, D and K physical and every run stable; the Jacobian comes from differences of that run in their nine
entries, and is exact in the first state and the offsets, which enter linearly.
"""

import numpy as np
import scipy
import scipy.optimize
import scipy.signal
from physical import ENTRIES, GUESS, continuous

VERSION = f"scipy {scipy.__version__}"
STEP = 1e-6


def matrices_of(factors):
    """M, D, K from three lower triangles, row by row as (0,0), (1,0), (1,1)."""
    lower = [np.array([[a, 0.0], [b, c]]) for a, b, c in factors.reshape(3, 3)]
    return tuple(L @ L.T for L in lower)


def modes(factors, h):
    """Sampled poles, rows from input and first state, and output columns: one of every conjugate pair, taken twice."""
    A, B = continuous(*matrices_of(factors))
    values, vectors = np.linalg.eig(A)
    inverse = np.linalg.inv(vectors)
    kept = values.imag >= 0
    twice = np.where(values.imag > 0, 2.0, 1.0)
    z = np.exp(values * h)
    held = ((z - 1) / values)[:, None] * (inverse @ B)
    return z[kept], held[kept], inverse[kept], vectors[:2, kept] * twice[kept]


def run(factors, first, u, h):
    """Displacements under held inputs from a first state."""
    z, held, inverse, columns = modes(factors, h)
    drives = u @ held.T
    begin = inverse @ first
    y = np.zeros((len(u), 2))
    for k, pole in enumerate(z):
        state, _ = scipy.signal.lfilter([0.0, 1.0], [1.0, -pole], drives[:, k], zi=begin[k : k + 1])
        y += state.real[:, None] * columns[:, k].real - state.imag[:, None] * columns[:, k].imag
    return y


def free(factors, samples, h):
    """Displacements from each unit first state; samples × outputs × states."""
    z, _, inverse, columns = modes(factors, h)
    powers = z ** np.arange(samples)[:, None]
    table = (columns.T[:, :, None] * inverse[:, None, :]).reshape(len(z), -1)
    return (powers.real @ table.real - powers.imag @ table.imag).reshape(samples, 2, 4)


def fit(u, y, h):
    samples, outputs = y.shape
    size = y.std(axis=0)
    offsets = np.broadcast_to(np.eye(outputs), (samples, outputs, outputs))
    start = np.concatenate([[np.linalg.cholesky(X)[k[::-1]] for k in ENTRIES] for X in GUESS])
    scale = np.repeat([np.sqrt(np.max(np.abs(X))) for X in GUESS], 3)

    def residual(theta):
        return ((run(theta[:9] * scale, theta[9:13], u, h) + theta[13:] - y) / size).ravel()

    def jacobian(theta):
        here = residual(theta)
        columns = [(residual(theta + STEP * row) - here) / STEP for row in np.eye(15)[:9]]
        linear = np.concatenate([free(theta[:9] * scale, samples, h), offsets], axis=2) / size[:, None]
        return np.column_stack([*columns, linear.reshape(-1, 6)])

    theta = np.concatenate([start / scale, np.zeros(6)])
    found = scipy.optimize.least_squares(residual, theta, jacobian, method="lm", xtol=1e-9, ftol=1e-9)
    if not found.success:
        raise RuntimeError(found.message)
    return matrices_of(found.x[:9] * scale), f"{found.njev} Jacobians"


METHODS = {"scipy": fit}
