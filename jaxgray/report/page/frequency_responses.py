"""Frequency responses of an identification on a grid that holds its resonances and antiresonances, with errors."""

import numpy as np

from ...identification.result import Identification
from ...mechanics.modal_uncertainty import frequency_response_band
from ...mechanics.systems.drives import ORDER
from ...mechanics.systems.zeros import zeros_of_pairs

KIND = ("receptance", "mobility", "accelerance")
QUANTILE_95 = 1.959964


def response_grid(result: Identification, points: int):
    """A grid in Hz around the modes that holds every resonance and antiresonance itself."""
    model, record = result.model, result.records[0]
    modes = model.modes().natural_frequency_hz
    moving = modes[modes > 0]
    nyquist = record.sampling_rate_hz / 2
    low, high = (0.2 * moving[0], 5 * moving[-1]) if len(moving) else (1 / record.duration, nyquist)
    low, high = max(low, 0.5 / record.duration), min(high, nyquist)
    zeros, antiresonances = zeros_of_pairs(model), {}
    for source in model.input_names:
        for place in model.output_names:
            pair = zeros.get((source, place))
            found = np.zeros(0) if pair is None else pair.antiresonance_hz
            antiresonances[source, place] = found[(found > low) & (found < high)]
    special = np.concatenate([moving[(moving > low) & (moving < high)], *antiresonances.values()])
    near = (special[:, None] * (1 + np.array([-0.01, -0.003, 0.0, 0.003, 0.01]))).ravel()
    grid = np.union1d(np.geomspace(low, max(high, 2 * low), points), near)
    return grid, moving, antiresonances


def responses(result: Identification, omega: np.ndarray):
    """Response, and standard errors of magnitude and phase or None, each output as it is measured."""
    model = result.model
    shape = len(omega), model.outputs, model.inputs
    H, magnitude, phase = (np.zeros(shape, kind) for kind in (complex, float, float))
    known = result.covariance is not None
    for kind in dict.fromkeys(model.measured):
        outputs = [k for k, one in enumerate(model.measured) if one == kind]
        name = KIND[ORDER[kind]]
        if known:
            band = frequency_response_band(model, omega, result.covariance, kind=name)
            H[:, outputs] = band.response[:, outputs]
            magnitude[:, outputs], phase[:, outputs] = band.magnitude[:, outputs], band.phase[:, outputs]
        else:
            H[:, outputs] = model.frequency_response(omega, kind=name)[:, outputs]
    return (H, magnitude, phase) if known else (H, None, None)
