"""The tables of a diagnosis, from its document: findings, errors, shifts, budget, what was rejected or not found."""

import re

from ..diagnosis.words.sentences import entry_of, times
from ..diagnosis.words.titles import NAMES, place_of, title_of, value_text
from ..numerics.text import listed, plus_minus
from .identification_rows import MATRICES
from .rows import Rows, number

_ID = re.compile(r"\b[a-z]+(_[a-z]+)+\b")

COUNTS = 10.0
"""ΔBIC at the gate from which a candidate is listed though it was not refitted."""

MORE = 5
"""Candidates of the gate that are looked through beyond those that were refitted."""


def coordinate_names(document: dict) -> tuple[str, ...]:
    """Names of the coordinates: those of the outputs, then those that no output measures."""
    model = document["baseline"]["model"]
    return tuple(model.get("coordinates") or model["output_names"])


def findings_rows(document: dict) -> Rows:
    """What was found: status, ΔBIC of the refit, gain, parameters; the rest of a class below its first."""
    names = coordinate_names(document)
    body = []
    for finding in document["findings"]:
        modelled = finding["stage"] == "model"
        body.append(
            (
                title_of(finding["effect"], finding["location"], names),
                finding["status"] if modelled else "record",
                number(finding["delta_bic"], "{:.0f}"),
                gain_words(finding["gain"]),
                parameter_lines(finding["parameters"], fixed=modelled),
            )
        )
        for member in rivals(finding):
            body.append(
                (
                    ("or " if finding["status"] == "equivalent" else "rather than ")
                    + title_of(member["effect"], member["location"], names),
                    "",
                    number(member["delta_bic"], "{:+.1f}"),
                    "",
                    parameter_lines(member["parameters"]),
                )
            )
    head = "finding", "status", "ΔBIC", "gain (95 %)", "parameters ± standard error"
    return Rows(head, tuple(body), frozenset({0, 1, 3, 4}))


def rivals(finding: dict) -> list[dict]:
    """The other members of a finding's class."""
    mine = finding["effect"], finding["location"]
    return [member for member in finding["members"] if (member["effect"], member["location"]) != mine]


def gain_words(gain: dict | None) -> str:
    """64.2 % (61.1 to 66.8), and whether it is not proven on held-out data."""
    if gain is None or gain["percent"] is None:
        return "–"
    low, high = gain["ci95"]
    interval = "" if low is None or high is None else f" ({low:.1f} to {high:.1f})"
    count = gain.get("together", 1)
    shared = f", one of {count} that gain this together" if count > 1 else ""
    return f"{gain['percent']:.1f} %{interval}" + ("" if gain["held_out"] else ", in-sample") + shared


def estimated(parameters: dict) -> dict:
    """Parameters that were estimated, or are words; all where none was."""
    told = {k: e for k, e in parameters.items() if e["standard_error"] is not None or isinstance(e["value"], str)}
    return told or parameters


def parameter_lines(parameters: dict, *, fixed: bool = True) -> str:
    """One parameter a line; `fixed`: say so of numbers that were not estimated."""
    lines = []
    for name, one in parameters.items():
        text = f"{name} = {value_text(one['value'], one['standard_error'], one['unit'])}"
        given = not isinstance(one["value"], str) and one["standard_error"] is None
        lines.append(text + (" (fixed)" if fixed and given else ""))
    return "\n".join(lines)


def error_kind(document: dict) -> str:
    """The data that errors are told on: held out where there is such a record."""
    return "validation" if document["baseline"]["rmse"].get("validation") else "estimation"


def error_rows(document: dict) -> Rows:
    """Fit and free-run error per output, before and after, held out where there is such a record."""
    before, after = document["baseline"], document["extended"]
    kind = error_kind(document)
    name = "yours" if document["own_model"] else "linear"
    head = [f"output, {kind}", f"{name} fit", "RMSE"] + ([] if after is None else ["extended fit", "RMSE"])
    model, body = before["model"], []
    for place, unit in zip(model["output_names"], model["output_units"]):
        cells = [place]
        for part in (before, after):
            if part is not None:
                cells.append(number(part["fit_percent"].get(kind, {}).get(place), "{:.2f} %"))
                cells.append(number(part["rmse"].get(kind, {}).get(place), "{:.3g}"))
        body.append((*cells, number(before["noise_floor"].get(place), "{:.3g}"), unit))
    return Rows((*head, "noise floor", "unit"), tuple(body))


def what_is_left(document: dict) -> str:
    """What remains after everything that was found."""
    remaining = document["remaining"]
    excess = remaining["excess"]
    text = f"{'an unknown multiple of' if excess is None else times(excess)} the noise floor"
    text += f" ({document['baseline']['noise_floor_source']}), {'white' if remaining['white'] else 'not white'}"
    if remaining["explainable"] is not None:
        text += f"; explainable share of the excess {100 * remaining['explainable']:.0f} %"
    if remaining["depends_on"]:
        text += f"; depends on {', '.join(remaining['depends_on'])}"
    return text


def energy_words(document: dict) -> str | None:
    """Where the energy goes in the model with its laws; None where that is not known."""
    energy = document.get("energy")
    if energy is None or not energy["entered"]:
        return None
    names = coordinate_names(document)
    parts = {"the inputs": -energy["supplied"], "damping": energy["damped"]}
    parts |= {title_of(law["effect"], law["location"], names): law["work"] for law in energy["laws"]}
    if energy["circulated"]:
        parts["circulatory coupling"] = energy["circulated"]
    parts["motion and springs at the end"] = energy["stored"]

    def percent(value):
        return f"{100 * value / energy['entered']:.1f} %"

    taken = [f"{name} {percent(work)}" for name, work in parts.items() if work > 0]
    given = [f"{name} {percent(-work)}" for name, work in parts.items() if work < 0]
    amount = f"{energy['entered']:.3g} {energy['unit']}".rstrip()
    return f"{amount} from {listed(given)}; to {listed(taken)}; missing {percent(abs(energy['residual']))}"


def shift_rows(document: dict) -> Rows | None:
    """Entries of M, D, K before and after; None where none was free to move."""
    shifts = [s for s in document["shifts"] if s["standard_error"] != 0 or s["before"] != s["after"]]
    if not any(shift["standard_error"] != 0 for shift in shifts):
        return None
    names, units = coordinate_names(document), document["baseline"]["model"]["units"]
    body = []
    for shift in shifts:
        error = shift["standard_error"]
        change = None if None in (shift["after"], shift["before"]) else shift["after"] - shift["before"]
        matrix, r, c = entry_of(shift["name"], names)
        unit = ""
        if units and matrix in MATRICES and r in names and c in names:
            unit = units[matrix][names.index(r)][names.index(c)]
        body.append(
            (
                shift["name"],
                plus_minus(shift["before"]),
                plus_minus(shift["after"], error),
                number(shift["percent"], "{:+.1f} %"),
                "–" if not error or change is None else f"{change / error:+.1f}",
                unit,
            )
        )
    head = "parameter", "yours" if document["own_model"] else "linear", "extended ± se", "shift", "in se", "unit"
    return Rows(head, tuple(body))


def budget_name(key: str, names: tuple[str, ...]) -> str:
    """What an entry of the error budget is called."""
    effect, _, location = key.partition(" at ")
    return title_of(effect, location, names) if location else key


def budget_rows(document: dict) -> Rows:
    """Share of every term, of noise and of the unexplained."""
    names = coordinate_names(document)
    body = tuple((budget_name(key, names), number(v, "{:.1f} %")) for key, v in document["budget"].items())
    return Rows(("error budget", "share of the mean square error"), body)


def rejected_rows(document: dict) -> Rows:
    """What passed the gate and was not taken, the best first, and why."""
    names = coordinate_names(document)
    least = -float("inf")
    rows = sorted(document["rejected"], key=lambda one: least if one["delta_bic"] is None else one["delta_bic"])[::-1]
    body = tuple(
        (title_of(one["effect"], one["location"], names), number(one["delta_bic"], "{:.0f}"), one["why"])
        for one in rows
    )
    return Rows(("rejected", "ΔBIC", "why"), body, frozenset({0, 2}))


def candidates(document: dict) -> list[dict]:
    """Every candidate that was looked at closely: findings with their classes, what was rejected, what passed the gate.

    **Returns:** one dictionary each, by its evidence: `effect`, `location`, `gate` and `refit` (ΔBIC, None where there
    is none), `parameters`, `gain`, `status`, `why`.
    """
    gate = {(one["effect"], one["location"]): one["delta_bic"] for one in document["gate"]}
    found: dict[tuple[str, str], dict] = {}

    def add(one: dict, **more) -> None:
        name = one["effect"], one["location"]
        empty = {"refit": one["delta_bic"], "gate": gate.get(name), "parameters": {}, "gain": None, "why": ""}
        found.setdefault(name, {"effect": name[0], "location": name[1], **empty, **more})

    for finding in document["findings"]:
        if finding["stage"] == "model" and finding["delta_bic"] is not None:
            add(finding, parameters=finding["parameters"], gain=finding["gain"], status=finding["status"])
            for member in rivals(finding):
                below = None if member["delta_bic"] is None else finding["delta_bic"] + member["delta_bic"]
                alike = finding["status"] == "equivalent"
                status = "in the class" if alike else "rejected"
                why = "this record cannot tell it from the finding" if alike else "stood in for the finding earlier"
                add(member, refit=below, parameters=member["parameters"], status=status, why=why)
    for one in document["rejected"]:
        add(one, parameters=one["parameters"], gain=one["gain"], status="rejected", why=one["why"])
    for one in document["gate"][: len(found) + MORE]:
        if (one["delta_bic"] or 0) >= COUNTS:
            add(one, refit=None, status="not refitted", why="others explained more")
    least = -float("inf")
    return sorted(
        found.values(),
        key=lambda row: tuple(least if row[key] is None else row[key] for key in ("refit", "gate")),
        reverse=True,
    )


def in_words(text: str) -> str:
    """A reason with names for the ids of effects."""
    return _ID.sub(lambda found: NAMES.get(found[0], found[0]), text)


def candidate_rows(document: dict) -> Rows:
    """The ranking of the candidates, without columns that have nothing to tell."""
    names = coordinate_names(document)
    body = tuple(
        (
            title_of(row["effect"], "", names),
            row["location"],
            number(row["gate"], "{:.0f}"),
            number(row["refit"], "{:.0f}"),
            parameter_lines(estimated(row["parameters"]), fixed=False) or "–",
            gain_words(row["gain"]),
            row["status"],
            in_words(row["why"]),
        )
        for row in candidates(document)
    )
    head = "candidate", "place", "ΔBIC gate", "ΔBIC refit", "size ± standard error", "gain (95 %)", "status", "why not"
    told = [k for k in range(len(head)) if k < 2 or any(row[k] not in ("", "–") for row in body)]
    words = frozenset(new for new, k in enumerate(told) if k not in (2, 3))
    return Rows(tuple(head[k] for k in told), tuple(tuple(row[k] for k in told) for row in body), words)


def not_found_rows(document: dict) -> Rows:
    """Every other candidate with the smallest size that would have been seen, by name."""
    names = coordinate_names(document)
    rows = sorted(document["not_found"], key=lambda one: (title_of(one["effect"], "").lower(), one["location"]))
    body = tuple(
        (title_of(one["effect"], ""), place_of(one["location"], names), smallest(one["min_detectable"])) for one in rows
    )
    return Rows(("not found", "place", "would have been seen from"), body, frozenset({0, 1, 2}))


def smallest(sizes: dict) -> str:
    """Smallest visible sizes, to as many digits as they are good for."""
    parts = []
    for name, one in sizes.items():
        values = one["value"] if isinstance(one["value"], list) else [one["value"]]
        if None not in values:
            text = ", ".join(v if isinstance(v, str) else f"{float(f'{v:.2g}'):g}" for v in values)
            parts.append(f"{name} = {text} {one['unit']}".strip())
    return ", ".join(parts)


def experiment_words(experiment: dict) -> str:
    """The experiment that is proposed, and what it is worth."""
    text = experiment["text"]
    now, then = experiment["separation_now"], experiment["separation"]
    if now is not None and then is not None:
        text += f" Separation of the members, d²/σ²: {then:.3g} with it, {now:.3g} with this record."
    return text
