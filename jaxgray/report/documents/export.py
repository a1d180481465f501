"""Models and results as files: strict JSON, and NPZ for exact arrays; never pickle."""

import io
import json
import math
import os
import reprlib
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ...mechanics.model import MechanicalModel
from ...mechanics.systems.drives import BaseAcceleration, BaseDisplacement, Force
from ...numerics.whole_files import write_whole
from ...records.readers.containers import KINDS, npz_members
from ...records.readers.limits import check_file, reading
from .terms import term_document, term_of

SCHEMA = "jaxgray/model/1"

MATRICES = ("mass", "damping", "stiffness")
TEXTS = ("measured", "input_names", "output_names", "input_units", "output_units")
BASES = {"displacement": BaseDisplacement, "acceleration": BaseAcceleration}

LONGEST = 1000
"""Letters of a message about a file, which may hold texts of any length."""

SYMMETRY = 1e-8
"""Largest difference across the diagonal, relative to the largest entry, that counts as rounding."""


def save(result_or_model, path) -> None:
    """Write a model, or the model of a result, to a file; the file is whole or not there.

    **Arguments:** `result_or_model`: a `MechanicalModel`, an identification, or a diagnosis (its extended model, with
    effects, where it has one); `path`: ending in .json or .npz.

    **Raises:** `ValueError` for another ending.

    **Example:**

        >>> import jaxgray
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> jaxgray.save(model, "model.json")
        >>> float(jaxgray.load("model.json").stiffness[0, 0])
        80.0
    """
    model = model_of(result_or_model)
    document = {"schema": SCHEMA, **model_document(model)}
    kind = _kind(path)
    if kind == ".json":
        write_json(document, path)
        return
    if "base" in document:
        base = document.pop("base")
        document |= {f"base_{key}": value for key, value in base.items()}
    if "effects" in document:
        document["effects"] = json.dumps(document["effects"])
    buffer = io.BytesIO()
    np.savez(buffer, **{key: np.asarray(value) for key, value in document.items()})
    write_whole(buffer.getvalue(), path)


def model_of(result_or_model) -> MechanicalModel:
    """The model itself, or that of a result: of an identification, or of a diagnosis, extended where it is so.

    **Raises:** `ValueError` for anything else.
    """
    if isinstance(result_or_model, MechanicalModel):
        return result_or_model
    for name in ("model", "extended", "baseline"):
        part = getattr(result_or_model, name, None)
        model = getattr(part, "model", part)
        if isinstance(model, MechanicalModel):
            return model
    raise ValueError(f"there is no model in a {type(result_or_model).__name__}; give a model or a result.")


def model_document(model: MechanicalModel) -> dict:
    """A model as plain lists, numbers and texts, without the schema: the "model" of every result's JSON."""
    document = {name: np.asarray(getattr(model, name)).tolist() for name in MATRICES}
    drive = model.drive
    if isinstance(drive, Force):
        document["input_map"] = np.asarray(drive.input_map).tolist()
    else:
        kind = next(kind for kind, base in BASES.items() if isinstance(drive, base))
        direction = np.asarray(drive.direction).tolist()
        document["base"] = {"kind": kind, "direction": direction, "relative": drive.relative}
    if model.effects:
        document["effects"] = [term_document(term) for term in model.effects]
    document |= {name: list(getattr(model, name)) for name in TEXTS}
    if model.hidden:
        document |= {"coordinates": list(model.coordinates), "hidden": list(model.hidden)}
    return document


def load(path) -> MechanicalModel:
    """Read a model.

    **Arguments:** `path`: a file that `save` wrote, or JSON with at least "mass", "damping" and "stiffness"
    (and "input_map" or "base"), at the top or under "model", or under "extended" or "baseline" and "model" as
    a diagnosis has them (extended before baseline).

    **Returns:** a `MechanicalModel`.

    **Raises:** `ValueError` when the file is missing or unreadable, or a key or matrix is missing or wrong.

    **Example:**

        >>> import pathlib, jaxgray
        >>> _ = pathlib.Path("mine.json").write_text('{"mass": [[2.0]], "damping": [[3.0]], "stiffness": [[80.0]]}')
        >>> jaxgray.load("mine.json").modes().natural_frequency_hz.round(3)
        array([1.007])
    """
    path = Path(path)
    check_file(path, "model")
    document = _document(path)
    try:
        return _model(document)
    except (ValueError, OverflowError) as error:
        text = str(error)
        raise ValueError(f"{path}: {text if len(text) <= LONGEST else text[:LONGEST] + ' …'}") from None


def _document(path: Path) -> dict:
    return _read_npz(path) if _kind(path) == ".npz" else _model_part(read_json(path), path)


def given(path) -> dict[str, int]:
    """What a model file says itself, rather than leaving it to defaults: how many entries every key has, 0 for none.

    **Arguments:** `path`: of a file that `load` reads.
    """
    document = _document(Path(path))
    entries = {key: document.get(key) for key in ("input_map", "base", "effects", *TEXTS)}
    return {key: len(entry) if isinstance(entry, dict | list | str) else 0 for key, entry in entries.items()}


def write_json(obj, path) -> None:
    """Write strict JSON; the file is whole or not there.

    **Arguments:** `obj`: dictionaries, lists, texts, numbers, NumPy or JAX arrays and scalars; NaN and
    infinite numbers become null; `path`.

    **Raises:** `ValueError` for something that JSON has no word for.
    """
    write_whole(json_text(obj).encode(), path)


def json_text(obj) -> str:
    """What `write_json` writes, as text."""
    return json.dumps(plain(obj), allow_nan=False, ensure_ascii=False, indent=1) + "\n"


def plain(obj):
    """What JSON has words for: numbers, texts, lists, dictionaries; None for NaN and infinite numbers.

    **Raises:** `ValueError` for something that JSON has no word for.
    """
    return _plain(obj, "")


def _plain(obj, place: str):
    """`place`: what it is called in an error."""
    if obj is None or isinstance(obj, bool | str):
        return obj
    if isinstance(obj, dict):
        return {str(key): _plain(value, f"{place}.{key}") for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [_plain(value, f"{place}[{k}]") for k, value in enumerate(obj)]
    if isinstance(obj, int):
        return obj
    if isinstance(obj, float):
        return float(obj) if math.isfinite(obj) else None
    if isinstance(obj, os.PathLike):
        return os.fspath(obj)
    if hasattr(obj, "__array__"):
        array = np.asarray(obj)
        if array.dtype.kind in "biufU":
            return _plain(array.tolist(), place)
    raise ValueError(f"{place.lstrip('.') or 'obj'} is a {type(obj).__name__}; give numbers, texts, lists, arrays.")


def _kind(path) -> str:
    kind = Path(path).suffix.lower()
    if kind not in (".json", ".npz"):
        raise ValueError(f"{path}: the ending {kind!r} is not known; give .json or .npz.")
    return kind


def read_json(path: Path):
    """What a JSON file holds.

    **Raises:** `ValueError` where it is none.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: this is not JSON that can be read ({error}).") from None


def _model_part(document, path: Path) -> dict:
    """Where the model stands in one of our files, or in one written by hand."""
    if not isinstance(document, dict):
        raise ValueError(f"{path}: the top is a {type(document).__name__}; give an object with {_KEYS}.")
    parts = [document, document.get("model")]
    for name in ("extended", "baseline"):
        part = document.get(name)
        parts.append(part.get("model") if isinstance(part, dict) else None)
    for part in parts:
        if isinstance(part, dict) and any(name in part for name in MATRICES):
            return part
    raise ValueError(f"{path}: no model in it; give {_KEYS}, at the top or under 'model'.")


_KEYS = "'mass', 'damping' and 'stiffness'"


def _read_npz(path: Path) -> dict:
    with reading(path, "NPZ file of arrays"):
        document = {key: _plain_array(stored.read()) for key, stored in npz_members(path, KINDS + "U").items()}
    base = {key: document.pop(f"base_{key}") for key in ("kind", "direction", "relative") if f"base_{key}" in document}
    if isinstance(document.get("effects"), str):
        try:
            document["effects"] = json.loads(document["effects"])
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: its effects are not JSON that can be read ({error}).") from None
    return document | ({"base": base} if base else {})


def _plain_array(values: np.ndarray):
    """Numbers, or texts once it is known that they are some: NumPy hands out damaged bytes as texts that Python fails
    on later."""
    if values.dtype.kind == "U":
        letters = np.frombuffer(values.tobytes(), np.dtype("u4").newbyteorder(values.dtype.byteorder))
        if letters.size and letters.max() > sys.maxunicode:
            raise ValueError("a text in it is damaged")
    return values.tolist()


def _model(document: dict) -> MechanicalModel:
    missing = [name for name in MATRICES if document.get(name) is None]
    if missing:
        raise ValueError(f"{', '.join(missing)} missing; give {_KEYS}.")
    M, D, K = (_symmetric(name, document[name]) for name in MATRICES)
    least = np.linalg.eigvalsh(M)[0]
    if not least > 0:
        raise ValueError(f"mass has the eigenvalue {least:.3g}; give a positive definite matrix.")
    drive = None
    if document.get("base") is not None:
        drive = _base(document["base"])
    elif document.get("input_map") is not None:
        drive = Force(jnp.asarray(_matrix("input_map", document["input_map"])))
    texts = {name: document[name] for name in (*TEXTS, "hidden") if document.get(name) is not None}
    if isinstance(texts.get("hidden"), int):
        raise ValueError(f"hidden is {_shown(texts['hidden'])}; give a list of texts.")
    for name, value in texts.items():
        words = isinstance(value, list) and all(isinstance(word, str) for word in value)
        if not words and not (name == "measured" and isinstance(value, str)):
            raise ValueError(f"{name} is {_shown(value)}; give a list of texts.")
    model = MechanicalModel(M, D, K, drive=drive, **texts)
    effects = document.get("effects") or []
    if not isinstance(effects, list):
        raise ValueError(f"effects is {_shown(effects)}; give a list.")
    terms = tuple(term_of(one, model.input_names, model.output_names, model.hidden) for one in effects)
    return MechanicalModel(M, D, K, drive=drive, effects=terms, **texts) if terms else model


def _base(base):
    kind = base.get("kind") if isinstance(base, dict) else None
    if not isinstance(kind, str) or kind not in BASES or base.get("direction") is None:
        raise ValueError(
            f"base is {_shown(base)}; give an object with 'kind' (displacement or acceleration), 'direction' and "
            "'relative'."
        )
    direction = jnp.asarray(_matrix("base direction", base["direction"]))
    return BASES[kind](direction, bool(base.get("relative", False)))


def _shown(value) -> str:
    """A value of a file in a message: cut, however long or deep it is."""
    return reprlib.repr(value)


def _matrix(name: str, value) -> np.ndarray:
    try:
        X = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is not a matrix of numbers; give a list of rows of equal length.") from None
    if X.ndim != 2 or X.size == 0:
        raise ValueError(f"{name} has shape {X.shape}; give a list of rows.")
    if not np.isfinite(X).all():
        row, column = np.argwhere(~np.isfinite(X))[0]
        raise ValueError(f"{name}[{row},{column}] is {X[row, column]}; give finite numbers.")
    return X


def _symmetric(name: str, value) -> np.ndarray:
    X = _matrix(name, value)
    if X.shape[0] != X.shape[1]:
        raise ValueError(f"{name} has shape {X.shape}; give a square matrix, one row per coordinate.")
    difference = np.abs(X - X.T)
    if np.max(difference) > SYMMETRY * np.max(np.abs(X)):
        row, column = np.unravel_index(np.argmax(difference), X.shape)
        raise ValueError(
            f"{name} is not symmetric: [{row},{column}] is {X[row, column]:g}, [{column},{row}] is "
            f"{X[column, row]:g}; give a symmetric matrix."
        )
    return X
