"""Pictures of the effects for the manual, as SVG that can be read on white and on dark pages."""

import io
from dataclasses import dataclass

import jax
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from ..mechanics.effects import AbstractEffect
from .effect_curves import Panel, panels

GREY = "#808080"
COLOURS = {"law": "#2f81e0", "second": "#d9730d", "third": "#2a9d5c", "plain": GREY}

STYLE = {
    "svg.hashsalt": "jaxgray",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.color": GREY,
    "axes.labelcolor": GREY,
    "axes.edgecolor": GREY,
    "axes.titlecolor": GREY,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.6,
}

DECADE = (0.05, 0.1, 0.2, 0.5)
"""Frequencies [Hz] that are marked."""


@dataclass(frozen=True)
class Picture:
    """`svg`: without background; `words`: what it shows, for those who do not see it."""

    svg: bytes
    words: str


def picture(effect: AbstractEffect) -> Picture:
    """The picture of an effect: what it depends on at the left, how it shows at the right.

    **Arguments:** `effect`: of the catalogue, or an error of a given model.

    **Returns:** a `Picture`, the same bytes every time.
    """
    with jax.enable_x64(True):
        left, right = panels(effect)
    words = f"Left: {left.title.lower()}. Right: {right.title.lower()}."
    return Picture(drawn((left, right)), words)


def drawn(panels: tuple[Panel, ...]) -> bytes:
    """Two panels side by side as SVG, the same bytes every time."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.4))
        FigureCanvasSVG(figure)
        # Fixed margins: finding them would take half of the time.
        figure.subplots_adjust(left=0.085, right=0.985, bottom=0.14, top=0.79, wspace=0.24)
        for axes, panel in zip(figure.subplots(1, 2), panels):
            _draw(axes, panel)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _draw(axes: Axes, panel: Panel) -> None:
    for curve in panel.curves:
        plain = curve.role == "plain"
        axes.plot(
            curve.x,
            curve.y,
            color=COLOURS[curve.role],
            linewidth=1.1 if plain else 1.6,
            linestyle="--" if plain else "-",
            label=curve.label or None,
        )
    if panel.logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(DECADE, [f"{x:g}" for x in DECADE])
        axes.set_xticks([], minor=True)
    else:
        axes.locator_params(nbins=6)
        low, high = axes.get_ylim()
        if np.ptp([y for curve in panel.curves for y in (np.min(curve.y), np.max(curve.y))]) == 0:
            axes.set_ylim(min(0.0, low), max(0.0, 1.1 * high))
    # Title, legend and curves are below each other, so that none covers another.
    axes.set_title(panel.title, y=1.12)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    axes.grid(True)
    if len(panel.curves) > 1:
        axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.985), ncols=3, borderpad=0.2, columnspacing=1.2)
