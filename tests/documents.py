"""Every document that is written while the tests run, held against its JSON Schema."""

import collections
import functools
import json
from pathlib import Path

import jsonschema

from jaxgray import schemas


class Documents:
    """What came of them: how many of each kind were `valid`, and the `faults` of the others."""

    def __init__(self):
        self.valid: collections.Counter = collections.Counter()
        self.faults: list[str] = []
        self._looked_at: set[tuple[Path, int]] = set()

    def check(self, document) -> None:
        """Look at what is about to be written; what has no "schema" is none of ours."""
        name = document.get("schema") if isinstance(document, dict) else None
        if not isinstance(name, str):
            return
        try:
            validator(name).validate(document)
        except (jsonschema.ValidationError, ValueError) as error:
            self.faults.append(f"{name}: {fault(error)}")
        else:
            self.valid[name] += 1

    def check_folder(self, folder: Path) -> None:
        """Look at every document that a command has left in a folder, whatever process has written it."""
        for path in folder.rglob("*.json"):
            one = path, path.stat().st_mtime_ns
            if one in self._looked_at:
                continue
            self._looked_at.add(one)
            self.check(json.loads(path.read_text(encoding="utf-8")))

    def watch(self, function):
        """The function, whose results are checked."""

        @functools.wraps(function)
        def watched(*arguments, **options):
            made = function(*arguments, **options)
            self.check(made)
            return made

        return watched


@functools.cache
def validator(name: str) -> jsonschema.Draft202012Validator:
    """What judges a kind of document."""
    return jsonschema.Draft202012Validator(schemas.schema(name))


def fault(error: Exception) -> str:
    """The innermost cause, with its place."""
    if not isinstance(error, jsonschema.ValidationError):
        return str(error)
    while error.context:
        error = max(error.context, key=lambda one: (len(one.absolute_path), one.validator != "type"))
    return f"{error.json_path}: {error.message[:300]}"


WRITTEN = Documents()
