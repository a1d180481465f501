"""A diagnosis in words: the verdict as a sentence, everything on one screen."""

import math
import re
import textwrap

import numpy as np

from ...mechanics.effects import CATALOGUE
from ...mechanics.systems.drives import Force
from ...numerics.text import listed, plus_minus
from .. import settings
from ..findings import DiagnosisFields, Estimate, Finding, Gain, ParameterShift
from .titles import number_of, parameters_text, place_of, title_of, value_text

MANY = 4.0
"""Ratio of an entry to what it should be from which a sentence says how many times it is."""

TOO_MUCH = 1e3
"""Ratio of an entry before to after from which the linear model had no such entry to speak of."""

UNLIKELY = 1000.0
"""Change of an entry [%] from which it says more of a small entry than of a large change."""

ENTRIES = {"mass_error": "mass", "damping_error": "damping", "stiffness_error": "stiffness"}

MODEL_ERRORS = (*ENTRIES, "parameter_error")


def verdict_sentence(diagnosis: DiagnosisFields) -> str:
    """The verdict in words: what is missed, its cause, what mending it buys, and what the linear model had instead.

    **Arguments:** `diagnosis`.

    **Returns:** a few sentences in one line.
    """
    subject = _subject(diagnosis)
    causes = [f for f in diagnosis.findings if f.stage == "model" and f.effect and f.status != "unexplained"]
    parts = [_missed(diagnosis, subject), _stands_in(diagnosis)]
    if causes:
        parts += _causes(diagnosis, causes)
        parts += [_altered(diagnosis, finding) for finding in causes]
        parts += [_gain(diagnosis, causes)]
    if causes and not diagnosis.own_model:
        parts += [_hidden(diagnosis, len(causes))]
    if diagnosis.verdict in ("unexplained", "partly"):
        parts += [_unexplained(diagnosis, bool(causes))]
    seen = [f for f in diagnosis.findings if f.stage == "record"]
    if seen:
        names = diagnosis.baseline.model.coordinates
        parts += [f"Seen in the record: {listed(_seen(f, names) for f in seen)}."]
        # Behind what it is, how much of it may be something else.
        parts += [f.message.partition(". ")[2] for f in seen if f.effect == "process_noise"]
        mended = [f for f in seen if f.gain is not None]
        if mended and not causes:
            parts += [_gain(diagnosis, mended)]
    return " ".join(part for part in parts if part)


def _subject(diagnosis: DiagnosisFields) -> str:
    """What is judged."""
    if not diagnosis.own_model:
        return "The linear model"
    if diagnosis.simulated is not None:
        return "Your simulation"
    return "Your model" if diagnosis.beside is None else "Your simulator"


def _stands_in(diagnosis: DiagnosisFields) -> str:
    """What moves as a simulation does of which only the outputs are known; empty where there is none."""
    if diagnosis.simulated is None:
        return ""
    names = diagnosis.baseline.model.coordinates
    laws = [_titled(one, names) for one in diagnosis.simulated.findings]
    left = max(diagnosis.simulated.left_percent.values())
    return f"It moves as M, D, K with {listed(laws) if laws else 'no other law'} ({max(left, 0.01):.2g} % left)."


def _missed(diagnosis: DiagnosisFields, subject: str) -> str:
    """How far the baseline is from the noise, where it is farthest."""
    excess, place = worst_output(diagnosis)
    where = f" at {place}" if place else ""
    if diagnosis.verdict == "noise" and diagnosis.extended is None:
        missed, poor = _poorest(diagnosis)
        if missed > settings.LARGE_RESIDUAL and not diagnosis.white:
            text = f"What {subject[0].lower()}{subject[1:]} leaves looks like noise, though it is {missed:.0f} % of the"
            return f"{text} motion at {poor}: an effect too strong to be told looks the same."
        text = f"{subject} explains the record down to its noise ({excess:.2f}× the noise floor{where}): "
        return text + "nothing is missing that this record could show."
    if diagnosis.verdict == "unexplained" and excess < settings.MIN_EXCESS:
        # The floor is what the model itself leaves on the data of the fit.
        return f"{subject} leaves more than noise{where}."
    return f"{subject} misses {times(excess)} the noise floor{where}."


def _poorest(diagnosis: DiagnosisFields) -> tuple[float, str]:
    """How much of the motion [%] the baseline misses on the data of the fit at the output that it misses most of."""
    fits = diagnosis.baseline.fit_percent.get("estimation") or {}
    fits = {name: fit for name, fit in fits.items() if fit is not None and math.isfinite(fit)}
    if not fits:
        return 0.0, ""
    place = min(fits, key=fits.__getitem__)
    return 100.0 - fits[place], place


def _seen(finding: Finding, names: tuple[str, ...]) -> str:
    """What is wrong with the record; with its size where it was estimated with the model."""
    return title_of(finding.effect, finding.location, names) if finding.gain is None else _titled(finding, names)


def times(excess: float) -> str:
    """A ratio as a person says it: 2.8×, 31×."""
    if not math.isfinite(excess):
        return "an unknown multiple of"
    return f"{excess:.2f}×" if excess < 1.95 else f"{excess:.1f}×" if excess < 9.95 else f"{excess:.0f}×"


def worst_output(diagnosis: DiagnosisFields) -> tuple[float, str]:
    """RMSE of the baseline over the noise floor where it is largest, held out if possible, and the output's name."""
    rmse = diagnosis.baseline.rmse
    held = rmse.get("validation") or rmse.get("estimation") or {}
    ratios = {
        name: value / diagnosis.noise_floor[name]
        for name, value in held.items()
        if value is not None and diagnosis.noise_floor.get(name)
    }
    ratios = {name: ratio for name, ratio in ratios.items() if math.isfinite(ratio)}
    if not ratios:
        return diagnosis.baseline_excess, ""
    place = max(ratios, key=ratios.__getitem__)
    return ratios[place], place


def _causes(diagnosis: DiagnosisFields, causes: list[Finding]) -> list[str]:
    """The causes; with the user's own model in two parts, numbers and structure."""
    if not diagnosis.own_model:
        return [_named(diagnosis, causes, "Cause" if len(causes) == 1 else "Causes")]
    wrong = [f for f in causes if f.effect in MODEL_ERRORS]
    laws = [f for f in causes if f.effect not in MODEL_ERRORS]
    names = diagnosis.baseline.model.coordinates
    parts = []
    if wrong:
        parts.append("Your numbers: " + listed(_correction(f, names) for f in wrong) + ".")
    if laws:
        parts.append(_named(diagnosis, laws, "Your structure lacks"))
    return parts


def _correction(finding: Finding, names: tuple[str, ...]) -> str:
    """How an entry that was given should change."""
    what = number_of(finding.effect, finding.location, names)
    what = f"the {ENTRIES[finding.effect]} {place_of(finding.location, names)}" if what is None else what
    delta = finding.parameters.get("delta")
    if delta is None:
        return f"{what} is wrong"
    if "value" in finding.parameters:
        members = finding.members if finding.status == "equivalent" else ()
        others = [m for m in members if (m.effect, m.location) != (finding.effect, finding.location)]
        parts = [_number(what, finding.parameters)]
        for m in others:
            number = number_of(m.effect, m.location, names) if "value" in m.parameters else None
            parts.append(_titled(m, names) if number is None else _number(number, m.parameters))
        return ", or ".join(parts) + (" (this record cannot tell which)" if others else "")
    size = value_text(abs(delta.value), delta.standard_error, delta.unit, digits=1)
    text = f"{what} should be {'higher' if delta.value > 0 else 'lower'} by {size}"
    return text + _rivals(finding, names)


def _number(what: str, parameters: dict[str, Estimate]) -> str:
    """What a number is, and what it was given as."""
    delta, value = parameters["delta"], parameters["value"]
    text = f"{what} is {value_text(value.value, value.standard_error, value.unit, digits=1)}"
    return f"{text}, not {plus_minus(value.value - delta.value)}"


def _rivals(finding: Finding, names: tuple[str, ...]) -> str:
    """The other members of a class, for what is not separated."""
    others = [m for m in finding.members if (m.effect, m.location) != (finding.effect, finding.location)]
    if finding.status != "equivalent" or not others:
        return ""
    return "".join(f", or {_titled(member, names)}" for member in others)


def _titled(one, names: tuple[str, ...]) -> str:
    """Name, place and parameters of a finding or member."""
    return ", ".join(filter(None, (title_of(one.effect, one.location, names), parameters_text(one.parameters))))


def _named(diagnosis: DiagnosisFields, causes: list[Finding], head: str) -> str:
    names = diagnosis.baseline.model.coordinates
    texts = []
    for finding in causes:
        text = _titled(finding, names) + _rivals(finding, names)
        texts.append(text + (" (part of it)" if finding.status == "partly" else ""))
    sentence = f"{head}: {'; '.join(texts)}."
    if any(f.status == "equivalent" for f in causes):
        proposed = diagnosis.next_experiment is not None
        sentence += " This record cannot tell them apart" + (
            "; an experiment that can is proposed." if proposed else "."
        )
    members = {m.effect for f in causes if f.status == "equivalent" for m in f.members}
    return " ".join([sentence, *(e.told_apart for e in CATALOGUE if e.id in members and e.told_apart)])


def _altered(diagnosis: DiagnosisFields, finding: Finding) -> str:
    """What a law that alters a matrix takes off or adds, in percent of what is there; empty for other laws."""
    term = next((t for t in diagnosis.terms if (t.effect.id, t.place.name) == (finding.effect, finding.location)), None)
    if term is None or not term.effect.alters or diagnosis.extended is None:
        return ""
    matrix, parameter = term.effect.alters
    model, first, second = diagnosis.extended.model, term.place.first, term.place.second
    X = np.asarray(getattr(model, matrix))
    other = "the ground" if isinstance(model.drive, Force) else "the base"
    ends = f"between {model.coordinates[first]} and {other if second < 0 else model.coordinates[second]}"
    there = -X[first, second] if second >= 0 else X[first].sum()
    if matrix == "mass":
        there, ends = X[first, first], f"at {model.coordinates[first]}"
    percent = 100 * finding.parameters[parameter].value / there if there > 0 else math.nan
    if not abs(percent) < UNLIKELY:
        return ""
    change = "fell" if percent < 0 else "rose"
    return f"The {matrix} {ends} {change} by {abs(percent):.{0 if abs(percent) >= 9.95 else 1}f} %."


def _gain(diagnosis: DiagnosisFields, causes: list[Finding]) -> str:
    """What mending all of it takes off the error, and what is left."""
    gain = diagnosis.gain
    if gain is None or not math.isfinite(gain.percent):
        return ""
    wrong = sum(f.effect in MODEL_ERRORS for f in causes)
    verb = "Adding" if not wrong else "Correcting" if wrong == len(causes) else "Mending"
    count = {1: "it", 2: "both", 3: "all three", 4: "all four"}.get(len(causes), "all of them")
    if any(f.stage == "record" and f.gain is not None for f in diagnosis.findings) and causes[0].stage == "model":
        count += ", and mending the record,"
    error = "the held-out error" if gain.held_out else "the error"
    if gain.percent > 0:
        here = " here, though it need not on other records," if gain.held_out and gain.ci95[0] < 0 else ""
        change = f"{verb} {count} cuts {error}{here} by {gain_text(gain)}"
    else:
        change = f"{verb} {count} does not lower {error} ({gain_text(gain)})"
    if not gain.held_out:
        change += " on the data it was fitted to (in-sample, not proven on held-out data)"
    if diagnosis.excess < settings.MIN_EXCESS:
        # Where the noise is taken from the final model itself, something may be left all the same.
        if diagnosis.verdict == "partly":
            return f"{change}."
        # A finding tied to the clock of one record is left out of the runs on another, and missing there.
        everywhere = all(f.gain is not None and f.gain.held_out for f in causes)
        unseen = _left_unseen(diagnosis) if gain.held_out and everywhere else 0.0
        if unseen >= settings.STAND_IN_EXCESS:
            whose = "its law" if len(causes) == 1 else "a law"
            return f"{change}, but leaves {times(unseen)} the noise floor there: {whose} may stand in for another."
        if any(f.effect == "process_noise" for f in diagnosis.findings):
            return f"{change} and leaves what noise at the forces explains."
        if diagnosis.white:
            return f"{change} and leaves only noise."
        return f"{change}; what is left is more than white noise, and no law of the catalogue explains it."
    return f"{change} and leaves {times(diagnosis.excess)} the noise floor."


def _left_unseen(diagnosis: DiagnosisFields) -> float:
    """Error after mending on held-out data over the noise floor, root mean square over the outputs that have one."""
    floors = diagnosis.noise_floor
    left = [after / floors[y] for y, (_, after) in diagnosis.gain.per_output.items() if floors.get(y, 0.0) > 0]
    return math.sqrt(sum(x**2 for x in left) / max(len(left), 1))


def gain_text(gain: Gain) -> str:
    """64 % (61 to 67)."""
    low, high = gain.ci95
    interval = f" ({low:.0f} to {high:.0f})" if math.isfinite(low) and math.isfinite(high) else ""
    return f"{gain.percent:.0f} %{interval}" + (", shared" if gain.together > 1 else "")


def _unexplained(diagnosis: DiagnosisFields, causes: bool) -> str:
    """What is not named, and on which variables it depends."""
    head = "What is left has no name in the catalogue" if causes else "No effect of the catalogue explains it"
    if diagnosis.depends_on:
        return f"{head}; it depends on {listed(diagnosis.depends_on)}."
    return f"{head}."


_ENTRY = re.compile(r"^(mass|damping|stiffness)\s*\[\s*(.+?)\s*,\s*(.+?)\s*\]$")


def entry_of(name: str, outputs: tuple[str, ...]) -> tuple[str, str, str]:
    """Matrix, row and column (names of outputs) of an entry such as "damping[0,1]"; empty where it is none."""
    match = _ENTRY.match(name)
    if match is None:
        return "", "", ""
    matrix, *places = match.groups()
    r, c = (outputs[int(p)] if p.isdigit() and int(p) < len(outputs) else p for p in places)
    return matrix, r, c


def _hidden(diagnosis: DiagnosisFields, causes: int) -> str:
    """Which entry of the linear model had taken the effect in, if one clearly had."""
    outputs = diagnosis.baseline.model.coordinates

    def clear(shift: ParameterShift) -> bool:
        matrix, r, c = entry_of(shift.name, outputs)
        change, after = abs(shift.before - shift.after), abs(shift.after)
        error = shift.standard_error if shift.standard_error is not None else after / 60
        shows = after > 3 * error and change > 3 * error and 0.01 * after < change < TOO_MUCH * after
        return matrix != "" and r == c and shows and after > 1e-3 * largest[matrix]

    largest = dict.fromkeys(("mass", "damping", "stiffness"), 0.0)
    for shift in diagnosis.shifts:
        matrix = entry_of(shift.name, outputs)[0]
        if matrix:
            largest[matrix] = max(largest[matrix], abs(shift.after))
    shifts = [shift for shift in diagnosis.shifts if clear(shift)]
    if not shifts:
        return ""
    most = max(shifts, key=lambda s: abs(s.before / s.after - 1))
    matrix, place, _ = entry_of(most.name, outputs)
    where = matrix + (f" at {place}" if len(outputs) > 1 else "")
    ratio = most.before / most.after
    percent = 100 * abs(ratio - 1)
    share = (
        f"{percent:.{0 if percent >= 9.5 else 1}f} % {'more' if ratio > 1 else 'less'}"
        if ratio < MANY
        else f"{ratio:.{0 if ratio >= 9.95 else 1}f} times the"
    )
    subject = "it" if causes == 1 else "them"
    return f"Without {subject}, the linear model has {share} {where}."


def describe(diagnosis: DiagnosisFields) -> str:
    """Verdict, findings, what is left, the next experiment and warnings.

    **Arguments:** `diagnosis`.

    **Returns:** the text, not ending in a newline.
    """
    names = diagnosis.baseline.model.coordinates
    lines = [f"Diagnosis: {diagnosis.verdict}", *_filled(verdict_sentence(diagnosis), "  ")]
    rows = [("finding", "status", "ΔBIC", "gain", "parameters")]
    for f in diagnosis.findings:
        rows.append(
            (
                title_of(f.effect, f.location, names),
                f.status if f.stage == "model" else "record",
                "–" if f.delta_bic is None else f"{f.delta_bic:.0f}",
                "–" if f.gain is None else gain_text(f.gain),
                parameters_text(f.parameters, digits=2) or "–",
            )
        )
    if len(rows) > 1:
        width = [max(len(row[k]) for row in rows) for k in range(5)]
        lines += ["  " + "  ".join(text.ljust(w) for text, w in zip(row, width)).rstrip() for row in rows]
    colour = "white" if diagnosis.white else "not white"
    lines.append(
        f"  left: {times(diagnosis.excess)} the noise floor ({diagnosis.noise_floor_source}), {colour}; "
        f"{len(diagnosis.rejected)} candidates rejected, {len(diagnosis.not_found)} not found"
    )
    if diagnosis.next_experiment is not None:
        lines += _filled(f"next experiment: {diagnosis.next_experiment.text}", "  ")
    for text in diagnosis.warnings:
        lines += _filled(f"warning: {text}", "  ")
    return "\n".join(lines)


def _filled(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, 108, initial_indent=indent, subsequent_indent=indent)
