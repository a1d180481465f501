"""The tables of an identification, from its document: verdict, matrices, fits, modes, tests."""

import numpy as np

from ..numerics.text import entry_text, plus_minus
from .rows import Rows

MATRICES = ("mass", "damping", "stiffness")


def verdict(document: dict) -> str:
    """The outcome of an identification in one sentence."""
    model, fits = document["model"], document["fit_percent"]
    held_out = "validation" in fits
    values = list(fits["validation" if held_out else "estimation"].values())
    shown = ", ".join(f"{v:.1f} %" for v in values) if len(values) <= 4 else f"{min(values):.1f} to {max(values):.1f} %"
    drive = model.get("input_map") or model["base"]["direction"]
    where = "on data the fit has not seen" if held_out else "on the data of the fit"
    colour = "white" if document["residual_test"]["white"] else "not white"
    unseen = len(model.get("hidden") or ())
    coordinates = _count(len(model["mass"]), "coordinate") + (f", {unseen} of them hidden" if unseen else "")
    count = coordinates, _count(len(drive[0]), "input")
    kind = "" if document["refined"] else ", starting model without refinement"
    return f"{count[0]}, {count[1]}{kind}: fit {shown} {where}; residual {colour}."


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def matrix_rows(name: str, model: dict) -> Rows:
    """A matrix ± one standard error, its unit in the head where all entries share it.

    **Arguments:** `name`: "mass", "damping" or "stiffness"; `model`: of a document, with `standard_errors` and `units`.
    """
    places = coordinate_titles(model)
    kinds = model.get("entries")
    errors, units = model["standard_errors"], model["units"]
    unit = common_unit(units and units[name])
    body = []
    for r, place in enumerate(places):
        cells = []
        for c, value in enumerate(model[name][r]):
            error = None if errors is None else errors[name][r][c]
            text = entry_text(value, error, kinds and kinds[name][r][c])
            cells.append(text if unit or not units else f"{text} {units[name][r][c]}")
        body.append((place, *cells))
    return Rows((f"{name} [{unit}]" if unit else name, *places), tuple(body))


def coordinate_titles(model: dict) -> list[str]:
    """Names of the coordinates, those that no output measures in brackets."""
    hidden = model.get("hidden") or []
    return [*model["output_names"], *(f"({name})" for name in hidden)]


def element_rows(document: dict) -> Rows | None:
    """Masses, dampers and springs of a structure ± one standard error, None where none is named."""
    hidden = document.get("hidden")
    if not hidden or not hidden["elements"]:
        return None
    body = []
    for element in hidden["elements"]:
        value, error = element["value"], element["standard_error"]
        shown = "open" if value is None else plus_minus(value, 0.0 if element["known"] else error)
        body.append((element["name"], shown))
    return Rows(("element", "value"), tuple(body))


def order_rows(document: dict) -> Rows | None:
    """How many coordinates are hidden, and why; None where the number was given."""
    order = (document.get("hidden") or {}).get("order")
    if not order:
        return None
    body = []
    for step in order["steps"]:
        delta = "–" if step["delta_bic"] is None else f"{step['delta_bic']:+.1f}"
        gain = "–" if step["gain_percent"] is None else f"{step['gain_percent']:.2g} ± {step['gain_error']:.1g} %"
        verdict = "accepted" if step["accepted"] else step["failure"] or "not accepted"
        body.append((str(step["hidden"]), delta, gain, verdict))
    return Rows(("hidden", "ΔBIC", "held-out error falls by", "verdict"), tuple(body), frozenset({0, 3}))


def hidden_lines(document: dict) -> list[str]:
    """What to keep in mind with hidden coordinates."""
    return list((document.get("hidden") or {}).get("sentences") or ())


def common_unit(table: list[list[str]] | None) -> str | None:
    """The one unit of all entries, or None where they differ or are not known."""
    if table is None:
        return None
    units = {unit for row in table for unit in row}
    return units.pop() if len(units) == 1 else None


def fit_rows(document: dict) -> Rows:
    """Fit and error per output on both kinds of data."""
    fits, rmse, floor = document["fit_percent"], document["rmse"], document["noise_floor"]
    model = document["model"]
    columns = [text for kind in fits for text in (f"{kind} fit", "RMSE")]
    body = []
    for name, unit in zip(model["output_names"], model["output_units"]):
        cells = [text for kind in fits for text in (f"{fits[kind][name]:.2f} %", f"{rmse[kind][name]:.3g}")]
        body.append((name, *cells, f"{floor[name]:.3g}", unit))
    return Rows(("output", *columns, "noise floor", "unit"), tuple(body))


def mode_rows(document: dict) -> Rows:
    """Natural frequencies, damping ratios and shapes, the largest entry of each shape 1."""
    body = []
    for k, mode in enumerate(document["modes"]):
        shape = np.array(mode["shape"])
        ratio, error = mode["damping_ratio"], mode["damping_ratio_standard_error"]
        body.append(
            (
                str(k + 1),
                plus_minus(mode["frequency_hz"], mode["frequency_standard_error"]),
                plus_minus(None if ratio is None else 100 * ratio, None if error is None else 100 * error),
                *(f"{v:+.3f}" for v in shape / np.max(np.abs(shape))),
            )
        )
    head = "mode", "natural frequency [Hz]", "damping ratio [%]", *coordinate_titles(document["model"])
    return Rows(head, tuple(body))


def evidence_lines(document: dict) -> list[str]:
    """What the tests of the residual and of the structure say."""
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


def start_line(start: dict) -> str:
    """Where the refinement started from."""
    rows = "" if start["block_rows"] is None else f", {start['block_rows']} block rows"
    tau = "" if start["time_constant"] is None else f", time constant {start['time_constant']:.3g} s"
    return f"start: {start['method']}{tau}{rows}"
