"""What every row shares: data from SciPy (tests/independent.py), errors, bounds, and children for long campaigns."""

import concurrent.futures
import multiprocessing
import os
import pathlib
import sys
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import independent as data  # noqa: E402

import jaxgray  # noqa: E402

warnings.simplefilter("ignore", jaxgray.RecordWarning)

H = data.REFERENCE_TIME
TRUTH = tuple(data.REFERENCE.values())
PAPER = {"time_constants": 0.15, "block_rows": 10}
NAMES = ("M", "D", "K")


def identified(record, **options):
    found = jaxgray.identify(record, **options)
    return found, data.relative_errors((found.mass, found.damping, found.stiffness), TRUTH)


def show(title, figures):
    print(f"{title:58s}" + "  ".join(f"{n} {v:.5f}" for n, v in zip(NAMES, figures)), flush=True)


def in_children(function, chunks):
    """function(*chunk) of every chunk, each in a process of its own.

    Compiled programs keep memory maps, of which a process may have 65 530.
    """
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        return [pool.submit(function, *chunk).result() for chunk in chunks]


def ratio_of(errors, norms):
    """RMS error over RMS bound."""
    return np.sqrt(np.mean(np.square(errors), axis=0)) / np.sqrt(np.mean(np.square(norms), axis=0))


def bound(u, *, noise=data.REFERENCE_NOISE, kept=None, records=None):
    """Cramér-Rao bound of the entries (upper triangles of M, D, K), initial state and offsets estimated too.

    Sensitivities by central differences of the independent simulator.
    """
    information = 0.0
    for inputs in records or [u]:
        mask = np.ones((len(inputs), 2)) if kept is None else kept
        J = (data.sensitivities(TRUTH, inputs, H) * mask[..., None]).reshape(-1, 15) / noise
        I = J.T @ J
        information = information + I[:9, :9] - I[:9, 9:] @ np.linalg.solve(I[9:, 9:], I[9:, :9])
    return np.linalg.inv(information)


def bound_norms(covariance):
    """RMS relative Frobenius error at the bound; off-diagonal entries count twice."""
    twice = np.tile([1.0, 2.0, 1.0], 3) * np.diag(covariance)
    return np.sqrt(twice.reshape(3, 3).sum(axis=1)) / [np.linalg.norm(X) for X in TRUTH]
