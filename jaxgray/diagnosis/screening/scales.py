"""Sizes in the record by which shapes of effects are chosen."""

import dataclasses

import numpy as np

from ...mechanics.effects.base import Scales
from ...mechanics.runs.extended import Plant, input_matrix_of
from ..model.candidate import Data
from ..model.simulator import natural_frequencies_hz
from .features import Motion

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Quantiles of a size that shapes are tried at."""


def scales_at(
    plant: Plant,
    motion: Motion,
    data: Data,
    input_names: tuple[str, ...],
    output_names: tuple[str, ...],
    lines_hz: tuple[float, ...],
    hidden: tuple[str, ...] = (),
) -> dict[tuple[str, str], Scales]:
    """Sizes in the record at every place: by kind of place (coordinate, input, output) and name; `hidden`: names of the
    coordinates that no output measures."""
    M, frequencies = np.asarray(plant.mass), tuple(natural_frequencies_hz(plant))
    n = data.samples
    u = data.u[:n]
    map_ = np.asarray(input_matrix_of(plant.drive))
    force = float(np.sqrt(np.mean((u @ map_.T) ** 2)))
    times = tuple(np.linspace(0.04, 0.96, 24) * n * data.sampling_time)

    def of(arm, u):
        q, v = motion.q[:n] @ arm, motion.v[:n] @ arm
        size = np.abs(u)
        return Scales(
            root_mean_square(q),
            root_mean_square(v),
            float(np.max(np.abs(q))),
            float(np.max(np.abs(v))),
            tuple(float(x) for x in np.quantile(np.abs(q), LEVELS)),
            root_mean_square(u),
            float(np.max(size)),
            tuple(float(x) for x in np.quantile(size, LEVELS)),
            force,
            float(arm @ np.linalg.solve(M, arm)),
            data.sampling_time,
            n * data.sampling_time,
            frequencies,
            lines_hz,
            times,
        )

    result = {}
    # A coordinate that an effect added bears no name.
    coordinates = output_names + hidden
    eye = np.eye(len(coordinates), motion.q.shape[1])
    for i, a in enumerate(coordinates):
        result["coordinate", a] = of(eye[i], np.zeros(n))
        for j in range(i + 1, len(coordinates)):
            result["coordinate", f"{a}-{coordinates[j]}"] = of(eye[i] - eye[j], np.zeros(n))
    for j, name in enumerate(input_names):
        result["input", name] = of(map_[:, j], u[:, j])
    # An output effect works on what the output measures, which need not be the displacement.
    for k, name in enumerate(output_names):
        y = motion.y[:n, k]
        result["output", name] = dataclasses.replace(
            result["coordinate", name],
            q=root_mean_square(y),
            q_peak=float(np.max(np.abs(y))),
            q_quantiles=tuple(float(x) for x in np.quantile(np.abs(y), LEVELS)),
        )
    return result


def root_mean_square(x) -> float:
    """Root mean square about zero, never quite zero."""
    return float(max(np.sqrt(np.mean(np.square(x))), 1e-300))
