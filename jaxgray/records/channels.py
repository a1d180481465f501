"""Channels of a record, made uniform: arrays, names, units, measured quantities."""

import numpy as np
from jaxtyping import Float

MEASURED = ("displacement", "velocity", "acceleration")

# Squares of larger values overflow, so that every norm of the record would be infinite.
LARGEST_VALUE = 1e150


def as_channels(name: str, values) -> Float[np.ndarray, "samples channels"]:
    """A read-only copy in two dimensions, checked for type and size."""
    given = np.asarray(values)
    if given.dtype.kind not in "fiub":
        raise ValueError(f"{name} holds {given.dtype}; give real numbers.")
    if given.ndim not in (1, 2) or given.size == 0:
        raise ValueError(
            f"{name} has shape {given.shape}; give (samples, channels) with at least one channel, or (samples,)."
        )
    array = np.array(given.reshape(len(given), -1), dtype=np.float64, order="C")
    if np.isinf(array).any():
        row, column = np.argwhere(np.isinf(array))[0]
        raise ValueError(f"{name} is infinite at sample {row} of channel {column}; cut or correct that sample.")
    largest = np.nanmax(np.abs(array), initial=0.0)
    if largest > LARGEST_VALUE:
        raise ValueError(
            f"{name} reaches {largest:.3g}, beyond {LARGEST_VALUE:g}; check the file or rescale the channel."
        )
    array.setflags(write=False)
    return array


def as_seconds(name: str, value, positive: bool = True) -> float:
    """A finite number of seconds."""
    try:
        seconds = float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = np.nan
    if not np.isfinite(seconds) or (positive and seconds <= 0.0):
        raise ValueError(f"{name} is {value!r}; give a{' positive' if positive else ''} number of seconds.")
    return seconds


def as_texts(name: str, given, count: int, default: str) -> tuple[str, ...]:
    """One text per channel; `default` with its number where none are given."""
    if given is None:
        return tuple(default.format(k + 1) for k in range(count))
    texts = (given,) if isinstance(given, str) else tuple(str(text) for text in given)
    if len(texts) != count:
        raise ValueError(f"{name} has {len(texts)} entries {texts}; give one for each of the {count} channels.")
    return texts


def measured_per_output(measured, outputs: int) -> tuple[str, ...]:
    """The measured quantity of every output, from one word for all or one for each.

    **Arguments:**

    - `measured`: `"displacement"`, `"velocity"`, `"acceleration"`, or one of them per output.
    - `outputs`: number of outputs.

    **Returns:** a tuple with one word per output.

    **Raises:** `ValueError` for another word or another number of them.
    """
    words = (measured,) * outputs if isinstance(measured, str) else tuple(measured)
    if len(words) == 1:
        words = words * outputs
    if len(words) != outputs or not set(words) <= set(MEASURED):
        raise ValueError(
            f"measured is {measured!r}; give one of {', '.join(MEASURED)} for all or for each of the {outputs} outputs."
        )
    return words


def channel_positions(argument: str, wanted, names: tuple[str, ...]) -> list[int]:
    """Places of the wanted channels, given by name or by place, one or several."""
    if wanted is None:
        return list(range(len(names)))
    wanted = [wanted] if isinstance(wanted, (str, int, np.integer)) else list(wanted)
    positions = []
    for one in wanted:
        if isinstance(one, str) and one in names:
            positions.append(names.index(one))
        elif isinstance(one, (int, np.integer)) and -len(names) <= one < len(names):
            positions.append(int(one) % len(names))
        else:
            raise ValueError(f"{argument}: there is no {one!r}; the record has {', '.join(names)}.")
    if not positions:
        raise ValueError(f"{argument} is empty; name at least one of {', '.join(names)}.")
    return positions


def without_trend(x: np.ndarray, degree: int) -> np.ndarray:
    """Residual of a least-squares polynomial over each column, NaN left alone."""
    result = x.copy()
    # Time centred and scaled to ±1 keeps the two regressors nearly orthogonal.
    basis = np.linspace(-1.0, 1.0, len(x))[:, None] ** np.arange(degree + 1)
    for column in result.T:
        there = ~np.isnan(column)
        if there.sum() > degree:
            coefficients = np.linalg.lstsq(basis[there], column[there])[0]
            column[there] -= basis[there] @ coefficients
    return result
