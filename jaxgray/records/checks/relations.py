"""Detectors of defects in how outputs follow inputs, without any model but a long difference equation."""

import numpy as np
from jaxtyping import Float

from jaxgray.numerics.responses.filters import filtered
from jaxgray.records.checks.answers import ORDERS, Answer, answer, fitted, smallest
from jaxgray.records.checks.modes import DERIVATIVE

FAR = (0.13, 0.29, 0.41, 0.57, 0.71, 0.87)
"""Shares of the record by which an input is shifted until it has nothing to do with what is left."""


# Feedback


def feedback(
    found: Answer, u: Float[np.ndarray, " samples"], period: int | None = None, first: int = 1
) -> tuple[float, float]:
    """How much an input follows what it does not explain of an output.

    Of a periodic input only what differs from period to period can follow anything: what it does to the system by laws
    that are not linear is periodic too.

    **Arguments:** `found`; `u`: the input; `period`: in samples, None for none; `first`: delay in samples from which it
    may follow.

    **Returns:** the largest correlation of the input's innovation with the output's up to two samples before `first`,
    and the largest that it shows with the input shifted far away.
    """
    e = found.innovation
    if period is not None:
        n = len(u) // period * period
        u, e = (np.reshape(x[:n], (-1, period)) for x in (u, e))
        u, e = ((x - x.mean(axis=0)).ravel() for x in (u, e))
    if np.median(np.abs(np.diff(u))) <= RESTING * np.std(u):
        return 0.0, 0.0
    w, e = _calm(_innovation(u)), _calm(e)
    n = len(e)

    def largest(shift):
        v = np.roll(w, shift)
        return max(abs(v[lag:] @ e[: n - lag]) / n for lag in range(first, first + 3))

    return float(largest(0)), float(max(largest(int(part * n)) for part in FAR))


RESTING = 1e-6
"""Usual step of an input, over its spread, up to which it rests: a controller never does."""


def predictable(u: Float[np.ndarray, " samples"]) -> float:
    """What the past of a signal leaves of it, RMS over RMS."""
    return float(np.std(_innovation(u)) / np.std(u))


def left_by_outputs(u: np.ndarray, outputs: list[tuple[np.ndarray, int]]) -> float:
    """What a controller would leave of an input: the usual error of predicting it by its own past and the last few
    samples of outputs, over that by its own past and the same outputs far off.

    By weights that leave rare jumps out: between those of its reference, a controller leaves nothing.

    **Arguments:** `u`: the input; `outputs`: each with the delay in samples from which the input may follow it.
    """
    n = len(u)
    rows = np.arange(OWN + BACK, n)
    past = [u[rows - k] for k in range(1, OWN + 1)]

    def error(shift):
        moved = [(np.roll(y, shift), first) for y, first in outputs]
        X = np.stack(past + [y[rows - first - k] for y, first in moved for k in range(BACK)])
        X /= np.sqrt(np.mean(X**2, axis=1))[:, None] + 1e-300
        weight = np.ones(len(rows))
        for _ in range(6):
            rest = u[rows] - smallest(X * weight, X, u[rows]) @ X
            usual = 1.4826 * np.median(np.abs(rest)) + 1e-9 * np.std(u)
            weight = 1.0 / (1.0 + (rest / (2.0 * usual)) ** 2)
        return usual

    return float(error(0) / error(int(FAR[2] * n)))


OWN, BACK = 30, 8
"""Samples of the past of an input, and of outputs, by which a controller is looked for."""


def distinguishable(u: Float[np.ndarray, "samples inputs"]) -> bool:
    """Whether inputs differ at the frequencies that they hold: sweeps that only lag each other do not."""
    U = np.fft.rfft(u * np.hanning(len(u))[:, None], axis=0)
    bands = np.array_split(U[1:], 64)
    for j in range(u.shape[1]):
        for k in range(j):
            across = np.array([abs(np.vdot(b[:, j], b[:, k])) for b in bands])
            each = np.array([np.linalg.norm(b[:, j]) * np.linalg.norm(b[:, k]) for b in bands])
            if np.sum(across) > 0.7 * np.sum(each):
                return False
    return True


def _innovation(x: np.ndarray, order: int = 60) -> np.ndarray:
    n = len(x)
    X = np.stack([x[order - k : n - k] for k in range(1, order + 1)])
    return np.concatenate([np.zeros(order), x[order:] - smallest(X, X, x[order:]) @ X])


def _calm(x: np.ndarray) -> np.ndarray:
    """Limited to four standard deviations of the usual samples, of unit mean square: without the rare jumps of a
    reference, in which what is fed back would drown."""
    usual = 4.0 * 1.4826 * np.median(np.abs(x))
    x = np.clip(x, -usual, usual) if usual > 0.0 else x
    return x / max(float(np.sqrt(np.mean(x**2))), 1e-300)


# Dry friction


def direction(y: np.ndarray, measured: str) -> np.ndarray:
    """Direction in which an output moves, −1 to 1: that of its velocity in the band of its motion."""
    n = len(y)
    f = np.fft.rfftfreq(n)
    Y = np.fft.rfft(y - y.mean())
    power = np.abs(Y) ** 2
    usual = float(np.sum(f * power) / max(np.sum(power), 1e-300))
    inside = np.exp(-((f / (BAND[1] * usual + 1e-300)) ** 2)) * (1 - np.exp(-((f / (BAND[0] * usual + 1e-300)) ** 2)))
    turned = (2j * np.pi * np.where(f > 0, f, 1.0)) ** (1 - DERIVATIVE[measured])
    v = np.fft.irfft(Y * turned * inside, n)
    return np.tanh(v / (SLOW * np.std(v) + 1e-300))


BAND = 0.2, 5.0
"""Frequencies of a motion over its mean one between which its velocity is asked for."""

SLOW = 0.1
"""Velocity over its standard deviation up to which the direction is in doubt."""


# Time


PARTS = 12


def drifting(u: np.ndarray, y: np.ndarray, found: Answer, beside: np.ndarray | None = None) -> tuple[float, float]:
    """How far an output falls behind its inputs over the record, at a steady rate.

    A straight line through the delays of parts of the record, behind what is explained by the equation of a quarter of
    it; taken back, until it stays.

    **Returns:** samples, 0 where nothing falls behind or the inputs explain hardly more then; the share
    left unexplained.
    """
    n = len(y)
    if found.share < LEAST_LEFT:
        return 0.0, found.share
    quarters = [answer(u, y, slice(start, start + n // 4), beside) for start in (0, 3 * n // 8, 3 * n // 4)]
    starts = [one for one in (found, *quarters) if one is not None and one.share < np.inf]
    lines = [_wandering(y, y - one.unexplained) for one in starts]
    # Those of two equations that agree are worth a try, and so is the surest.
    best = 0.0, min(found.share, 1.0)
    for total, sure in sorted(lines, key=lambda line: -line[1])[:2]:
        if sure < SURE or abs(total) < LEAST_DRIFT:
            continue
        for _ in range(3):
            along = None if beside is None else np.stack([retimed(x, total) for x in beside.T], axis=1)
            other = answer(u, retimed(y, total), None, along)
            if other is None or not other.share < best[1]:
                break
            best = total, other.share
            more, sure = _wandering(retimed(y, total), retimed(y, total) - other.unexplained)
            if sure < SURE or abs(more) < LEAST_DRIFT:
                break
            total += more
        if best[1] < min(DRIFTED * found.share, MOST_LEFT):
            return best
    return 0.0, found.share


LEAST_LEFT = 0.05
"""Unexplained share below which no drift is looked for."""

MOST_LEFT = 0.6
"""Unexplained share that may stay at most."""

SURE, LEAST_DRIFT = 5.0, 0.1
"""Standard errors and samples from which a drift is believed."""

DRIFTED = 0.7
"""Share of what was unexplained that may stay when a drift is taken back."""


def _wandering(y: np.ndarray, explained: np.ndarray) -> tuple[float, float]:
    """How the delay of an output behind what is explained of it changes over the record: samples by a robust straight
    line through the delays of its parts, and that over its standard error."""
    n = len(y)
    middle, delay = [], []
    for k in range(PARTS):
        part = slice(n * k // PARTS, n * (k + 1) // PARTS)
        middle.append((part.start + part.stop) / 2.0 / n)
        delay.append(_delay(y[part], explained[part]))
    t, d = np.array(middle), np.array(delay)
    i, j = np.triu_indices(PARTS, 1)
    slope = float(np.median((d[j] - d[i]) / (t[j] - t[i])))
    rest = d - slope * t
    scatter = 1.4826 * float(np.median(np.abs(rest - np.median(rest)))) + 0.02
    return slope, abs(slope) * float(np.sqrt(np.sum((t - t.mean()) ** 2))) / scatter


def _delay(y: np.ndarray, x: np.ndarray) -> float:
    """Samples by which y is behind x, where their correlation is largest; between samples by a parabola."""
    n = len(y)
    length = 2 ** int(np.ceil(np.log2(2 * n)))
    window = np.hanning(n)
    Y, X = np.fft.rfft((y - y.mean()) * window, length), np.fft.rfft((x - x.mean()) * window, length)
    across = np.fft.irfft(Y * np.conj(X), length)
    at = int(np.argmax(across))
    before, top, after = across[at - 1], across[at], across[(at + 1) % length]
    bend = 2.0 * top - before - after
    beside = 0.5 * (after - before) / bend if bend > 0.0 else 0.0
    return float((at - length if at > length // 2 else at) + beside)


def retimed(y: np.ndarray, total: float) -> np.ndarray:
    """A signal that falls behind by so many samples over the record, brought back; cubic (Catmull-Rom)."""
    n = len(y)
    position = np.clip(np.arange(n) * (1.0 + total / n), 0.0, n - 1.0)
    k = np.clip(position.astype(int), 0, n - 2)
    s = position - k
    y0, y1, y2, y3 = (y[np.clip(k + shift, 0, n - 1)] for shift in (-1, 0, 1, 2))
    return y1 + 0.5 * s * (y2 - y0 + s * (2.0 * y0 - 5.0 * y1 + 4.0 * y2 - y3 + s * (3.0 * (y1 - y2) + y3 - y0)))


def overlap(u: Float[np.ndarray, " samples"], parts: int = 2) -> float:
    """How alike the spectra of the first and the last part of a signal are, 1 for equal ones, 0 for a sweep."""
    n = len(u) // parts
    spectra = []
    for x in (u[:n], u[-n:]):
        power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(n))) ** 2
        bands = np.array([band.mean() for band in np.array_split(power[1:], 64)])
        spectra.append(np.sqrt(bands / max(bands.sum(), 1e-300)))
    return float(spectra[0] @ spectra[1])


# Scale


WINDOWS = 32

PUSHED = 1e-4
"""Movement of the inputs in a window, over the largest of all, from which it counts."""

FEWEST = 3
"""Windows on either side of a change."""


def gain_change(u: np.ndarray, y: np.ndarray) -> tuple[float, int, int | None] | None:
    """The change of an output's gain to what the inputs bring, by the half of the record that is one system.

    **Returns:** factor, last over first, the sample about which it changes, and the input whose gain it is, None for
    all of several; None where the gain is steady.
    """
    n, inputs = u.shape
    halves = [answer(u, y, rows) for rows in (slice(0, n // 2), slice(n // 2, n))]
    halves = [half for half in halves if half is not None and half.share < 0.7]
    if not halves:
        return None
    found = min(halves, key=lambda half: half.share)
    brought = np.stack([found.by(u[:, j], j) for j in range(inputs)], axis=1)
    edges = np.linspace(0, n, WINDOWS + 1).astype(int)
    windows = [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]
    pushed = np.array([np.max(np.std(u[w], axis=0) / np.std(u, axis=0).clip(1e-300)) for w in windows])
    gains = np.abs([_slopes(brought[w], y[w]) for w in windows])
    # Where nothing is done, nothing is learned.
    kept = np.flatnonzero((pushed > PUSHED * pushed.max()) & np.all(gains > 0.0, axis=1))
    changes = [_step(np.log(gains[kept, j])) for j in range(inputs)]
    changed = [j for j in range(inputs) if changes[j] is not None]
    if not changed:
        return None
    # What little an input brings may hide the change of its gain.
    largest = max(changed, key=lambda j: float(np.std(brought[:, j])))
    factor, split = changes[largest]
    others = [np.log(gains[kept, j]) for j in range(inputs) if j != largest]
    steady = [float(np.median(np.abs(x - np.median(x)))) < 0.2 * abs(np.log(factor)) for x in others]
    alone = inputs > 1 and len(changed) == 1 and all(steady)
    return factor, int(edges[kept[split]]), largest if alone else None


def _step(level: np.ndarray) -> tuple[float, int] | None:
    """The factor by which the exponential of a level steps, and where; None where it does not step and stay."""
    best = None
    for split in range(FEWEST, len(level) - FEWEST + 1):
        left, right = level[:split], level[split:]
        cost = np.sum(np.abs(left - np.median(left))) + np.sum(np.abs(right - np.median(right)))
        if best is None or cost < best[0]:
            best = cost, split
    if best is None:
        return None
    left, right = level[: best[1]], level[best[1] :]
    change = float(np.median(right) - np.median(left))
    scatter = max(float(np.median(np.abs(x - np.median(x)))) for x in (left, right))
    return None if abs(change) < np.log(2.0) or scatter > 0.2 * abs(change) else (float(np.exp(change)), best[1])


def _slopes(X: np.ndarray, y: np.ndarray) -> np.ndarray:
    X, y = X - X.mean(axis=0), y - y.mean()
    size = np.linalg.norm(X, axis=0) + 1e-300
    return np.linalg.lstsq(X / size, y, rcond=1e-6)[0] / size


# Lines


def mains_line(
    left: np.ndarray, a: np.ndarray, u: np.ndarray, sampling_time: float, frequency: float
) -> tuple[float, float, float] | None:
    """A line of the mains in what the inputs do not explain of an output, as it is or whitened: what else is left has
    lines and resonances of its own, and an equation that holds the line whitens it away.

    **Arguments:** `left`: that; `a`: polynomial of the equation that whitens it; `u`: inputs; `sampling_time` [s];
    `frequency` [Hz].

    **Returns:** where it appears [Hz], its amplitude, and its power over the largest beside it; None where there is
    none, where it would fall on zero or on half the sampling rate, or where an input has it too.
    """
    n = len(left)
    resolution = 1.0 / (n * sampling_time)
    folded = abs(frequency - np.rint(frequency * sampling_time) / sampling_time)
    beside = 24
    around = 2 + int(np.ceil(2e-3 * frequency / resolution))
    centre = round(folded / resolution)
    if centre - around - beside < 4 or centre + around + beside > n // 2 - 4:
        return None
    window = np.hanning(n)

    def stands_out(x):
        power = np.abs(np.fft.rfft(x * window)[centre - around - beside : centre + around + beside + 1]) ** 2
        at = beside + int(np.argmax(power[beside:-beside]))
        side = np.concatenate([power[: at - 3], power[at + 4 :]])
        return at, power[at], power[at] / max(float(np.max(side)), 1e-300), side

    best = None
    for by in ([1.0], a):
        at, power, ratio, side = stands_out(filtered(by, [1.0], left))
        if ratio >= max(ABOVE_SIDES, best[2] if best else 0.0) and power >= ABOVE_USUAL * np.median(side):
            line = centre - around - beside + at
            size = np.sqrt(power) / abs(np.polynomial.polynomial.polyval(np.exp(-2j * np.pi * line / n), by))
            best = line * resolution, float(2.0 * size / np.sum(window)), float(ratio)
    return best if best is not None and all(stands_out(x)[2] <= IN_INPUT for x in u.T) else None


ABOVE_SIDES, ABOVE_USUAL = 4.0, 30.0
"""Power of a line over the largest and over the median of 24 lines on each side."""

IN_INPUT = 3.0
"""The same over the largest, from which an input holds the line too."""


def count_lines(x: Float[np.ndarray, " samples"], most: int, left: float = 1e-4) -> int:
    """How many lines hold all but a share `left` of a signal's power, `most` + 1 for more than that."""
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
    power[:2] = 0.0
    whole = float(np.sum(power))
    for count in range(most + 1):
        if np.sum(power) <= left * whole:
            return count
        at = int(np.argmax(power))
        power[max(0, at - 4) : at + 5] = 0.0
    return most + 1


def resonance(y: np.ndarray, left: np.ndarray) -> tuple[float, float, float]:
    """The strongest peak of what the inputs do not explain of an output.

    **Returns:** its frequency in cycles per sample, its power over the median (0 where power only falls from zero
    frequency on), and the unexplained share there.
    """
    length = max(64, len(y) // 24)
    window = np.hanning(length)

    def spectrum(x):
        starts = range(0, len(x) - length + 1, length // 2)
        return np.mean([np.abs(np.fft.rfft(x[s : s + length] * window)) ** 2 for s in starts], axis=0)

    whole, part = spectrum(y), spectrum(left)
    smooth = np.convolve(part, np.ones(3) / 3.0, "same")
    at = 2 + int(np.argmax(smooth[2:-2]))
    here = slice(at - 1, at + 2)
    rises = smooth[at] > 1.2 * np.min(smooth[2 : at + 1])
    above = float(smooth[at] / np.median(smooth)) if rises else 0.0
    return at / length, above, float(np.sum(part[here]) / np.sum(whole[here]))


def explained_by_chance(u: np.ndarray, y: np.ndarray) -> bool:
    """Whether the inputs explain no more of an output than of any other: than they do put far off, at any of several
    averages over neighbouring samples, which bring a slow motion out of noise."""
    for size in AVERAGED:
        n = len(y) // size
        if n < LEAST_AVERAGES:
            break
        v, x = (np.mean(z[: n * size].reshape(n, size, -1), axis=1) for z in (u, y))
        found = fitted(v, x[:, 0], ORDERS[0], None)
        others = [fitted(np.roll(v, int(part * n), axis=0), x[:, 0], ORDERS[0], None) for part in FAR[::2]]
        if found is None or None in others:
            continue
        usual = min(float(np.std(other.innovation)) for other in others)
        chance = 4.0 * np.sqrt(found.b.size / 2.0) / n
        if float(np.std(found.innovation)) < (1.0 - chance) * usual:
            return False
    return True


AVERAGED = (1, 4, 16)
"""Neighbouring samples taken for one."""

LEAST_AVERAGES = 150


def exchanged(u: np.ndarray, y: np.ndarray, j: int, forward: float) -> float | None:
    """What an output and the other inputs leave of input j, where that is far less than inputs leave of the output
    (`forward`); else None."""
    back = answer(_in_place_of(u, y, j), u[:, j])
    follows = back is not None and back.stable and back.share < min(0.3, 0.4 * forward)
    return back.share if follows else None


def waits(u: np.ndarray, y: np.ndarray, j: int, share: float) -> bool:
    """Whether input j follows as well, all but this share, from an output that comes later still: no machine that the
    output moves waits that long."""
    later = answer(_in_place_of(u, np.roll(y, WAITED), j), u[:, j])
    return later is not None and later.share < WAITS * share


WAITED, WAITS = 10, 1.2
"""Samples by which an output is put off, and by how much more that may leave of an input that waits for it."""


def _in_place_of(u: np.ndarray, y: np.ndarray, j: int) -> np.ndarray:
    columns = u.copy()
    columns[:, j] = y
    return columns


def from_rest(found: Answer, u: np.ndarray, beside: np.ndarray | None = None) -> np.ndarray:
    """What the inputs, and columns beside them, bring to an output, from rest: without a line that went on from before
    the record."""
    columns = [*u.T, *(() if beside is None else beside.T)]
    with np.errstate(over="ignore", invalid="ignore"):
        brought = sum(filtered(b, found.a, x) for b, x in zip([*found.b, *found.c], columns))
    return brought if found.share < np.inf else np.zeros(len(u))
