"""Checks of how outputs follow inputs; what one of them explains, those after it leave alone."""

import itertools
from collections.abc import Iterator

import numpy as np

from jaxgray.numerics.text import listed
from jaxgray.records.checks.answers import answer
from jaxgray.records.checks.finding import RecordFinding
from jaxgray.records.checks.looked import ALIKE, LEFT, MANY, ROUGH, Answering, Looked, proportion
from jaxgray.records.checks.relations import (
    RESTING,
    WINDOWS,
    count_lines,
    drifting,
    exchanged,
    explained_by_chance,
    feedback,
    from_rest,
    gain_change,
    mains_line,
    overlap,
    predictable,
    resonance,
    waits,
)


def excitation(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    moving = [(name, x) for name, x in zip(record.input_names, looked.u.T) if np.any(x)]
    if not moving:
        return
    lines = [count_lines(x, record.outputs) for _, x in moving]
    if max(lines) <= record.outputs and record.samples >= 100:
        looked.explained.update(record.output_names)
        yield RecordFinding(
            "little_excitation",
            moving[0][0] if len(moving) == 1 else "record",
            f"The inputs hold no more than {max(lines)} of the at least {record.outputs + 1} frequencies that "
            "the outputs need. Excite a band: noise, a multisine, steps.",
            "warning",
            {"lines": max(lines)},
        )
    for k in range(1, len(moving)):
        for j in range(k):
            a, b = moving[j][1], moving[k][1]
            alike = abs(float(a @ b / np.sqrt((a @ a) * (b @ b))))
            if alike > TOGETHER:
                looked.explained.update(record.output_names)
            if alike > TOGETHER and proportion(a, b) is None:
                yield RecordFinding(
                    "little_excitation",
                    moving[k][0],
                    f"Input {moving[k][0]} moves with {moving[j][0]} (correlation {alike:.4f}): what each of them does "
                    "is not told apart. Excite them independently, or one after the other.",
                    "warning",
                    {"other": moving[j][0], "correlation": alike},
                )


TOGETHER = 0.99
"""Correlation of two inputs from which they are taken for one."""


def unit(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    # In a sweep the gain over time is the gain over frequency.
    if not looked.open or min(overlap(x) for x in looked.u.T if np.any(x)) < ALIKE:
        return
    told: set[int] = set()
    for one in looked.open:
        change = gain_change(looked.u, one.y) if one.found.share > STEADY else None
        if change is None:
            continue
        factor, sample, source = change
        if record.inputs == 1 and _grows(looked.u[:, 0], sample, 1.0 / factor):
            source = 0
        if not _explains(looked.u, one, factor, sample, source):
            continue
        looked.explained.add(one.name)
        if source is None:
            name, seen = one.name, f"{factor:.4g} times as large for the same inputs"
        elif source in told:
            continue
        else:
            told.add(source)
            name, factor = record.input_names[source], 1.0 / factor
            seen = f"{factor:.4g} times as large for the same motion of {one.name}"
        kind = "Output" if source is None else "Input"
        yield RecordFinding(
            "unit_change",
            name,
            f"{kind} {name} is {seen} from about {record.time[sample]:.6g} s on, as after a change of unit or range. "
            "Convert one part.",
            "warning",
            {"factor": factor, "sample": sample},
        )


def _explains(u: np.ndarray, one: Answering, factor: float, sample: int, source: int | None) -> bool:
    """Whether with the change taken back one equation explains the output all over the record, and better; but for the
    window in which it lies."""
    u, y = np.array(u), np.array(one.y)
    if source is None:
        y[sample:] /= factor
    else:
        u[sample:, source] *= factor
    width = len(y) // WINDOWS
    y[max(0, sample - width) : sample + width] = np.nan
    mended = answer(u, y, None, one.beside)
    return mended is not None and mended.share < EXPLAINED * one.found.share


EXPLAINED = 0.8
"""Unexplained share with a change taken back, over that before, from which the change explains it."""


def _grows(x: np.ndarray, sample: int, factor: float) -> bool:
    """Whether a signal itself grows by a factor at a sample, within one and a half times."""
    grown = np.std(np.diff(x[sample:])) / max(float(np.std(np.diff(x[:sample]))), 1e-300)
    return bool(1.0 / 1.5 < grown / factor < 1.5)


STEADY = 0.1
"""Unexplained share below which one gain holds all over the record."""


def timing(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    # Where modes do not say it, what follows from inputs to come does.
    shifts = {name: shift for name, shift in (looked.early | looked.shifts).items() if name not in looked.explained}
    if not shifts:
        return
    together = len(shifts) == len(looked.answering) and len(set(shifts.values())) == 1
    looked.explained.update(shifts)
    for name, shift in [("record", next(iter(shifts.values())))] if together else shifts.items():
        who = "The outputs come" if together else f"Output {name} comes"
        late = "late" if shift > 0 else "early"
        when = f"{abs(shift):.3g} samples ({abs(shift) * record.sampling_time:.3g} s) too {late}"
        by_modes = bool(looked.shifts) if together else name in looked.shifts
        their, them = ("their", "them") if together else ("its", "it")
        how = f"judging by the phases of {their} modes" if by_modes else f"since only later inputs explain {them}"
        yield RecordFinding(
            "time_shift",
            name,
            f"{who} {when} for the inputs, {how}. Align the channels, or find what delays them.",
            "warning",
            {"samples": shift, "seconds": shift * record.sampling_time},
        )


def signs(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    seen = {
        one.position: looked.modes[one.name]
        for one in looked.answering
        if one.name not in looked.explained and looked.modes.get(one.name) is not None
    }
    # Of every pair: 1 for residues that are all positive, -1 for all negative, 0 for both, NaN where unknown.
    signs, turned = np.full((2, record.outputs, record.inputs), np.nan)
    several = np.zeros(signs.shape, bool)
    for k, found in seen.items():
        if found.misfit <= ROUGH:
            clear = [_clear(parts, found.misfit, found.share) for parts in found.parts]
            signs[k] = [_sign(parts) for parts in clear]
            turned[k] = [_sign(_clear(parts, found.left, found.share)) for parts in found.turned]
            several[k] = [len(parts) > 1 for parts in clear] & (signs[k] != 0.0)
    if record.inputs == record.outputs:
        place = range(record.inputs)
    elif record.inputs == 1:
        # Of outputs at unknown places, one that answers with several modes alike is the place of the input, or else one
        # whose modes do not differ; which of them does not matter where all say the same.
        alike = [k for k in seen if several[k, 0]]
        others = [k for k in range(record.outputs) if signs[k, 0] != 0.0]
        place = next((some[:1] for some in (alike, others) if some and np.ptp(signs[some, 0]) == 0.0), [])
    else:
        return
    diagonal = {j: signs[k, j] for j, k in zip(range(record.inputs), place)}
    if record.inputs == record.outputs:
        for j, k in itertools.combinations(range(record.inputs), 2):
            crossed = [S[j, k] == 1.0 and S[k, j] == 1.0 and S[j, j] + S[k, k] < 2.0 for S in (signs, turned)]
            if any(crossed):
                names = record.output_names[j], record.output_names[k]
                diagonal[j] = diagonal[k] = 1.0
                yield RecordFinding(
                    "swapped_channels",
                    names[0],
                    f"{names[0]} moves like the place where {record.input_names[k]} acts, {names[1]} like that of "
                    f"{record.input_names[j]}: the two look swapped. Exchange the columns, or say where inputs act.",
                    "warning",
                    {"other": names[1]},
                )
    for j, k in zip(range(record.inputs), place):
        if diagonal[j] == -1.0:
            yield RecordFinding(
                "sign_error",
                record.output_names[k],
                f"{record.output_names[k]} moves against {record.input_names[j]} in every mode: one of them has the "
                "wrong sign, unless the input moves the base and the output is relative to it. Reverse one.",
                "warning",
                {"input": record.input_names[j]},
            )


def _clear(parts: np.ndarray, misfit: float, share: float) -> np.ndarray:
    """Those of the parts of modes that are no chance."""
    size = np.abs(parts)
    least = max(0.01, 3.0 * np.sqrt(misfit), BY_CHANCE * share)
    return parts[size > max(least * size.max(initial=0.0), 1e-3)]


BY_CHANCE = 0.15
"""Part of a mode, over what is unexplained, up to which dry friction brings it."""


def _sign(clear: np.ndarray) -> float:
    """Sign that all modes of a pair share, 0 where they differ, NaN where none is seen."""
    if clear.size == 0:
        return np.nan
    return float(np.sign(clear[0])) if np.all(np.sign(clear) == np.sign(clear[0])) else 0.0


def exchange(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for one in looked.open:
        # What follows from what comes after it alone is unstable.
        forward = one.found.share if one.found.stable else np.inf
        if forward < UNEXPLAINED:
            continue
        for j, name in enumerate(record.input_names):
            back = exchanged(looked.u, one.y, j, forward) if np.any(looked.u[:, j]) else None
            if back is not None and not _comes_early(looked, one, j, back):
                looked.explained.add(one.name)
                yield RecordFinding(
                    "swapped_channels",
                    one.name,
                    f"{name} follows from the past of {one.name}, all but {100 * back:.2g} %, and {one.name} does not "
                    f"follow from that of {name}: input and output look swapped. Exchange the two columns.",
                    "warning",
                    {"input": name, "share": one.found.share, "exchanged_share": back},
                )
                break


def _comes_early(looked: Looked, one: Answering, j: int, back: float) -> bool:
    """Whether an output that input j seems to follow from, all but a share `back`, comes before it instead: what is to
    come explains it far better, or the input waits for it."""
    if one.name in looked.shifts:
        better = looked.shifts[one.name] > 0 or looked.aligned[one.name][1].share < back
    else:
        better = one.name in looked.early and looked.aligned[one.name][1].share < FORWARD * back
    return better or (one.name in looked.early | looked.shifts and waits(looked.u, one.y, j, back))


FORWARD = 0.5
"""Share that inputs to come leave of an output, over what it leaves of them, below which it is not their cause where no
modes say so."""


def no_answer(looked: Looked) -> Iterator[RecordFinding]:
    for one in looked.open:
        if not 0.9 < one.found.share < np.inf:
            continue
        chance = explained_by_chance(looked.u, one.y)
        # What is coloured comes from elsewhere.
        if not chance and np.std(one.found.innovation) < WHITE * np.std(one.found.unexplained):
            continue
        looked.explained.add(one.name)
        if chance:
            yield RecordFinding(
                "dead_channel",
                one.name,
                f"Output {one.name} has nothing to do with any input. Check the sensor and its cable, or leave the "
                "output out.",
                "warning",
                {"share": one.found.share},
            )
        else:
            yield RecordFinding(
                "little_excitation",
                one.name,
                f"The inputs explain {100 * max(0.0, 1 - one.found.share**2):.2g} % of the power of {one.name}. Excite "
                "more, or measure with less noise.",
                "warning",
                {"share": one.found.share},
            )


WHITE = 0.97
"""What its own past leaves of noise, RMS over RMS, from which it is white."""


def loop(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    if record.samples < MANY or not looked.open:
        return
    # Where inputs explain all but this, hardly anything is fed back.
    unexplained = [one for one in looked.open if one.found.share > UNEXPLAINED]
    if not unexplained:
        return
    period = record.detect_period()
    for j, name in enumerate(record.input_names):
        x = looked.u[:, j]
        if np.median(np.abs(np.diff(x))) <= RESTING * np.std(x):
            continue
        left = looked.left[j]
        followed = []
        if overlap(x) > ALIKE and predictable(x) > PREDICTED:
            for one in unexplained:
                here, far = feedback(one.found, x, period)
                if here > max(LOOP / np.sqrt(record.samples), FOLLOWED, 1.5 * far):
                    followed.append(one.name)
        if left > LEFT and not followed:
            continue
        looked.explained.update(one.name for one in looked.open)
        seen = (
            f"{name} follows from the last outputs, all but {100 * left:.2g} % of what its own past leaves open"
            if left <= LEFT
            else f"{name} responds to the part of {listed(followed)} that it does not explain"
        )
        yield RecordFinding(
            "closed_loop",
            name,
            f"{seen}: a controller closes the loop and feeds noise back, too. Record the reference, and excite by it.",
            "note",
            {"left": left, "outputs": followed},
        )


UNEXPLAINED = 0.01
"""Unexplained share of an output from which another relation may explain it, or what is fed back of it matters."""

FOLLOWED = 0.06
"""Correlation of an input with what went before that matters."""

LOOP = 5.0
"""Correlation with what went before, in standard deviations, that is no chance."""

PREDICTED = 1e-4
"""Innovation of an input, RMS over its own, below which nothing can be seen to enter it."""


def drift(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    if not looked.open or min(overlap(x) for x in looked.u.T if np.any(x)) < ALIKE:
        return
    for one in looked.open:
        total, share = drifting(looked.u, one.y, one.found, one.beside)
        if total != 0.0:
            looked.explained.add(one.name)
            behind = "falls behind" if total > 0.0 else "gets ahead"
            ppm = 1e6 * total / record.samples
            yield RecordFinding(
                "clock_drift",
                one.name,
                f"Output {one.name} {behind} by {abs(total):.3g} samples over the record: its clock is {abs(ppm):.3g} "
                "ppm off that of the inputs. Sample by one clock, or resample one of the two.",
                "warning",
                {"samples": total, "ppm": ppm, "share": share},
            )


def hum(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    for one in looked.answering:
        left = one.y - from_rest(one.found, looked.u, one.beside)
        for frequency in MAINS_HZ:
            line = mains_line(left, one.found.a, looked.u, record.sampling_time, frequency)
            if line is not None and line[1] > LEAST_LINE * np.std(one.y):
                seen, amplitude, above = line
                amplitude = float(amplitude * one.size)
                folded = "" if frequency < 0.5 / record.sampling_time else f", seen at {seen:.4g} Hz"
                yield RecordFinding(
                    "mains_hum",
                    one.name,
                    f"Output {one.name} holds a line of {frequency:g} Hz{folded}, amplitude {amplitude:.3g}, that no "
                    "input explains: mains hum. Shield the cable and ground it at one end, or sample whole periods.",
                    "warning",
                    {"frequency_hz": seen, "mains_hz": frequency, "amplitude": amplitude, "above_its_sides": above},
                )


MAINS_HZ = (50.0, 60.0)

LEAST_LINE = 1e-3
"""Amplitude over the standard deviation of an output from which a line is said."""


def alias(looked: Looked) -> Iterator[RecordFinding]:
    record = looked.record
    if len(looked.open) < len(looked.answering) or not looked.open:
        return
    shares = [one.found.share for one in looked.open]
    if min(shares) < FOREIGN or max(shares) == np.inf:
        return
    for one in looked.open:
        frequency, above, share = resonance(one.y, one.found.unexplained)
        if above > PEAK and share > UNEXPLAINED_PEAK:
            yield RecordFinding(
                "aliasing",
                one.name,
                f"{one.name} has a peak at {frequency / record.sampling_time:.4g} Hz, of which the inputs explain "
                f"{100 * max(0.0, 1 - share):.2g} %: an alias from above half the sampling rate, or a force that is "
                "not recorded. Measure with an anti-alias filter, or at another rate: a mode stays, an alias moves.",
                "warning",
                {"frequency_hz": frequency / record.sampling_time, "share": share, "above_median": above},
            )


FOREIGN = 0.6
"""Unexplained share of every output from which what moves them is looked for elsewhere."""

PEAK, UNEXPLAINED_PEAK = 1.5, 0.3
"""Power over the median, and unexplained share, from which a peak is said."""
