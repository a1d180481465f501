"""The page of a diagnosis: the verdict, then nine parts from the runs to the next experiment."""

import numpy as np

from ...diagnosis.result import Diagnosis
from ...diagnosis.words.sentences import times
from ...diagnosis.words.titles import place_of, title_of
from ...mechanics.effects import AbstractEffect
from ...mechanics.systems.drives import Force
from ..diagnosis_rows import (
    budget_rows,
    candidate_rows,
    candidates,
    coordinate_names,
    energy_words,
    error_kind,
    error_rows,
    estimated,
    experiment_words,
    findings_rows,
    gain_words,
    not_found_rows,
    parameter_lines,
    rivals,
    shift_rows,
    what_is_left,
)
from ..identification_rows import MATRICES, matrix_rows
from .diagnosis_plots import (
    budget_plot,
    experiment_plots,
    missing_force_plots,
    over_time_plots,
    ranking_plot,
    spectrum_plots,
)
from .parts import Fact, Page, Section, Table, Tables, Words
from .records import record_section

WIDE = 40.0
"""Width of a gain's interval [%] from which the page says why it is wide."""

VERDICTS = {
    "named": "cause named",
    "equivalent": "causes this record cannot tell apart",
    "partly": "partly explained",
    "unexplained": "something is missing that has no name",
    "noise": "nothing is missing",
}
KINDS = {
    "coordinate": "a force on this coordinate",
    "spring": "a force on this coordinate, to ground",
    "pair": "a force between these two",
    "input": "this input",
    "output": "the sensor of this output",
    "cross": "a channel that leaks into another",
    "record": "all outputs",
}
"""What a place means, by where laws can act."""

STOREYS = {
    "spring": "a force between this floor and the base, on the drift of that storey",
    "pair": "a force between these two floors, on the drift of that storey",
}
"""The same where the base moves."""

FOLDED = 12
"""Rows from which a table is closed at first."""


def diagnosis_page(diagnosis: Diagnosis, document: dict) -> Page:
    """The page of a diagnosis.

    **Arguments:** `diagnosis`; `document`: by `diagnosis_document`, whose numbers the page shows.

    **Returns:** a `Page`.
    """
    names = coordinate_names(document)
    causes = _causes(document)
    titles = [title_of(one["effect"], one["location"], names) for one in causes]
    laws = {term.effect.id: term.effect for term in diagnosis.terms}
    kinds = KINDS if isinstance(diagnosis.baseline.model.drive, Force) else KINDS | STOREYS
    cards = [
        _card(document, one, names, k, len(causes), laws.get(one["effect"]), kinds) for k, one in enumerate(causes)
    ]
    badge = VERDICTS[document["verdict"]]
    return Page(
        "; ".join(titles) or badge.capitalize(),
        "diagnosis",
        "causes named" if len(causes) > 1 and document["verdict"] == "named" else badge,
        document["sentence"],
        (*cards, _summary(document, len(causes))),
        tuple(section for section in _sections(diagnosis, document) if section.blocks),
        document,
    )


def _causes(document: dict) -> list[dict]:
    """Findings of the model that have a name."""
    return [one for one in document["findings"] if one["stage"] == "model" and one["status"] != "unexplained"]


def _card(
    document: dict,
    finding: dict,
    names: tuple[str, ...],
    index: int,
    count: int,
    law: AbstractEffect | None,
    kinds: dict[str, str],
) -> tuple[Fact, ...]:
    """Cause, place, parameters, gain of a finding, `index` of `count`; `kinds`: what a place means."""
    others = ", or ".join(
        title_of(one["effect"], one["location"], names) for one in rivals(finding) if finding["status"] == "equivalent"
    )
    # Of a single finding the gain is that of the whole extension, which the sentence tells.
    gain = document["extended"]["gain"] if count == 1 and document["extended"] else finding["gain"]
    seen = "on held-out data" if gain and gain["held_out"] else "on the data of the fit"
    if index:
        seen += ", beyond the cause above" if index == 1 else ", beyond the causes above"
    if gain and None not in gain["ci95"] and gain["ci95"][1] - gain["ci95"][0] > WIDE:
        seen += "; the interval is wide: the gain differs much between parts of the record"
    kind = (
        "" if law is None else kinds.get("pair" if " and " in place_of(finding["location"], names) else law.places, "")
    )
    return (
        Fact("Cause", title_of(finding["effect"], "").capitalize(), f"or {others}" if others else finding["status"]),
        Fact("Place", place_of(finding["location"], names).removeprefix("at ") or "–", kind),
        Fact(
            "Size ± standard error",
            parameter_lines(estimated(finding["parameters"]), fixed=False) or "–",
            "" if law is None else law.law,
        ),
        Fact("RMS error taken off (95 % interval)", gain_words(gain).removesuffix(", in-sample"), seen),
    )


def _summary(document: dict, causes: int) -> tuple[Fact, ...]:
    """How far off the model was, what all findings mend, what is left."""
    extended = document["extended"]
    gain = None if extended is None else extended["gain"]
    kind = error_kind(document) if gain is None or gain["held_out"] else "estimation"
    data = {"validation": "held-out data", "estimation": "the data of the fit"}[kind]
    floor, several = document["baseline"]["noise_floor"], len(document["baseline"]["model"]["output_names"]) > 1

    def fact(title: str, rmse: dict) -> Fact:
        ratios = _ratios(rmse, floor)
        detail = f"the noise floor, on {data}"
        if several and ratios:
            worst = max(ratios, key=ratios.__getitem__)
            detail += f", over all outputs ({times(ratios[worst])} at {worst})"
        return Fact(title, _times(ratios), detail)

    facts = [fact("RMS error before", document["baseline"]["rmse"][kind])]
    if extended is not None:
        facts.append(fact("RMS error after", extended["rmse"][kind]))
        if causes > 1:
            facts.append(Fact("All together take off", gain_words(gain), f"of the error on {data}"))
    facts.append(Fact("What is left", *_left(document)))
    return tuple(facts)


def _left(document: dict) -> tuple[str, str]:
    """Whether anything but noise is left, and what is known of it."""
    remaining = document["remaining"]
    if remaining["depends_on"]:
        return "more than noise", f"depends on {', '.join(remaining['depends_on'])}"
    if document["verdict"] in ("unexplained", "partly"):
        return "more than noise", "no law of the catalogue explains it"
    if remaining["white"]:
        return "noise alone", "white: no pattern over time is left"
    if any(one["effect"] == "process_noise" for one in document["findings"]):
        return "noise", "part of it enters at the forces"
    return "more than white noise", "no law of the catalogue explains it"


def _ratios(rmse: dict, floor: dict) -> dict[str, float]:
    """Error over noise floor, by output."""
    return {name: rmse[name] / floor[name] for name in floor if floor[name] and rmse.get(name) is not None}


def _times(ratios: dict[str, float]) -> str:
    """Root mean square over the outputs."""
    return times(float(np.sqrt(np.mean(np.square(list(ratios.values())))))) if ratios else "–"


def _sections(diagnosis: Diagnosis, document: dict):
    kind = {"validation": "data that the fit has not seen", "estimation": "the data of the fit"}[error_kind(document)]
    findings = findings_rows(document)
    messages = tuple(
        f"{title_of(one['effect'], one['location'], coordinate_names(document))}: {one['message']}"
        for one in document["findings"]
        if one["message"]
    )
    yield Section(
        "findings",
        "What was found",
        "Each finding with its evidence (ΔBIC, from 10 it counts), what it takes off the RMS error beyond "
        "those above it, and its parameters.",
        ((Table(findings, "Findings", False), Words(messages)) if findings.body else ())
        + (Table(error_rows(document), f"Fit and error of the free run, on {kind}"),)
        + (Words((f"Left: {what_is_left(document)}.",)),),
    )
    windows = "windows" in document["baseline"]["noise_floor_source"]
    yield Section(
        "time",
        "Measured, simulated, extended",
        f"Free runs from the input alone, on {kind}. Below each, what the models miss, with ±2 σ of the noise shaded: "
        "a model that lacks nothing stays inside."
        + (
            " The runs start anew in every window: over the whole record they would show drift alone."
            if windows
            else ""
        ),
        tuple(over_time_plots(diagnosis)),
    )
    yield Section(
        "spectra",
        "Spectra",
        "Where in frequency the error lies, before and after. What lies on the dashed line is noise."
        + (" Free runs start anew in every window; their jumps spread over all frequencies." if windows else ""),
        tuple(spectrum_plots(diagnosis)),
    )
    forces = missing_force_plots(diagnosis)
    yield Section(
        "missing",
        "What the model lacks, against what it depends on",
        "What was measured and the linear part does not account for, with other findings taken out. The law that was "
        "found is drawn for the same motion: as a line where one variable decides it, else as points.",
        tuple(forces),
    )
    ranked = candidate_rows(document)
    plot = ranking_plot(candidates(document), coordinate_names(document))
    yield Section(
        "ranking",
        "Candidates",
        "Every effect that passed the gate, how it fared once refitted, and why it was not taken.",
        ((plot,) if plot else ()) + ((Table(ranked, "Candidates by evidence"),) if ranked.body else ()),
    )
    yield Section(
        "shift",
        f"What it does to {'mass, damping and stiffness' if diagnosis.beside is None else 'your numbers'}",
        "Parameters of the model without and with what was found: a linear model hides what it lacks in its numbers.",
        tuple(_models(document)),
    )
    budget, energy = document["budget"], energy_words(document)
    yield Section(
        "budget",
        "Error budget",
        "Where the mean square error comes from, before anything is added to the model.",
        ((budget_plot(document), Table(budget_rows(document), "Shares of the mean square error")) if budget else ())
        + ((Words((f"Energy of the extended model: {energy}.",)),) if energy else ()),
    )
    missing = not_found_rows(document)
    yield Section(
        "not-found",
        "Looked for and not found",
        f"{len(missing.body)} other candidates, each with the smallest size that this record would have shown.",
        (Table(missing, "Smallest visible sizes", len(missing.body) > FOLDED),) if missing.body else (),
    )
    proposed = document["next_experiment"]
    text = "Nothing is left to separate: no experiment is proposed."
    if document["verdict"] in ("partly", "unexplained"):
        text = "No experiment is proposed: what is left has no candidates to separate."
    elif proposed is None and document["verdict"] == "equivalent":
        text = "No experiment was found that separates the members of the class."
    yield Section(
        "experiment",
        "Next experiment",
        "The input that best separates what this record cannot tell apart.",
        (Words((text,)),) if proposed is None else (Words((experiment_words(proposed),)), *experiment_plots(diagnosis)),
    )
    yield record_section(diagnosis.records, diagnosis.validation_records, document, _noise(document))


def _noise(document: dict) -> str:
    return f"Noise floor taken from: {document['baseline']['noise_floor_source']}."


def _models(document: dict):
    shifts = shift_rows(document)
    if shifts is not None:
        yield Table(shifts, "Before and after, in percent and in standard errors")
    first = "Your model" if document["own_model"] else "Linear model"
    for title, part in ((first, document["baseline"]), ("Extended model", document["extended"])):
        if part is not None:
            matrices = tuple(Table(matrix_rows(name, part["model"]), name.capitalize()) for name in MATRICES)
            yield Tables(matrices, f"{title}, ± standard error", shifts is not None)
