"""What is said where nothing is hidden, two things are, the law is not in the catalogue, or the record is spoilt."""

import zlib

import hidden
import numpy as np
import pytest
from found import (
    SAMPLES,
    WHOLE,
    check_found,
    check_parameter,
    diagnosed,
    explains,
    generator,
    hidden_case,
    model_findings,
    record_findings,
)
from independent import smooth_noise

import jaxgray
from jaxgray.diagnosis import routing as routes
from jaxgray.identification.validation.residuals import residual_test


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k == "process")) for k in hidden.NULLS])
def test_nothing_is_found_where_nothing_is_hidden(kind):
    diagnosis = diagnosed(hidden.null_case(generator(kind), kind, dofs=(2,), samples=SAMPLES))
    assert diagnosis.verdict == "noise", str(diagnosis)
    assert not model_findings(diagnosis)
    assert ("process_noise" in record_findings(diagnosis)) == (kind == "process")
    assert diagnosis.not_found and diagnosis.extended is None and diagnosis.gain is None


@pytest.mark.slow
def test_a_delay_and_a_spring_that_hide_each_other_are_both_found():
    # A record of a campaign in which each effect alone brought no free run nearer, and neither was found. No record of
    # one coordinate tells a delay of the input from one of the sensor.
    pair, rng = ("cubic_stiffness", "input_delay"), np.random.default_rng([71012, 2, 1])
    case = hidden.random_pair(rng, pair=pair, dofs=(1, 2, 3), samples=3000, excess=(1.5, 4.0))
    diagnosis = diagnosed(case, only=["cubic_stiffness", "actuator_lag", "sensor_delay", "input_delay"])
    found = model_findings(diagnosis)
    assert len(found) == 2 and diagnosis.verdict == "equivalent", str(diagnosis)
    (delay,) = [f for f in found if f.effect != "cubic_stiffness"]
    assert {m.effect for m in delay.members} == {"input_delay", "sensor_delay"}, str(diagnosis)
    assert all(any(explains(f, effect) for f in found) for effect in case.effects), str(diagnosis)
    assert np.all(list(diagnosis.noise_floor.values()) < 1.1 * case.noise), str(diagnosis)
    cubic = next(f for f in found if f.effect == "cubic_stiffness")
    check_parameter(cubic.parameters["k3"], case.effects[0].parameters["k3"], "k3", str(diagnosis))


@pytest.mark.slow
def test_a_cubic_spring_is_heard_where_a_sine_turns_out_to_be_one():
    # A record of a campaign: the sine was refused for being a cubic spring, and Dahl's friction named in its place.
    pair, rng = ("stribeck_friction", "cubic_stiffness"), np.random.default_rng([100001, 2, 10])
    case = hidden.random_pair(rng, pair=pair, dofs=(1, 2, 3), samples=4000, excess=(1.5, 4.0))
    diagnosis = diagnosed(case, exclude=["mass_step", "stiffness_step", "stiffness_drift", "play_hysteresis"])
    assert {f.effect for f in model_findings(diagnosis)} == set(pair), str(diagnosis)


def test_a_weak_controller_is_heard_in_the_same_and_the_next_sample_together():
    # The loop of a campaign that neither told alone; the noise itself stands for what a perfect model leaves.
    case = hidden.closed_loop_case(np.random.default_rng([100001, 4, 1]), dofs=(1, 2, 3), samples=4000)
    assert residual_test(case.y - case.clean, case.u).feedback
    shuffled = np.roll(case.y - case.clean, 1500, axis=0)
    assert not residual_test(shuffled, case.u).feedback


@pytest.mark.slow
def test_a_law_is_found_from_where_the_linear_model_has_gone_astray():
    # A record of a campaign: the linear model had taken so much of it that no small step leads back.
    truth = "fractional_damping"
    rng = np.random.default_rng([73201, 0, zlib.crc32(truth.encode()), 0])
    case = hidden.random_case(rng, truth, dofs=(1, 2, 3), samples=3000, excess=(1.5, 4.0))
    diagnosis = diagnosed(case, only=[truth, "actuator_creep", "actuator_lag"], max_effects=1)
    (found,) = model_findings(diagnosis)
    assert found.effect == truth and len(found.members) == 1, str(diagnosis)
    assert np.all(list(diagnosis.noise_floor.values()) < 1.1 * case.noise), str(diagnosis)
    for name, true in case.effects[0].parameters.items():
        check_parameter(found.parameters[name], true, name, str(diagnosis))


@pytest.mark.slow
def test_a_mode_is_found_beside_the_crosstalk_that_took_a_little_of_it():
    # A record of a campaign: what the crosstalk left rang at one frequency, and passed for coloured noise.
    truth = "unmodelled_mode"
    rng = np.random.default_rng([80421, 0, zlib.crc32(truth.encode()), 0])
    case = hidden.random_case(rng, truth, dofs=(1, 2, 3), samples=3000, excess=(1.5, 4.0))
    diagnosis = diagnosed(case, only=[truth, "sensor_crosstalk", "sensor_nonlinearity", "periodic_disturbance"])
    check_found(case, diagnosis)
    assert "sensor_crosstalk" in {rejected.effect for rejected in diagnosis.rejected}, str(diagnosis)


@pytest.mark.slow
def test_a_hysteresis_shorter_than_a_sample_does_not_stand_for_friction_and_a_spring():
    # A record of a campaign: two stops that gave way within a thousandth of a sample stood for both effects.
    pair, rng = ("stribeck_friction", "cubic_stiffness"), np.random.default_rng([78301, 2, 10])
    case = hidden.random_pair(rng, pair=pair, dofs=(1, 2, 3), samples=3000, excess=(1.5, 4.0))
    diagnosis = diagnosed(case, only=[*pair, "coulomb_friction", "maxwell_slip_hysteresis"])
    found = model_findings(diagnosis)
    assert {f.effect for f in found} == {*pair} and diagnosis.verdict == "named", str(diagnosis)
    for effect in case.effects:
        (finding,) = (f for f in found if f.effect == effect.id)
        for name, true in effect.parameters.items():
            check_parameter(finding.parameters[name], true, name, str(diagnosis))


@pytest.mark.slow
def test_what_is_not_in_the_catalogue_is_not_given_its_name():
    case = hidden_case("cubic_stiffness", excess=(2.0, 3.0))
    stand_ins = ["cubic_stiffness", "sine_stiffness", "end_stop", "dead_zone_stiffness"]
    diagnosis = diagnosed(case, only=[*WHOLE, *stand_ins, "bilinear_stiffness"], exclude=stand_ins, max_effects=1)
    assert diagnosis.verdict in ("partly", "unexplained"), str(diagnosis)
    assert not any(m.effect in stand_ins for f in diagnosis.findings for m in f.members)
    assert diagnosis.depends_on, str(diagnosis)


def test_only_what_is_asked_for_is_looked_for():
    diagnosis = diagnosed(hidden_case("coulomb_friction"), only=["coulomb_friction", "cubic_stiffness"])
    assert {f.effect for f in model_findings(diagnosis)} == {"coulomb_friction"}
    assert {n.effect for n in diagnosis.not_found} <= {"coulomb_friction", "cubic_stiffness"}


def test_a_law_that_is_not_asked_for_gives_no_name():
    # The same law as an end stop, named by how much of the record is spent in contact.
    diagnosis = diagnosed(hidden_case("dead_zone_stiffness"), only=["end_stop", "cubic_stiffness"])
    assert {f.effect for f in model_findings(diagnosis)} == {"end_stop"}


def test_where_the_force_equation_hears_nothing_a_free_run_is_still_judged(monkeypatch):
    monkeypatch.setattr(routes, "route_of", lambda *_: "force equation")
    case = hidden_case("coulomb_friction")
    check_found(case, diagnosed(case, only=["coulomb_friction"]))


def test_a_wrong_hold_is_found_first():
    case = hidden_case("intersample_hold")
    (finding,) = model_findings(diagnosed(case))
    assert "intersample_hold" in {member.effect for member in finding.members}


@pytest.mark.slow
def test_a_wrong_hold_of_two_inputs_is_no_lost_half_of_a_sample():
    # Taken half a sample late as a whole, the record is nearer than with the hold of either input mended.
    rng, records = np.random.default_rng(7), []
    K = np.array([[300.0, -100.0], [-100.0, 200.0]])
    system = hidden.System(np.diag([2.0, 1.0]), np.diag([3.0, 1.0]), K)
    for _ in range(2):
        u = smooth_noise(rng, SAMPLES, 2, bandwidth=0.16)
        y = hidden.simulate(system, u, 0.01, (), hold="linear")
        records.append(jaxgray.Record(u, y + 0.002 * np.std(y) * rng.standard_normal(y.shape), 0.01))
    laws = ["dropped_samples", "clock_scale", "intersample_hold", "sensor_crosstalk", "sensor_delay", "input_delay"]
    diagnosis = jaxgray.diagnose(records[0], validation=records[1], only=laws)
    found = model_findings(diagnosis)
    assert {(f.effect, f.location) for f in found} == {("intersample_hold", u) for u in ("u1", "u2")}, str(diagnosis)
    for finding in found:
        check_parameter(finding.parameters["linear_share"], 1.0, "linear_share", str(diagnosis))
    assert "dropped_samples" not in record_findings(diagnosis) and diagnosis.gain.percent > 80


@pytest.mark.parametrize("entry", ["mass", "stiffness"])
def test_the_users_own_numbers_are_judged(entry):
    case = hidden.null_case(generator("own", entry), "white", dofs=(2,), samples=SAMPLES)
    own = {"mass": case.system.M.copy(), "damping": case.system.D.copy(), "stiffness": case.system.K.copy()}
    wrong = 0.1 * own[entry][1, 1]
    own[entry][1, 1] += wrong
    diagnosis = diagnosed(case, model=jaxgray.MechanicalModel(*own.values()))
    (finding,) = model_findings(diagnosis)
    assert finding.effect == f"{entry}_error" and finding.location == "y2", str(diagnosis)
    check_parameter(finding.parameters["delta"], -wrong, "delta", str(diagnosis))


SEEDS = [[80441, 12, 0], [80441, 16, 5], [100010, 12, 17], [100004, 16, 3], [100011, 16, 0]]


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_mass_that_puts_the_free_run_out_of_phase_is_found_alone_and_with_friction(seed):
    # Records of campaigns: 5 % of a mass had been said to be a step of it, friction to be wrong damping, the whole to
    # be noise at the forces or, beside friction, springs, and friction was off by 3.3 standard errors, for the steps.
    rng, size = np.random.default_rng(seed), {"dofs": (1, 2, 3), "samples": 3000}
    if seed[1] == 12:
        case = hidden.null_case(rng, "white", **size)
    else:
        case = hidden.random_case(rng, "coulomb_friction", excess=(1.5, 4.0), **size)
    at = int(rng.integers(len(case.system.M)))
    mass, wrong = case.system.M.copy(), 0.05 * case.system.M[at, at]
    mass[at, at] += wrong
    own = jaxgray.MechanicalModel(mass, case.system.D, case.system.K)
    diagnosis = diagnosed(case, model=own, only=["mass_step", "stiffness_step", "coulomb_friction"])
    everything = model_findings(diagnosis)
    (number,) = [f for f in everything if f.effect == "mass_error"]
    assert number.location == f"y{at + 1}", str(diagnosis)
    check_parameter(number.parameters["delta"], -wrong, "delta", str(diagnosis))
    others = [f for f in everything if f is not number]
    assert [f.effect for f in others] == [effect.id for effect in case.effects], str(diagnosis)
    for found, effect in zip(others, case.effects):
        friction = found.parameters["Fc"]
        assert abs(friction.value - effect.parameters["Fc"]) < 2 * friction.standard_error, str(diagnosis)


@pytest.mark.parametrize("effect_id", hidden.RAW)
def test_what_the_raw_record_shows(effect_id):
    case = hidden.raw_case(generator(effect_id), effect_id, dofs=(2,), samples=SAMPLES)
    diagnosis = diagnosed(case)
    assert record_findings(diagnosis) == {effect_id}, str(diagnosis)
    assert diagnosis.verdict == "noise", str(diagnosis)


@pytest.mark.slow
def test_samples_lost_without_a_gap_are_counted_and_dated():
    rng, form = generator("jump"), None
    while form != "jump":
        case = hidden.raw_case(rng, "dropped_samples", dofs=(2,), samples=SAMPLES)
        form = case.effects[0].parameters["form"]
    diagnosis = diagnosed(case)
    assert "dropped_samples" in record_findings(diagnosis), f"{diagnosis}\n{diagnosis.rejected}"
    (finding,) = [f for f in diagnosis.findings if f.effect == "dropped_samples"]
    assert diagnosis.verdict == "noise", str(diagnosis)
    truth, found = case.effects[0].parameters, finding.parameters
    assert abs(found["count"].value - truth["count"]) < max(5 * found["count"].standard_error, 0.01), str(diagnosis)
    assert abs(found["t0"].value / case.sampling_time - truth["at"]) < 1.5, str(diagnosis)


def test_a_closed_loop_is_announced():
    diagnosis = diagnosed(hidden.closed_loop_case(generator("loop"), dofs=(2,), samples=SAMPLES))
    assert "closed_loop" in record_findings(diagnosis)
    assert not model_findings(diagnosis), str(diagnosis)


@pytest.mark.slow
def test_noise_that_a_controller_feeds_back_is_no_crosstalk():
    # A record of a campaign in which the input seemed to leak into the output.
    diagnosis = diagnosed(hidden.closed_loop_case(np.random.default_rng([68101, 4, 2])))
    assert "closed_loop" in record_findings(diagnosis)
    assert diagnosis.verdict == "noise" and not model_findings(diagnosis), str(diagnosis)
    assert any(r.effect == "sensor_crosstalk" and "closed loop" in r.why for r in diagnosis.rejected)


def test_the_extended_model_simulates_what_was_measured():
    case = hidden_case("cubic_stiffness")
    diagnosis = diagnosed(case, only=["cubic_stiffness", "end_stop", "quadratic_drag"])
    model = diagnosis.extended.model
    assert [term.effect.id for term in model.effects] == ["cubic_stiffness"]
    y = model.simulate(case.u_v, case.sampling_time, hold=case.hold)
    error = np.sqrt(np.mean((y - case.clean_v) ** 2, axis=0))
    assert np.all(error < 0.3 * case.noise)
