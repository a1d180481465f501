"""Figures of a diagnosis; every function returns the Matplotlib figure."""

import numpy as np
from matplotlib.figure import Figure

from ..diagnosis.result import Curves, Diagnosis
from .figures import MEASURED, RESIDUAL, SIMULATED, _labelled, _trace

STRETCHES = 20
"""The closer look shows one of so many stretches of the record."""


def extension(diagnosis: Diagnosis, *, record: int | None = None) -> Figure:
    """What does the extension mend? Measured, linear and extended; the errors of both below.

    **Arguments:** `diagnosis`; `record`: which of `curves`, default the first held-out one.

    **Returns:** the figure: per output the whole record and the stretch where the linear model is worst, errors with
    ±2 noise floors.

    **Raises:** `ValueError` where there is no such record.
    """
    if record is None:
        record = next((k for k, curves in enumerate(diagnosis.curves) if curves.held_out), 0)
    if not 0 <= record < len(diagnosis.curves):
        raise ValueError(f"record={record} is not there; there are {len(diagnosis.curves)} such records.")
    curves, model = diagnosis.curves[record], diagnosis.baseline.model
    outputs = len(model.output_names)
    figure = Figure(figsize=(11.0, 1.0 + 3.2 * outputs), layout="constrained")
    grid = figure.add_gridspec(2 * outputs, 2, height_ratios=[2.0, 1.2] * outputs, width_ratios=[1.5, 1.0])
    kind = "held-out record" if curves.held_out else "record of the fit"
    first = "your model" if diagnosis.own_model else "linear model"
    figure.suptitle(f"Measured, {first} and extended model, {kind}")
    runs = [(first, curves.baseline, RESIDUAL)]
    if diagnosis.extended is not None:
        runs.append(("extended model", curves.extended, SIMULATED))
    for k, (name, unit) in enumerate(zip(model.output_names, model.output_units)):
        floor = 2 * diagnosis.noise_floor[name]
        worst = worst_stretch(curves, k)
        for column, window in enumerate((slice(0, len(curves.time)), worst)):
            above = figure.add_subplot(grid[2 * k, column])
            below = figure.add_subplot(grid[2 * k + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _trace(above, curves, curves.measured[:, k], window, color=MEASURED, linewidth=2.4, label="measured")
            for label, run, colour in runs:
                style = {"color": colour, "linewidth": 0.9, "label": label}
                _trace(above, curves, run[:, k], window, **style)
                style |= {"linewidth": 0.6, "label": None}
                _trace(below, curves, curves.measured[:, k] - run[:, k], window, **style)
            for edge, label in ((-floor, None), (floor, "±2 σ of the noise")):
                below.axhline(edge, color="black", linewidth=0.9, linestyle="--", label=label)
            above.margins(x=0)
            above.set_title(name if column == 0 else "where it is worst", loc="left", fontsize="medium")
            if column == 0:
                above.set_ylabel(_labelled(name, unit))
                below.set_ylabel(_labelled("error", unit))
            if k == 0 and column == 1:
                handles = [part for axes in (above, below) for part in axes.get_legend_handles_labels()[0]]
                above.legend(handles=handles, ncols=2, fontsize="x-small", loc="lower right", bbox_to_anchor=(1.0, 1.0))
            if k == outputs - 1:
                below.set_xlabel("time [s]")
            else:
                below.tick_params(labelbottom=False)
    return figure


def worst_stretch(curves: Curves, output: int) -> slice:
    """The stretch of the record in which the linear model's mean square error is largest.

    **Arguments:** `curves`; `output`: its number.

    **Returns:** its samples.
    """
    error = np.nan_to_num(curves.measured[:, output] - curves.baseline[:, output])
    samples = len(error)
    length = max(samples // STRETCHES, min(samples, 50))
    total = np.concatenate([[0.0], np.cumsum(error**2)])
    first = int(np.argmax(total[length:] - total[:-length])) if samples > length else 0
    return slice(first, first + length)
