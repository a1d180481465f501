"""Figures of modes; every function returns the Matplotlib figure."""

import numpy as np
from matplotlib.figure import Figure

from ...identification.result import Identification
from ...identification.stabilisation import Stabilisation
from ...mechanics.modal_uncertainty import modal_uncertainty
from ...mechanics.model import MechanicalModel
from ...numerics.text import plus_minus
from .identification import BAND, MEASURED, RESIDUAL, SIMULATED


def mode_shapes(result: Identification | MechanicalModel) -> Figure:
    """How do the coordinates move against each other? Every mode's shape, its largest entry 1.

    **Arguments:** `result`: an `Identification`, whose shapes get ±2 standard errors where they are known, or a model.

    **Returns:** the figure: a panel per mode, titled with natural frequency and damping ratio.
    """
    model = result if isinstance(result, MechanicalModel) else result.model
    modes = model.modes()
    spread = None
    if isinstance(result, Identification) and result.covariance is not None:
        spread = modal_uncertainty(model, result.covariance)
    count = len(modes.natural_frequency_hz)
    columns = min(count, 4)
    rows = -(-count // columns)
    figure = Figure(figsize=(2.4 + 2.2 * columns, 0.6 + 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    at = np.arange(model.dofs)
    for k, axis in enumerate(axes.flat):
        if k >= count:
            axis.set_visible(False)
            continue
        shape = modes.mode_shapes[:, k]
        size = np.max(np.abs(shape))
        errors = None if spread is None else spread.mode_shapes[:, k] / size
        axis.axhline(0, color=MEASURED, linewidth=0.8)
        axis.plot(at, shape / size, "o-", color=SIMULATED, markersize=6)
        if errors is not None:
            axis.errorbar(at, shape / size, 2 * errors, fmt="none", ecolor=RESIDUAL, capsize=3)
        axis.set_xticks(at, [f"({name})" if name in model.hidden else name for name in model.coordinates])
        axis.set_xlim(-0.5, model.dofs - 0.5)
        known = spread is not None
        frequency = plus_minus(modes.natural_frequency_hz[k], spread.natural_frequency_hz[k] if known else None)
        ratio = plus_minus(100 * modes.damping_ratio[k], 100 * spread.damping_ratio[k] if known else None)
        axis.set_title(f"{frequency} Hz\nζ = {ratio} %", fontsize="small")
    axes[0, 0].set_ylim(-1.25, 1.25)
    return figure


def stabilisation_diagram(result: Stabilisation) -> Figure:
    """How many modes does the record show? Poles over the order of the model: true ones stay, others wander.

    **Arguments:** `result`: by `stabilisation`.

    **Returns:** the figure: filled marks agree with the next lower order in frequency, damping and shape.
    """
    orders = np.unique(result.order)
    figure = Figure(figsize=(9.0, 1.4 + 0.28 * max(len(orders), 6)), layout="constrained")
    axis = figure.subplots()
    stable = result.stable
    partly = result.frequency & ~stable
    for chosen, style, label in (
        (~result.frequency, {"marker": ".", "color": MEASURED, "markersize": 4}, "new at this order"),
        (partly, {"marker": "o", "color": RESIDUAL, "markerfacecolor": "none", "markersize": 5}, "frequency agrees"),
        (stable, {"marker": "o", "color": SIMULATED, "markersize": 6}, "frequency, damping and shape agree"),
    ):
        axis.plot(result.frequency_hz[chosen], result.order[chosen], linestyle="none", label=label, **style)
    for order in orders:
        axis.axhline(order, color=BAND, linewidth=0.6, zorder=0)
    axis.set_yticks(orders)
    axis.set_xlim(0, 1.1 * float(np.max(result.frequency_hz, initial=result.highest_hz / 10)))
    axis.set_xlabel("natural frequency [Hz]")
    axis.set_ylabel("order")
    axis.legend(fontsize="small", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure
