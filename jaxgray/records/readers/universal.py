"""Universal files (UFF, UNV) of modal testing: time signals in datasets of type 58."""

import os
from collections import Counter
from pathlib import Path

import numpy as np

from jaxgray.records.readers.limits import reading
from jaxgray.records.readers.table import Table

FUNCTION = 58
TIME_RESPONSE = 1
UNKNOWN = 0
TIME = 17

# Specific data types of the ordinate.
KINDS = {8: "displacement", 9: "reaction", 11: "velocity", 12: "acceleration", 13: "force", 2: "stress", 3: "strain"}
DIRECTIONS = ("", "X", "Y", "Z", "RX", "RY", "RZ")


def read_universal(path: Path) -> Table:
    """A universal file; a signal bears its quantity, node and direction, `force 1+Z`, `acceleration 12-RX`.

    Signals of the same name are numbered, `force 1+Z #2`; functions over frequency and all other datasets are left
    out. Where every signal has the same time axis it is the column `time`.

    **Arguments:**

    - `path`: the file, text or binary.

    **Returns:** a `Table`.

    **Raises:** `ImportError` without pyuff, `ValueError` where the file has no time signals or their axes differ.
    """
    try:
        import pyuff
    except ImportError:
        raise ImportError(f"{path.name} needs pyuff: pip install 'jaxgray[uff]'.") from None

    with reading(path, "universal file"):
        file = pyuff.UFF(os.fspath(path))
        functions = [k for k, kind in enumerate(file.get_set_types()) if kind == FUNCTION]
        headers = [file.read_sets(k, header_only=True) for k in functions]
        signals = [_signal(file.read_sets(k)) for k, header in zip(functions, headers) if _over_time(header)]
    if not signals:
        raise ValueError(
            f"{path.name} is no universal file with time signals (datasets of type 58, function 1); it has "
            f"{len(functions)} other functions."
        )
    columns = [signal["data"][: signal["num_pts"]] for signal in signals]
    names = _names(signals)
    for name, signal, column in zip(names, signals, columns):
        if len(column) < signal["num_pts"]:
            raise ValueError(f"{path.name} is damaged: {name!r} has {len(column)} of {signal['num_pts']} values.")
    units = {name: _label(signal["ordinate_axis_units_lab"]) for name, signal in zip(names, signals)}
    time = signals[0]["x"][: len(columns[0])]
    for name, signal, column in zip(names, signals, columns):
        if not np.array_equal(signal["x"][: len(column)], time):
            raise ValueError(f"{path.name}: {names[0]!r} and {name!r} have different time axes; split the file.")
    unit = _label(signals[0]["abscissa_axis_units_lab"])
    columns.append(time)
    return Table(path.name, (*names, "time"), lambda k: columns[k], units=units | {"time": unit})


def _signal(found: dict) -> dict:
    """What is used of a data set, in the types that it should have; any error says that the file is damaged."""
    whole = {name: int(found[name]) for name in ("num_pts", "rsp_dir", "rsp_node", "ordinate_spec_data_type")}
    texts = {name: str(found[name]) for name in ("ordinate_axis_units_lab", "abscissa_axis_units_lab")}
    if whole["num_pts"] < 0:
        raise ValueError(f"a signal has {whole['num_pts']} values")
    return whole | texts | {name: np.asarray(found[name], dtype=float) for name in ("data", "x")}


def _over_time(header: dict) -> bool:
    if header["func_type"] == UNKNOWN:
        return header["abscissa_spec_data_type"] == TIME
    return header["func_type"] == TIME_RESPONSE


def _names(signals: list[dict]) -> list[str]:
    names, seen = [], Counter()
    for signal in signals:
        direction = signal["rsp_dir"]
        axis = DIRECTIONS[abs(direction)] if abs(direction) < len(DIRECTIONS) else str(abs(direction))
        sign = "" if direction == 0 else "-" if direction < 0 else "+"
        name = f"{KINDS.get(signal['ordinate_spec_data_type'], 'channel')} {signal['rsp_node']}{sign}{axis}"
        seen[name] += 1
        names.append(name if seen[name] == 1 else f"{name} #{seen[name]}")
    return names


def _label(text: str) -> str:
    text = text.strip()
    return "" if text.upper() == "NONE" else text
