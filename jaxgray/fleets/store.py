"""The folder of a fleet: one file a result, whole or not there. It alone says what has been done."""

import json
import os
from pathlib import Path

from ..numerics.whole_files import part_name, replace_files, tidy

RESULT = "jaxgray/fleet-record/1"


class Store:
    """Results by their keys, below a folder that all workers reach.

    **Arguments:** `folder`: of the fleet; `results/KEY.json`, `pages/KEY.html` and `plans/NAME.json` are below it.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        self.results, self.pages, self.plans = (self.folder / name for name in ("results", "pages", "plans"))

    def open(self) -> None:
        """Make the folders, see that they can be written, and remove what killed processes of this machine left.

        **Raises:** `ValueError` where nothing can be written there.
        """
        try:
            for place in (self.results, self.pages, self.plans):
                place.mkdir(parents=True, exist_ok=True)
                probe = place / part_name()
                probe.write_bytes(b"1")
                probe.unlink()
        except OSError as error:
            raise ValueError(
                f"out: {self.folder} cannot be written ({error.strerror or error}); give a folder with room that you "
                "may write to."
            ) from None
        self.tidy()

    def tidy(self) -> None:
        """Remove half-written files whose process on this machine is gone."""
        for place in (self.folder, self.results, self.pages, self.plans):
            tidy(place)

    def keys(self) -> set[str]:
        """Keys of all results that are there."""
        with os.scandir(self.results) as entries:
            return {e.name[:-5] for e in entries if e.name.endswith(".json") and not e.name.startswith(".")}

    def __contains__(self, key: str) -> bool:
        return (self.results / f"{key}.json").exists()

    def read(self, key: str) -> dict | None:
        """A result; None where it is not there. One that is not whole, as after a crash of the disk, is removed."""
        found = _read(self.results / f"{key}.json")
        if found is None or found.get("schema") != RESULT:
            self.remove(key)
            return None
        return found

    def write(self, key: str, document: dict) -> None:
        """Keep a result.

        **Raises:** `OSError` where the disk is full or read-only.
        """
        from ..report.documents.export import plain

        text = json.dumps(plain({"schema": RESULT, "key": key, **document}), allow_nan=False, ensure_ascii=False)
        replace_files({self.results / f"{key}.json": text.encode()})

    def remove(self, key: str) -> None:
        """Forget a result, so that it is computed again."""
        (self.results / f"{key}.json").unlink(missing_ok=True)

    def write_page(self, key: str, html: str) -> None:
        """Keep the page of a record."""
        replace_files({self.pages / f"{key}.html": html.encode()})

    def read_plan(self, name: str) -> dict | None:
        """What was decided for all records of a fleet; None where nothing was."""
        return _read(self.plans / f"{name}.json")

    def write_plan(self, name: str, plan: dict) -> None:
        """Keep what was decided for all records."""
        replace_files({self.plans / f"{name}.json": json.dumps(plan, allow_nan=False).encode()})


def _read(path: Path) -> dict | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
