"""Reading records and writing results for the commands."""

import warnings
from pathlib import Path

import numpy as np

from ..records import Record, RecordWarning, read_record
from .arguments import Channels, File, words


def check_holdout(channels: Channels) -> None:
    """Raise `ValueError` where a held-out share is none, or comes with a validation file."""
    if channels.holdout is None:
        return
    if channels.validation is not None:
        raise ValueError("--validation and --holdout are both given; leave one out.")
    if not 0.0 < channels.holdout < 1.0:
        raise ValueError(f"--holdout={channels.holdout:g} is not a share; give a number between 0 and 1.")


def read(path: Path, file: File, channels, notes: list[str]) -> Record:
    """A record by the options; what the reader warns of is added to the notes.

    **Arguments:** `path`: which file; `file`: how it is read; `channels`: has `inputs`, `outputs`, `hold`,
    `measured`, as text with commas or as lists; `notes`: is added to.

    **Returns:** a `Record`.

    **Raises:** `ValueError` where file and options do not fit.
    """

    def listed(name: str):
        value = getattr(channels, name)
        if not isinstance(value, str):
            return list(value)
        parts = words(value)
        if not parts:
            raise ValueError(f"--{name} is empty; name one or several columns, with commas between.")
        return parts

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RecordWarning)
        record = read_record(
            path,
            inputs=listed("inputs"),
            outputs=listed("outputs"),
            time=file.time,
            sampling_time=file.sampling_time,
            hold=channels.hold,
            measured=listed("measured"),
            scheduling=file.scheduling,
        )
    for one in caught:
        if issubclass(one.category, RecordWarning):
            notes.append(str(one.message))
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return record


def read_pair(file: File, channels: Channels, notes: list[str]) -> tuple[Record, Record | None]:
    """The record to fit, and the one to hold against it: another file, or the last part of the same."""
    check_holdout(channels)
    record = read(file.file, file, channels, notes)
    if channels.validation is not None:
        return record, read(channels.validation, file, channels, notes)
    if channels.holdout is not None:
        return record.split(channels.holdout)
    return record, None


def check_places(*paths) -> None:
    """Raise `ValueError` for a file that could not be written, before time is spent on what goes into it."""
    for path in paths:
        if path is None or str(path) == "-":
            continue
        if Path(path).is_dir():
            raise ValueError(f"{path} is a folder; give the name of a file.")
        if not Path(path).parent.is_dir():
            raise ValueError(f"{path}: the folder {Path(path).parent} is not there; create it first.")


def columns_text(columns: dict[str, np.ndarray]) -> str:
    """A table with commas; every number so that it is read again as it was, missing ones empty.

    **Arguments:** `columns`: by header.
    """
    cells = [["" if np.isnan(v) else repr(v) for v in column.tolist()] for column in columns.values()]
    headers = ",".join(f'"{name}"' if "," in name else name for name in columns)
    return "\n".join([headers, *(",".join(row) for row in zip(*cells))]) + "\n"


def header(name: str, unit: str) -> str:
    """Name and unit as `read_record` takes them apart."""
    return f"{name} [{unit}]" if unit else name


def record_columns(record: Record) -> dict[str, np.ndarray]:
    """Time, inputs and outputs of a record by their headers."""
    columns = {"time [s]": record.time}
    columns |= {header(n, u): x for n, u, x in zip(record.input_names, record.input_units, record.u.T)}
    columns |= {header(n, u): x for n, u, x in zip(record.output_names, record.output_units, record.y.T)}
    return columns


def simulation_columns(record: Record, simulated: np.ndarray) -> dict[str, np.ndarray]:
    """Time, and for every output what was measured, simulated, and the difference."""
    columns = {"time [s]": record.time}
    for name, unit, y, run in zip(record.output_names, record.output_units, record.y.T, simulated.T):
        columns[header(f"{name} measured", unit)] = y
        columns[header(f"{name} simulated", unit)] = run
        columns[header(f"{name} residual", unit)] = y - run
    return columns
