"""What the user asks for, in words, turned into the objects that the pipeline takes."""

import difflib
import re

import jax
import numpy as np

from ...mechanics.model import hidden_names
from ...mechanics.systems.drives import AbstractDrive, BaseAcceleration, BaseDisplacement, Force
from ...numerics.matrices.linear_algebra import triangle
from ...records import Record
from .structure import Diagonal, Full, Structure
from .units import Scaling

EXCITATIONS = ("force", "base", "base-displacement", "base-acceleration")
_ACCELERATION_UNITS = ("m/s^2", "m/s2", "m/s²", "g", "mm/s^2", "mm/s2", "mm/s²")


def pick(kind: str, name, table: dict):
    """An entry of a table of choices by name; objects of the right kind pass through."""
    if not isinstance(name, str):
        return name
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise ValueError(f"{kind}={name!r} is not known{hint}; choose from {', '.join(table)}.")
    return table[name]


def parse_input_map(text: str, record: Record, hidden: tuple[str, ...] = ()) -> np.ndarray:
    """E from text such as "u1:y1,u2:y1-y2".

    **Arguments:** `text`: for every input the coordinate it acts on; `y1-y2` means +u on y1 and −u on y2;
    `record`: whose names are meant; `hidden`: names of coordinates that no output measures, default none.

    **Returns:** coordinates × inputs matrix.

    **Raises:** `ValueError` for an unknown name or an input without a place.
    """
    places_known = record.output_names + hidden
    E = np.zeros((len(places_known), record.inputs))
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, _, places = item.partition(":")
        if name.strip() not in record.input_names or not places:
            raise ValueError(
                f"input_map={text!r}: {item!r} is not input:coordinate; inputs are {', '.join(record.input_names)}."
            )
        column = record.input_names.index(name.strip())
        rest = places.strip()
        sign = 1.0
        if rest in places_known:
            E[places_known.index(rest), column] += 1.0
            continue
        for name in rest.split("-"):
            if name.strip() not in places_known:
                raise ValueError(
                    f"input_map={text!r}: no coordinate {name.strip()!r}; there are {', '.join(places_known)}."
                )
            E[places_known.index(name.strip()), column] += sign
            sign = -1.0
    if not np.all(np.any(E != 0, axis=0)):
        missing = [name for name, column in zip(record.input_names, E.T) if not np.any(column)]
        raise ValueError(f"input_map={text!r} gives no coordinate for {', '.join(missing)}; name one for each.")
    return E


def drive_by(record: Record, options: dict) -> AbstractDrive:
    """The drive that some options of `identify` describe, those that are not among them at their defaults.

    **Raises:** as `drive_of`.
    """
    given = {name: options[name] for name in ("excitation", "input_map", "relative") if name in options}
    hidden = options.get("hidden", 0)
    given["hidden"] = () if hidden == "auto" else hidden_names(hidden)
    return drive_of(record, **({"excitation": "force", "input_map": None, "relative": False} | given))


def drive_of(record: Record, excitation, input_map, relative: bool, hidden: tuple[str, ...] = ()) -> AbstractDrive:
    """The drive that excitation and input map describe.

    **Arguments:** `record`; `excitation`: "force", "base" (kind by the input's unit), "base-displacement",
    "base-acceleration"; `input_map`: matrix outputs × inputs, text, or None (input j acts on the coordinate of
    output j; a base moves all coordinates alike); `relative`: outputs measured relative to the base; `hidden`: names
    of coordinates that no output measures, default none: rows of the matrix for them come last, or are zeros.

    **Raises:** `ValueError` when they do not fit together.
    """
    if excitation not in EXCITATIONS:
        raise ValueError(f"excitation={excitation!r} is not known; choose from {', '.join(EXCITATIONS)}.")
    dofs = record.outputs + len(hidden)
    if isinstance(input_map, str):
        matrix = parse_input_map(input_map, record, hidden)
    elif input_map is not None:
        matrix = np.atleast_2d(np.array(input_map, dtype=float))
        if matrix.shape == (record.outputs, record.inputs) and excitation == "force":
            matrix = np.pad(matrix, ((0, len(hidden)), (0, 0)))
    elif excitation == "force":
        if record.inputs > record.outputs:
            raise ValueError(f"{record.inputs} inputs act on {record.outputs} coordinates; say where with input_map.")
        matrix = np.eye(dofs, record.inputs)
    else:
        matrix = np.ones((dofs, record.inputs))
    if matrix.shape != (dofs, record.inputs) or not np.all(np.isfinite(matrix)):
        raise ValueError(
            f"input_map has shape {matrix.shape}; give a finite matrix of {dofs} coordinates × {record.inputs} inputs."
        )
    if excitation == "force":
        drive = Force(jax.device_put(matrix))
    else:
        accelerated = excitation == "base-acceleration" or (
            excitation == "base" and all(unit.strip() in _ACCELERATION_UNITS for unit in record.input_units)
        )
        kind = BaseAcceleration if accelerated else BaseDisplacement
        drive = kind(jax.device_put(matrix), relative)
    drive.check(dofs, record.measured)
    return drive


_ENTRY = re.compile(r"^\s*(mass|damping|stiffness)\s*\[\s*(\d+)\s*,\s*(\d+)\s*\]\s*$")


def parse_fix(fix) -> dict[tuple[str, int, int], float]:
    """Known entries from a mapping or from text such as "stiffness[0,1]=0,mass[0,0]=5".

    **Raises:** `ValueError` for what is neither.
    """
    if fix is None:
        return {}
    if isinstance(fix, str):
        items = re.findall(r"\s*([^=]+?\])\s*=\s*([^,]+)\s*(?:,|$)", fix)
        if not items or re.sub(r"\s*([^=]+?\])\s*=\s*([^,]+)\s*(?:,|$)", "", fix).strip():
            raise ValueError(f"fix={fix!r} is not understood; write for example 'stiffness[0,1]=0,mass[0,0]=5'.")
    else:
        items = list(fix.items())
    entries = {}
    for key, value in items:
        match = _ENTRY.match(str(key).lstrip(", "))
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        if match is None or not np.isfinite(number):
            raise ValueError(f"fix: {key}={value} is not understood; write for example 'stiffness[0,1]=0'.")
        r, c = sorted((int(match[2]), int(match[3])))
        entries[match[1], r, c] = number
    return entries


def fixed_entries(
    entries: dict[tuple[str, int, int], float], structure: Structure, scaling: Scaling
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Which entries of the joined blocks are held, and the matrices' known entries in scaled units.

    **Arguments:** `entries` by `parse_fix`; `structure`; `scaling`.

    **Returns:** a mask over the joined block vectors, and per matrix an array with NaN where unknown.

    **Raises:** `ValueError` for an entry outside the matrix, or one that the structure does not leave by itself.
    """
    dofs = scaling.coordinates.shape[0]
    known = {name: np.full((dofs, dofs), np.nan) for name in ("mass", "damping", "stiffness")}
    for (name, r, c), value in entries.items():
        if c >= dofs:
            raise ValueError(f"fix: {name}[{r},{c}] is outside a model of {dofs} coordinates (indices from 0).")
        known[name][r, c] = known[name][c, r] = value
    one = np.ones((dofs, dofs))
    units = {n: np.asarray(X) for n, X in zip(known, scaling.matrices_in(one, one, one))}
    known = {name: X * units[name] for name, X in known.items()}
    mask = []
    for name in ("mass", "damping", "stiffness"):
        assembly = getattr(structure, name)
        values = known[name]
        if isinstance(assembly, Full):
            mask.append(np.isfinite(values[triangle(dofs)]))
        elif isinstance(assembly, Diagonal):
            if np.any(np.isfinite(values[~np.eye(dofs, dtype=bool)])):
                raise ValueError(f"fix: {name} is diagonal by structure; its other entries are zero already.")
            mask.append(np.isfinite(np.diag(values)))
        else:
            if np.any(np.isfinite(values)):
                raise ValueError(f"fix: entries of {name} cannot be fixed together with this structure; use one.")
            mask.append(np.zeros(sum(n * (n + 1) // 2 for n in assembly.sizes(dofs)), bool))
    return np.concatenate(mask), known


def scale_to(known: np.ndarray, matrix: np.ndarray) -> float:
    """The factor of a matrix that brings it nearest to its known entries.

    **Arguments:** `known`: not all zero, NaN where it is not known; `matrix`: positive definite.
    """
    given = np.isfinite(known)
    on_diagonal = given & np.eye(len(known), dtype=bool)
    chosen = on_diagonal if np.any(known[on_diagonal]) else given
    a, b = known[chosen], np.asarray(matrix)[chosen]
    return float(np.abs(a @ b) / (b @ b))


def with_known(matrix: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The matrix with known entries put in, pulled towards its diagonal until it is positive semidefinite.

    **Raises:** `ValueError` when the known entries alone contradict a positive semidefinite matrix.
    """
    given = np.isfinite(known)
    result = np.where(given, known, matrix)
    if not np.any(given):
        return result
    free = ~given & ~np.eye(len(matrix), dtype=bool)
    diagonal_free = ~given & np.eye(len(matrix), dtype=bool)
    for _ in range(60):
        values = np.linalg.eigvalsh(result)
        if values[0] > 1e-9 * max(values[-1], 1e-300) or (values[0] >= 0 and not np.any(free | diagonal_free)):
            return result
        result = np.where(free, 0.8 * result, result)
        result = np.where(diagonal_free, 1.2 * np.abs(result) + 1e-6 * np.max(np.abs(result)), result)
    if values[0] < -1e-9 * max(abs(values[-1]), 1e-300):
        raise ValueError("fix: the known entries cannot belong to a positive semidefinite matrix; check them.")
    return result
