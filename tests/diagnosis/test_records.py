"""Records as they come: each from a zero of its own, or ended where the motion runs away."""

import dataclasses
import warnings

import hidden
import numpy as np
import pytest
from found import SAMPLES, check_found, diagnosed, explains, generator, hidden_case, model_findings
from hidden_laws import Effect
from hidden_simulation import System

import jaxgray
from jaxgray.diagnosis.data_checks.residual_outliers import standing_out


def test_encoders_may_count_from_another_zero_in_every_record():
    case = hidden_case("coulomb_friction")
    zeros = np.array([7.0, -3.0]) * np.ptp(case.y, axis=0)
    elsewhere = dataclasses.replace(case, y=case.y + zeros, y_v=case.y_v - 0.5 * zeros)
    only = ["coulomb_friction", "constant_force", "sensor_offset"]
    diagnosis = diagnosed(elsewhere, only=only)
    check_found(elsewhere, diagnosis)
    assert sum("counts from another zero" in text for text in diagnosis.warnings) == 2


def test_noise_is_not_said_of_a_record_that_misses_another_one():
    case = hidden.null_case(generator("elsewhere"), "white", dofs=(2,), samples=SAMPLES)
    slow = 5 * case.noise * np.sin(np.linspace(0, 6, SAMPLES))[:, None]
    elsewhere = diagnosed(dataclasses.replace(case, y_v=case.y_v + slow), only=["cubic_stiffness"])
    assert elsewhere.verdict == "unexplained", str(elsewhere)
    limit = np.quantile(np.abs(case.y_v[:, 0]), 0.5)
    clipped = np.column_stack([np.clip(case.y_v[:, 0], -limit, limit), case.y_v[:, 1:]])
    spoilt = diagnosed(dataclasses.replace(case, y_v=clipped), only=["cubic_stiffness"])
    assert spoilt.verdict == "noise", str(spoilt)


def test_one_offset_in_all_records_is_a_finding_and_not_taken_off():
    case = hidden_case("sensor_offset")
    (effect,) = case.effects
    at = int(effect.place[1:]) - 1
    far = np.where(np.arange(case.y.shape[1]) == at, 20 * np.ptp(case.y, axis=0), 0.0)
    diagnosis = diagnosed(dataclasses.replace(case, y=case.y + far, y_v=case.y_v + far), only=["sensor_offset"])
    (finding,) = model_findings(diagnosis)
    assert explains(finding, effect) and not any("another zero" in text for text in diagnosis.warnings)


@pytest.mark.slow
def test_a_record_may_end_where_the_motion_runs_away():
    # Past its saddle a softening spring lets go: beyond the last sample the simulation overflows.
    rng = np.random.default_rng(5)
    system = System(np.array([[1.0]]), np.array([[0.2]]), np.array([[1.0]]))
    softening = Effect("cubic_stiffness", "y1", {"k3": -0.15})

    def record(last):
        u = np.repeat(rng.standard_normal(200), 10)[:, None] * 0.35
        u[1980:] = last
        y = hidden.simulate(system, u, 0.1, [softening])
        return jaxgray.Record(u, y + 0.01 * rng.standard_normal(y.shape), 0.1)

    over, usual = record(4.0), record(0.0)
    assert 2.6 < over.y[-1, 0] < 10.0 and np.max(np.abs(over.y[:1980])) < 1.9
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnosis = jaxgray.diagnose(over, validation=usual, only=["cubic_stiffness", "constant_force"])
    (finding,) = model_findings(diagnosis)
    stiffness = finding.parameters["k3"]
    assert finding.effect == "cubic_stiffness" and diagnosis.verdict == "named", str(diagnosis)
    assert abs(stiffness.value + 0.15) < 4 * stiffness.standard_error + 0.002, str(diagnosis)


def test_outliers_that_the_motion_hides_are_left_out():
    # The motion goes as far in a sample as the outliers lie off, also at both ends of the record.
    rng = np.random.default_rng(8)
    system = System(np.array([[1.0]]), np.array([[1.0]]), np.array([[400.0]]))
    places = np.array([2, 300, 301, 700, 1100, 1994, 1998])

    def record():
        u = rng.standard_normal((2000, 1))
        y = hidden.simulate(system, u, 0.06, [])
        size = np.std(y)
        y = y + 1e-3 * size * rng.standard_normal(y.shape)
        y[places, 0] += size * np.where(np.arange(len(places)) % 2, -0.8, 0.8)
        return jaxgray.Record(u, y, 0.06)

    estimation, validation = record(), record()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        diagnosis = jaxgray.diagnose(estimation, validation=validation, only=["cubic_stiffness", "constant_force"])
    (finding,) = diagnosis.findings
    assert diagnosis.verdict == "noise" and finding.effect == "outliers", str(diagnosis)
    assert finding.parameters["count"].value == len(places)
    assert set(np.flatnonzero(np.isnan(diagnosis.records[0].y))) == set(places)
    assert not any("missing" in text for text in diagnosis.warnings), diagnosis.warnings
    (rmse,), (floor,) = diagnosis.baseline.rmse["validation"].values(), diagnosis.noise_floor.values()
    assert rmse < 1.2 * floor, str(diagnosis)


def test_a_sample_between_missing_ones_is_judged_by_those_that_are_known():
    rng = np.random.default_rng(8)
    e = np.where(np.repeat(rng.random(400) < 0.6, 10), np.nan, rng.standard_normal(4000))
    first, last = 1000, 3000
    e[first - 8 : first + 9] = e[last - 8 : last + 9] = np.nan
    e[[first, last]] = 2.5, 25.0
    assert list(standing_out(e)) == [last]


@pytest.mark.slow
def test_a_hum_has_another_phase_in_every_record():
    rng = np.random.default_rng(9)
    system = System(np.array([[1.0]]), np.array([[2.0]]), np.array([[400.0]]))

    def record(phase):
        u = hidden.draws.excitation(rng, "noise", SAMPLES, np.array([15.0]))
        hum = Effect("periodic_disturbance", "y1", {"A": 6.0, "frequency_hz": 4.7, "phase": phase})
        y = hidden.simulate(system, u, 0.02, [hum])
        return jaxgray.Record(u, y + 0.02 * y.std() * rng.standard_normal(y.shape), 0.02)

    records = [record(phase) for phase in (0.3, 0.3 + np.pi, 1.1)]
    diagnosis = jaxgray.diagnose(records, only=["periodic_disturbance", "constant_force"])
    (found,) = model_findings(diagnosis)
    assert found.effect == "periodic_disturbance", str(diagnosis)
    for name, true in (("A", 6.0), ("frequency_hz", 4.7)):
        estimate = found.parameters[name]
        assert abs(estimate.value - true) < 4 * estimate.standard_error < 0.2 * true, str(diagnosis)
