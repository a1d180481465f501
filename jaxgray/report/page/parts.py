"""What a page is made of: sections of words, tables and plots, without any markup."""

import base64
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..rows import Rows

MOST_VALUES = 360_000
"""Values of long series that one page carries at most, about 2 MB; longer ones are drawn by their extremes."""

FEWEST = 4_000
"""Values that a series keeps however long the others are."""


@dataclass(frozen=True)
class Words:
    """Paragraphs."""

    kind: ClassVar[str] = "words"
    paragraphs: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table that can be copied: `rows`, and a `caption` that says how it is read; `folded`: closed at first."""

    kind: ClassVar[str] = "table"
    rows: Rows
    caption: str
    folded: bool = False


@dataclass(frozen=True)
class Tables:
    """Small tables side by side."""

    kind: ClassVar[str] = "tables"
    tables: tuple[Table, ...]
    caption: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Plot:
    """An interactive plot.

    `name`: unique on the page; `traces`, `layout`: as Plotly has them, colours by the page's own names (`@measured`);
    `height` [px]; `alt`: what it shows, for those who do not see it; `caption`; `linked`: plots of the same word share
    their horizontal axis; `width`: "", or "half" or "third" where there is room.
    """

    kind: ClassVar[str] = "plot"
    name: str
    traces: list[dict]
    layout: dict
    height: int
    alt: str
    caption: str = ""
    linked: str = ""
    width: str = ""

    def drawing(self) -> dict:
        """What the page's program draws."""
        return {"name": self.name, "traces": self.traces, "layout": self.layout, "linked": self.linked}


@dataclass(frozen=True)
class Shapes:
    """Mode shapes, drawn to move: `modes`, each with `title` and `values` by the `names` of coordinates."""

    kind: ClassVar[str] = "shapes"
    names: tuple[str, ...]
    modes: tuple[tuple[str, tuple[float, ...]], ...]
    caption: str


@dataclass(frozen=True)
class Section:
    """A part of the page: `name` for links, `title`, `lead` that says what is seen, and its `blocks`."""

    name: str
    title: str
    lead: str
    blocks: tuple[Words | Table | Tables | Plot | Shapes, ...]


@dataclass(frozen=True)
class Fact:
    """One thing of the first screen: what it is called, what it is, and a remark."""

    label: str
    value: str
    remark: str = ""


@dataclass(frozen=True)
class Page:
    """The whole: `title` of the window, `kind` and `status` of the result, `sentence`, `cards` of facts, `sections`,
    and the `document` that the JSON file holds."""

    title: str
    kind: str
    status: str
    sentence: str
    cards: tuple[tuple[Fact, ...], ...]
    sections: tuple[Section, ...]
    document: dict = field(repr=False)


def packed(values) -> dict:
    """A series of 32-bit floats as text; what is not finite stays NaN, which is a gap."""
    array = np.ascontiguousarray(np.where(np.isfinite(values), values, np.nan), dtype="<f4")
    return {"f4": base64.b64encode(array.tobytes()).decode()}


def unpacked(packed: dict) -> np.ndarray:
    """The series that `packed` made."""
    return np.frombuffer(base64.b64decode(packed["f4"]), dtype="<f4")


def evenly(first: float, step: float, count: int) -> dict:
    """Evenly spaced numbers, such as times."""
    return {"first": float(first), "step": float(step), "count": int(count)}


def extremes(x: np.ndarray, stretch: int) -> np.ndarray:
    """The smallest and the largest of every stretch of a series, missing samples left out; the order of the two
    alternates, so that a line does not fall back between stretches."""
    count = -(-len(x) // stretch)
    parts = np.concatenate([x, np.full(count * stretch - len(x), np.nan)]).reshape(count, stretch)
    low = np.where(np.isnan(parts), np.inf, parts).min(axis=1)
    high = np.where(np.isnan(parts), -np.inf, parts).max(axis=1)
    pairs = np.stack([low, high], axis=1)
    pairs[1::2] = pairs[1::2, ::-1]
    return np.where(np.isfinite(pairs), pairs, np.nan).ravel()


def stretch_for(samples: int, series: int) -> int:
    """How many samples of a long record make one stretch, so that all its series fit on the page."""
    room = max(MOST_VALUES // max(series, 1), FEWEST)
    return 1 if samples <= room else -(-2 * samples // room)


def over_time(time: np.ndarray, values: np.ndarray, stretch: int = 1) -> dict:
    """`x` and `y` of a trace over evenly sampled time; of a stretch of several samples, its extremes."""
    h = (time[-1] - time[0]) / max(len(time) - 1, 1)
    if stretch == 1:
        return {"x": evenly(time[0], h, len(time)), "y": packed(values)}
    y = extremes(np.asarray(values, float), stretch)
    return {"x": evenly(time[0] + h * (stretch - 1) / 4, h * stretch / 2, len(y)), "y": packed(y)}


def drawn_from(samples: int, stretch: int) -> str:
    """How a long series is drawn, in words."""
    if stretch == 1:
        return "Zoom in for every sample; where samples are denser than the screen, the extremes are drawn."
    return f"Of every {stretch} of the {samples} samples the smallest and the largest are drawn."


def axis(title: str, **more) -> dict:
    """An axis with its title."""
    return {"title": {"text": title}, **more}


def labelled(name: str, unit: str) -> str:
    """A quantity with its unit in brackets, where it has one."""
    return f"{name} [{unit}]" if unit else name
