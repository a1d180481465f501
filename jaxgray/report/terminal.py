"""What a person reads in the terminal: the verdict first, then the evidence; from `summary`'s documents."""

import contextlib
import math
import textwrap

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..numerics.progress import AbstractProgress, Silent
from .identification_rows import (
    MATRICES,
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
from .rows import Rows

WIDTH = 110


def console(*, error: bool = False) -> Console:
    """A console that takes text as it is, without markup, and keeps its width where it is piped."""
    made = Console(stderr=error, highlight=False, markup=False, emoji=False)
    if not made.is_terminal:
        made.width = WIDTH
    return made


class RichProgress(AbstractProgress):
    """The stage's name, a spinner and the time that has passed, gone when all is done.

    **Arguments:** `bar`: a started `rich.progress.Progress`.
    """

    def __init__(self, bar: Progress):
        self._bar = bar
        self._task = bar.add_task("starting", total=None)

    def stage(self, name: str, *, fraction: float | None = None) -> None:
        done = "" if fraction is None else f" {100 * fraction:.0f} %"
        self._bar.update(self._task, description=name + done)


class Spoken(AbstractProgress):
    """Every stage on a line of its own, once, for logs.

    **Arguments:** `out`: where to.
    """

    def __init__(self, out: Console):
        self._out = out
        self._last = ""

    def stage(self, name: str, *, fraction: float | None = None) -> None:
        if name != self._last:
            self._out.print(f"{name} …", soft_wrap=True)
        self._last = name


@contextlib.contextmanager
def progress(*, quiet: bool = False, verbose: bool = False):
    """Progress on the error stream while the body runs: silent when quiet or piped, in lines when verbose."""
    out = console(error=True)
    if quiet or not (out.is_terminal or verbose):
        yield Silent()
    elif verbose:
        yield Spoken(out)
    else:
        columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
        with Progress(*columns, console=out, transient=True) as bar:
            yield RichProgress(bar)


def show_identification(out: Console, document: dict) -> None:
    """Verdict, matrices ± one standard error, fits, modes, tests and warnings of an identification.

    **Arguments:** `out`: where to; `document`: by `identification_document`.
    """
    out.print(verdict(document), style="bold", soft_wrap=True)
    for name in MATRICES:
        out.print(table_of(matrix_rows(name, document["model"])))
    for rows in (element_rows(document), order_rows(document)):
        if rows is not None:
            out.print(table_of(rows))
    for line in hidden_lines(document):
        out.print(line, soft_wrap=True)
    out.print(table_of(fit_rows(document)))
    out.print(table_of(mode_rows(document)))
    for line in (*evidence_lines(document), start_line(document["start"])):
        out.print(line, soft_wrap=True)
    show_warnings(out, document["warnings"])


def new_table(title: str, *columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def table_of(rows: Rows, *, wrapped: tuple[int, ...] = ()) -> Table:
    """Rows as a table of the terminal: numbers to the right; columns that may take several lines are `wrapped`."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for k, title in enumerate(rows.head):
        justify = "left" if k == 0 or k in wrapped else "right"
        table.add_column(title, justify=justify, no_wrap=k not in wrapped)
    for row in rows.body:
        table.add_row(*row)
    return table


def show_sweep(out: Console, document: dict) -> None:
    """The table over τ × i, the best choice and its matrices.

    **Arguments:** `out`: where to; `document`: by `sweep_document`.
    """
    best, cells = document["best"], document["cells"]
    kind = "validation" if "validation" in best["fit_percent"] else "estimation"
    where = "on data the fit has not seen" if kind == "validation" else "on the data of the fit"
    shown = ", ".join(f"{name} {v:.2f} %" for name, v in best["fit_percent"][kind].items())
    out.print(
        f"Best of {len(cells) * len(cells[0])}: time constant {best['time_constant']:.4g} s, "
        f"{best['block_rows']} block rows: fit {shown} {where}.",
        style="bold",
        soft_wrap=True,
    )
    table = new_table("τ [s]", *(f"i = {i}" for i in document["block_rows"]))
    for tau, row in zip(document["time_constants"], cells):
        table.add_row(f"{tau:.4g}", *(_cell_text(cell, cell is best or _same(cell, best), kind) for cell in row))
    out.print(table)
    out.print(f"fit in % of the worst output, {kind} record; * best, – no stable model", soft_wrap=True)
    out.print(f"{document['unstable']} unstable, {document['failed']} without a model", soft_wrap=True)
    for name in MATRICES:
        places = list(best["fit_percent"][kind])
        table = new_table(name, *places)
        for place, row in zip(places, best[name]):
            table.add_row(place, *(f"{v:.5g}" for v in row))
        out.print(table)
    show_warnings(out, document["warnings"])


def _same(cell: dict, best: dict) -> bool:
    return all(cell[key] == best[key] for key in ("time_constant", "block_rows"))


def _cell_text(cell: dict, best: bool, kind: str) -> str:
    worst = min(cell["fit_percent"][kind].values())
    return "–" if math.isnan(worst) else f"{worst:.2f}{'*' if best else ''}"


def show_simulation(out: Console, document: dict) -> None:
    """Fit and RMSE per output of a free run.

    **Arguments:** `out`: where to; `document`: by `simulation_document`.
    """
    shown = ", ".join(f"{v:.1f} %" for v in document["fit_percent"].values())
    record = document["record"]
    out.print(f"Free run over {record['samples']} samples: fit {shown}.", style="bold", soft_wrap=True)
    table = new_table("output", "fit", "RMSE", "unit")
    for name, fit in document["fit_percent"].items():
        table.add_row(name, f"{fit:.2f} %", f"{document['rmse'][name]:.3g}", document["units"][name])
    out.print(table)
    show_warnings(out, document["warnings"])


def show_warnings(out: Console, warnings: list[str]) -> None:
    """Every warning, wrapped, in its colour."""
    for text in warnings:
        out.print(textwrap.fill(f"warning: {text}", out.width, subsequent_indent="  "), style="yellow")
