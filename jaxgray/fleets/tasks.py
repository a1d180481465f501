"""What is asked of every record of a fleet, and the key under which the answer is kept."""

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

TASKS = ("identify", "diagnose")

TOGETHER = frozenset({"time_constants", "block_rows", "weight", "input_map", "structure"})
"""Options of `identify` that a batch understands; with any other, records are identified one by one."""


@dataclass(frozen=True)
class Options:
    """What is asked of every record.

    `task`: "identify", "diagnose" or "score"; `reading`: keywords of `read_record`; `fitting`: keywords of the task;
    `columns`: further columns of the files whose means are kept (covariates, a machine's number, a date). All of it
    can be written as JSON.
    """

    task: str
    reading: dict
    fitting: dict = field(default_factory=dict)
    columns: tuple[str, ...] = ()

    def digest(self) -> str:
        """Bytes that stand for the options and the version of the package, as text."""
        told = {
            "task": self.task,
            "reading": self.reading,
            "fitting": self.fitting,
            "columns": list(self.columns),
            "version": _version(),
        }
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()

    @property
    def together(self) -> bool:
        """Whether records of equal shape are computed side by side."""
        given = {name for name, value in self.fitting.items() if value is not None}
        return self.task == "identify" and given <= TOGETHER


@dataclass(frozen=True)
class Job:
    """What one call of a worker does: paths and keys, never arrays.

    `folder` of the store; `options`; `files`: path, key and options of its own of every record; `plan`: what the fleet
    has decided for all records; `programs`: folder of compiled programs that workers share; `pages`: whether a page is
    written for every record; `batch`: records of one shape that are computed side by side.
    """

    folder: str
    options: Options
    files: tuple[tuple[str, str, dict], ...]
    plan: dict
    programs: str | None
    pages: bool
    batch: int


def _version() -> str:
    from ..report.page.whole import own_version

    return own_version()


def listed(paths) -> list[Path]:
    """The files that paths and patterns stand for, each once, in the order of their names.

    **Arguments:** `paths`: a path, a pattern with `*`, `?` or `[…]`, or several of either.

    **Raises:** `ValueError` for a pattern that no file matches, or nothing at all.
    """
    import glob

    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not given:
        raise ValueError("paths is empty; give files, or a pattern such as 'data/*.parquet'.")
    found: dict[Path, None] = {}
    for one in given:
        text = os.fspath(one)
        if Path(text).is_file():
            matches = [text]
        elif glob.has_magic(text):
            matches = [name for name in glob.glob(text, recursive=True) if Path(name).is_file()]
        else:
            raise ValueError(f"paths: {text} is no file; give files, or a pattern such as 'data/*.parquet'.")
        if not matches:
            raise ValueError(f"paths: no file matches {text}; check the pattern.")
        found |= dict.fromkeys(Path(name) for name in sorted(matches))
    return list(found)


def names(argument: str, given) -> tuple[str, ...]:
    """Names of columns, one or several.

    **Raises:** `ValueError` where there is none.
    """
    found = (given,) if isinstance(given, str) else tuple(given)
    if not found or not all(isinstance(name, str) and name.strip() for name in found):
        raise ValueError(f"{argument} is {given!r}; give the name of one or several columns.")
    return tuple(name.strip() for name in found)


def key_of(content: str, digest: str, own: dict | None = None) -> str:
    """The name of a result.

    **Arguments:** `content`: hash of the file's bytes; `digest` of the options; `own`: options of this record alone.
    """
    text = content + digest + (json.dumps(own, sort_keys=True) if own else "")
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def content_hash(path: Path) -> str:
    """Hash of a file's bytes.

    **Raises:** `OSError` where it cannot be read.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def batches(files: Iterable[tuple[str, str, dict]], size: int) -> list[tuple[tuple[str, str, dict], ...]]:
    """Files in groups of at most `size`, those of nearly one length together, the longest first."""
    ordered = sorted(files, key=lambda one: (-os.path.getsize(one[0]), one[0]))
    return [tuple(ordered[k : k + size]) for k in range(0, len(ordered), size)]
