"""What is looked for beside a law that was found: answers of the model with it, not of its linear plant."""

import dataclasses

import numpy as np
import pytest
import scipy.integrate
from independent import random_steps

import jaxgray
from jaxgray.diagnosis.estimation.gauss_newton import refit
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.simulator import Simulator, Steps
from jaxgray.diagnosis.noise.whitening import white_noise_model
from jaxgray.diagnosis.screening import features, linearization
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term

M, D, K, H, SAMPLES, FRICTION, HARDENING = 1.0, 0.3, 40.0, 0.05, 1000, 4.0, 30.0
LAWS = tuple(by_id(name) for name in ("coulomb_friction", "cubic_stiffness", "quadratic_drag", "end_stop"))


@pytest.fixture(scope="module")
def rubbing():
    """A stage with dry friction of a record that has a cubic spring as well, and the refits without it and with it."""
    rng, x, q = np.random.default_rng(4), np.zeros(2), []
    u = 12.0 * random_steps(rng, SAMPLES, 1, H)

    def rate(t, x, w):
        return x[1], (w - D * x[1] - K * x[0] - HARDENING * x[0] ** 3 - FRICTION * np.tanh(x[1] / 2e-3)) / M

    for w in u[:, 0]:
        q.append(x[0])
        x = scipy.integrate.solve_ivp(rate, (0.0, H), x, "LSODA", args=(w,), rtol=1e-8, atol=1e-10).y[:, -1]
    y = np.array(q)[:, None]
    record = jaxgray.Record(u, y + 0.002 * np.std(y) * rng.standard_normal(y.shape), H)
    names = {"input_names": record.input_names, "output_names": record.output_names}
    model = jaxgray.MechanicalModel(np.array([[M]]), np.array([[D]]), np.array([[1.2 * K]]), **names)
    baseline = baseline_of([record], None, model)
    setup = dataclasses.replace(baseline.setup, held=np.zeros(len(baseline.start.entries), bool))
    simulator, data, place = Simulator(setup, LAWS, steps=Steps(4)), Data.of(record), Place("y1", 0)
    friction, cubic = Term(LAWS[0], place, np.array([3.0, 2e-3])), Term(LAWS[1], place, np.array([10.0]))
    start = baseline.start
    white = white_noise_model(simulator.run(start, data) - data.y, data.kept, stage(simulator, start, data).system)
    held = np.zeros(len(start.entries), bool)
    alone = refit(simulator, start.with_terms((friction,)), [data], white, held=held, max_steps=60)
    both = refit(simulator, alone.candidate.with_terms((*alone.candidate.terms, cubic)), [data], white, held=held)
    return stage(simulator, alone.candidate, data), data, (record.input_names, record.output_names), alone, both


def stage(simulator, candidate, data):
    return linearization.stage_of(simulator, candidate, data)


def scores(monkeypatch, rubbing, plain):
    here, data, names, *_ = rubbing
    if plain:
        monkeypatch.setattr(linearization, "run_about", lambda stage, data: None)
    found = linearization.screen_simulated(here, data, LAWS, names, surrogates=0)
    return {name: score.ratio for name, score in found.best_by_effect().items()}


def test_beside_friction_a_score_is_what_the_refit_gains(monkeypatch, rubbing):
    *_, alone, both = rubbing
    gain = both.count * np.log(alone.cost / both.cost)
    assert gain > 100
    found = scores(monkeypatch, rubbing, plain=False)
    assert max(found, key=found.get) == "cubic_stiffness"
    assert found["cubic_stiffness"] == pytest.approx(gain, rel=0.3)
    # The linear plant alone is moved by forces that friction takes up.
    assert scores(monkeypatch, rubbing, plain=True).get("cubic_stiffness", 0.0) < 0.5 * gain


def test_where_the_linearised_run_overflows_the_plant_answers(monkeypatch, rubbing):
    plain = scores(monkeypatch, rubbing, plain=True)
    monkeypatch.undo()
    nothing = lambda run, column, start, end, outputs, forced: np.full((*start.shape, outputs), np.nan)  # noqa: E731
    monkeypatch.setattr(features, "_answers", nothing)
    assert scores(monkeypatch, rubbing, plain=False) == plain


def test_answers_that_run_away_after_the_record_end_with_it(rubbing):
    _, data, *_ = rubbing
    made = np.ones((3, len(data.u), 1))
    assert len(data.u) > data.samples
    made[1, -1], made[2, -1] = 1e4, np.inf
    ended = features._within(made.copy(), data)
    assert np.array_equal(ended[0], made[0]) and np.all(ended[:, : data.samples] == 1.0)
    assert not np.any(ended[1:, data.samples :])


def test_accelerometers_say_nothing_beside_reversals(monkeypatch, rubbing):
    here, data, names, *_ = rubbing
    whole = linearization._features(here, here.motion, data, LAWS, names).responses
    near = np.arange(len(data.u)) % 7 == 0
    monkeypatch.setattr(linearization, "beside_reversals", lambda simulator, candidate, data: near)
    for accelerated in (True, False):
        monkeypatch.setattr(linearization, "accelerations", lambda simulator, a=accelerated: np.array([a]))
        made = linearization._features(here, here.motion, data, LAWS, names).responses
        assert np.any(whole[:, near]) and np.any(made[:, near]) != accelerated
        assert np.array_equal(made[:, ~near], whole[:, ~near])
