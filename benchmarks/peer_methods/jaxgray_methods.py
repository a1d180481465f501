"""jaxgray's own rows: the subspace start alone, and `identify` as it is called."""

import importlib.metadata
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from physical import GUESS  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.identification.initialization.start import StartOptions, subspace_starts  # noqa: E402
from jaxgray.identification.refinement.refine import refine  # noqa: E402
from jaxgray.identification.setup.options import drive_of  # noqa: E402
from jaxgray.identification.setup.prediction import Batch, Setting  # noqa: E402
from jaxgray.identification.setup.preparation import prepare, scaling_of  # noqa: E402
from jaxgray.identification.subspace.projection import MOESP  # noqa: E402
from jaxgray.identification.subspace.realization import ExactMap  # noqa: E402
from jaxgray.numerics.programs.runtime import ready  # noqa: E402

warnings.simplefilter("ignore", jaxgray.RecordWarning)
ready()
VERSION = f"jaxgray {importlib.metadata.version('jaxgray')} (jax {jax.__version__})"
TIME_CONSTANT, BLOCK_ROWS = 0.04, 10
"""τ [s] and i in the middle of the broad optimum."""


def _prepared(u, y, h):
    record = jaxgray.Record(u, y, h)
    scaling = scaling_of([record])
    drive = drive_of(record, "force", None, False).scaled(scaling.coordinates, scaling.inputs, h)
    return prepare(record, scaling), scaling, Setting(drive, record.measured, record.hold)


def _start(u, y, h, source):
    signals, scaling, setting = _prepared(u, y, h)
    options = StartOptions(np.array([TIME_CONSTANT]), (BLOCK_ROWS,), MOESP(), ExactMap(), source, None)
    start = subspace_starts([signals], setting, h, options)[0]
    return scaling.matrices_out(*start.matrices), f"τ = {TIME_CONSTANT} s, i = {BLOCK_ROWS}, input matrix: {source}"


def start(u, y, h):
    """Record to M, D, K at given τ and i, as `identify` starts; no refinement, no error bars, no tests."""
    return _start(u, y, h, "best")


def start_from_factor(u, y, h):
    return _start(u, y, h, "factor")


def start_identified(u, y, h):
    """The same by the public call, with preflight, error bars and residual tests."""
    found = jaxgray.identify(jaxgray.Record(u, y, h), refine=False, time_constants=TIME_CONSTANT, block_rows=BLOCK_ROWS)
    return (found.mass, found.damping, found.stiffness), f"τ = {TIME_CONSTANT} s, i = {BLOCK_ROWS}"


def identify(u, y, h):
    found = jaxgray.identify(jaxgray.Record(u, y, h))
    return (found.mass, found.damping, found.stiffness), "τ and i by search; no start needed"


def refine_guess(u, y, h):
    """The refinement alone, from the guess that the gray-box peers start from."""
    signals, scaling, setting = _prepared(u, y, h)
    matrices = tuple(jnp.asarray(X) for X in scaling.matrices_in(*GUESS))
    found = refine(matrices, Batch.of([signals]), setting)
    return scaling.matrices_out(found.mass, found.damping, found.stiffness), f"{sum(found.steps)} steps"


METHODS = {
    "jaxgray-start": start,
    "jaxgray-start-factor": start_from_factor,
    "jaxgray-start-identify": start_identified,
    "jaxgray-identify": identify,
    "jaxgray-refine": refine_guess,
}
