"""Records of one shape identified side by side, as the documents that `identify` would have written."""

import numpy as np

from ..identification.batch.many import identify_many
from ..identification.batch.result import Identifications
from ..identification.refinement.uncertainty import entry_names
from ..mechanics.matrix_units import matrix_units
from ..records import Record
from ..report.documents.export import model_document, plain
from ..report.documents.identification import IDENTIFICATION, antiresonances, modes_of, per_name, record_document
from ..report.identification_rows import MATRICES, fit_rows, matrix_rows, mode_rows
from ..report.page.parts import Fact, Page, Section, Table, Tables, Words


def identified(records: list[Record], plan: dict, fitting: dict, batch: int) -> list[dict | None]:
    """Documents of records of one shape.

    **Arguments:** `records`; `plan`: time constants [s] and block rows of the fleet; `fitting`: further keywords of
    `identify_many`; `batch`: how many are computed at once; fewer are filled up, so that one program serves all.

    **Returns:** a document per record, shaped as that of `identify`; None where the batch has no safe answer, or where
    the residual is not white, so that error bars need a second look.
    """
    options = {name: fitting[name] for name in ("weight", "input_map", "structure") if fitting.get(name) is not None}
    filled = records + records[-1:] * (batch - len(records))
    try:
        found = identify_many(
            filled, time_constants=plan["time_constants"], block_rows=plan["block_rows"], alone=False, **options
        )
    except (ValueError, RuntimeError):
        return [None] * len(records)
    usable = found.successful & found.white
    return [_document(found, k, record) if usable[k] else None for k, record in enumerate(records)]


def _document(found: Identifications, k: int, record: Record) -> dict:
    model, covariance = found.model(k), found.covariance[k]
    names = record.output_names
    errors = {name: X[k].tolist() for name, X in found.standard_errors.items()}
    document = {
        "schema": IDENTIFICATION,
        "model": model_document(model) | {"standard_errors": errors, "units": matrix_units(model)},
        "fit_percent": {"estimation": per_name(names, found.fit_percent[k])},
        "rmse": {"estimation": per_name(names, found.rmse[k])},
        # Of a white residual nothing can be predicted: all of it is floor.
        "noise_floor": per_name(names, found.rmse[k]),
        "start": {
            "method": "subspace",
            "time_constant": float(found.time_constant[k]),
            "block_rows": int(found.block_rows[k]),
            "singular_values": None,
        },
        "refined": True,
        "modes": modes_of(model, covariance),
        "zeros_hz": antiresonances(model),
        "covariance": {"names": list(entry_names(len(names))), "matrix": covariance.tolist()},
        # The batch leaves these unsaid.
        **dict.fromkeys(("condition_number", "at_edge", "weak_directions", "unmoved", "hidden", "aic", "bic")),
        "residual_test": {"white": bool(found.white[k]), "input_explained": None, "feedback": None},
        "structure_test": None,
        "noise": {"form": "output-error"},
        "clocks": [],
        "records": {"estimation": [record_document(record)], "validation": []},
        "warnings": [found.details[k]] if found.details[k] else [],
    }
    return plain(document)


def page_of_document(document: dict, file: str) -> Page:
    """The page of a record that was identified in a batch: all its numbers, without curves."""
    fits = document["fit_percent"]["estimation"]
    cards = tuple(Fact(f"Fit at {name}", f"{fit:.2f} %", "on the data of the fit") for name, fit in fits.items())
    modes = tuple(
        Fact(f"Mode {row[0]}", f"{row[1]} Hz", f"damping ratio {row[2]} %") for row in mode_rows(document).body[:4]
    )
    tables = tuple(Table(matrix_rows(name, document["model"]), name.capitalize()) for name in MATRICES)
    notes = tuple(f"Warning: {text}" for text in document["warnings"]) or ("No warnings.",)
    shown = ", ".join(f"{fit:.1f} %" for fit in fits.values())
    one = document["records"]["estimation"][0]
    size = f"{file}: {one['samples']} samples, every {one['sampling_time']:.6g} s."
    return Page(
        "Mass, damping and stiffness",
        "identification",
        "refined",
        f"{np.shape(document['model']['mass'])[0]} coordinates: fit {shown} on the data of the fit; residual white.",
        (cards[:4], modes),
        (
            Section("model", "Mass, damping, stiffness", "Each entry ± one standard error.", (Tables(tables),)),
            Section(
                "fit",
                "Fit",
                "Free run from the input alone; identified side by side with other records of its shape.",
                (Table(fit_rows(document), "Fit and error of the free run"),),
            ),
            Section(
                "modes",
                "Modes",
                "Natural frequencies, damping ratios and shapes; the largest entry of a shape is 1.",
                (Table(mode_rows(document), "Modes ± standard error"),),
            ),
            Section("data", "Data", "What was measured.", (Words((size, *notes)),)),
        ),
        document,
    )
