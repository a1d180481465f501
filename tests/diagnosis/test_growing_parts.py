"""Numbers of a simulator whose motion hangs sharply on them, fitted by its own runs over parts of the record that
grow; data from equations of their own, with the truth in them."""

import dataclasses

import numpy as np
import pendulum

import jaxgray
from jaxgray.diagnosis.estimation.gauss_newton import Refit
from jaxgray.diagnosis.own_simulator.growing_parts import Ended, Grown, bettered, grown, sharpened
from jaxgray.diagnosis.own_simulator.runs.calls import Simulator
from jaxgray.diagnosis.own_simulator.runs.problem import Problem, Span, sized
from jaxgray.diagnosis.own_simulator.runs.tracking import near_until, relative_error

SAMPLES, KICK = 1600, 1.0
GIVEN = {"inertia": 0.103, "damping": 0.0, "gravity": 1.9, "friction": 0.0}
"""Without friction it turns over where the machine does not."""

UNITS = np.array([0.103, 0.1, 1.9, 0.1])


def measured(law=pendulum.nothing, size=0.0, *, kick=0.0, seed=1):
    """A record of the machine, which begins in motion after a kick [N m] that the record does not hold."""
    rng = np.random.default_rng(seed)
    u = pendulum.torque(SAMPLES, rng)
    q = pendulum.run(u + kick * (np.arange(SAMPLES) == 0), pendulum.TRUTH, law, size)
    return jaxgray.Record(u, q + 0.003 * q.std() * rng.standard_normal(SAMPLES), 0.01)


def problem_of(record, end=SAMPLES):
    simulator = Simulator(pendulum.simulator, tuple(GIVEN), 1)
    return Problem(simulator, (Span(record, slice(0, end), None),), UNITS, ())


START = np.array(list(GIVEN.values())) / UNITS
START_NEAR = np.array(list(pendulum.TRUTH.values())) / UNITS * 1.01


def right(found, problem):
    """Whether entries are the truth, and leave nothing but noise."""
    e = problem.record.y - found.runs.y[0]
    assert np.allclose(found.entries * UNITS, list(pendulum.TRUTH.values()), rtol=0.02)
    return np.sqrt(np.mean(e**2)) < 1.1 * 0.003 * problem.record.y.std()


def test_numbers_far_off_are_found():
    problem = problem_of(measured())
    before = problem.tried(problem.called(START))
    assert relative_error(problem.record, before.y[0]) > 0.1, "with the numbers that were given it moves elsewhere"
    near = grown(problem, START)
    assert isinstance(near, Ended) and problem.follow(near.runs.y), "parts end to grow near the whole record"
    assert np.allclose(near.entries * UNITS, list(pendulum.TRUTH.values()), rtol=0.02)
    found = bettered(problem, near.entries, near.runs)
    assert isinstance(found, Grown) and right(found, problem)
    # Slopes are those of the simulator.
    one, other = (
        pendulum.simulator(problem.record.u, 0 * near.runs.y[0], dict(zip(GIVEN, (found.entries + x) * UNITS)))
        for x in (0.0, 1e-5 * np.eye(4)[2])
    )
    slope = ((other - one) / 1e-5).reshape(-1)
    assert np.linalg.norm(slope - found.slopes[0][:, 0, 2]) < 0.1 * np.linalg.norm(slope)


def test_numbers_far_off_are_found_whatever_the_first_state():
    problem = problem_of(measured(kick=KICK))
    found = grown(problem, START)
    assert isinstance(found, Grown) and right(found, problem)
    assert np.any(found.pushed[0][:2]) and not np.any(found.pushed[0][2:])


def test_numbers_that_are_near_are_found_whatever_the_first_state():
    problem = problem_of(measured(kick=KICK))
    found = bettered(problem, START_NEAR, problem.tried(problem.called(START_NEAR)))
    assert isinstance(found, Grown) and right(found, problem) and np.any(found.pushed[0])


def test_a_number_given_as_none_has_a_size_where_it_leads_no_run_elsewhere():
    for seed in (1, 2, 3, 4):
        problem = problem_of(measured(seed=seed))
        call = problem.called(START)[0]
        y = problem.simulator.run(call)
        sizes = [sized(problem.simulator, call, y, end)[1] for end in (near_until(problem.record, y), SAMPLES)]
        # Over the whole record a part of the damping turns it over elsewhere.
        assert sizes[1] < pendulum.TRUTH["damping"] / 5 < pendulum.TRUTH["damping"] < sizes[0]


def test_a_fit_says_of_its_own_runs_what_is_not_determined():
    problem = problem_of(measured())
    found = bettered(problem, START_NEAR, problem.tried(problem.called(START_NEAR)))
    samples, state = SAMPLES, 2
    size = len(GIVEN) + state
    none = np.zeros((samples, 1, size))
    before = Refit(
        None, (np.zeros((samples, 1)),), (none,), np.eye(size), 0.0, samples, 1, True, None, np.ones(size, bool), None
    )
    told = found.fit(problem, before)
    # Of the first state there is no slope here.
    assert list(told.undetermined) == [False] * len(GIVEN) + [True] * state
    held = dataclasses.replace(found, slopes=tuple(S * [1, 0, 1, 1] for S in found.slopes))
    assert list(held.fit(problem, before).undetermined)[:4] == [False, True, False, False]


def test_where_nothing_is_left_to_fit_runs_stay_as_they_are():
    problem = problem_of(measured())
    true, none = START_NEAR / 1.01, (np.zeros((SAMPLES, 1)),)
    found = sharpened(problem, true, np.zeros(len(GIVEN), bool), none)
    assert found is not None and np.array_equal(found.entries, true) and not np.any(found.slopes[0])


def test_a_law_that_is_missing_is_seen_before_more_runs_are_spent():
    problem, true = problem_of(measured(pendulum.cogging, 0.02)), np.array(list(pendulum.TRUTH.values())) / UNITS
    runs = problem.tried(problem.called(true))
    spent = problem.simulator.count
    assert bettered(problem, true, runs) is None
    assert problem.simulator.count - spent == len(GIVEN)


def test_what_numbers_do_not_explain_ends_it_soon():
    spent = 0.0
    for seed in (1, 2, 3):
        problem = problem_of(measured(pendulum.cogging, 0.3, seed=seed))
        assert isinstance(grown(problem, START), Ended)
        spent += problem.simulator.samples / SAMPLES
    assert spent < 6.5, "lengths of the record, of which steps that lead nowhere took four more"


def test_a_simulator_that_fails_on_the_way_ends_it():
    problem = problem_of(measured())
    plain = problem.simulator.function

    def fails(u, w, numbers):
        if numbers["damping"] > 0.01:
            raise ValueError("too much")
        return plain(u, w, numbers)

    problem.simulator.function = fails
    assert isinstance(grown(problem, START), Ended)
