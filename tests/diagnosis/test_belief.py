"""When a law's size counts, and what happens to those that are refused for its error alone."""

from types import SimpleNamespace

import independent
import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis.conclusions.assembly import picked_up
from jaxgray.diagnosis.estimation.gauss_newton import refit
from jaxgray.diagnosis.estimation.significance import significance
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.parameter_vector import Layout
from jaxgray.diagnosis.model.simulator import Simulator
from jaxgray.diagnosis.noise.whitening import white_noise_model
from jaxgray.diagnosis.screening.linearization import stage_of
from jaxgray.diagnosis.search.forward import _class_of
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term

HUM = ("periodic_disturbance", "y2")


@pytest.mark.parametrize("touched, sure", [(1, False), (12, True)])
def test_a_stop_that_is_touched_in_one_sample_has_no_size(touched, sure):
    rng = np.random.default_rng(11)
    u = independent.random_steps(rng, 600, 1, 0.05, (0.2, 1.0))
    y = independent.simulate([[1.0]], [[0.8]], [[9.0]], u, 0.05)
    record = jaxgray.Record(u, y + 0.01 * y.std() * rng.standard_normal(y.shape), 0.05)
    stop, data = by_id("end_stop"), Data.of(record)
    baseline = baseline_of([record], None, jaxgray.MechanicalModel([[1.0]], [[0.8]], [[9.0]]))
    simulator = Simulator(baseline.setup, (stop,))
    e = simulator.run(baseline.start, data) - data.y
    white = white_noise_model(e, data.kept, stage_of(simulator, baseline.start, data).system)
    farthest = np.sort(np.abs(y[:, 0]))
    gap = 0.5 * (farthest[-touched] + farthest[-touched - 1])
    candidate = baseline.start.with_terms((Term(stop, Place("y1", 0), np.array([2.0, gap])),))
    fit = refit(simulator, candidate, [data], white, max_steps=0)
    layout = Layout(simulator.setup, candidate)
    assert fit.undetermined_alone[layout.first :].any() != sure
    assert (significance(fit, layout, 0) > 0.0) == sure


def attempt(effect, criterion):
    values = {"cubic_stiffness": [1.0], "sine_stiffness": [1.0, 1.0], "coulomb_friction": [1.0, 0.1]}[effect]
    term = Term(by_id(effect), Place("y1", 0), np.array(values))
    scales = SimpleNamespace(q_peak=2.0)
    shape = SimpleNamespace(effect=term.effect, place=term.place, scales=scales)
    fit = SimpleNamespace(candidate=SimpleNamespace(terms=(term,)))
    name = effect, "y1"
    return SimpleNamespace(
        name=name, criterion=criterion, delta_bic=-criterion, fit=fit, score=SimpleNamespace(shape=shape)
    )


def test_what_is_refused_for_its_error_alone_stays_in_the_class_of_what_explains_no_more():
    context = SimpleNamespace(simulator=SimpleNamespace(setup=SimpleNamespace(own=())))
    sine = attempt("sine_stiffness", -20.0)
    for criterion, member in ((-25.0, True), (-15.0, True), (-45.0, False)):
        rivals, _, refused = _class_of(context, sine, [attempt("cubic_stiffness", criterion)])
        assert [rival.name[0] for rival in rivals] == ["cubic_stiffness"] * member and not refused
    (one,) = _class_of(context, sine, [attempt("cubic_stiffness", 0.0)])[2]
    assert one.why == "explained better by sine_stiffness at y1 (by 20)"


def test_a_periodic_force_is_said_to_look_like_hum_of_the_sensor():
    named = [
        SimpleNamespace(attempt=attempt("cubic_stiffness", 0.0)),
        SimpleNamespace(attempt=SimpleNamespace(name=HUM)),
    ]
    (said,) = picked_up(SimpleNamespace(accepted=named), ("y1", "y2"))
    assert said.startswith("A hum that the sensor at y2 picks up looks the same as a periodic force there.")
