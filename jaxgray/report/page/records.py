"""The part of a page on the records themselves: what they were, what is wrong with them, warnings."""

from ...records import Record, preflight
from ..rows import Rows
from .parts import Section, Table, Words


def record_section(records, held_out, document: dict, *notes: str) -> Section:
    """Sizes of the records, what is wrong with them as measured, warnings, notes.

    **Arguments:** `records`, `held_out`: of the fit and not; `document`: of the result, for its warnings; `notes`.

    **Returns:** the `Section`.
    """
    rows = [_row("fit", record) for record in records] + [_row("held out", record) for record in held_out]
    head = "record", "samples", "duration [s]", "sampling time [s]", "hold", "missing samples"
    blocks = [Table(Rows(head, tuple(rows), frozenset({0, 4})), "Records")]
    seen = [(one.location, one.severity, one.message) for record in records for one in preflight(record)]
    if seen:
        rows = Rows(("channel", "severity", "what was seen"), tuple(dict.fromkeys(seen)), frozenset({0, 1, 2}))
        blocks.append(Table(rows, "Looked at before any model"))
    else:
        notes = ("Looked at before any model: nothing was found.", *notes)
    warnings = tuple(f"Warning: {text}" for text in document["warnings"])
    blocks.append(Words((*notes, *warnings)))
    return Section(
        "data", "Data quality", "What was measured, before any model, and what to keep in mind.", tuple(blocks)
    )


def _row(kind: str, record: Record) -> tuple[str, ...]:
    missing = ", ".join(f"{name} {n}" for name, n in zip(record.output_names, record.missing.sum(axis=0)) if n)
    size = f"{record.samples}", f"{record.duration:.5g}", f"{record.sampling_time:.5g}"
    return kind, *size, record.hold, missing or "none"
