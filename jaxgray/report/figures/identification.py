"""One figure a question, drawn without any global state; every function returns the Matplotlib figure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FormatStrFormatter, LogLocator, MultipleLocator, NullFormatter

from ...identification.result import Identification
from ...identification.sweep import Sweep
from ...mechanics.systems.drives import ORDER
from ...records import Record
from ..page.frequency_responses import KIND, QUANTILE_95, response_grid, responses

MEASURED, SIMULATED, RESIDUAL, BAND = "0.65", "#0b5394", "#b45f06", "0.88"
MOST_POINTS = 4000


def compare(result: Identification, *, held_out: bool | None = None, record: int = 0) -> Figure:
    """Does the model move as the system did? Measured against simulated, the residual below.

    **Arguments:** `result`; `held_out`: on the validation record, default where there is one; `record`: which
    of several records, default the first.

    **Returns:** the figure: per output the whole record and a closer look, residual with ±2 noise floors.

    **Raises:** `ValueError` where there is no such record.
    """
    held_out = bool(result.validation) if held_out is None else held_out
    fits, records = (result.validation, result.validation_records) if held_out else (result.estimation, result.records)
    if not 0 <= record < len(fits):
        raise ValueError(f"record={record} is not there; there are {len(fits)} such records.")
    fit, data = fits[record], records[record]
    close = _window(result, data)
    columns = 1 if close is None else 2
    figure = Figure(figsize=(10.0, 0.8 + 3.0 * data.outputs), layout="constrained")
    grid = figure.add_gridspec(
        2 * data.outputs, columns, height_ratios=[2.2, 1.0] * data.outputs, width_ratios=[1.6, 1.0][:columns]
    )
    kind = "held-out record" if held_out else "record of the fit"
    figure.suptitle(f"Measured and simulated, {kind}")
    for k, name in enumerate(data.output_names):
        unit = data.output_units[k]
        floor = 2 * float(result.noise_floor[k])
        for column, window in enumerate((slice(0, data.samples), close)[:columns]):
            above = figure.add_subplot(grid[2 * k, column])
            below = figure.add_subplot(grid[2 * k + 1, column], sharex=above)
            above.tick_params(labelbottom=False)
            _trace(above, data, data.y[:, k], window, color=MEASURED, linewidth=2.2, label="measured")
            _trace(above, data, fit.simulated[:, k], window, color=SIMULATED, linewidth=0.9, label="simulated")
            _trace(below, data, fit.residual[:, k], window, color=RESIDUAL, linewidth=0.6, label="residual")
            for edge, label in ((-floor, None), (floor, "±2 σ of the noise")):
                below.axhline(edge, color="black", linewidth=0.9, linestyle="--", label=label)
            above.margins(x=0)
            title = f"{name}: fit {fit.fit_percent[k]:.2f} %" if column == 0 else "a closer look"
            above.set_title(title, loc="left", fontsize="medium")
            if column == 0:
                above.set_ylabel(_labelled(name, unit))
                below.set_ylabel(_labelled("residual", unit))
            if k == 0 and column == columns - 1:
                handles = [part for axes in (above, below) for part in axes.get_legend_handles_labels()[0]]
                corner = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
                above.legend(handles=handles, ncols=2, fontsize="x-small", **corner)
            if k == data.outputs - 1:
                below.set_xlabel("time [s]")
            else:
                below.tick_params(labelbottom=False)
    return figure


def _labelled(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _window(result: Identification, data: Record) -> slice | None:
    """Some six periods of the slowest oscillation, a third into the record; None where that is most of it."""
    modes = result.model.modes()
    moving = modes.natural_frequency_hz[modes.natural_frequency_hz > 0]
    length = 6.0 / moving[0] if len(moving) else data.duration / 20
    samples = int(max(length / data.sampling_time, 50))
    if samples > data.samples // 2:
        return None
    first = data.samples // 3
    return slice(first, first + samples)


def _trace(axes: Axes, data: Record, values: np.ndarray, window: slice, **style) -> None:
    """A line of at most a few thousand points: of more samples, the extremes of every stretch."""
    t, x = data.time[window], values[window]
    if len(x) > MOST_POINTS:
        stretch = -(-len(x) // (MOST_POINTS // 2))
        count = len(x) // stretch
        t = np.repeat(t[: count * stretch : stretch], 2)
        parts = x[: count * stretch].reshape(count, stretch)
        known = np.where(np.isnan(parts), np.inf, parts), np.where(np.isnan(parts), -np.inf, parts)
        low, high = known[0].min(axis=1), known[1].max(axis=1)
        # The order of the two alternates, so that the line does not fall back between stretches.
        pairs = np.stack([low, high], axis=1)
        pairs[1::2] = pairs[1::2, ::-1]
        x = np.where(np.isfinite(pairs), pairs, np.nan).ravel()
    axes.plot(t, x, **style)


def residuals(result: Identification) -> Figure:
    """Is anything left in the residual? Its correlation with itself and with the inputs, with 99 % bands.

    **Arguments:** `result`.

    **Returns:** the figure: a row per output; bars beyond the bands are shown in colour.
    """
    test, model = result.residual_test, result.model
    n, m = model.outputs, model.inputs
    figure = Figure(figsize=(3.0 + 2.6 * (1 + m), 0.9 + 2.0 * n), layout="constrained")
    axes = figure.subplots(n, 1 + m, squeeze=False, sharex="col")
    white = "white" if test.white else "not white"
    past = "inputs explain more of it" if test.input_explained else "inputs explain no more of it"
    figure.suptitle(f"Residual on the record of the fit: {white}; {past}")
    lags = len(test.autocorrelation)
    for k, name in enumerate(model.output_names):
        _bars(axes[k, 0], np.arange(1, lags + 1), test.autocorrelation[:, k], test.band)
        axes[k, 0].set_ylabel(name)
        for j in range(m):
            half = (len(test.cross_correlation) - 1) // 2
            _bars(
                axes[k, 1 + j],
                np.arange(-half, half + 1),
                test.cross_correlation[:, k, j],
                test.cross_band[k, j],
            )
            axes[k, 1 + j].axvline(0, color="0.8", linewidth=0.8, zorder=0)
    axes[0, 0].set_title("autocorrelation", fontsize="medium")
    for j, source in enumerate(model.input_names):
        axes[0, 1 + j].set_title(f"with earlier {source}", fontsize="medium")
    for column in axes[-1]:
        column.set_xlabel("lag [samples]")
    return figure


def _bars(axes: Axes, lags: np.ndarray, values: np.ndarray, band: float) -> None:
    beyond = np.abs(values) > band
    axes.axhspan(-band, band, color=BAND, linewidth=0, zorder=0)
    axes.vlines(lags, 0, values, color=np.where(beyond, RESIDUAL, SIMULATED), linewidth=1.6)
    axes.axhline(0, color="0.4", linewidth=0.6)
    reach = 1.25 * max(float(np.max(np.abs(values))), 1.6 * band)
    axes.set_ylim(-reach, reach)


def bode(result: Identification, *, points: int = 600) -> Figure:
    """How does the system answer each frequency? Magnitude and phase with 95 % bands.

    **Arguments:** `result`; `points`: frequencies, default 600, besides the resonances and antiresonances.

    **Returns:** the figure: two rows per output, a column per input; receptance, mobility or accelerance as
    the output measures; resonances dotted, antiresonances dashed.
    """
    model = result.model
    n, m = model.outputs, model.inputs
    frequency, resonances, antiresonances = response_grid(result, points)
    H, magnitude, phase = responses(result, 2 * np.pi * frequency)
    figure = Figure(figsize=(max(1.6 + 4.2 * m, 7.0), 0.8 + 3.0 * n), layout="constrained")
    axes = figure.subplots(2 * n, m, squeeze=False, sharex=True, height_ratios=[1.7, 1.0] * n)
    for k, place in enumerate(model.output_names):
        kind = KIND[ORDER[model.measured[k]]]
        for j, source in enumerate(model.input_names):
            above, below = axes[2 * k, j], axes[2 * k + 1, j]
            size = np.abs(H[:, k, j])
            angle = np.degrees(np.unwrap(np.angle(H[:, k, j])))
            angle -= 360.0 * np.round(np.median(angle) / 360.0)
            above.loglog(frequency, size, color=SIMULATED, linewidth=1.2)
            below.semilogx(frequency, angle, color=SIMULATED, linewidth=1.2)
            if magnitude is not None:
                reach = QUANTILE_95 * magnitude[:, k, j]
                low = np.maximum(size - reach, 1e-3 * size)
                limits = above.get_ylim()
                above.fill_between(frequency, low, size + reach, color=SIMULATED, alpha=0.25, linewidth=0)
                # Where it is hardly known the band reaches down to zero, which must not stretch the axis.
                above.set_ylim(limits[0] / 3, limits[1] * 1.5)
                wide = np.degrees(np.minimum(QUANTILE_95 * phase[:, k, j], np.pi))
                below.fill_between(frequency, angle - wide, angle + wide, color=SIMULATED, alpha=0.25, linewidth=0)
            for axis in (above, below):
                for value in resonances:
                    axis.axvline(value, color=RESIDUAL, linewidth=0.8, linestyle=":")
                for value in antiresonances[source, place]:
                    axis.axvline(value, color="0.45", linewidth=0.8, linestyle="--")
            above.set_title(f"{source} to {place}", loc="left", fontsize="medium")
            below.yaxis.set_major_locator(MultipleLocator(90))
            if j == 0:
                units = model.output_units[k], model.input_units[j]
                unit = f"{units[0]}/{units[1]}" if all(units) else ""
                above.set_ylabel(_labelled(f"|H|, {kind}", unit))
                below.set_ylabel("phase [°]")
    for axis in axes[-1]:
        axis.set_xlabel("frequency [Hz]")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].set_xlim(frequency[0], frequency[-1])
    band = "" if magnitude is None else "95 % band shaded, "
    figure.suptitle(f"Frequency response: {band}resonances dotted, antiresonances dashed", fontsize="medium")
    return figure


def sweep_map(sweep: Sweep) -> Figure:
    """Which time constant and block rows serve? How far each choice's residual is above the best one's.

    **Arguments:** `sweep`.

    **Returns:** the figure: one panel for the estimation record, one for the held-out record; fit in % of the
    worst output in every cell, colour the residual relative to the best choice, the best framed.
    """
    panels = [("record of the fit", sweep.fit_percent)]
    if sweep.validation_fit_percent is not None:
        panels.append(("held-out record", sweep.validation_fit_percent))
    rows, columns = len(sweep.time_constants), len(sweep.block_rows)
    width = 1.8 + len(panels) * (0.9 + 0.75 * columns)
    figure = Figure(figsize=(max(width, 5.0), 1.4 + 0.34 * rows), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    image = None
    for axis, (title, fits) in zip(axes, panels):
        worst = np.min(fits, axis=2)
        excess = (100.0 - worst) / np.nanmin(np.maximum(100.0 - worst, 1e-12))
        image = axis.imshow(excess, aspect="auto", cmap="viridis_r", norm=LogNorm(1.0, 10.0), origin="lower")
        axis.set_facecolor("0.9")
        for k in np.ndindex(worst.shape):
            dark = np.isfinite(excess[k]) and excess[k] > 2.5
            text = "–" if np.isnan(worst[k]) else f"{worst[k]:.1f}"
            axis.text(k[1], k[0], text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
        row, column = sweep.best_index
        corner = column - 0.46, row - 0.46
        axis.add_patch(Rectangle(corner, 0.92, 0.92, fill=False, edgecolor=RESIDUAL, linewidth=2.2))
        axis.set_xticks(range(columns), [str(i) for i in sweep.block_rows])
        axis.set_xlabel("block rows")
        axis.set_title(title, fontsize="medium")
    axes[0].set_yticks(range(rows), [f"{tau:.3g}" for tau in sweep.time_constants])
    axes[0].set_ylabel("time constant [s]")
    bar = figure.colorbar(image, ax=list(axes), extend="max", ticks=[1, 2, 5, 10])
    bar.ax.set_yticklabels(["1", "2", "5", "10"])
    bar.set_label("residual relative to the best choice")
    figure.suptitle("Fit in % of the worst output", fontsize="medium")
    return figure
