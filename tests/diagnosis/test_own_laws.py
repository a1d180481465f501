"""A given model that has laws already: a wrong number of one is found, and what it lacks beside them."""

import dataclasses
import json
import pickle

import hidden
import numpy as np
import pytest
from found import SAMPLES, check_parameter, diagnosed, generator, model_findings, records_of

import jaxgray
from jaxgray.diagnosis.estimation.significance import at_bound
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Candidate, Data, estimated
from jaxgray.diagnosis.model.own_laws import columns_of, corrected_laws, laws_of, parameter_errors, wrong_number
from jaxgray.diagnosis.model.simulator import Simulator
from jaxgray.diagnosis.screening.features import Shape
from jaxgray.diagnosis.screening.score_test import allowed
from jaxgray.diagnosis.words.titles import title_of
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.report.documents import export
from jaxgray.report.documents.diagnosis import diagnosis_document

FEW = ("coulomb_friction", "cubic_stiffness", "input_delay", "actuator_lag", "quadratic_drag")


def term(name, place, first, *values, second=-1):
    return Term(by_id(name), Place(place, first, second), np.array(values))


def made(case, *effects):
    """The package's model of a case's system, with laws."""
    return dataclasses.replace(jaxgray.MechanicalModel(case.system.M, case.system.D, case.system.K), effects=effects)


@dataclasses.dataclass
class FakeFit:
    """As much of a refit as its bounds ask for."""

    candidate: Candidate


@pytest.fixture(scope="module")
def rubbing():
    """A system with dry friction, far above the noise, and the law as the package has it."""
    case = hidden.random_case(
        generator("own laws"), "coulomb_friction", dofs=(2,), samples=SAMPLES, excess=(10.0, 15.0), place="y1"
    )
    (effect,) = case.effects
    return case, term("coulomb_friction", "y1", 0, effect.parameters["Fc"], 1e-6)


@pytest.fixture(scope="module")
def baseline(rubbing):
    case, law = rubbing
    (record, _) = records_of(case)
    return record, baseline_of([record], None, made(case, law, term("cubic_stiffness", "y2", 1, 40.0)))


def test_every_number_of_a_law_may_be_wrong(baseline):
    own = baseline[1].setup.own
    errors = parameter_errors(own)
    names = [wrong_number(error, own) for error in errors]
    assert names == ["Fc of coulomb_friction at y1", "k3 of cubic_stiffness at y2"]
    titles = [title_of("parameter_error", name, ("y1", "y2")) for name in names]
    assert titles == ["wrong Fc of Coulomb friction at y1", "wrong k3 of cubic stiffness at y2"]
    # Friction is not below zero, whatever is added to it.
    assert errors[0].parameters[0].lower == -own[0].values[0] and errors[1].parameters[0].lower == -np.inf
    assert errors[0].parameters[0].unit == by_id("coulomb_friction").parameters[0].unit
    assert parameter_errors(own)[0] is errors[0]
    changed = corrected_laws(own, (term("input_delay", "u1", 0, 0.01), Term(errors[1], Place(names[1], 1), [2.0])))
    assert [one.effect.id for one in changed] == ["coulomb_friction", "cubic_stiffness", "input_delay"]
    assert changed[1].values[0] == 42.0 and own[1].values[0] == 40.0


@pytest.mark.slow
def test_derivatives_by_the_numbers_of_a_law_are_those_of_the_run(baseline):
    record, found = baseline
    data, simulator = Data.of(record), Simulator(found.setup, (by_id("coulomb_friction"), by_id("cubic_stiffness")))
    errors = parameter_errors(found.setup.own)
    places = [Place(wrong_number(error, found.setup.own), 0) for error in errors]
    other = term("input_delay", "u1", 0, 0.004)

    def with_sizes(*sizes):
        terms = [Term(e, p, np.array([size])) for e, p, size in zip(errors, places, sizes)]
        return found.start.with_terms((terms[1], other, terms[0]))

    y, J, slopes = simulator.run_and_slopes(with_sizes(0.0, 0.0), data)
    np.testing.assert_allclose(y, simulator.run(found.start.with_terms((other,)), data), atol=1e-12 * np.abs(y).max())
    steps = 1e-4 * np.array([float(one.values[0]) for one in found.setup.own])
    for k, (step, column) in enumerate(zip(steps, (-1, -3))):
        up, down = (simulator.run(with_sizes(*(sign * step * np.eye(2)[k])), data) for sign in (1, -1))
        by_difference = (up - down) / (2 * step)
        scale = np.linalg.norm(by_difference)
        assert np.linalg.norm(J[:, :, column] - by_difference) < 0.01 * scale
        np.testing.assert_array_equal(J[:, :, column], slopes[:, :, k])
    assert J.shape[2] == len(found.start.entries) + 4 + 3 and slopes.shape[2] == 2


def test_entries_are_corrected_before_laws_act_as_in_a_model_that_is_saved(baseline):
    own = (term("unmodelled_mode", "y1", 0, *np.full(len(by_id("unmodelled_mode").parameters), 0.3)),)
    error = term("mass_error", "y1", 0, 0.1)
    delay = term("input_delay", "u1", 0, 0.01)
    acting = corrected_laws(own, (delay, error))
    assert [one.effect.id for one in acting] == ["mass_error", "unmodelled_mode", "input_delay"]
    candidate = baseline[1].start.with_terms((delay, error))
    count = len(estimated(own[0]))
    mine, numbers = columns_of(candidate, own)
    assert mine == [1 + count, 0] and numbers == list(range(1, 1 + count))


def test_a_law_that_was_given_and_is_not_there_lies_at_no_bound(baseline):
    own = baseline[1].setup.own
    (friction, _) = parameter_errors(own)
    shape = Shape(friction, Place(wrong_number(friction, own), 0), np.ones(1), (np.ones(1),), None, 1)
    assert allowed(shape, np.array([-2.0 * float(own[0].values[0])])) and not allowed(shape, np.zeros(1))
    gone = baseline[1].start.with_terms((Term(friction, shape.place, np.array([-float(own[0].values[0])])),))
    wider = baseline[1].start.with_terms((term("stribeck_friction", "y1", 0, 0.0, 0.5, 0.1, 1e-6),))
    assert at_bound(FakeFit(gone), 0, own) is None
    assert at_bound(FakeFit(wider), 0, own) is None and at_bound(FakeFit(wider), 0) == "Fc"


def test_laws_take_the_places_of_the_record_and_leave_the_clock_of_another_behind(rubbing):
    case, law = rubbing
    (record, _) = records_of(case)
    step = by_id("force_step")
    late = Term(step, Place("y1", 0), step.bounded(np.ones(len(step.parameters))))
    renamed = dataclasses.replace(record, output_names=("a", "b"))
    own, left_out = laws_of(made(case, law, late), renamed)
    assert [one.place.name for one in own] == ["a"] and len(left_out) == 1 and "force_step at y1" in left_out[0]
    with pytest.raises(ValueError, match="coulomb_friction at 'y5', where the record has no channel"):
        laws_of(made(case, term("coulomb_friction", "y5", 4, 1.0, 0.1)), record)


@pytest.mark.slow
def test_a_wrong_number_of_a_law_is_found_and_mended(rubbing, tmp_path):
    case, law = rubbing
    true = float(law.values[0])
    wrong = dataclasses.replace(law, values=law.values * np.array([0.9, 1.0]))
    diagnosis = diagnosed(case, model=made(case, wrong), only=FEW)
    (finding,) = model_findings(diagnosis)
    assert (finding.effect, finding.location) == ("parameter_error", "Fc of coulomb_friction at y1"), str(diagnosis)
    check_parameter(finding.parameters["delta"], 0.1 * true, "delta", str(diagnosis))
    value = finding.parameters["value"]
    assert value.value == pytest.approx(0.9 * true + finding.parameters["delta"].value)
    assert "Your numbers: Fc of Coulomb friction at y1 is " in diagnosis.sentence and ", not " in diagnosis.sentence
    (mended,) = diagnosis.extended.model.effects
    assert mended.effect.id == "coulomb_friction" and abs(mended.values[0] / true - 1) < 0.02
    path = tmp_path / "mended.json"
    jaxgray.save(diagnosis, path)
    np.testing.assert_allclose(export.load(path).effects[0].values, mended.values)
    # The document of the whole result is a model, too: the law with the number that was mended, no error of it.
    path.write_text(json.dumps(diagnosis_document(diagnosis), allow_nan=False))
    (again,) = export.load(path).effects
    assert again.effect.id == "coulomb_friction"
    np.testing.assert_allclose(again.values, mended.values)
    jaxgray.write_report(diagnosis, tmp_path / "out.html")
    assert "wrong Fc of Coulomb friction at y1" in (tmp_path / "out.html").read_text()
    (term,) = pickle.loads(pickle.dumps(diagnosis.terms))
    assert term.effect.owner.id == "coulomb_friction" and term.effect is diagnosis.terms[0].effect


@pytest.mark.slow
def test_a_model_with_the_right_law_lacks_nothing(rubbing):
    case, law = rubbing
    diagnosis = diagnosed(case, model=made(case, law), only=FEW)
    assert diagnosis.verdict == "noise" and not model_findings(diagnosis), str(diagnosis)


@pytest.mark.slow
def test_a_model_with_one_coordinate_more_is_judged():
    case = hidden.random_case(
        generator("own mode"), "unmodelled_mode", dofs=(2,), samples=SAMPLES, excess=(8.0, 12.0), place="y1"
    )
    (effect,) = case.effects
    law = by_id("unmodelled_mode")
    mode = Term(law, Place("y1", 0), np.array([effect.parameters[p.name] for p in law.parameters]))
    own = made(case, mode)
    stiffness = np.array(own.stiffness)
    stiffness[1, 1] *= 1.05
    own = own.with_matrices(own.mass, own.damping, stiffness)
    diagnosis = diagnosed(case, model=own, only=(*FEW, "unmodelled_mode"))
    (finding,) = model_findings(diagnosis)
    assert (finding.effect, finding.location) == ("stiffness_error", "y2"), str(diagnosis)
    check_parameter(finding.parameters["delta"], -stiffness[1, 1] * 0.05 / 1.05, "delta", str(diagnosis))
    kinds = [one.effect.id for one in diagnosis.extended.model.effects]
    assert kinds == ["stiffness_error", "unmodelled_mode"]
