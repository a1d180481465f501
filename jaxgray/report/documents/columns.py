"""Records and runs as delimited text: columns by header, every number so that it is read again as it was."""

import numpy as np

from ...records import Record


def columns_text(columns: dict[str, np.ndarray]) -> str:
    """A table with commas, missing numbers empty.

    **Arguments:** `columns`: by header.
    """
    cells = [["" if np.isnan(v) else repr(v) for v in column.tolist()] for column in columns.values()]
    headers = ",".join(_quoted(" ".join(name.split())) for name in columns)
    return "\n".join([headers, *(",".join(row) for row in zip(*cells))]) + "\n"


def _quoted(name: str) -> str:
    """A header that is one cell, and the first no comment."""
    quoted = any(letter in name for letter in ',"') or name.startswith(("#", "%"))
    return '"' + name.replace('"', '""') + '"' if quoted else name


def header(name: str, unit: str) -> str:
    """Name and unit as `read_record` takes them apart."""
    return f"{name} [{unit}]" if unit else name


def record_columns(record: Record) -> dict[str, np.ndarray]:
    """Time, inputs and outputs of a record by their headers."""
    columns = {"time [s]": record.time}
    columns |= {header(n, u): x for n, u, x in zip(record.input_names, record.input_units, record.u.T)}
    columns |= {header(n, u): x for n, u, x in zip(record.output_names, record.output_units, record.y.T)}
    return columns


def input_columns(record: Record, u: np.ndarray, sampling_time: float) -> dict[str, np.ndarray]:
    """Time and inputs, headed as in a record."""
    columns = {"time [s]": sampling_time * np.arange(len(u))}
    return columns | {header(n, unit): x for n, unit, x in zip(record.input_names, record.input_units, u.T)}


def simulation_columns(record: Record, simulated: np.ndarray) -> dict[str, np.ndarray]:
    """Time, and for every output what was measured, simulated, and the difference."""
    columns = {"time [s]": record.time}
    for name, unit, y, run in zip(record.output_names, record.output_units, record.y.T, simulated.T):
        columns[header(f"{name} measured", unit)] = y
        columns[header(f"{name} simulated", unit)] = run
        columns[header(f"{name} residual", unit)] = y - run
    return columns
