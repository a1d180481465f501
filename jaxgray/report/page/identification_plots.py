"""The plots of an identification for its page: free runs, frequency responses, residual tests, the start's table."""

import numpy as np

from ...identification import Identification
from ...mechanics.systems.drives import ORDER
from .frequency_responses import KIND, QUANTILE_95, response_grid, responses
from .parts import Plot, axis, labelled, packed
from .time_plots import Channel, Run, closer, stretches, whole

OF_EACH = 4
"""Outputs up to which every one is shown closely."""


def fit_plots(result: Identification) -> list[Plot]:
    """Measured and simulated, output by output: the worst stretch, a typical one, the whole record."""
    fit = (result.validation or result.estimation)[0]
    data = (result.validation_records or result.records)[0]
    runs = [Run("model", "@after", fit.simulated)]
    plots = []
    for k, (name, unit) in enumerate(zip(data.output_names, data.output_units)):
        channel = Channel(k, name, unit, float(result.noise_floor[k]))
        args = data.time, data.y, runs, channel
        if data.outputs <= OF_EACH:
            for word, window in zip(("Worst", "Typical"), stretches(fit.residual[:, k])):
                plots.append(closer(*args, window, name=f"time-{k}-{word.lower()}", title=f"{word} stretch"))
        plots.append(whole(*args, name=f"time-{k}", series=3 * data.outputs))
    return plots


def bode_plots(result: Identification, *, points: int = 500) -> list[Plot]:
    """Magnitude and phase of every input and output with 95 % bands."""
    model = result.model
    frequency, resonances, antiresonances = response_grid(result, points)
    H, magnitude, phase = responses(result, 2 * np.pi * frequency)
    plots = []
    for k, place in enumerate(model.output_names):
        for j, source in enumerate(model.input_names):
            size, angle = np.abs(H[:, k, j]), np.degrees(np.unwrap(np.angle(H[:, k, j])))
            angle -= 360.0 * np.round(np.median(angle) / 360.0)
            traces = []
            if magnitude is not None:
                reach = QUANTILE_95 * magnitude[:, k, j]
                wide = np.degrees(np.minimum(QUANTILE_95 * phase[:, k, j], np.pi))
                traces.append(_band(frequency, np.maximum(size - reach, 1e-3 * size), size + reach))
                traces.append(_band(frequency, angle - wide, angle + wide) | {"yaxis": "y2", "showlegend": False})
            line = {"mode": "lines", "line": {"color": "@after", "width": 1.8}, "x": packed(frequency)}
            traces.append({**line, "y": packed(size), "name": "model"})
            traces.append({**line, "y": packed(angle), "name": "phase", "yaxis": "y2", "showlegend": False})
            units = model.output_units[k], model.input_units[j]
            low, high = np.log10(size.min() / 2), np.log10(size.max() * 2)
            layout = {
                "xaxis": axis("frequency [Hz]", type="log", anchor="y2", range=np.log10(frequency[[0, -1]]).tolist()),
                "yaxis": axis(
                    labelled(KIND[ORDER[model.measured[k]]], "/".join(units) if all(units) else ""),
                    type="log",
                    domain=[0.4, 1.0],
                    range=[low, high],
                ),
                "yaxis2": axis("phase [°]", domain=[0.0, 0.33], dtick=90),
                "shapes": [_mark(value, "dot") for value in resonances]
                + [_mark(value, "dash") for value in antiresonances[source, place]],
                "hovermode": "x",
            }
            alt = f"Frequency response from {source} to {place}: magnitude above, phase below, with 95 % bands."
            name = f"bode-{k}-{j}"
            half = model.outputs * model.inputs > 1
            plots.append(
                Plot(
                    name,
                    traces,
                    layout,
                    360,
                    alt,
                    f"{source} to {place}.",
                    linked="frequency",
                    width="half" if half else "",
                )
            )
    return plots


def _band(x, low, high) -> dict:
    outline = {"x": [*x.tolist(), *x[::-1].tolist()], "y": [*low.tolist(), *high[::-1].tolist()]}
    style = {"fill": "toself", "fillcolor": "@afterband", "line": {"width": 0}, "mode": "lines", "hoverinfo": "skip"}
    return {**outline, **style, "name": "95 % band"}


def _mark(value: float, dash: str) -> dict:
    colour = "@before" if dash == "dot" else "@measured"
    line = {"color": colour, "width": 1.2, "dash": dash}
    return {"type": "line", "x0": float(value), "x1": float(value), "yref": "paper", "y0": 0, "y1": 1, "line": line}


def correlation_plots(result: Identification) -> list[Plot]:
    """Correlation of the residual with itself and with every input, with 99 % bands."""
    test, model = result.residual_test, result.model
    lags = np.arange(1, len(test.autocorrelation) + 1)
    half = (len(test.cross_correlation) - 1) // 2
    width = "half" if model.inputs == 1 else "third"
    plots = []
    for k, place in enumerate(model.output_names):
        title = f"residual of {place} with itself"
        plots.append(_bars(f"auto-{k}", lags, test.autocorrelation[:, k], test.band, title, width))
        for j, source in enumerate(model.input_names):
            values, band = test.cross_correlation[:, k, j], test.cross_band[k, j]
            title = f"residual of {place} with earlier {source}"
            plots.append(_bars(f"cross-{k}-{j}", np.arange(-half, half + 1), values, band, title, width))
    return plots


def _bars(name: str, lags, values, band: float, title: str, width: str) -> Plot:
    colours = ["@before" if abs(v) > band else "@after" for v in values]
    bars = {
        "type": "bar",
        "x": lags.tolist(),
        "y": np.asarray(values).tolist(),
        "marker": {"color": colours},
        "width": 0.4,
    }
    reach = 1.25 * max(float(np.max(np.abs(values))), 1.6 * float(band))
    layout = {
        "xaxis": axis("lag [samples]"),
        "yaxis": axis("correlation", range=[-reach, reach]),
        "shapes": [
            {
                "type": "rect",
                "xref": "paper",
                "x0": 0,
                "x1": 1,
                "y0": -float(band),
                "y1": float(band),
                "fillcolor": "@band",
                "line": {"width": 0},
                "layer": "below",
            }
        ],
        "showlegend": False,
        "hovermode": "closest",
    }
    beyond = int(np.sum(np.abs(values) > band))
    alt = f"Correlation of the {title} over lags: {beyond} of {len(values)} beyond the 99 % band."
    return Plot(
        name, [bars | {"name": "correlation"}], layout, 210, alt, title[0].upper() + title[1:] + ".", width=width
    )


def start_plot(result: Identification) -> Plot | None:
    """How far the residual of every choice of τ and i is above that of the best one; None without such a table."""
    start = result.start
    if start.table is None or start.grid is None:
        return None
    # The score is minus half the sum over outputs of ln(mean square): back to a ratio of RMS residuals.
    excess = np.exp((np.max(start.table) - start.table) / result.model.outputs)
    excess = np.where(np.isfinite(start.table), excess, np.nan)
    taus, rows = start.grid
    text = [["–" if np.isnan(v) else f"{v:.2f}×" for v in line] for line in excess]
    trace = {
        "type": "heatmap",
        "x": [str(i) for i in rows],
        "y": [f"{tau:.3g}" for tau in taus],
        "z": [[None if np.isnan(v) else float(np.log10(v)) for v in line] for line in excess],
        "text": text,
        "texttemplate": "%{text}",
        "hovertemplate": "%{y} s, %{x} block rows: %{text}",
        "name": "residual",
        "zmin": 0.0,
        "zmax": 1.0,
        "showscale": False,
        "colorscale": [[0, "@after"], [1, "@soft"]],
    }
    layout = {
        "xaxis": axis("block rows", type="category"),
        "yaxis": axis("time constant [s]", type="category"),
        "hovermode": "closest",
    }
    best = np.unravel_index(np.nanargmin(excess), excess.shape)
    frame = {"x0": best[1] - 0.5, "x1": best[1] + 0.5, "y0": best[0] - 0.5, "y1": best[0] + 0.5}
    layout["shapes"] = [
        {"type": "rect", **{k: float(v) for k, v in frame.items()}, "line": {"color": "@before", "width": 3}}
    ]
    alt = "Residual of the start for every time constant and number of block rows, relative to the best."
    caption = "Residual of the start relative to the best choice, framed; – no stable model."
    return Plot("start-map", [trace], layout, 120 + 26 * len(taus), alt, caption)
