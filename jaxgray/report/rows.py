"""Tables as rows of text, the same for the terminal, the page and the notebook."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Rows:
    """A table in words: `head`, one title a column; `body`, one text a cell; `words`: columns that hold no numbers."""

    head: tuple[str, ...]
    body: tuple[tuple[str, ...], ...]
    words: frozenset[int] = frozenset({0})


def number(value: float | None, form: str) -> str:
    """A number in a form such as `{:.2f} %`, a dash where there is none."""
    return "–" if value is None else form.format(value)
