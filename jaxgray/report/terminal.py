"""What a person reads in the terminal: the verdict first, then the evidence; from `summary`'s documents."""

import contextlib
import math
import textwrap

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..numerics.progress import AbstractProgress, Silent
from ..numerics.text import plus_minus

WIDTH = 110
MATRICES = ("mass", "damping", "stiffness")


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


def verdict(document: dict) -> str:
    """The outcome of an identification in one sentence."""
    model, fits = document["model"], document["fit_percent"]
    held_out = "validation" in fits
    values = list(fits["validation" if held_out else "estimation"].values())
    shown = ", ".join(f"{v:.1f} %" for v in values) if len(values) <= 4 else f"{min(values):.1f} to {max(values):.1f} %"
    drive = model.get("input_map") or model["base"]["direction"]
    where = "on data the fit has not seen" if held_out else "on the data of the fit"
    colour = "white" if document["residual_test"]["white"] else "not white"
    count = _count(len(model["mass"]), "coordinate"), _count(len(drive[0]), "input")
    kind = "" if document["refined"] else ", starting model without refinement"
    return f"{count[0]}, {count[1]}{kind}: fit {shown} {where}; residual {colour}."


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def show_identification(out: Console, document: dict) -> None:
    """Verdict, matrices ± one standard error, fits, modes, tests and warnings of an identification.

    **Arguments:** `out`: where to; `document`: by `identification_document`.
    """
    out.print(verdict(document), style="bold", soft_wrap=True)
    for name in MATRICES:
        out.print(_matrix_table(name, document["model"]))
    out.print(_fit_table(document))
    out.print(_mode_table(document))
    for line in (*_test_lines(document), _start_line(document["start"])):
        out.print(line, soft_wrap=True)
    show_warnings(out, document["warnings"])


def new_table(title: str, *columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _matrix_table(name: str, model: dict) -> Table:
    places = model["output_names"]
    errors, units = model["standard_errors"], model["units"]
    unit = common_unit(units and units[name])
    table = new_table(f"{name} [{unit}]" if unit else name, *places)
    for r, place in enumerate(places):
        cells = []
        for c, value in enumerate(model[name][r]):
            text = plus_minus(value, None if errors is None else errors[name][r][c])
            cells.append(text if unit or not units else f"{text} {units[name][r][c]}")
        table.add_row(place, *cells)
    return table


def common_unit(table: list[list[str]] | None) -> str | None:
    """The one unit of all entries, or None where they differ or are not known."""
    if table is None:
        return None
    units = {unit for row in table for unit in row}
    return units.pop() if len(units) == 1 else None


def _fit_table(document: dict) -> Table:
    fits, rmse, floor = document["fit_percent"], document["rmse"], document["noise_floor"]
    model = document["model"]
    columns = [text for kind in fits for text in (f"{kind} fit", "RMSE")]
    table = new_table("output", *columns, "noise floor", "unit")
    for name, unit in zip(model["output_names"], model["output_units"]):
        cells = [text for kind in fits for text in (f"{fits[kind][name]:.2f} %", f"{rmse[kind][name]:.3g}")]
        table.add_row(name, *cells, f"{floor[name]:.3g}", unit)
    return table


def _mode_table(document: dict) -> Table:
    table = new_table("mode", "natural frequency [Hz]", "damping ratio [%]", *document["model"]["output_names"])
    for k, mode in enumerate(document["modes"]):
        shape = np.array(mode["shape"])
        ratio, error = mode["damping_ratio"], mode["damping_ratio_standard_error"]
        table.add_row(
            str(k + 1),
            plus_minus(mode["frequency_hz"], mode["frequency_standard_error"]),
            plus_minus(100 * ratio, None if error is None else 100 * error),
            *(f"{v:+.3f}" for v in shape / np.max(np.abs(shape))),
        )
    return table


def _test_lines(document: dict) -> list[str]:
    tests, found = document["residual_test"], document["structure_test"]
    lines = [
        f"residual: {'white' if tests['white'] else 'not white'}; past inputs explain "
        f"{'more of it' if tests['input_explained'] else 'no more of it'}; "
        f"{'correlated with future inputs (feedback)' if tests['feedback'] else 'no sign of feedback'}"
    ]
    if found is not None:
        more = f"another linear model explains {found['explained_percent']:.2g} % more of the residual"
        fits = "M, D, K suffice" if found["fits"] else "M, D, K do not suffice: " + more
        p = found["p_value"]
        lines.append(f"structure: {fits} ({f'p = {p:.2g}' if p > 1e-16 else 'p < 1e-16'})")
    return lines


def _start_line(start: dict) -> str:
    rows = "" if start["block_rows"] is None else f", {start['block_rows']} block rows"
    return f"start: {start['method']}, time constant {start['time_constant']:.3g} s{rows}"


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
