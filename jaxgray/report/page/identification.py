"""The page of an identification: the model with its intervals, then the evidence for it."""

import numpy as np

from ...identification import Identification
from ...numerics.text import plus_minus
from ..identification_rows import (
    MATRICES,
    coordinate_titles,
    element_rows,
    evidence_lines,
    fit_rows,
    hidden_lines,
    matrix_rows,
    mode_rows,
    order_rows,
    start_line,
    verdict,
)
from ..rows import Rows
from .identification_plots import bode_plots, correlation_plots, fit_plots, start_plot
from .parts import Fact, Page, Section, Shapes, Table, Tables, Words
from .records import record_section


def identification_page(result: Identification, document: dict) -> Page:
    """The page of an identification.

    **Arguments:** `result`; `document`: by `identification_document`, whose numbers the page shows.

    **Returns:** a `Page`.
    """
    return Page(
        "Mass, damping and stiffness",
        "identification",
        "refined" if document["refined"] else "starting model",
        verdict(document),
        _cards(document),
        tuple(section for section in _sections(result, document) if section.blocks),
        document,
    )


def _cards(document: dict) -> tuple[tuple[Fact, ...], ...]:
    """Fits and modes: what is read first."""
    kind = "validation" if "validation" in document["fit_percent"] else "estimation"
    where = "on held-out data" if kind == "validation" else "on the data of the fit"
    fits = [
        Fact(f"Fit at {name}", f"{fit:.2f} %", where) for name, fit in list(document["fit_percent"][kind].items())[:4]
    ]
    rows = mode_rows(document).body[:4]
    modes = [Fact(f"Mode {row[0]}", f"{row[1]} Hz", f"damping ratio {row[2]} %") for row in rows]
    return tuple(fits), tuple(modes)


def _sections(result: Identification, document: dict):
    known = document["model"]["standard_errors"] is not None
    yield Section(
        "model",
        "Mass, damping, stiffness",
        "Each entry ± one standard error." if known else "The starting model, without standard errors.",
        (Tables(tuple(Table(matrix_rows(name, document["model"]), name.capitalize()) for name in MATRICES)),)
        + (Words(tuple(_limits(document))),),
    )
    yield Section(
        "hidden",
        "Coordinates that no output measures",
        "What inputs and outputs say of them, and what they leave open.",
        tuple(_hidden(document)),
    )
    yield Section(
        "fit",
        "Measured and simulated",
        "Free runs from the input alone. Below each, what the model misses, with ±2 σ of the noise shaded.",
        (Table(fit_rows(document), "Fit and error of the free run"), *fit_plots(result)),
    )
    yield Section(
        "bode",
        "Frequency response",
        "Magnitude and phase with 95 % bands; resonances dotted, antiresonances dashed.",
        (*bode_plots(result), *_zeros(document)),
    )
    yield Section(
        "modes",
        "Modes",
        "Natural frequencies, damping ratios and shapes; the largest entry of a shape is 1.",
        (Table(mode_rows(document), "Modes ± standard error"), *_shapes(document)),
    )
    yield Section(
        "residual",
        "Residual",
        "Correlation of what is left with itself and with the inputs; beyond the shaded 99 % bands something is left "
        "to explain.",
        (
            Words(tuple(line[0].upper() + line[1:] + "." for line in evidence_lines(document))),
            *correlation_plots(result),
        ),
    )
    plot = start_plot(result)
    line = start_line(document["start"])
    yield Section(
        "start",
        "Where it started from",
        "The subspace start was tried over time constants and block rows; the refinement began at the best.",
        (Words((line[0].upper() + line[1:] + ".",)),) + ((plot,) if plot else ()),
    )
    yield record_section(result.records, result.validation_records, document, *_noise(document))


def _hidden(document: dict):
    """Elements of a structure, how the number was found, and what to keep in mind."""
    for rows, title in (
        (element_rows(document), "Masses, dampers and springs ± standard error"),
        (order_rows(document), "How many coordinates are hidden"),
    ):
        if rows is not None:
            yield Table(rows, title)
    lines = hidden_lines(document)
    if lines:
        yield Words(tuple(lines))


def _limits(document: dict):
    """What the numbers rest on."""
    for text in document["at_edge"] or ():
        yield f"At the edge of what is physical: {text}."
    for text in document["weak_directions"] or ():
        yield f"Hardly determined by this record: {text}."
    if document["condition_number"] is not None:
        yield f"Condition number of the fit: {document['condition_number']:.3g}."


def _noise(document: dict):
    yield f"Noise model: {document['noise']['form']}."


def _zeros(document: dict):
    """Antiresonances of every pair, as far as there are any."""
    known = (document.get("hidden") or {}).get("zeros_standard_errors_hz") or {}

    def shown(pair, values):
        errors = known.get(pair) or [None] * len(values)
        return ", ".join(f"{v:.5g}" if e is None else plus_minus(v, e) for v, e in zip(values, errors)) or "none"

    body = tuple((pair.replace("->", " to "), shown(pair, values)) for pair, values in document["zeros_hz"].items())
    yield Table(Rows(("input to output", "antiresonances [Hz]"), body, frozenset({0, 1})), "Antiresonances")


def _shapes(document: dict):
    names = tuple(coordinate_titles(document["model"]))
    modes = []
    for row, mode in zip(mode_rows(document).body, document["modes"]):
        shape = np.array(mode["shape"])
        modes.append((f"Mode {row[0]}: {row[1]} Hz", tuple((shape / np.max(np.abs(shape))).tolist())))
    yield Shapes(names, tuple(modes), "Mode shapes: how the coordinates move against each other.")
