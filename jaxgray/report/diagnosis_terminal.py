"""What a person reads of a diagnosis in the terminal: the sentence first, then the evidence."""

import textwrap

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..diagnosis.words import entry_of, place_of, times, title_of, value_text
from ..numerics.text import plus_minus
from .terminal import MATRICES, new_table, show_warnings

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
    names = tuple(document["baseline"]["model"]["output_names"])
    out.print(document["sentence"], style="bold", soft_wrap=True)
    if document["findings"]:
        out.print(_findings_table(document["findings"], names))
    for finding in document["findings"]:
        if finding["message"]:
            _line(out, f"{title_of(finding['effect'], finding['location'], names)}: {finding['message']}")
    out.print(_error_table(document))
    _line(out, _left(document))
    moved = [shift for shift in document["shifts"] if shift["standard_error"] != 0 or shift["before"] != shift["after"]]
    if any(shift["standard_error"] != 0 for shift in moved):
        out.print(_shift_table(document, moved, names))
    if document["budget"]:
        out.print(_budget_table(document["budget"], names))
    if document["rejected"]:
        out.print(_rejected_table(document["rejected"], names, verbose))
    _show_not_found(out, document["not_found"], names, verbose)
    if document["next_experiment"] is not None:
        _line(out, _experiment(document["next_experiment"]))
    show_warnings(out, document["warnings"])


def _line(out: Console, text: str) -> None:
    out.print(textwrap.fill(text, out.width, subsequent_indent="  "), soft_wrap=True)


def _findings_table(findings: list[dict], names: tuple[str, ...]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("finding")
    table.add_column("status", no_wrap=True)
    table.add_column("ΔBIC", justify="right", no_wrap=True)
    table.add_column("gain (95 %)", no_wrap=True)
    table.add_column("parameters ± standard error")
    for finding in findings:
        table.add_row(
            title_of(finding["effect"], finding["location"], names),
            finding["status"] if finding["stage"] == "model" else "record",
            _number(finding["delta_bic"], "{:.0f}"),
            _gain(finding["gain"]),
            _parameters(finding["parameters"], fixed=finding["stage"] == "model"),
        )
        for member in finding["members"]:
            if (member["effect"], member["location"]) != (finding["effect"], finding["location"]):
                table.add_row(
                    "or " + title_of(member["effect"], member["location"], names),
                    "",
                    _number(member["delta_bic"], "{:+.1f}"),
                    "",
                    _parameters(member["parameters"]),
                )
    return table


def _gain(gain: dict | None) -> str:
    if gain is None or gain["percent"] is None:
        return "–"
    low, high = gain["ci95"]
    interval = "" if low is None or high is None else f" ({low:.1f} to {high:.1f})"
    return f"{gain['percent']:.1f} %{interval}" + ("" if gain["held_out"] else ", in-sample")


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def _parameters(parameters: dict, *, fixed: bool = True) -> str:
    """One parameter a line; `fixed`: say so of numbers that were not estimated."""
    lines = []
    for name, one in parameters.items():
        text = f"{name} = {value_text(one['value'], one['standard_error'], one['unit'])}"
        number = not isinstance(one["value"], str)
        lines.append(text + (" (fixed)" if fixed and number and one["standard_error"] is None else ""))
    return "\n".join(lines)


def _error_table(document: dict) -> Table:
    """Fit and free-run error per output, before and after, held out where there is such a record."""
    before, after = document["baseline"], document["extended"]
    kind = "validation" if before["rmse"].get("validation") else "estimation"
    name = "yours" if document["own_model"] else "linear"
    columns = [f"{name} fit", "RMSE"] + ([] if after is None else ["extended fit", "RMSE"])
    table = new_table(f"output, {kind}", *columns, "noise floor", "unit")
    model = before["model"]
    for place, unit in zip(model["output_names"], model["output_units"]):
        cells = []
        for part in (before, after):
            if part is not None:
                cells.append(_number(part["fit_percent"].get(kind, {}).get(place), "{:.2f} %"))
                cells.append(_number(part["rmse"].get(kind, {}).get(place), "{:.3g}"))
        table.add_row(place, *cells, _number(before["noise_floor"].get(place), "{:.3g}"), unit)
    return table


def _left(document: dict) -> str:
    """What remains after everything that was found."""
    remaining = document["remaining"]
    excess = remaining["excess"]
    text = f"left: {'an unknown multiple of' if excess is None else times(excess)} the noise floor"
    text += f" ({document['baseline']['noise_floor_source']}), {'white' if remaining['white'] else 'not white'}"
    if remaining["explainable"] is not None:
        text += f"; explainable share of the excess {100 * remaining['explainable']:.0f} %"
    if remaining["depends_on"]:
        text += f"; depends on {', '.join(remaining['depends_on'])}"
    return text


def _shift_table(document: dict, shifts: list[dict], names: tuple[str, ...]) -> Table:
    """Entries of M, D, K before and after."""
    name = "yours" if document["own_model"] else "linear"
    table = new_table("parameter", name, "extended ± se", "shift", "in se", "unit")
    units = document["baseline"]["model"]["units"]
    for shift in shifts:
        error = shift["standard_error"]
        change = None if None in (shift["after"], shift["before"]) else shift["after"] - shift["before"]
        matrix, r, c = entry_of(shift["name"], names)
        unit = ""
        if units and matrix in MATRICES and r in names and c in names:
            unit = units[matrix][names.index(r)][names.index(c)]
        table.add_row(
            shift["name"],
            plus_minus(shift["before"]),
            plus_minus(shift["after"], error),
            _number(shift["percent"], "{:+.1f} %"),
            "–" if not error or change is None else f"{change / error:+.1f}",
            unit,
        )
    return table


def _budget_table(budget: dict, names: tuple[str, ...]) -> Table:
    table = new_table("error budget", "share of the mean square error")
    for key, share in budget.items():
        effect, _, location = key.partition(" at ")
        table.add_row(title_of(effect, location, names) if location else key, _number(share, "{:.1f} %"))
    return table


def _rejected_table(rejected: list[dict], names: tuple[str, ...], verbose: bool) -> Table:
    """The best first; the reason may take several lines."""
    rows = sorted(rejected, key=lambda one: -float("inf") if one["delta_bic"] is None else one["delta_bic"])[::-1]
    shown = rows if verbose else rows[:FEW]
    title = "rejected" if len(shown) == len(rows) else f"rejected (first {len(shown)} of {len(rows)})"
    table = new_table(title, "ΔBIC")
    table.add_column("why")
    for one in shown:
        table.add_row(title_of(one["effect"], one["location"], names), _number(one["delta_bic"], "{:.0f}"), one["why"])
    return table


def _show_not_found(out: Console, not_found: list[dict], names: tuple[str, ...], verbose: bool) -> None:
    """Everything with the smallest visible size, or how many there are and that of the usual ones."""
    if not not_found:
        return
    if verbose:
        table = new_table("not found", "place")
        table.add_column("would have been seen from")
        for one in sorted(not_found, key=lambda one: (title_of(one["effect"], "").lower(), one["location"])):
            table.add_row(
                title_of(one["effect"], ""), place_of(one["location"], names), _smallest(one["min_detectable"])
            )
        out.print(table)
        return
    known = [one for one in not_found if _smallest(one["min_detectable"])]
    order = {effect: k for k, effect in enumerate(USUAL)}
    chosen: dict[str, dict] = {}
    for one in sorted(known, key=lambda one: order.get(one["effect"], len(order))):
        chosen.setdefault(one["effect"], one)
    few = [
        f"{title_of(one['effect'], one['location'], names)} from {_smallest(one['min_detectable'])}"
        for one in list(chosen.values())[:FEW]
    ]
    text = f"not found: {len(not_found)} other candidates"
    _line(out, text + (f"; would have been seen: {'; '.join(few)}" if few else "") + " (--verbose lists all)")


def _smallest(sizes: dict) -> str:
    """Smallest visible sizes, to as many digits as they are good for."""
    parts = []
    for name, one in sizes.items():
        values = one["value"] if isinstance(one["value"], list) else [one["value"]]
        if None not in values:
            text = ", ".join(v if isinstance(v, str) else f"{float(f'{v:.2g}'):g}" for v in values)
            parts.append(f"{name} = {text} {one['unit']}".strip())
    return ", ".join(parts)


def _experiment(experiment: dict) -> str:
    text = f"next experiment: {experiment['text']}"
    now, then = experiment["separation_now"], experiment["separation"]
    if now is not None and then is not None:
        text += f" Separation of the members, d²/σ²: {then:.3g} with it, {now:.3g} with this record."
    return text + " (--experiment writes the input)"
