"""The force equation on bodies without a spring to the ground, of more than one coordinate."""

import dataclasses

import hidden
import numpy as np
import pytest
from independent import smooth_noise

from jaxgray import Record, diagnose, write_report
from jaxgray.diagnosis import routing
from jaxgray.diagnosis.conclusions.equation_error import force_diagnosis
from jaxgray.diagnosis.conclusions.missing_force import missing_forces
from jaxgray.diagnosis.equation_error.band import band_of
from jaxgray.diagnosis.equation_error.rows import contribution, contributions, series_of
from jaxgray.diagnosis.equation_error.without_unmeasured_forces import search_forces
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place
from jaxgray.mechanics.systems.drives import Force
from jaxgray.numerics.programs.runtime import ready
from jaxgray.numerics.progress import Silent

T, SAMPLES = 0.005, 3000
LAWS = "constant_force", "dahl_friction", "coulomb_friction", "quadratic_drag", "asymmetric_friction"


def carriage(rng, lost=0):
    """Records of two bodies on a rail, of which the first rubs; samples of the first record missing here and there."""
    M, D, K = np.diag([1.2, 0.8]), np.diag([0.6, 0.4]), 60.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    rubbing = (hidden.Effect("coulomb_friction", "y1", {"Fc": 1.5, "eps": 0.01}),)
    records = []
    for _ in range(2):
        u = 4.0 * smooth_noise(rng, SAMPLES, 2, bandwidth=0.02)
        y = hidden.simulate(hidden.System(M, D, K, np.eye(2)), u, T, rubbing, hold="linear")
        y = y + rng.normal(scale=1e-4, size=y.shape)
        y[rng.choice(SAMPLES, 0 if records else lost, replace=False)] = np.nan
        records.append(Record(u, y, T, hold="linear"))
    return records


def searched(records):
    options = {"rng": np.random.default_rng(0), "progress": Silent()}
    laws = tuple(by_id(one) for one in LAWS)
    return search_forces(records[:1], records[1:], Force(np.eye(2)), laws, 2, **options)


def test_friction_of_two_bodies_that_drift_is_found_among_laws_that_explain_as_much():
    ready()
    search = searched(carriage(np.random.default_rng(8)))
    found = [f for f in force_diagnosis(search, None).findings if f.stage == "model"]
    assert [(f.effect, f.location) for f in found] == [("coulomb_friction", "y1")]
    assert abs(found[0].parameters["Fc"].value - 1.5) < 0.1
    assert found[0].gain.ci99_lower > 0
    # Of laws that explain as much the one of fewer parameters is judged first, wherever it stands.
    wide = dataclasses.replace(search.taken[0].trial, fit=dataclasses.replace(search.fit, moving=((0, 1),)))
    plain = dataclasses.replace(search.taken[0].trial, power=0.9 * wide.power)
    assert dataclasses.replace(search, taken=[]).ordered([wide, plain]) == [plain, wide]


def test_the_force_equation_is_set_up_and_searched_once_for_the_same_records(monkeypatch):
    ready()
    made, setting_up = [], routing.table_of
    monkeypatch.setattr(routing, "table_of", lambda *given: made.append(given) or setting_up(*given))
    records, drive, laws = carriage(np.random.default_rng(8)), Force(np.eye(2)), tuple(by_id(one) for one in LAWS)
    forces = routing.ForceEquation(laws, 2, 0, Silent())
    trials = routing.force_equation_trials(records[:1], forces, {})
    search = forces.search(records[:1], records[1:], drive)
    assert trials()[0].name == search.taken[0].trial.name == ("coulomb_friction", "y1")
    assert len(made) == 1 and forces.search(records[:1], records[1:], drive) is search
    alone = searched(carriage(np.random.default_rng(8)))
    assert alone.fit.cost == search.fit.cost and alone.rejected == search.rejected
    assert forces.search(records[1:], records[:1], drive) is not search and len(made) == 2


def test_for_the_first_law_alone_the_force_equation_is_searched_no_further(monkeypatch):
    ready()
    records, drive, laws = carriage(np.random.default_rng(8)), Force(np.eye(2)), tuple(by_id(one) for one in LAWS)
    asked, pushed, searching = [], [], routing.search_forces

    def counted(records, held, drive, catalogue, most, **options):
        asked.append(most)
        found = searching(records, held, drive, catalogue, most, **options)
        found.brief_forces = tuple(pushed)
        return found

    monkeypatch.setattr(routing, "search_forces", counted)
    groups, forces = (records[:1], records[1:]), routing.ForceEquation(laws, 3, 0, Silent())
    first = forces.first(*groups, drive)
    assert asked == [1] and forces.first(*groups, drive) is first
    whole = forces.search(*groups, drive)
    assert asked == [1, 3] and whole.taken[0].trial.name == first.taken[0].trial.name == ("coulomb_friction", "y1")
    # The trials of the first law are those of one table.
    assert whole.taken[0].trial is first.taken[0].trial and forces.first(*groups, drive) is whole
    # What pushes besides the inputs may be a law that is missing.
    pushed.append(None)
    assert routing.ForceEquation(laws, 3, 0, Silent()).first(*groups, drive).brief_forces and asked == [1, 3, 1, 3]


@pytest.mark.parametrize("law", ("stribeck_friction", "maxwell_slip_hysteresis"))
def test_many_terms_of_a_law_give_together_what_each_gives_alone(law):
    ready()
    records, place, law = carriage(np.random.default_rng(8)), Place("y1-y2", 0, 1), by_id(law)
    series = series_of(records[0], band_of(records[:1]))
    table = np.random.default_rng(9).uniform(0.01, 1.0, (21, len(law.parameters)))
    table[3] = np.nan
    made = contributions(law, place, table, series, np.eye(2))
    assert made.shape == (len(series.rows), 2, 21)
    for k in (0, 3, 20):
        np.testing.assert_allclose(made[:, :, k], contribution(law, place, table[k], series, np.eye(2)), atol=1e-12)


def test_what_is_missing_is_shown_where_samples_were_lost(tmp_path):
    ready()
    diagnosis = force_diagnosis(searched(carriage(np.random.default_rng(8), lost=25)), None)
    assert "coulomb_friction" in [f.effect for f in diagnosis.findings]
    shown = missing_forces(diagnosis)
    assert shown and all(np.all(np.isfinite(one.missing)) and len(one.missing) > 100 for one in shown)
    write_report(diagnosis, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 1000


@pytest.mark.slow
def test_a_link_that_turns_over_beside_one_that_does_not_is_begun_where_the_force_equation_says():
    # On average the linear free run is of use, that of the first link is not, and every score is about it.
    rng, records = np.random.default_rng(8), []
    rubbing = hidden.Effect("coulomb_friction", "y2", {"Fc": 1.0})
    turning = hidden.Effect("sine_stiffness", "y1", {"k": 8.0, "length": 1.0}), rubbing
    links = hidden.System(np.diag([1.2, 0.8]), np.diag([0.6, 0.4]), np.zeros((2, 2)), np.eye(2))
    for _ in range(2):
        u = 9.0 * smooth_noise(rng, 1500, 2, bandwidth=0.02)
        y = hidden.simulate(links, u, T, turning, hold="linear")
        records.append(Record(u, y + rng.normal(scale=1e-3, size=y.shape), T, hold="linear"))
    laws = ["sine_stiffness", "coulomb_friction", "constant_force"]
    diagnosis = diagnose(records[0], validation=records[1], only=laws)
    fit = diagnosis.identification.estimation[0].fit_percent
    assert fit.min() < 0 and fit.mean() > 30
    found = {(f.effect, f.location): f.parameters for f in diagnosis.findings if f.stage == "model"}
    assert set(found) == {("sine_stiffness", "y1"), ("coulomb_friction", "y2")} and diagnosis.verdict == "named"
    length, force = found["sine_stiffness", "y1"]["length"], found["coulomb_friction", "y2"]["Fc"]
    assert abs(length.value - 1.0) < 4 * length.standard_error < 0.01
    assert abs(force.value - 1.0) < 4 * force.standard_error < 0.05
    assert diagnosis.gain.ci95[0] > 90 and not any("force equation" in text for text in diagnosis.warnings)


@pytest.mark.slow
def test_cogging_is_found_where_the_axis_passes_many_periods():
    # Free runs lose count of the periods unless law, first state and period all fit; in the force equation the law is
    # in step with the measured displacement or it is not.
    rng, records = np.random.default_rng(1), []
    axis = hidden.System(np.array([[5.0]]), np.array([[40.0]]), np.zeros((1, 1)), np.eye(1))
    pitch = 0.024
    cogging = (hidden.Effect("sine_stiffness", "y1", {"k": 6.0 * 2 * np.pi / pitch, "length": pitch / (2 * np.pi)}),)
    for _ in range(2):
        u = np.repeat(rng.uniform(-25.0, 25.0, (30, 1)), 100, axis=0)
        y = hidden.simulate(axis, u, 0.002, cogging)
        records.append(Record(u, y + rng.normal(scale=5e-6, size=y.shape), 0.002))
    assert np.ptp(records[0].y) > 5 * pitch
    diagnosis = diagnose(records[0], validation=records[1], only=["sine_stiffness", "unmodelled_mode"])
    (finding,) = [f for f in diagnosis.findings if f.stage == "model"]
    assert finding.effect == "sine_stiffness"
    length = finding.parameters["length"].value
    assert abs(2 * np.pi * length / pitch - 1) < 1e-3 and finding.gain.ci95[0] > 80
    assert abs(finding.parameters["k"].value * length - 6.0) < 0.1
