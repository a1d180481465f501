"""Numbers as a person reads them."""

import math

ABSURD = 1e-7
"""Standard error relative to its value below which it is not printed as one."""


def plus_minus(value: float | None, error: float | None = None, *, digits: int = 2) -> str:
    """A value ± one standard error, the value to the same place as the error.

    An error of zero belongs to a value that was given, not estimated. One that is absurdly small is none: what it comes
    from is rounding, or a parameter that the record does not determine.

    **Arguments:** `value`; `error`: default none; `digits` of the error, default 2.

    **Returns:** the text, a dash where there is no value.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if error is None or not math.isfinite(error):
        return f"{value:.5g}"
    if error == 0:
        return f"{value:.5g} (fixed)"
    if error < ABSURD * abs(value):
        return f"{value:.6g}"
    size = max(abs(value), error)
    exponent = math.floor(math.log10(size))
    power = exponent if exponent < -3 or exponent > 5 else 0
    decimals = max(0, digits - 1 - math.floor(math.log10(error)) + power)
    text = f"{value / 10**power:.{decimals}f} ± {error / 10**power:.{decimals}f}"
    return f"({text})e{power:+03d}" if power else text


def listed(words, last: str = "and") -> str:
    """Words with commas, and `last` before the last one."""
    words = list(words)
    return ", ".join(words[:-1]) + f" {last} {words[-1]}" if len(words) > 1 else "".join(words)


def entry_text(value: float | None, error: float | None, kind: str | None, *, digits: int = 2) -> str:
    """An entry of a matrix with hidden coordinates: "set" by the canonical form, "canonical", "open" or "physical".

    **Arguments:** as of `plus_minus`; `kind`: None for a matrix without hidden coordinates.
    """
    if kind == "open":
        return "open"
    if kind == "set":
        return f"{value:.5g} (set)"
    return plus_minus(value, error, digits=digits) + ("*" if kind == "canonical" else "")
