"""A diagnosis as a sentence, a document, tables and a figure."""

import dataclasses
import io
import json

import numpy as np
import pytest
from made_diagnosis import FRICTION, GAIN, diagnosis, equivalent, experiment, nothing, wrong_numbers
from rich.console import Console

from jaxgray.diagnosis.findings import Estimate, Finding, Member, ParameterShift
from jaxgray.diagnosis.model.own_laws import ParameterError
from jaxgray.diagnosis.words.titles import NAMES, place_of, title_of, value_text
from jaxgray.mechanics.effects import CATALOGUE, MODEL_ERRORS, RECORD_FINDINGS
from jaxgray.mechanics.energy import EnergyBalance, LawEnergy
from jaxgray.report.diagnosis_rows import energy_words
from jaxgray.report.diagnosis_terminal import show_diagnosis
from jaxgray.report.documents.catalogue import catalogue_document, show_catalogue, unit_pattern
from jaxgray.report.documents.diagnosis import diagnosis_document
from jaxgray.report.figures.diagnosis import extension
from jaxgray.report.page.whole import html_of

NAN = float("nan")
MISSED = "The linear model misses 2.8× the noise floor at y1. "
CAUSE = "Cause: Coulomb friction at y1, Fc = 0.241 ± 0.002 N. "


def strict(text):
    """JSON without NaN and infinity, which Python would read."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def shown(made, **options):
    """What the terminal shows, piped."""
    out = Console(file=io.StringIO(), width=110, highlight=False, markup=False, emoji=False)
    show_diagnosis(out, diagnosis_document(made), **options)
    return out.file.getvalue()


def test_every_effect_has_a_name():
    ids = {effect.id for effect in (*CATALOGUE, *MODEL_ERRORS, ParameterError)} | set(RECORD_FINDINGS)
    assert set(NAMES) == ids and len(set(NAMES.values())) == len(ids)


@pytest.mark.parametrize(
    "location, names, words",
    [
        ("y1", (), "at y1"),
        ("y1-y2", (), "between y1 and y2"),
        ("tip-left", ("tip-left", "base"), "at tip-left"),
        ("tip-left-base", ("tip-left", "base"), "between tip-left and base"),
        ("u1->y1", ("y1",), "from u1 to y1"),
        ("record", ("y1",), "in the record"),
        ("", (), ""),
    ],
)
def test_places(location, names, words):
    assert place_of(location, names) == words


def test_values():
    assert value_text((0.1, 0.25), (0.01, 0.02), "N") == "0.100 ± 0.010, 0.250 ± 0.020 N"
    assert value_text((0.1, 0.25), None) == "0.1, 0.25"
    assert value_text("square", None) == "square"
    assert value_text(None, None, "N") == "– N"
    assert title_of("own_law", "y2") == "own law at y2"


def test_sentence_of_a_named_cause():
    assert diagnosis().sentence == MISSED + CAUSE + (
        "Adding it cuts the held-out error by 64 % (61 to 67) and leaves only noise. "
        "Without it, the linear model has 13 % more damping at y1."
    )


@pytest.mark.parametrize(
    "before, said",
    [
        (39.0, "13 times the"),
        (13.5, "4.5 times the"),
        (700.0, "233 times the"),
        (4.5, "50 % more"),
        (2.7, "10 % less"),
    ],
)
def test_what_an_entry_has_without_the_effect_is_said_in_percent_or_as_a_multiple(before, said):
    shifts = (
        ParameterShift("mass[0,0]", 2.1, 2.0, 0.01),
        ParameterShift("damping[0,0]", before, 3.0, 0.02),
        ParameterShift("damping[1,1]", 50.0, 1e-6, 1e-7),
    )
    assert diagnosis(shifts=shifts).sentence.endswith(f"Without it, the linear model has {said} damping at y1.")


def test_rivals_between_two_coordinates_keep_both():
    alike = equivalent()
    (finding,) = alike.findings
    members = tuple(dataclasses.replace(m, location="y1-y2") for m in finding.members)
    finding = dataclasses.replace(finding, location="y1-y2", members=members)
    said = dataclasses.replace(alike, findings=(finding,)).sentence
    assert "constant force between y1 and y2" in said and ", or sensor offset between y1 and y2" in said, said


@pytest.mark.parametrize(
    "made, sentence",
    [
        (
            nothing(),
            "The linear model explains the record down to its noise (1.02× the noise floor at y1): nothing is missing "
            "that this record could show.",
        ),
        (
            nothing("unexplained", 2.8, depends_on=("velocity (y1)", "input (u2)")),
            MISSED + "No effect of the catalogue explains it; it depends on velocity (y1) and input (u2).",
        ),
        (
            nothing(
                "unexplained",
                2.8,
                findings=(Finding("unexplained", "y1", "unexplained", "model", (), {}, None, None),),
            ),
            MISSED + "No effect of the catalogue explains it.",
        ),
        (
            nothing("unexplained", 1.01),
            "The linear model leaves more than noise at y1. No effect of the catalogue explains it.",
        ),
        (
            equivalent(),
            MISSED + "Cause: constant force at y1, f0 = 0.10 ± 0.01 N, or sensor offset at y1, b = -0.0010 ± 0.0001 m. "
            "This record cannot tell them apart; an experiment that can is proposed. Adding it cuts the held-out error "
            "by 64 % (61 to 67) and leaves only noise.",
        ),
        (
            diagnosis(verdict="partly", excess=1.4, depends_on=("input (u1)",), shifts=()),
            MISSED + CAUSE + "Adding it cuts the held-out error by 64 % (61 to 67) and leaves 1.40× the noise floor. "
            "What is left has no name in the catalogue; it depends on input (u1).",
        ),
        (
            wrong_numbers(shifts=()),
            "Your model misses 2.8× the noise floor at y1. Your numbers: the stiffness at y1 should be lower by "
            "3.04 ± 0.02 N/m. Your structure lacks: Coulomb friction at y1, Fc = 0.241 ± 0.002 N. Mending both cuts "
            "the held-out error by 64 % (61 to 67) and leaves only noise.",
        ),
        (
            diagnosis(
                findings=(
                    FRICTION,
                    dataclasses.replace(FRICTION, effect="quadratic_drag", location="y1-y2", parameters={}),
                ),
                gain=dataclasses.replace(GAIN, held_out=False, ci95=(NAN, NAN)),
                shifts=(),
            ),
            MISSED + "Causes: Coulomb friction at y1, Fc = 0.241 ± 0.002 N; quadratic drag between y1 and y2. Adding "
            "both cuts the error by 64 % on the data it was fitted to (in-sample, not proven on held-out data) and "
            "leaves only noise.",
        ),
        (
            nothing(findings=(Finding("outliers", "y2", "named", "record", (), {}, None, None, "Three."),)),
            "The linear model explains the record down to its noise (1.02× the noise floor at y1): nothing is missing "
            "that this record could show. Seen in the record: outliers at y2.",
        ),
    ],
    ids=[
        "noise",
        "unexplained",
        "unnamed finding",
        "own floor",
        "equivalent",
        "partly",
        "own model",
        "two in sample",
        "record",
    ],
)
def test_sentences(made, sentence):
    assert made.sentence == sentence


def test_sentences_where_something_is_not_known():
    assert "cannot tell them apart." in equivalent(next_experiment=None).sentence
    load = Member("load_friction", "u1", 0.5, {"mu": Estimate(0.1, 0.01, "")})
    members = (*FRICTION.members, load)
    either = equivalent(findings=(dataclasses.replace(FRICTION, status="equivalent", members=members),))
    assert "Put another payload on: friction of the load changes with it" in either.sentence
    assert "payload" not in equivalent().sentence
    worse = dataclasses.replace(GAIN, percent=-1.0, ci95=(-3.0, 2.0))
    assert "Adding it does not lower the held-out error (-1 % (-3 to 2))" in diagnosis(gain=worse).sentence
    assert "held-out" not in diagnosis(gain=None).sentence
    astray = dataclasses.replace(GAIN, per_output={"y1": (2.8e-3, 2e-3), "y2": (2.1e-3, 4e-3)})
    text = diagnosis(gain=astray).sentence
    assert "64 % (61 to 67), but leaves 2.0× the noise floor there: its law may stand in for another." in text
    assert "stand in" not in diagnosis(gain=dataclasses.replace(astray, held_out=False)).sentence
    # What is tied to the clock of one record is missing on another, whatever its law.
    clocked = tuple(
        dataclasses.replace(f, gain=dataclasses.replace(GAIN, held_out=False)) for f in diagnosis().findings
    )
    assert "stand in" not in diagnosis(gain=astray, findings=clocked).sentence
    unknown = diagnosis(noise_floor={"y1": NAN, "y2": 0.0}, baseline_excess=NAN, excess=NAN)
    assert unknown.sentence.startswith("The linear model misses an unknown multiple of the noise floor. Cause")
    higher = Estimate(2.0, None, "N/m")
    numbers = dataclasses.replace(wrong_numbers().findings[1], parameters={"delta": higher})
    text = wrong_numbers(findings=(numbers,)).sentence
    assert "the stiffness at y1 should be higher by 2 N/m. Correcting it" in text
    assert "Your model explains" in nothing(own_model=True).sentence


def test_a_linear_parameter_that_hardly_moved_hides_nothing():
    calm = dataclasses.replace(diagnosis().shifts[1], before=3.02)
    assert "hidden" not in diagnosis(shifts=(calm, *diagnosis().shifts[2:])).sentence


def test_repr_is_one_screen():
    text = repr(diagnosis())
    assert text.startswith("Diagnosis: named\n") and len(text.splitlines()) < 20
    assert max(map(len, text.splitlines())) <= 120
    for part in ("ΔBIC", "2500", "64 % (61 to 67)", "0.2412 ± 0.0023 N", "2 candidates rejected", "warning: Poor"):
        assert part in text
    assert "next experiment: Drive u1" in repr(equivalent())
    assert "finding" not in repr(nothing())


def test_document_has_the_fixed_keys():
    found = strict(json.dumps(diagnosis_document(diagnosis(), ("a note",)), allow_nan=False))
    assert found["schema"] == "jaxgray/diagnosis/1" and found["verdict"] == "named"
    assert found["baseline"]["model"]["damping"] == [[3.39, 0.0], [0.0, 1.0]]
    assert found["baseline"]["model"]["standard_errors"]["mass"] == [[0.01, 0.01], [0.01, 0.01]]
    assert found["baseline"]["noise_floor"] == {"y1": 1e-3, "y2": 2e-3}
    assert found["baseline"]["excess"] == 2.1 and "residual" in found["baseline"]["noise_floor_source"]
    for part in (found["baseline"], found["extended"]):
        assert set(part["fit_percent"]) == set(part["rmse"]) == {"estimation", "validation"}
    (finding,) = found["findings"]
    keys = {
        "effect",
        "location",
        "status",
        "stage",
        "members",
        "parameters",
        "delta_bic",
        "gain",
        "message",
        "found_by",
    }
    assert set(finding) == keys
    assert finding["parameters"]["Fc"] == {"value": 0.2412, "standard_error": 0.0023, "unit": "N"}
    assert finding["parameters"]["eps"]["standard_error"] is None
    assert finding["members"][0]["effect"] == "coulomb_friction"
    gain = finding["gain"]
    assert gain["per_output"]["y1"] == {"rmse_before": 2.8e-3, "rmse_after": 1e-3}
    assert (gain["percent"], gain["ci95"], gain["held_out"]) == (64.2, [61.1, 66.8], True)
    assert found["extended"]["gain"]["percent"] == 64.2
    assert found["extended"]["model"]["effects"] == [
        {"effect": "coulomb_friction", "location": "y1", "parameters": {"Fc": 0.2412, "eps": 0.001}}
    ]
    assert {"white", "excess", "explainable"} <= set(found["remaining"]) and found["remaining"]["explainable"] is None
    assert found["rejected"][1] == {
        "effect": "dahl_friction",
        "location": "y1",
        "delta_bic": None,
        "why": "its refit could not be simulated",
        "parameters": {},
        "gain": None,
    }
    assert found["not_found"][2]["min_detectable"] == {"w": {"value": [0.05, None], "unit": ""}}
    assert found["next_experiment"] is None
    assert found["warnings"] == ["a note", "Poor fit at y2."]


def test_document_of_nothing_found():
    found = strict(json.dumps(diagnosis_document(nothing()), allow_nan=False))
    assert found["extended"] is None and found["findings"] == [] and found["verdict"] == "noise"


def test_document_of_an_experiment_and_words():
    form = {"a": Estimate(0.3, 0.1, "1/m"), "form": Estimate("square", None, "")}
    made = equivalent(findings=(dataclasses.replace(FRICTION, parameters=form, gain=None, delta_bic=None),))
    found = strict(json.dumps(diagnosis_document(made), allow_nan=False))
    assert found["findings"][0]["parameters"]["form"]["value"] == "square"
    assert found["findings"][0]["gain"] is None
    proposed = found["next_experiment"]
    assert proposed["samples"] == 50 and len(proposed["input"]["u2"]) == 50
    np.testing.assert_array_equal(proposed["input"]["u1"], experiment().input[:, 0])


def test_tables():
    text = shown(diagnosis())
    lines = text.splitlines()
    assert lines[0] == diagnosis().sentence
    assert all(len(line.rstrip()) <= 110 for line in lines[1:])
    for part in (
        "64.2 % (61.1 to 66.8)",
        "eps = 0.001 m/s (fixed)",
        "3.000 ± 0.010",
        "-11.5 %",
        "N s/m",
        "87.0 %",
        "left: 1.00× the noise floor",
        "explained better by coulomb_friction",
        "not found: 3 other candidates",
        "cubic stiffness between y1 and y2 from k3 = 1300 N/m^3; sensor lag",
        "warning: Poor fit at y2.",
    ):
        assert part in " ".join(text.split()), part
    assert "play hysteresis" not in text and "\x1b" not in text


def test_tables_with_everything():
    many = diagnosis().rejected * 4
    assert "rejected (first 5 of 8)" in shown(diagnosis(rejected=many))
    text = shown(diagnosis(rejected=many), verbose=True)
    assert text.count("its refit could not be simulated") == 4
    assert "play hysteresis" in text and "would have been seen from" in text and "--verbose" not in text


def test_tables_of_other_verdicts():
    text = shown(equivalent())
    assert "or sensor offset at y1" in text and "-2.5" in text
    assert "next experiment: Drive u1 with slow steps." in text and "250 with it, 3 with" in text
    text = shown(nothing("unexplained", 2.8, depends_on=("velocity",)))
    assert "depends on velocity" in text and "extended" not in text
    assert "yours fit" in shown(wrong_numbers())
    still = tuple(dataclasses.replace(s, after=s.before, standard_error=0.0) for s in diagnosis().shifts)
    assert "shift" not in shown(wrong_numbers(shifts=still))
    local = dataclasses.replace(FRICTION, gain=dataclasses.replace(GAIN, held_out=False), message="One sentence.")
    text = shown(diagnosis(findings=(local,)))
    assert ", in-sample" in text and "Coulomb friction at y1: One sentence." in text
    seen = Finding("outliers", "y2", "named", "record", (), {"count": Estimate(3.0, None, "")}, None, None)
    assert "count = 3\n" in "\n".join(line.rstrip() for line in shown(nothing(findings=(seen,))).splitlines()) + "\n"


def test_figure():
    figure = extension(diagnosis())
    figure.canvas.draw()
    assert "held-out record" in figure.get_suptitle()
    measured, linear, extended = figure.axes[0].get_lines()
    np.testing.assert_allclose(linear.get_ydata(), 0.9 * measured.get_ydata())
    np.testing.assert_allclose(extended.get_ydata(), 0.99 * measured.get_ydata())
    assert "your model" in extension(wrong_numbers()).get_suptitle()
    assert len(extension(nothing()).axes[0].get_lines()) == 2
    with pytest.raises(ValueError, match="record=1 is not there; there are 1"):
        extension(diagnosis(), record=1)


def test_catalogue():
    document = catalogue_document()
    found = {one["id"]: one for one in strict(json.dumps(document, allow_nan=False))["effects"]}
    assert list(found) == [effect.id for effect in CATALOGUE]
    assert found["cubic_stiffness"]["parameters"][0]["unit"] == "force/length^3"
    assert [one["count"] for one in found["play_hysteresis"]["parameters"]] == [3, 3]
    assert found["sensor_nonlinearity"]["parameters"][1]["choices"] == ["square", "cube", "abs"]
    assert [one["id"] for one in document["record_findings"]] == list(RECORD_FINDINGS)
    out = Console(file=io.StringIO(), width=110, highlight=False, markup=False, emoji=False)
    show_catalogue(out, document)
    text = out.file.getvalue()
    assert all(f"  {id}: " in text for id in NAMES) and max(map(len, text.splitlines())) <= 110
    assert unit_pattern((1, -1, 2)) == "force s^2/length" and unit_pattern((0, 0, 0)) == "1"
    assert unit_pattern((0, 0, -1)) == "1/s" and unit_pattern((1, -1, -1)) == "force/(length s)"


ENERGY = EnergyBalance(
    2.0, 0.1, 1.1, 0.0, (LawEnergy("coulomb_friction", "y1", 0.79, 0.7, 12, 0.7, 0.1, False),), "N m"
)


def test_the_energy_of_the_extended_model_is_told():
    made = diagnosis(energy=ENERGY)
    document = strict(json.dumps(diagnosis_document(made), allow_nan=False))
    law = {"effect": "coulomb_friction", "location": "y1", "work": 0.79, "creates": False}
    wanted = {"unit": "N m", "entered": 2.0, "supplied": 2.0, "stored": 0.1, "damped": 1.1, "circulated": 0.0}
    residual = document["energy"].pop("residual")
    assert document["energy"] == wanted | {"laws": [law]} and residual == pytest.approx(0.01)
    line = (
        "energy of the extended model: 2 N m from the inputs 100.0 %; to damping 55.0 %, Coulomb friction at y1 39.5 % "
        "and motion and springs at the end 5.0 %; missing 0.5 %"
    )
    assert line in " ".join(shown(made).split())
    assert line.split(": ")[1] in html_of(made)
    assert diagnosis_document(nothing())["energy"] is None and "energy of" not in shown(nothing())


def test_energy_from_elsewhere_is_told_as_such():
    taken = dataclasses.replace(ENERGY, supplied=-0.5, stored=-3.0)
    text = energy_words(diagnosis_document(diagnosis(energy=taken)))
    assert text.startswith("3 N m from motion and springs at the end 100.0 %; to the inputs 16.7 %, damping 36.7 %")
