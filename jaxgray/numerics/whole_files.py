"""Files that are whole under their name or not there: written beside, brought to the disk, then renamed."""

import contextlib
import os
import socket
import uuid
from collections.abc import Mapping
from pathlib import Path

PART = ".part-"
"""How the names of files begin that are being written."""


def write_whole(content: bytes, path) -> None:
    """One file, as `write_together`."""
    write_together({path: content})


def write_together(contents: Mapping) -> None:
    """Write files; none gets its name before all are on the disk, so that a full disk changes none of them.

    What killed processes of this machine left in their folders is removed.

    **Arguments:** `contents`: bytes by path.

    **Raises:** `ValueError` where a folder is not there or a path is no file; `OSError`, naming the file, where one
    cannot be written.
    """
    for path in contents:
        check_place(path)
    for folder in {Path(path).parent for path in contents}:
        tidy(folder)
    replace_files(contents)


def replace_files(contents: Mapping) -> None:
    """`write_together` without a look at what else is in the folders, which takes time where it is much."""
    made: dict[Path, Path] = {}
    try:
        for path, content in contents.items():
            part = made[Path(path)] = Path(path).with_name(part_name())
            with _named(path), open(part, "wb") as file:
                file.write(content)
                _to_disk(file)
        for path, part in made.items():
            with _named(path):
                os.replace(part, path)
    finally:
        _remove(made.values())


@contextlib.contextmanager
def replacing(path):
    """Give a path beside a file, for a library that writes files itself; the file is replaced at the end."""
    part = Path(path).with_name(part_name())
    try:
        yield part
        with open(part, "rb") as file:
            _to_disk(file)
        os.replace(part, path)
    finally:
        _remove([part])


def _to_disk(file) -> None:
    file.flush()
    os.fsync(file.fileno())


def _remove(parts) -> None:
    for part in parts:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def check_place(path) -> None:
    """Raise `ValueError` for a path that is no file, or whose folder is not there."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the name of a file.")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no regular file, and would be replaced; give the name of a file.")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} is not there; create it first.")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(
            f"{path}: the folder {path.parent} cannot be written; give another, or change its permissions."
        )


def tidy(folder) -> None:
    """Remove files in a folder that a process of this machine was writing when it was killed."""
    here = socket.gethostname()
    for path in Path(folder).glob(f"{PART}*"):
        host, _, rest = path.name.removeprefix(PART).rpartition("@")
        process = rest.split("-")[0]
        if host == here and process.isdigit() and not _alive(int(process)):
            _remove([path])


def part_name() -> str:
    """A name for a file that is being written, with the machine and process that does."""
    return f"{PART}{socket.gethostname()}@{os.getpid()}-{uuid.uuid4().hex}"


@contextlib.contextmanager
def _named(path):
    """Errors of the operating system name the file that was asked for, not the one beside it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
