"""Results as a notebook shows them: verdict, facts and tables, without scripts."""

from ..diagnosis.result import Diagnosis
from ..identification import Identification
from ..identification.sweep import Sweep
from .diagnosis_rows import error_rows, findings_rows, shift_rows
from .documents.diagnosis import diagnosis_document
from .documents.export import plain
from .documents.identification import identification_document
from .identification_rows import (
    MATRICES,
    element_rows,
    fit_rows,
    hidden_lines,
    matrix_rows,
    mode_rows,
    order_rows,
    verdict,
)
from .page.whole import environment
from .rows import Rows


def html(result) -> str | None:
    """A result as HTML for a notebook.

    **Arguments:** `result`: an `Identification`, a `Diagnosis` or a `Sweep`.

    **Returns:** the text, None for anything else.
    """
    if isinstance(result, Diagnosis):
        return _diagnosis(diagnosis_document(result))
    if isinstance(result, Identification):
        return _identification(plain(identification_document(result)))
    if isinstance(result, Sweep):
        return _sweep(result)
    return None


def _diagnosis(document: dict) -> str:
    tables = [findings_rows(document), error_rows(document), shift_rows(document)]
    notes = [f"Warning: {text}" for text in document["warnings"]]
    return _rendered(document["sentence"], [rows for rows in tables if rows is not None and rows.body], notes)


def _identification(document: dict) -> str:
    extra = [rows for rows in (element_rows(document), order_rows(document)) if rows is not None]
    tables = [matrix_rows(name, document["model"]) for name in MATRICES] + extra
    tables += [fit_rows(document), mode_rows(document)]
    notes = hidden_lines(document)
    return _rendered(verdict(document), tables, notes + [f"Warning: {text}" for text in document["warnings"]])


def _sweep(result: Sweep) -> str:
    best, worst = result.best, result.judged_by.min(axis=2)
    where = "estimation" if result.validation_fit_percent is None else "held-out"
    body = tuple(
        (f"{tau:.4g}", *("–" if value != value else f"{value:.2f}" for value in line))
        for tau, line in zip(result.time_constants, worst)
    )
    head = "τ [s]", *(f"i = {i}" for i in result.block_rows)
    title = (
        f"Fit in % of the worst output on the {where} record; best at τ = {best['time_constant']:.4g} s, "
        f"i = {best['block_rows']}."
    )
    return _rendered(title, [Rows(head, body)], [])


def _rendered(sentence: str, tables: list[Rows], notes: list[str]) -> str:
    return environment().get_template("notebook.html.j2").render(sentence=sentence, tables=tables, notes=notes)
