"""A user's own simulator on trial: wrong numbers and a law that it lacks, from data of its own equations with the truth
in them; and every way in which it can fail."""

import dataclasses
import os
from types import SimpleNamespace

import independent
import numpy as np
import pendulum
import pytest
import scipy.signal

import jaxgray
from jaxgray.diagnosis.estimation.measured_motion import FORCES
from jaxgray.diagnosis.model.candidate import Candidate
from jaxgray.diagnosis.model.simulator import Steps
from jaxgray.diagnosis.own_simulator import beginning
from jaxgray.diagnosis.own_simulator.conclusions import _shifts
from jaxgray.diagnosis.own_simulator.runs import tracking
from jaxgray.diagnosis.own_simulator.runs.calls import Call, Simulator, checked_numbers
from jaxgray.diagnosis.own_simulator.runs.linearized import linearized
from jaxgray.diagnosis.own_simulator.runs.problem import Problem, Span
from jaxgray.diagnosis.own_simulator.runs.tracking import forces_by_slopes, slopes_by_number, tracked
from jaxgray.numerics.outcomes import ComputationError

H, SAMPLES = 0.01, 1500


def measured(law=pendulum.nothing, size=0.0, *, samples=SAMPLES, seed=1, noise=0.003):
    rng = np.random.default_rng(seed)
    u = pendulum.torque(samples, rng)
    q = pendulum.run(u, pendulum.TRUTH, law, size)
    record = jaxgray.Record(u, q + noise * q.std() * rng.standard_normal(samples), H, input_units=["N m"])
    return record, pendulum.off(rng)


def within(shifts, errors=4.0):
    return all(abs(s.after - pendulum.TRUTH[s.name]) < errors * s.standard_error for s in shifts)


@pytest.mark.slow
def test_a_law_is_told_from_wrong_numbers():
    record, numbers = measured(pendulum.cubic, 0.2)
    laws = ["cubic_stiffness", "quadratic_drag"]
    found = jaxgray.diagnose(record, simulator=pendulum.simulator, parameters=numbers, only=laws)
    named = [finding for finding in found.findings if finding.effect != "parameter_error" and finding.stage == "model"]
    assert [(one.effect, one.location) for one in named] == [("cubic_stiffness", "y1")]
    size = named[0].parameters["k3"]
    assert abs(size.value - 0.2) < 4 * size.standard_error < 0.04
    assert within(found.shifts) and all(s.standard_error < 0.02 * abs(s.after) for s in found.shifts)
    assert found.gain.percent > 80 and found.gain.held_out and "Your simulator misses" in found.sentence
    # Runs and fits are the simulator's own.
    assert np.allclose(found.curves[0].baseline, pendulum.simulator(record.u, 0 * record.u, numbers)[:1050, None])
    assert "not white" not in str(found) and "nan" not in str(found)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_weak_law_is_found_from_far_away(seed):
    # The plant about the numbers as they were given errs by more than the law: 37 times the noise, and 5.
    record, _ = measured(pendulum.cogging, 0.0233, samples=2000, seed=seed)
    shares = {"inertia": 0.97, "damping": 1.03, "gravity": 1.03, "friction": 1.03}
    numbers = {name: share * pendulum.TRUTH[name] for name, share in shares.items()}
    laws = "sine_stiffness,cubic_stiffness,stiffness_step"
    found = jaxgray.diagnose(record, simulator=pendulum.simulator, parameters=numbers, only=laws)
    assert found.verdict == "named" and found.baseline_excess > 30 and found.excess < 1.05
    (law,) = (f for f in found.findings if f.stage == "model" and f.effect != "parameter_error")
    assert law.effect == "sine_stiffness" and within(found.shifts)


@pytest.mark.slow
def test_wrong_numbers_alone_are_said_to_be_that():
    # More of a friction that the simulator has is no law that it lacks.
    record, numbers = measured(pendulum.coulomb, 0.03, seed=2)
    validation, _ = measured(pendulum.coulomb, 0.03, seed=3)
    found = jaxgray.diagnose(
        record, validation=validation, simulator=pendulum.simulator, parameters=numbers, only="coulomb_friction"
    )
    assert {finding.effect for finding in found.findings} == {"parameter_error"} and found.verdict == "named"
    after = {shift.name: shift for shift in found.shifts}["friction"]
    assert abs(after.after - 0.18) < 4 * after.standard_error
    assert "friction is 0.1" in found.sentence and "not 0.1545" in found.sentence and found.excess < 1.05
    assert within([shift for shift in found.shifts if shift.name != "friction"])


def test_numbers_of_which_only_a_sum_is_known_stand_for_one_another():
    rng = np.random.default_rng(5)
    u = pendulum.torque(SAMPLES, rng)
    q = pendulum.run(u)
    record = jaxgray.Record(u, q + 0.003 * q.std() * rng.standard_normal(SAMPLES), H)

    def simulator(u, w, numbers):
        parts = dict(numbers)
        damping = parts.pop("bearing") + parts.pop("seal")
        return pendulum.simulator(u, w, {"inertia": parts["inertia"], "damping": damping} | parts)

    numbers = {name: value for name, value in pendulum.TRUTH.items() if name != "damping"}
    numbers |= {"bearing": 0.05, "seal": 0.02}
    found = jaxgray.diagnose(record, simulator=simulator, parameters=numbers, only="coulomb_friction")
    (finding,) = found.findings
    assert found.verdict == finding.status == "equivalent" and found.excess < 1.05
    # One of the two takes all of it, where the other is as it was given; what need not be other stays.
    values = {member.location: member.parameters["value"] for member in finding.members}
    assert values.keys() == {"bearing", "seal"} and "this record cannot tell which" in found.sentence
    assert abs(values["bearing"].value - 0.06) < 5e-5 and abs(values["seal"].value - 0.03) < 5e-5
    assert all(one.standard_error < 2e-4 for one in values.values())
    assert found.gain.percent > 95 and abs(found.curves[0].extended[:, 0] - q[:1050]).max() < 0.01 * q.std()


def test_a_budget_ends_the_search_and_is_said():
    record, numbers = measured(pendulum.cubic, 0.2)
    found = jaxgray.diagnose(
        record, simulator=pendulum.simulator, parameters=numbers, only="cubic_stiffness", budget=1e-3
    )
    assert any("ended after its budget of 0.001 s" in text for text in found.warnings)


def two_masses(u, w, numbers):
    M, D = np.diag([2.0, 1.0]), np.array([[3.0, -1.0], [-1.0, 2.0]])
    K = np.array([[300.0, -100.0], [-100.0, numbers["k"]]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    system = scipy.signal.cont2discrete((A, B, np.eye(2, 4), np.zeros((2, 2))), H)
    return scipy.signal.dlsim(system, np.column_stack([3.0 * u[:, 0] + w[:, 0], w[:, 1]]))[1]


def test_small_forces_show_the_linear_plant():
    u = pendulum.torque(2000, np.random.default_rng(0), highest=10.0)[:, None]
    call = Call(u, np.zeros((2000, 2)), np.array([200.0]))
    simulator = Simulator(two_masses, ("k",), 2)
    y = simulator.run(call)
    plant = linearized(simulator, jaxgray.Record(u, y, H), call, y, np.random.default_rng(1))
    assert np.allclose(plant.mass, np.diag([2.0, 1.0]), atol=0.04)
    assert np.allclose(plant.stiffness, [[300, -100], [-100, 200]], atol=4)
    assert np.allclose(plant.input_map, [[3.0], [0.0]], atol=0.06)
    # Forces that give a motion give it.
    record = jaxgray.Record(u, y, H)
    w, x0 = plant.forces_of(y, record)
    assert np.allclose(plant.response(w, record, x0), y, atol=1e-3 * y.std())


@pytest.mark.parametrize(("moves", "end"), [(False, None), (True, 60), (True, 400)])
def test_the_linear_plant_shows_at_rest_and_in_a_part_of_a_run(moves, end):
    u = pendulum.torque(2000, np.random.default_rng(0), highest=10.0)[:, None]
    simulator = Simulator(two_masses, ("k",), 2)
    call = Call(u, np.zeros((2000, 2)), np.array([200.0]))
    record = jaxgray.Record(u, simulator.run(call), H)
    call = dataclasses.replace(call, u=u if moves else 0.0 * u)
    plant = linearized(simulator, record, call, simulator.run(call), np.random.default_rng(1), end)
    assert np.allclose(plant.mass, np.diag([2.0, 1.0]), atol=0.08)
    assert np.allclose(plant.stiffness, [[300, -100], [-100, 200]], atol=20)
    assert np.allclose(plant.input_map, [[3.0], [0.0]], atol=0.15)
    assert np.max(np.abs(plant.varying.table)) < 1e5, "what moves nothing has no stiffness"


@pytest.mark.slow
def test_a_simulator_far_from_its_record_is_led_there():
    # Without its damping it turns over and over; the machine does not.
    rng = np.random.default_rng(8)
    u = pendulum.torque(SAMPLES, rng, size=1.0)
    q = pendulum.run(u)
    record = jaxgray.Record(u, q + 0.003 * q.std() * rng.standard_normal(SAMPLES), H)
    numbers = pendulum.TRUTH | {"damping": 0.0, "friction": 0.1}
    assert np.max(np.abs(q)) < 3 < 10 < np.max(np.abs(pendulum.run(u, numbers)))
    found = jaxgray.diagnose(record, simulator=pendulum.simulator, parameters=numbers, only="coulomb_friction")
    assert found.verdict == "named" and within(found.shifts), found
    assert {finding.location for finding in found.findings} == {"damping", "friction"}


def test_a_number_takes_a_force_along_the_motion():
    rng = np.random.default_rng(4)
    u = pendulum.torque(SAMPLES, rng)[:, None]
    call = Call(u, np.zeros((SAMPLES, 1)), np.array(list(pendulum.TRUTH.values())))
    simulator = Simulator(pendulum.simulator, tuple(pendulum.TRUTH), 1)
    y = simulator.run(call)
    record = jaxgray.Record(u, y, H)
    plant = linearized(simulator, record, call, y, rng)
    forces = forces_by_slopes(plant, record, y, slopes_by_number(simulator, record, call, y, call.numbers))[:, 0]
    v = np.gradient(y[:, 0], H)
    wanted = np.stack([0.1 * np.gradient(v, H), 0.08 * v, 2.0 * np.sin(y[:, 0]), 0.15 * np.tanh(v / 1e-3)], axis=1)
    # At reversals a force stands for what the varying plant does not know of dry friction.
    moving = np.abs(v) > 0.3 * np.std(v)
    share = np.sum((forces * wanted)[moving], axis=0) / np.sum(wanted[moving] ** 2, axis=0)
    assert np.allclose(share, 1.0, atol=[0.02, 0.02, 0.02, 0.1]), share


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_the_varying_plant_moves_as_the_simulator_does(hold):
    def held(u, w, numbers):
        # Straight lines as steps of a finer grid.
        if hold == "zero":
            return pendulum.simulator(u, w, numbers)
        fine = 20
        at = np.arange(len(u) * fine) / fine + 0.5 / fine
        lines = [np.interp(at, np.arange(len(u)), x[:, 0])[:, None] for x in (u, w)]
        made = pendulum.run(sum(lines)[:, 0], numbers, h=H / fine, steps=2)
        return np.asarray(made)[::fine, None]

    u = pendulum.torque(SAMPLES, np.random.default_rng(9), size=0.8)[:, None]
    record = jaxgray.Record(u, np.zeros_like(u), H, hold=hold)
    simulator, values = Simulator(held, tuple(pendulum.TRUTH), 1), np.array(list(pendulum.TRUTH.values()))
    problem = Problem(simulator, (Span(record, slice(0, SAMPLES), None),), values, FORCES)
    run = problem.runs(problem.called(np.ones(4)))
    problem.spans = (Span(dataclasses.replace(record, y=run.y[0]), slice(0, SAMPLES), None),)
    problem.plant = linearized(simulator, record, run.calls[0], run.y[0], np.random.default_rng(1))
    linear = problem.linear_simulator(np.ones(4), Steps())
    wholes = problem.linear_data(linear, problem.with_forces(run))
    here = Candidate(np.ones(4), wholes.states)
    assert np.std(linear.run(here, wholes.data[0])[:SAMPLES] - run.y[0]) < 1e-4 * np.std(run.y[0])
    for change in 0.01 * np.eye(4):
        moved = problem.runs(problem.called(1 + change)).y[0] - run.y[0]
        foreseen = linear.run(here.with_entries(1 + change), wholes.data[0])[:SAMPLES] - run.y[0]
        assert np.std(foreseen - moved) < 0.1 * np.std(moved)


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("frequency", [15.0, 30.0])
def test_the_linear_plant_of_a_stiff_drive_moves_as_the_simulator_does(frequency, hold):
    # A hardly damped mode with 7 or 3 samples a period: forces by differences of the motion miss its resonance.
    inertia, ends = np.diag([0.01, 0.05]), np.array([[1.0, -1.0], [-1.0, 1.0]])
    coupling = (2 * np.pi * frequency) ** 2 / np.sum(1 / np.diag(inertia))
    damping, stiffness = 0.02 * np.eye(2), coupling * ends + np.diag([0.0, 1.0])

    def drive(u, w, numbers):
        forces = np.concatenate([u, np.zeros_like(u)], axis=1) + w
        return independent.simulate(inertia, damping, stiffness, forces, H, hold=hold)

    u = independent.random_steps(np.random.default_rng(2), SAMPLES, 1, H, (0.1, 0.5))
    record = jaxgray.Record(u, drive(u, np.zeros((SAMPLES, 2)), None), H, hold=hold)
    problem = Problem(Simulator(drive, (), 2), (Span(record, slice(0, SAMPLES), None),), np.ones(0), FORCES)
    run = problem.runs(problem.called(np.ones(0)))
    problem.plant = linearized(problem.simulator, record, run.calls[0], run.y[0], np.random.default_rng(1))
    linear = problem.linear_simulator(np.ones(0), Steps(2))
    wholes = problem.linear_data(linear, problem.with_forces(run))
    moved = linear.run(Candidate(np.ones(0), wholes.states), wholes.data[0])[:SAMPLES]
    assert np.all(np.std(moved - run.y[0], axis=0) < 2e-3 * np.std(run.y[0], axis=0))


@pytest.mark.parametrize("law, size, most", [(pendulum.cubic, 0.3, 8), (pendulum.stop, 0.5, 24)])
def test_a_force_leads_the_simulator_along_the_record(law, size, most):
    record, numbers = measured(law, size, seed=3, noise=0.004)
    u, values = record.u, np.array(list(numbers.values()))
    simulator = Simulator(pendulum.simulator, tuple(numbers), 1)
    call = Call(u, 0 * u, values)
    y = simulator.run(call)
    plant = linearized(simulator, record, call, y, np.random.default_rng(1))
    # Dry friction takes what is asked for near reversals, and hides nothing of the rest.
    assert np.allclose(plant.mass, values[0], rtol=0.02) and np.allclose(plant.input_map, 1.0, atol=0.02)
    assert plant.varying.v[0] > 0
    before, after = simulator.count, tracked(simulator, plant, record, call, y)
    clean = pendulum.run(u[:, 0], pendulum.TRUTH, law, size)
    noise = np.std(record.y[:, 0] - clean)
    assert np.std(y[:, 0] - clean) > 10 * noise
    assert np.std(after[1][:, 0] - clean) < 0.7 * noise and simulator.count - before <= most


@pytest.mark.parametrize(("foretold", "moved"), [(-10.01, False), (-9.99, False), (-10.5, True), (-9.5, True)])
def test_the_plant_moves_on_where_the_next_run_is_foretold_to_leave_something_else(monkeypatch, foretold, moved):
    """Numbers that led runs from far away to leave −10, as a logarithm."""
    asked = []
    monkeypatch.setattr(beginning, "left_by", lambda problem, y: y)
    monkeypatch.setattr(beginning, "foreseen_by", lambda fit, data: fit)
    monkeypatch.setattr(beginning, "left_of", lambda runs: runs)
    monkeypatch.setattr(beginning.Beginner, "_law_is_missing", lambda self, found: False)
    monkeypatch.setattr(beginning.Beginner, "_about_numbers", lambda self, found: asked.append(found))
    problem = SimpleNamespace(follow=lambda y: y < -5.0, record=SimpleNamespace(outputs=1))
    found = SimpleNamespace(fitted=SimpleNamespace(y=-10.0, fit=foretold, data=None))
    begun = beginning.Beginner(problem, None, None, None)._moved_on(found, SimpleNamespace(y=-2.0))
    assert begun is found and bool(asked) == moved


def test_a_force_that_is_no_number_is_never_tried(monkeypatch):
    record, numbers = measured(pendulum.cubic, 0.3, seed=3)
    u = record.u
    simulator = Simulator(pendulum.simulator, tuple(numbers), 1)
    call = Call(u, 0 * u, np.array(list(numbers.values())))
    y = simulator.run(call)
    monkeypatch.setattr(tracking, "following_force", lambda plant, record, w, y: np.full_like(w, np.nan))
    before, found = simulator.count, tracked(simulator, None, record, call, y)
    assert simulator.count == before and found[0] is call and found[1] is y


def test_slopes_of_the_varying_plant_are_those_of_the_simulator():
    u = pendulum.torque(SAMPLES, np.random.default_rng(9), size=0.5)[:, None]
    numbers = pendulum.TRUTH | {"friction": 0.0}
    simulator = Simulator(pendulum.simulator, tuple(numbers), 1)
    call = Call(u, 0 * u, np.array(list(numbers.values())))
    y = simulator.run(call)
    record = jaxgray.Record(u, y, H)
    plant = linearized(simulator, record, call, y, np.random.default_rng(1))
    assert plant.varying.v[0] == 0.0
    w = 1e-4 * np.random.default_rng(2).standard_normal(u.shape)
    moved = simulator.run(Call(u, w, call.numbers)) - y
    assert np.std(plant.varying.response(w, y, record) - moved) < 0.01 * np.std(moved)


def broken(how):
    chance = np.random.default_rng(0)

    def simulate(u, w, numbers):
        if how == "raises":
            raise RuntimeError("solver did not converge")
        if how == "chance":
            return pendulum.simulator(u, w, numbers) + 1e-4 * chance.standard_normal(len(u))
        return {"shape": np.zeros(3), "nan": np.full(len(u), np.nan), "still": np.zeros(len(u))}[how]

    return simulate


@pytest.mark.parametrize(
    "how, said",
    [
        ("raises", "it raised RuntimeError: solver did not converge"),
        ("shape", r"outputs of shape \(3, 1\), not \(1500, 1\)"),
        ("nan", "not finite from sample 0 on"),
        ("still", "do not answer to the forces w"),
        ("chance", "outputs that differ by .* for the same inputs"),
    ],
)
def test_a_simulator_that_fails_is_said_to(how, said, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    record, numbers = measured()
    with pytest.raises(ComputationError, match=said) as caught:
        jaxgray.diagnose(record, simulator=broken(how), parameters=numbers)
    if how not in ("still", "chance"):
        path = str(caught.value).partition("are in ")[2].partition(". ")[0]
        with np.load(path) as saved:
            np.testing.assert_allclose(saved["u"], record.u, rtol=1e-12)
            assert list(saved["names"]) == list(numbers)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"simulator": 3}, "simulator=3; give a function"),
        ({"simulator": pendulum.simulator, "parameters": [1.0]}, "give the simulator's numbers by name"),
        ({"simulator": pendulum.simulator, "parameters": {"inertia": "heavy"}}, "'inertia'.*'heavy'; give a finite"),
        ({"simulator": pendulum.simulator, "workers": 0}, "workers=0; give a whole number"),
        ({"simulator": lambda u, w, numbers: u, "workers": 2}, "other processes cannot have it"),
        ({"simulator": pendulum.simulator, "structure": "chain"}, "structure given with a simulator"),
        ({"parameters": {"inertia": 1.0}}, "parameters are those of a simulator"),
    ],
)
def test_arguments_that_cannot_serve_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        jaxgray.diagnose(measured(samples=300)[0], **options)


def test_a_simulator_wants_displacements():
    record, _ = measured(samples=300)
    fast = jaxgray.Record(record.u, record.y, H, measured="velocity")
    with pytest.raises(ValueError, match="give displacements"):
        jaxgray.diagnose(fast, simulator=pendulum.simulator)


def test_numbers_come_by_name():
    assert checked_numbers({"a": 1, "b": np.float64(2)}) == {"a": 1.0, "b": 2.0} and checked_numbers(None) == {}


def dies(u, w, numbers):
    os._exit(3)


def test_calls_run_side_by_side():
    u = pendulum.torque(100, np.random.default_rng(0))[:, None]
    values = np.array(list(pendulum.TRUTH.values()))
    calls = [Call(u, 0 * u, values), Call(u, 0 * u, 1.1 * values)]
    with Simulator(pendulum.simulator, tuple(pendulum.TRUTH), 1, workers=2) as simulator:
        one, other = simulator.runs(calls)
        again, _ = simulator.runs(calls)
    assert np.array_equal(one[:, 0], pendulum.run(u[:, 0])) and not np.allclose(one, other) and simulator.count == 4
    assert np.array_equal(one, again)
    with Simulator(dies, tuple(pendulum.TRUTH), 1, workers=2) as simulator:
        assert all("process that ran it died" in failure.text for failure in simulator.runs(calls))


def spring(u, w, numbers):
    """A mass on a spring that begins at rest, or where its numbers say; no more than 1 of an efficiency."""
    if numbers.get("efficiency", 1.0) > 1.0:
        raise ValueError("an efficiency is at most 1")
    A = np.array([[0.0, 1.0], [-40.0 - numbers.get("more", 0.0), -1.5]])
    system = scipy.signal.cont2discrete((A, np.array([[0.0], [1.0]]), np.eye(1, 2), np.zeros((1, 1))), H)
    force = numbers.get("efficiency", 1.0) * u[:, 0] + w[:, 0]
    return scipy.signal.dlsim(system, force, x0=[numbers.get("first", 0.0), 0.0])[1]


def pushed(y, u, seed=0):
    rng = np.random.default_rng(seed)
    return jaxgray.Record(u, y + 0.003 * y.std() * rng.standard_normal(y.shape), H)


def test_the_force_of_a_number_that_cannot_be_more_is_that_of_less():
    u = pendulum.torque(400, np.random.default_rng(3), highest=10.0)[:, None]
    call = Call(u, 0 * u, np.ones(1))
    simulator = Simulator(spring, ("efficiency",), 1)
    y = simulator.run(call)
    record = jaxgray.Record(u, y, H)
    plant = linearized(simulator, record, call, y, np.random.default_rng(1))
    slopes = slopes_by_number(simulator, record, call, y, call.numbers)
    (force,) = forces_by_slopes(plant, record, y, slopes).T[:, 0]
    # More of it takes less force beside.
    assert np.corrcoef(force, u[:, 0])[0, 1] < -0.99 and abs(np.std(force) / np.std(u) - 1) < 0.1


@pytest.mark.slow
def test_a_number_that_cannot_be_more_is_tried_with_less():
    u = pendulum.torque(SAMPLES, np.random.default_rng(3), highest=10.0)[:, None]
    record = pushed(spring(0.9 * u, 0 * u, {}), u)
    found = jaxgray.diagnose(record, simulator=spring, parameters={"efficiency": 1.0}, only="cubic_stiffness")
    (shift,) = found.shifts
    assert abs(shift.after - 0.9) < 4 * shift.standard_error < 0.01
    assert [finding.location for finding in found.findings if finding.stage == "model"] == ["efficiency"]


@pytest.mark.slow
def test_a_record_that_begins_elsewhere_is_no_fault_of_the_simulator():
    u = pendulum.torque(SAMPLES, np.random.default_rng(5), highest=10.0)[:, None]
    record = pushed(spring(u, 0 * u, {"first": 0.2}), u)
    found = jaxgray.diagnose(record, simulator=spring, parameters={"more": 0.0}, only="cubic_stiffness")
    assert found.verdict == "noise" and not found.findings and found.baseline_excess < 1.05
    assert any("does not begin where the simulator does" in text for text in found.warnings)


@pytest.mark.slow
def test_a_simulator_that_runs_with_no_numbers_asked_for_keeps_those_that_were_given(monkeypatch):
    record, numbers = measured(pendulum.cubic, 0.3, samples=800)
    monkeypatch.setattr(beginning, "_numbers_alone", lambda *given: None)
    found = jaxgray.diagnose(record, simulator=pendulum.simulator, parameters=numbers, only=["sensor_offset"])
    assert found.verdict == "unexplained" and [finding.effect for finding in found.findings] == ["unexplained"]
    assert all(s.after == s.before and s.standard_error is None for s in found.shifts)
    assert found.excess > 2.0 and found.noise_floor_source == "white part of what is left"


@pytest.mark.parametrize("unexplained", [False, True])
def test_numbers_that_make_up_for_what_is_not_explained_have_no_errors(unexplained):
    problem = SimpleNamespace(simulator=SimpleNamespace(names=("mass", "drag")), units=np.array([2.0, -1.0]))
    numbers = SimpleNamespace(values=np.array([1.1, 3.0]), errors=np.array([0.01, 0.0]))
    mass, drag = _shifts(problem, numbers, np.ones(2), unexplained)
    assert (mass.before, mass.after, drag.after) == (2.0, 2.2, -3.0) and drag.standard_error is None
    assert mass.standard_error == (None if unexplained else 0.02)


def test_a_number_that_says_nothing_has_no_error():
    u = pendulum.torque(SAMPLES, np.random.default_rng(6), highest=10.0)[:, None]
    record = pushed(spring(u, 0 * u, {"more": 1.0}), u)
    given = {"more": 0.0, "idle": 3.0}
    found = jaxgray.diagnose(record, simulator=spring, parameters=given, only="cubic_stiffness")
    more, idle = found.shifts
    assert abs(more.after - 1.0) < 4 * more.standard_error < 0.1
    assert idle.after == 3.0 and idle.standard_error is None
    assert any("does not determine idle" in text for text in found.warnings)
