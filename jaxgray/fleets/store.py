"""The folder of a fleet: one file a result, whole or not there. It alone says what has been done."""

import contextlib
import json
import os
import socket
import uuid
from pathlib import Path

RESULT = "jaxgray/fleet-record/1"

PART = ".part-"
"""How the names of files begin that are being written."""


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
                probe = place / _part_name()
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
        here = socket.gethostname()
        for place in (self.folder, self.results, self.pages, self.plans):
            for path in place.glob(f"{PART}*"):
                host, _, rest = path.name.removeprefix(PART).rpartition("@")
                process = rest.split("-")[0]
                if host == here and process.isdigit() and not _alive(int(process)):
                    path.unlink(missing_ok=True)

    def keys(self) -> set[str]:
        """Keys of all results that are there."""
        with os.scandir(self.results) as entries:
            return {e.name[:-5] for e in entries if e.name.endswith(".json") and not e.name.startswith(".")}

    def __contains__(self, key: str) -> bool:
        return (self.results / f"{key}.json").exists()

    def read(self, key: str) -> dict | None:
        """A result; None where it is not there. One that is not whole, as after a crash of the disk, is removed."""
        found = _read(self.results / f"{key}.json")
        if found is None:
            self.remove(key)
        return found

    def write(self, key: str, document: dict) -> None:
        """Keep a result.

        **Raises:** `OSError` where the disk is full or read-only.
        """
        from ..report.export import plain

        text = json.dumps(plain({"schema": RESULT, "key": key, **document}), allow_nan=False, ensure_ascii=False)
        write_whole(self.results / f"{key}.json", text.encode())

    def remove(self, key: str) -> None:
        """Forget a result, so that it is computed again."""
        (self.results / f"{key}.json").unlink(missing_ok=True)

    def write_page(self, key: str, html: str) -> None:
        """Keep the page of a record."""
        write_whole(self.pages / f"{key}.html", html.encode())

    def read_plan(self, name: str) -> dict | None:
        """What was decided for all records of a fleet; None where nothing was."""
        return _read(self.plans / f"{name}.json")

    def write_plan(self, name: str, plan: dict) -> None:
        """Keep what was decided for all records."""
        write_whole(self.plans / f"{name}.json", json.dumps(plan, allow_nan=False).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Through a file beside it, written to the disk before it gets its name.

    **Raises:** `OSError` that names the file, where it cannot be written.
    """
    beside = path.with_name(_part_name())
    try:
        with open(beside, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)


def _part_name() -> str:
    return f"{PART}{socket.gethostname()}@{os.getpid()}-{uuid.uuid4().hex}"


def _read(path: Path) -> dict | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
