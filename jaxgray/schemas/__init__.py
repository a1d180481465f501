"""JSON Schema (draft 2020-12) of every document that jaxgray writes."""

import functools
import json
import re
from importlib.resources import files

SHARED = "parts.json"
"""What several documents have in common."""


def names() -> tuple[str, ...]:
    """What documents have as their "schema"."""
    found = (re.fullmatch(r"(.+)-(\d+)\.json", file.name) for file in files(__name__).iterdir())
    return tuple(sorted(f"jaxgray/{match[1]}/{match[2]}" for match in found if match))


def schema(name: str) -> dict:
    """The schema of a kind of document, complete in itself.

    A document with a field more, a field less, a value of another type, or a word where others are expected is not
    valid. Later versions may write further fields, which their schemas then have.

    **Arguments:** `name`: what the document has as its "schema", such as `"jaxgray/diagnosis/1"`.

    **Returns:** the schema as a dictionary, for any validator of draft 2020-12.

    **Raises:** `ValueError` for a name that no document has.

    **Example:**

        >>> import jaxgray
        >>> jaxgray.schema("jaxgray/diagnosis/1")["properties"]["verdict"]["enum"]
        ['named', 'equivalent', 'partly', 'unexplained', 'noise']
    """
    if name not in names():
        raise ValueError(f"name is {name!r}; give one of {', '.join(names())}.")
    file = name.removeprefix("jaxgray/").replace("/", "-") + ".json"
    shared: dict[str, dict] = {}
    document = _complete(_read(file), file, file, shared)
    if shared:
        document["$defs"] = document.get("$defs", {}) | dict(sorted(shared.items()))
    return document


@functools.cache
def _text(file: str) -> str:
    return files(__name__).joinpath(file).read_text(encoding="utf-8")


def _read(file: str) -> dict:
    return json.loads(_text(file))


def _complete(part, file: str, top: str, shared: dict):
    """A part of a file, with all that it refers to in other files than the `top` put among what is `shared`."""
    if isinstance(part, list):
        return [_complete(one, file, top, shared) for one in part]
    if not isinstance(part, dict):
        return part
    if not isinstance(part.get("$ref"), str):
        return {key: _complete(value, file, top, shared) for key, value in part.items()}
    other, _, key = part["$ref"].partition("#/$defs/")
    other = other or file
    if other == top:
        return part
    key, kept = key or other.removesuffix(".json"), bool(key)
    if key not in shared:
        shared[key] = {}
        whole = _read(other)
        wanted = whole["$defs"][key] if kept else {k: v for k, v in whole.items() if k != "$schema"}
        shared[key] = _complete(wanted, other, top, shared)
    return part | {"$ref": f"#/$defs/{key}"}
