"""Plots over time for the page: what was measured, what models make of it, and what is left, over one time axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .parts import Plot, axis, drawn_from, labelled, over_time, stretch_for

STRETCHES = 20
"""A closer look shows one of so many stretches of the record."""

LEAST, MOST = 50, 5000
"""Samples of a stretch at least and at most."""


@dataclass(frozen=True)
class Run:
    """A model's free run: `name` for the legend, `colour` by the page's own name, `y`."""

    name: str
    colour: str
    y: Float[np.ndarray, "samples outputs"]


@dataclass(frozen=True)
class Channel:
    """What is drawn of one output: its `index`, `name` and `unit`, and the `floor` of its noise."""

    index: int
    name: str
    unit: str
    floor: float


def stretches(error: Float[np.ndarray, " samples"]) -> tuple[slice, slice]:
    """The stretch with the largest mean square error, and one with a typical (median) one.

    **Arguments:** `error`: with NaN where nothing was measured.

    **Returns:** their samples, of one length.
    """
    samples = len(error)
    length = min(max(samples // STRETCHES, min(samples, LEAST)), MOST)
    if samples <= length:
        return slice(0, samples), slice(0, samples)
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(error) ** 2)])
    power = total[length:] - total[:-length]
    typical = np.argsort(power, kind="stable")[len(power) // 2]
    return tuple(slice(int(first), int(first) + length) for first in (np.argmax(power), typical))


def whole(time, measured, runs: list[Run], channel: Channel, *, name: str, series: int) -> Plot:
    """The whole record of one output.

    **Arguments:** `time`, `measured`, `runs`; `channel`; `name`: of the plot; `series`: how many long series the page
    carries, which share its room.
    """
    stretch = stretch_for(len(time), series)
    caption = drawn_from(len(time), stretch)
    return _plot(
        time, measured, runs, channel, slice(0, len(time)), stretch, name, "Whole record", caption, linked="time"
    )


def closer(time, measured, runs: list[Run], channel: Channel, window: slice, *, name: str, title: str) -> Plot:
    """A stretch of one output, every sample drawn; arguments as for `whole`, `window` its samples."""
    return _plot(time, measured, runs, channel, window, 1, name, title, "", width="half")


def _plot(time, measured, runs, channel: Channel, window: slice, stretch, name, title, caption, **more) -> Plot:
    k, t = channel.index, time[window]
    y = measured[window, k]
    close = window.stop - window.start < len(time)
    traces = [_line(t, y, stretch, "measured", "@faint", 5.0 if close else 2.5)]
    for run in runs:
        part = run.y[window, k]
        traces.append(_line(t, part, stretch, run.name, run.colour, 1.4, group=run.name))
        error = _line(t, y - part, stretch, f"error of {run.name}", run.colour, 1.0, group=run.name)
        traces.append(error | {"yaxis": "y2", "showlegend": False})
    floor, ends = 2 * channel.floor, [float(t[0]), float(t[-1])]
    if np.isfinite(floor):
        band = {"x": [*ends, *ends[::-1]], "y": [floor, floor, -floor, -floor], "fill": "toself", "yaxis": "y2"}
        style = {"fillcolor": "@band", "line": {"width": 0}, "hoverinfo": "skip", "mode": "lines"}
        traces.append({**band, **style, "name": "±2 σ of the noise"})
    layout = {
        "xaxis": axis("time [s]", anchor="y2", range=ends),
        "yaxis": axis(labelled(channel.name, channel.unit), domain=[0.44, 1.0]),
        "yaxis2": axis(labelled("error", channel.unit), domain=[0.0, 0.36]),
        "hovermode": "x",
    }
    models = " and ".join(run.name for run in runs)
    alt = f"{title} of {channel.name}: measured and {models} over time; below, the errors with ±2 σ of the noise."
    return Plot(name, traces, layout, 380, alt, f"{title} of {channel.name}. {caption}".strip(), **more)


def _line(t, y, stretch: int, name: str, colour: str, width: float, group: str = "") -> dict:
    trace = {**over_time(t, y, stretch), "name": name, "mode": "lines", "line": {"color": colour, "width": width}}
    return trace | ({"legendgroup": group} if group else {})
