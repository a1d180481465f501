"""What a person reads of a diagnosis in the terminal: the sentence first, then the evidence."""

import dataclasses
import textwrap

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..diagnosis.words.titles import title_of
from .diagnosis_rows import (
    budget_rows,
    coordinate_names,
    energy_words,
    error_rows,
    experiment_words,
    findings_rows,
    not_found_rows,
    rejected_rows,
    shift_rows,
    smallest,
    what_is_left,
)
from .terminal import show_warnings, table_of

FEW = 5
"""Rows of what was rejected or not found, unless all are asked for."""

USUAL = (
    "cubic_stiffness",
    "coulomb_friction",
    "quadratic_drag",
    "input_delay",
    "sensor_offset",
    "end_stop",
    "bilinear_stiffness",
    "play_hysteresis",
    "unmodelled_mode",
    "stiffness_drift",
)
"""Effects that most people ask after first."""


def show_diagnosis(out: Console, document: dict, *, verbose: bool = False) -> None:
    """Sentence, findings, parameter shifts, error budget, what was rejected or not found, next experiment, warnings.

    **Arguments:** `out`: where to; `document`: by `diagnosis_document`; `verbose`: all rows; default the first few of
    what was rejected and not found.
    """
    names = coordinate_names(document)
    out.print(document["sentence"], style="bold", soft_wrap=True)
    if document["findings"]:
        out.print(_findings_table(document))
    for finding in document["findings"]:
        if finding["message"]:
            _line(out, f"{title_of(finding['effect'], finding['location'], names)}: {finding['message']}")
    out.print(table_of(error_rows(document)))
    _line(out, f"left: {what_is_left(document)}")
    shifts = shift_rows(document)
    if shifts is not None:
        out.print(table_of(shifts))
    if document["budget"]:
        out.print(table_of(budget_rows(document)))
    if (energy := energy_words(document)) is not None:
        _line(out, f"energy of the extended model: {energy}")
    if document["rejected"]:
        out.print(_rejected_table(document, verbose))
    _show_not_found(out, document, verbose)
    if document["next_experiment"] is not None:
        _line(out, f"next experiment: {experiment_words(document['next_experiment'])} (--experiment writes the input)")
    show_warnings(out, document["warnings"])


def _line(out: Console, text: str) -> None:
    out.print(textwrap.fill(text, out.width, subsequent_indent="  "), soft_wrap=True)


def _findings_table(document: dict) -> Table:
    rows = findings_rows(document)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for k, title in enumerate(rows.head):
        table.add_column(title, justify="right" if title == "ΔBIC" else "left", no_wrap=k in (1, 2, 3))
    for row in rows.body:
        table.add_row(*row)
    return table


def _rejected_table(document: dict, verbose: bool) -> Table:
    """The best first; the reason may take several lines."""
    rows = rejected_rows(document)
    body = rows.body if verbose else rows.body[:FEW]
    few = "" if len(body) == len(rows.body) else f" (first {len(body)} of {len(rows.body)})"
    return table_of(dataclasses.replace(rows, head=(rows.head[0] + few, *rows.head[1:]), body=body), wrapped=(2,))


def _show_not_found(out: Console, document: dict, verbose: bool) -> None:
    """Everything with the smallest visible size, or how many there are and that of the usual ones."""
    not_found, names = document["not_found"], coordinate_names(document)
    if not not_found:
        return
    if verbose:
        out.print(table_of(not_found_rows(document), wrapped=(2,)))
        return
    known = [one for one in not_found if smallest(one["min_detectable"])]
    order = {effect: k for k, effect in enumerate(USUAL)}
    chosen: dict[str, dict] = {}
    for one in sorted(known, key=lambda one: order.get(one["effect"], len(order))):
        chosen.setdefault(one["effect"], one)
    few = [
        f"{title_of(one['effect'], one['location'], names)} from {smallest(one['min_detectable'])}"
        for one in list(chosen.values())[:FEW]
    ]
    text = f"not found: {len(not_found)} other candidates"
    _line(out, text + (f"; would have been seen: {'; '.join(few)}" if few else "") + " (--verbose lists all)")
