"""What a file may ask for: bounds that hold before a library acts on what the file says of itself."""

from contextlib import contextmanager
from pathlib import Path

EXPANSION = 1032
"""Most bytes that deflate makes of one (zlib, technical details: 1032 to 1)."""

SMALL = 2**24
"""Bytes that any column may have, as a constant channel of a short record has next to none in its file."""

LONGEST_NAME = 200
"""Characters of a name that a message shows."""


class Refused(ValueError):
    """What a file asks for and does not get."""


def check_file(path: Path, argument: str = "path") -> None:
    """Raise `ValueError` where a path is no file, so that reading from it could wait for ever."""
    if path.is_file():
        return
    what = "is a folder" if path.is_dir() else "is no regular file" if path.exists() else "does not exist"
    raise ValueError(f"{argument}: {path} {what}; give the path of a file.")


def check_size(source: str, name: str, size: int, file_size: int) -> None:
    """Raise `Refused` for a column that is larger than a file of this size can hold.

    **Arguments:** `source`: the file's name; `name` of the column; `size`: bytes that the column would take in memory,
    as the file declares them; `file_size`: bytes of the file.
    """
    if size > max(SMALL, EXPANSION * file_size):
        raise Refused(
            f"{source} has {file_size} bytes and declares {size} for {name[:LONGEST_NAME]!r}; it is damaged or made to "
            "fill the memory: write the file anew, without compression."
        )


@contextmanager
def reading(path: Path, what: str):
    """Turn whatever a library raises into one line; a damaged file fails in as many ways as the library has steps.

    **Arguments:** `path` of the file; `what` it should be.
    """
    try:
        yield
    except (PermissionError, Refused, ImportError):
        raise
    except Exception as error:
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise ValueError(f"{path.name} is no {what} ({text}).") from None
