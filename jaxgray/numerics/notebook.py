"""Results that show themselves in notebooks: how is said by whoever shows, so that computing knows nothing of it."""

from collections.abc import Callable


class Shown:
    """A result that a notebook shows as a formatted page where a formatter is known, and as its text otherwise."""

    _formatter: Callable[[object], str | None] | None = None

    def _repr_html_(self) -> str | None:
        formatter = Shown._formatter
        return None if formatter is None else formatter(self)


def show_with(formatter: Callable[[object], str | None]) -> None:
    """Let notebooks show results by a formatter.

    **Arguments:** `formatter`: from a result to HTML, or None for what it has no form for.
    """
    Shown._formatter = staticmethod(formatter)
