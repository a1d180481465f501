"""A third start: modes found one by one, free residues first, then the nearest mechanical system with these modes.

Where a sensor lags or an effect is strong, residues are not those of any M, D, K, and a fit that asks for them finds
wrong frequencies too. Poles are common to all outputs and survive it.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ...mechanics.systems.drives import ORDER, Force
from ...numerics.outcomes import RESULTS, ComputationError
from ..setup.prediction import Setting
from ..setup.preparation import Signals
from ..validation.free_modes import RivalFit, Whitened, fit_rival, further_modes, no_modes
from .start import Start, total_deviation

STEPS = 30
TRIES = 3

OSCILLATING = 0.7
"""Largest damping ratio of what is taken for a mode of the structure."""


def modal_start(signals: list[Signals], setting: Setting) -> Start:
    """M, D, K from the modes of the longest record.

    One mode after the other is added to a model with free residues, one more than there are coordinates (it may stand
    for what is not mechanical: a drift takes a slow and strong one). As many of those that oscillate as there are
    coordinates give shapes, the choice that simulates best: the residue of mode j is φ_j φ_jᵀ, its size kept where its
    phase is not that of a mechanical system; then M = (ΦΦᵀ)⁻¹, K and D with the poles' c0 and c1.

    **Arguments:** `signals`: scaled records; `setting`.

    **Returns:** a `Start`.

    **Raises:** `ComputationError` where forces do not drive every coordinate, or fewer modes oscillate.
    """
    dofs = len(setting.measured)
    longest = max(signals, key=lambda s: s.samples)
    if not isinstance(setting.drive, Force) or np.linalg.matrix_rank(np.asarray(setting.drive.input_map)) < dofs:
        raise ComputationError(RESULTS.unreachable, stage="modal start")
    n = longest.samples
    y = np.where(np.asarray(longest.kept)[:n] > 0, np.asarray(longest.y)[:n], np.nan)
    direct = setting.hold == "linear" or "acceleration" in setting.measured
    data = Whitened.of(y, np.asarray(longest.u)[:n], [np.ones(1)] * dofs, np.ones(dofs), direct=direct)
    fit = no_modes(data)
    for _ in range(dofs + 1):
        starts = [np.concatenate([fit.poles, new[None]]) for new in further_modes(fit, data, keep=TRIES)]
        fit = min((fit_rival(poles, data, steps=STEPS) for poles in starts), key=lambda found: found.cost)
    c0, c1 = np.exp(fit.poles).T
    modes = np.flatnonzero(c1 < 2 * OSCILLATING * np.sqrt(c0))
    if len(modes) < dofs:
        raise ComputationError(RESULTS.order_not_found, stage="modal start")
    back = np.linalg.pinv(np.asarray(setting.drive.input_map))
    shapes = {j: _shape(_residue(fit, data, j, setting) @ back) for j in modes}
    found = []
    for chosen in map(list, itertools.combinations(modes, dofs)):
        inverse = np.linalg.pinv(np.stack([shapes[j] for j in chosen], axis=1))
        matrices = tuple(
            jnp.asarray(inverse.T @ np.diag(weights) @ inverse) for weights in (np.ones(dofs), c1[chosen], c0[chosen])
        )
        deviation = total_deviation(matrices, setting, signals)
        found.append(Start(matrices, deviation, "modal", None, None, None, None))
    return max(found, key=lambda start: start.score)


def _residue(fit: RivalFit, data: Whitened, j: int, setting: Setting) -> Complex[np.ndarray, "outputs inputs"]:
    """What (s² + c1 s + c0) G_j(s) of one mode is at its own frequency, of displacements."""
    c0, c1 = np.exp(fit.poles[j])
    w = np.sqrt(c0)
    response = fit.response(j, w, data)
    # A held input comes half a sample late.
    late = np.exp(0.5j * w) if setting.hold == "zero" else 1.0
    order = np.array([ORDER[kind] for kind in setting.measured])
    return response * late * (1j * w * c1) / (1j * w) ** order[:, None]


def _shape(residue: Complex[np.ndarray, "dofs dofs"]) -> Float[np.ndarray, " dofs"]:
    """φ of the nearest φ φᵀ."""
    sized = np.abs(residue) * np.where(residue.real >= 0, 1.0, -1.0)
    values, vectors = np.linalg.eigh((sized + sized.T) / 2)
    return vectors[:, -1] * np.sqrt(max(values[-1], 1e-12 * np.max(np.abs(values))))
