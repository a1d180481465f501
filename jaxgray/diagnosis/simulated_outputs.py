"""A simulation of which only the outputs are known: the model whose motion they are stands in for it.

What a simulation gets wrong is the difference of two models, that of its outputs and that of the measured ones. The
first is found as any other, in outputs without noise, and must account for all of them; then it is judged on the
measured record as a model of the user's own: which of its numbers are off, and which laws it lacks.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..mechanics.model import MechanicalModel
from ..numerics.outcomes import RESULTS, ComputationError
from ..records import Record
from .findings import SimulatedOutputs
from .result import Diagnosis

NOISE = 1e-3
"""Noise that is added to simulated outputs, relative to their motion: what a solver's tolerance, rounding or a hold
that differs leave is smaller, and no law is asked to explain it."""

REPRODUCED = 5e-3
"""Error of the model that stands in, relative to the motion of an output, up to which it is the simulation's."""


def as_if_measured(record: Record, simulated: Float[np.ndarray, "samples outputs"], seed: int) -> Record:
    """The record with simulated outputs in the place of the measured ones, and a little noise.

    **Arguments:** `record`: measured; `simulated`: what a simulation gives for the same inputs; `seed` of the noise.

    **Raises:** `ValueError` where they are no finite numbers of that shape, or one does not move.
    """
    y = np.asarray(simulated, dtype=float)
    y = y[:, None] if y.ndim == 1 else y
    if y.shape != record.y.shape:
        raise ValueError(f"simulated has shape {y.shape}, the measured outputs have {record.y.shape}; give as many.")
    if not np.all(np.isfinite(y)):
        at = tuple(int(k) for k in np.argwhere(~np.isfinite(y))[0])
        raise ValueError(f"simulated[{at[0]}, {at[1]}] is {y[at]}; a simulation gives a number at every sample.")
    size = y.std(axis=0)
    if not np.all(size > 0):
        still = record.output_names[int(np.argmin(size))]
        raise ValueError(f"the simulated {still} does not move; give outputs that do.")
    noise = NOISE * size * np.random.default_rng(seed).standard_normal(y.shape)
    return dataclasses.replace(record, y=y + noise)


def stand_in(found: Diagnosis) -> tuple[MechanicalModel, SimulatedOutputs]:
    """The model of simulated outputs, and how near it is.

    **Arguments:** `found`: the diagnosis of the simulated outputs.

    **Raises:** `ComputationError` where no laws reproduce them, with the output and how much is left.
    """
    summary = found.baseline if found.extended is None else found.extended
    left = {}
    for names, records in (("estimation", found.records), ("validation", found.validation_records)):
        for k, (name, error) in enumerate((summary.rmse.get(names) or {}).items()):
            size = np.sqrt(np.mean([np.nanvar(record.y[:, k]) for record in records]))
            share = np.inf if error is None else np.sqrt(max(error**2 - (NOISE * size) ** 2, 0.0)) / size
            left[name] = max(left.get(name, 0.0), float(100 * share))
    worst = max(left, key=left.__getitem__)
    if left[worst] > 100 * REPRODUCED:
        size = f"{left[worst]:.2g} % of the motion of {worst}" if np.isfinite(left[worst]) else f"{worst} as a whole"
        detail = f"M, D, K with laws of the catalogue leave {size}, and at most {100 * REPRODUCED:g} % may be left"
        raise ComputationError(RESULTS.not_reproduced, stage="simulated outputs", detail=detail)
    laws = tuple(finding for finding in found.findings if finding.stage == "model" and finding.effect != "unexplained")
    return summary.model, SimulatedOutputs(laws, left)
