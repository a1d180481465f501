"""Results of a fleet as tables: one row a record for pandas, polars and DuckDB, and matrices for xarray."""

import io
import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..diagnosis.words.titles import place_of
from ..numerics.whole_files import replacing, write_whole
from ..report.diagnosis_rows import coordinate_names
from ..report.identification_rows import MATRICES
from .drift.series import Naming
from .store import Store

TABLE, ARRAYS = "results.parquet", "matrices.nc"

TEXTS = (
    "file",
    "key",
    "outcome",
    "failure_kind",
    "failure",
    "effect",
    "place",
    "effects",
    "effect_parameters",
    "machine",
    "when",
    "warnings",
    "page",
)
"""Columns of text; all others hold numbers."""


def row_of(file: str, store: Store, key: str | None, unread: str | None, naming: Naming) -> dict:
    """One row: what the result of a file says, as plain values.

    **Arguments:** `file`; `store`; `key` of its result, None where its bytes could not be read, for the reason
    `unread`; `naming`: says which machine, when.
    """
    result = None if key is None else store.read(key)
    if result is None:
        failure = {"kind": "Missing", "reason": unread or "its result is not in the store; call again"}
        result = {"failure": failure, "document": None, "columns": {}, "page": False, "run": {}}
    columns = result["columns"]
    machine, when, number = naming.machine_and_when(file, columns)
    document, failure = result["document"], result["failure"]
    row = dict.fromkeys(TEXTS)
    row |= {"file": file, "key": key, "machine": machine, "when": when, "when_number": number, "outcome": "failed"}
    row |= {"seconds": result["run"].get("seconds")} | columns
    if failure is not None:
        return row | {"failure_kind": failure["kind"], "failure": _of(file, result, failure["reason"])}
    row["page"] = f"pages/{key}.html" if result["page"] else None
    row["warnings"] = "\n".join(document["warnings"])
    return row | (_diagnosed(document) if "verdict" in document else _identified(document))


def _of(file: str, result: dict, reason: str) -> str:
    """A reason that names this file: the result of files with the same bytes was made of one of them."""
    other = str(result.get("file") or file)
    names = {other: str(file), Path(other).name: Path(file).name}
    either = "|".join(re.escape(name) for name in names)
    return re.sub(rf"(?<![\w.-])(?:{either})(?![\w-]|\.\w)", lambda found: names[found[0]], reason)


def _identified(document: dict) -> dict:
    kind = "validation" if "validation" in document["fit_percent"] else "estimation"
    row = {"outcome": "identified", "white": float(document["residual_test"]["white"])}
    row |= _model(document["model"]) | _modes(document["modes"]) | _record(document)
    ratios = [document["rmse"][kind][name] / floor for name, floor in document["noise_floor"].items() if floor]
    row["excess"] = float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None
    return row | _fits(document) | {f"noise_floor_{name}": value for name, value in document["noise_floor"].items()}


def _diagnosed(document: dict) -> dict:
    """Verdict, findings, and the model that they leave."""
    named = [one for one in document["findings"] if one["stage"] == "model" and one["status"] != "unexplained"]
    seen = named or document["findings"]
    part = document["extended"] or document["baseline"]
    names = coordinate_names(document)
    row = {"outcome": document["verdict"], "white": float(document["remaining"]["white"])}
    if seen:
        row |= {"effect": seen[0]["effect"], "place": seen[0]["location"]}
        row["effects"] = "; ".join(
            f"{one['effect']} {place_of(one['location'], names)}".strip() for one in document["findings"]
        )
        row["effect_parameters"] = json.dumps(seen[0]["parameters"], ensure_ascii=False)
        row["gain_percent"] = None if seen[0]["gain"] is None else seen[0]["gain"]["percent"]
    row |= _model(part["model"]) | _modes(document["modes"]) | _record(document) | _fits(part)
    row |= {f"noise_floor_{name}": value for name, value in document["baseline"]["noise_floor"].items()}
    return row | {"excess": document["remaining"]["excess"], "excess_before": document["baseline"]["excess"]}


def _model(model: dict) -> dict:
    """Upper triangles, `stiffness_y1_y2` and `stiffness_y1_y2_error`; on the diagonal `stiffness_y1`."""
    row, places = {}, model.get("coordinates") or model["output_names"]
    for name in MATRICES:
        for r, c in zip(*np.triu_indices(len(places))):
            column = f"{name}_{places[r]}" + ("" if r == c else f"_{places[c]}")
            errors = model["standard_errors"]
            row[column] = model[name][r][c]
            row[f"{column}_error"] = None if errors is None else errors[name][r][c]
    return row


def _modes(modes: list[dict]) -> dict:
    row = {}
    for k, mode in enumerate(modes, start=1):
        row |= {f"frequency_{k}_hz": mode["frequency_hz"], f"frequency_{k}_hz_error": mode["frequency_standard_error"]}
        row |= {f"damping_ratio_{k}": mode["damping_ratio"]}
        row[f"damping_ratio_{k}_error"] = mode["damping_ratio_standard_error"]
    return row


def _fits(part: dict) -> dict:
    return {
        f"{word}_{name}" + ("" if kind == "estimation" else f"_{kind}"): value
        for word in ("fit_percent", "rmse")
        for kind, values in part[word].items()
        for name, value in values.items()
    }


def _record(document: dict) -> dict:
    records = document["records"]["estimation"] + document["records"]["validation"]
    return {"samples": float(sum(one["samples"] for one in records)), "sampling_time": records[0]["sampling_time"]}


def parameters(row: dict) -> list[str]:
    """Columns of a row that are parameters of the system, each with a column of its error."""
    return [name for name in row if f"{name}_error" in row]


def columns_of(rows: list[dict]) -> list[str]:
    """Columns of all rows, in the order in which they first occur."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write_tables(folder: Path, rows: list[dict], documents: Iterable) -> tuple[Path, Path | None]:
    """Write the table, and the matrices with their covariances.

    **Arguments:** `folder`; `rows`; `documents`: key and result of every record, in the same order.

    **Returns:** the two files; None for the second where no record has a model.

    **Raises:** `ImportError` naming the extra to install.
    """
    try:
        import pyarrow
        import pyarrow.parquet
        import xarray  # noqa: F401
    except ImportError as error:
        raise ImportError(f"tables of a fleet need {error.name}: pip install 'jaxgray[fleet]'.") from None
    fields = []
    for name in columns_of(rows):
        text = name in TEXTS
        kind = pyarrow.string() if text else pyarrow.float64()
        values = [row.get(name) if text or row.get(name) is None else float(row[name]) for row in rows]
        fields.append((name, pyarrow.array(values, kind)))
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(dict(fields)), buffer)
    write_whole(buffer.getvalue(), folder / TABLE)
    return folder / TABLE, _write_matrices(folder, rows, documents)


def _write_matrices(folder: Path, rows: list[dict], documents: Iterable) -> Path | None:
    """One array over all records for each matrix and its errors, and the covariance of all entries where it is known.

    Records of other channels than the first that has a model, and those that failed, are not a number.
    """
    import xarray

    arrays, places, inputs = {}, None, None
    for k, (_, result) in enumerate(documents):
        document = None if result is None else result["document"]
        if document is None:
            continue
        model = (document.get("extended") or document.get("baseline") or document)["model"]
        if places is None:
            places, inputs = model.get("coordinates") or model["output_names"], model["input_names"]
            n, entries = len(places), 3 * len(places) * (len(places) + 1) // 2
            for name in MATRICES:
                arrays[name] = np.full((len(rows), n, n), np.nan)
                arrays[f"{name}_error"] = np.full((len(rows), n, n), np.nan)
            arrays["covariance"] = np.full((len(rows), entries, entries), np.nan)
        if np.shape(model["mass"]) != arrays["mass"].shape[1:]:
            continue
        for name in MATRICES:
            arrays[name][k] = model[name]
            if model["standard_errors"] is not None:
                arrays[f"{name}_error"][k] = np.array(model["standard_errors"][name], dtype=float)
        covariance = document.get("covariance")
        if covariance is not None:
            arrays["covariance"][k] = np.array(covariance["matrix"], dtype=float)
    if places is None:
        return None
    from ..identification.refinement.uncertainty import entry_names

    names = list(entry_names(len(places)))
    square, own = ("record", "coordinate", "with_coordinate"), ("record", "entry", "with_entry")
    data = xarray.Dataset(
        {name: (own if name == "covariance" else square, values) for name, values in arrays.items()},
        coords={
            "record": [row["file"] for row in rows],
            "coordinate": places,
            "with_coordinate": places,
            "entry": names,
            "with_entry": names,
        },
        attrs={"inputs": ", ".join(inputs), "covariance_of": "upper triangles by columns, in units of the records"},
    )
    path = folder / ARRAYS
    with replacing(path) as beside:
        data.to_netcdf(beside, engine="h5netcdf")
    return path
