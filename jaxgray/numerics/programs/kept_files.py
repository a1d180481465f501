"""Files for later processes: in a folder that nobody else can change, each read only where its digest fits.

What is kept is machine code that a later process runs. The digest at the head of a file tells damage: flipped bits, a
disk that was full, an entry under the name of another. It says nothing of who wrote the file, since that one writes the
digest, too; against others there is the folder: it and all on the way to it can be changed by the user and the
superuser alone.
"""

import contextlib
import hashlib
import os
import stat
import tempfile
from pathlib import Path

MAGIC = b"jaxgray kept\n"

MOST_LINKS = 40
"""Symbolic links that are followed on the way to a folder, as in Linux."""

OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class NotPrivate(ValueError):
    """A folder that others can change."""


def private_folder(path: Path) -> Path:
    """A folder for the user alone, made with mode 0700 where it is not there, as are folders missing on the way to it.

    Where the system has no owners of files (Windows) it is made as is usual there.

    **Raises:** `NotPrivate` where the folder belongs to somebody else or others can write to it, or can put another
    in its place; `OSError` where it cannot be made or written.
    """
    path = Path(path)
    if not path.is_absolute():
        raise NotADirectoryError(f"{path} is not an absolute path")
    if not hasattr(os, "getuid"):
        path.mkdir(parents=True, exist_ok=True)
        return path
    folder = _walked(path)
    found = os.lstat(folder)
    if found.st_uid != os.getuid():
        raise NotPrivate(f"{folder} belongs to user {found.st_uid}, and you are user {os.getuid()}")
    if found.st_mode & OTHERS_WRITE:
        raise NotPrivate(_writable(folder, found))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} cannot be written")
    return path


def _walked(path: Path) -> Path:
    """The folder at the end of all symbolic links, made if need be, every step on the way to it checked."""
    here, left, links = Path(path.anchor), list(reversed(path.parts[1:])), 0
    _check_step(here)
    while left:
        name = left.pop()
        step = here.parent if name == os.pardir else here / name
        with contextlib.suppress(FileExistsError):
            os.mkdir(step, 0o700)
        _check_step(step)
        if not step.is_symlink():
            here = step
            continue
        links += 1
        if links > MOST_LINKS:
            raise OSError(f"{path} has more than {MOST_LINKS} symbolic links")
        target = Path(os.readlink(step))
        if target.is_absolute():
            here, target = Path(target.anchor), target.relative_to(target.anchor)
        left.extend(reversed(target.parts))
    return here


def _check_step(step: Path) -> None:
    found = os.lstat(step)
    if found.st_uid not in (os.getuid(), 0):
        raise NotPrivate(f"{step} belongs to user {found.st_uid}, and you are user {os.getuid()}")
    if stat.S_ISLNK(found.st_mode):
        return
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{step} is no folder")
    # In a folder like /tmp nobody can rename or remove what belongs to others.
    if found.st_mode & OTHERS_WRITE and not found.st_mode & stat.S_ISVTX:
        raise NotPrivate(_writable(step, found))


def _writable(folder: Path, found: os.stat_result) -> str:
    return f"others may write to {folder} (mode {stat.S_IMODE(found.st_mode):04o}; chmod go-w takes that away)"


def read_kept(path: Path) -> bytes | None:
    """The content that `write_kept` gave to a file of this name; None where there is none, whole and the user's own."""
    try:
        # Not to wait for a pipe that lies there.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        try:
            found = os.fstat(handle)
            if not stat.S_ISREG(found.st_mode):
                return None
            if hasattr(os, "getuid") and (found.st_uid != os.getuid() or found.st_mode & OTHERS_WRITE):
                return None
            with open(handle, "rb", closefd=False) as file:
                whole = file.read()
        finally:
            os.close(handle)
    except OSError:
        return None
    content = whole[len(MAGIC) + hashlib.sha256().digest_size :]
    return content if whole.startswith(_head(path, content)) else None


def write_kept(path: Path, content: bytes) -> bool:
    """Write a file whole or not at all, in the place of what was there.

    **Returns:** whether it was written: not on a full disk, nor in a folder that cannot be written.
    """
    try:
        handle, part = tempfile.mkstemp(dir=path.parent, prefix=".part-")
    except OSError:
        return False
    try:
        with open(handle, "wb") as file:
            file.write(_head(path, content))
            file.write(content)
        os.replace(part, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(part)
        return False
    return True


def _head(path: Path, content: bytes) -> bytes:
    digest = hashlib.sha256(path.name.encode() + b"\0")
    digest.update(content)
    return MAGIC + digest.digest()
