"""Dry friction in a frame, seen by accelerometers: samples that no simulation decides, and where refits begin."""

import dataclasses

import frames
import hidden_laws
import numpy as np
import pytest
from test_damage import H

import jaxgray
from jaxgray.diagnosis import settings
from jaxgray.diagnosis.estimation.continuation import ROUGH
from jaxgray.diagnosis.estimation.gauss_newton import refit
from jaxgray.diagnosis.estimation.measured_motion import KnownForce, along_measured_motion
from jaxgray.diagnosis.estimation.normal_equations import Equations
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.parameter_vector import Layout
from jaxgray.diagnosis.model.reversals import undecided
from jaxgray.diagnosis.model.simulator import Simulator, Steps
from jaxgray.diagnosis.noise.whitening import white_noise_model
from jaxgray.diagnosis.screening.linearization import screen_simulated, stage_of
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term
from jaxgray.mechanics.systems.drives import BaseAcceleration

PLACE = Place("floor1-floor2", 0, 1)
NAMES = ("floor1", "floor2")
LAWS = (by_id("coulomb_friction"), by_id("cubic_stiffness"), KnownForce())


@pytest.fixture(scope="module")
def rubbing():
    """A frame that rubs in its second storey, its record and the noise of it, by the event-driven simulator."""
    frame = frames.Frame((120.0, 90.0), (1.9e5, 1.5e5), (90.0, 70.0))
    rng = np.random.default_rng(23)
    u = 1.2 * frames.band_noise(rng, 3000, 1, (0.5, 12.0), H)
    clean = frames.shaken_with(frame, u, H, [hidden_laws.Effect("coulomb_friction", "y1-y2", {"Fc": 160.0})])[0]
    noise = 5e-3 * clean.std()
    record = jaxgray.Record(
        u,
        clean + noise * rng.standard_normal(clean.shape),
        H,
        hold="linear",
        measured="acceleration",
        output_names=NAMES,
    )
    return frame, record, noise


def linear(frame, record, *, damping=1.0):
    """Simulator and start of the frame without its friction, damped so many times as much."""
    model = jaxgray.MechanicalModel(
        frame.mass,
        damping * frame.damping,
        frame.stiffness,
        drive=BaseAcceleration(np.ones((2, 1))),
        measured=record.measured,
        input_names=record.input_names,
        output_names=record.output_names,
    )
    baseline = baseline_of([record], None, model)
    simulator = Simulator(baseline.setup, LAWS, steps=Steps(16))
    return simulator, dataclasses.replace(baseline.start, x0=(np.zeros(4),))


def test_few_samples_beside_reversals_are_undecided_and_the_rest_is_noise(rubbing, monkeypatch):
    frame, record, noise = rubbing
    simulator, start = linear(frame, record)
    data = Data.of(record)
    true = start.with_terms((Term(by_id("coulomb_friction"), PLACE, np.array([160.0, 1e-4])),))
    e = np.where(data.kept, data.y - simulator.run(true, data), 0.0)
    left_out = undecided(simulator, true, data, e)
    # Each is off by a share of twice the friction over the mass, not by noise, and they alone spoil the fit.
    assert 0 < left_out.any(axis=1).sum() < 0.02 * record.samples
    assert np.all(np.abs(e[left_out]) > 4 * noise)
    decided = np.where(left_out, 0.0, e)
    for k in range(2):
        assert np.sqrt(np.mean(e[: record.samples, k] ** 2)) > 1.3 * noise
        assert np.sqrt(np.mean(decided[: record.samples, k] ** 2)) < 1.2 * noise
    # A law that does not jump, and sensors that do not see the jump, decide every sample.
    smooth = start.with_terms((Term(by_id("cubic_stiffness"), PLACE, np.array([1.0])),))
    assert undecided(simulator, smooth, data, e) is None
    setup = dataclasses.replace(simulator.setup, measured=("displacement",) * 2)
    assert undecided(Simulator(setup, LAWS), true, data, e) is None
    # Runs that overflow are refused elsewhere, and where more is off than a few samples the model is wrong.
    assert undecided(simulator, true, data, np.where(left_out, 1e200, e)) is None
    monkeypatch.setattr(settings, "MAX_UNDECIDED_SHARE", 0.5 * left_out.any(axis=1).sum() / record.samples)
    assert undecided(simulator, true, data, e) is None


@pytest.mark.slow
def test_friction_that_had_passed_for_damping_is_reached_along_the_measured_motion(rubbing):
    frame, record, noise = rubbing
    simulator, start = linear(frame, record, damping=12.0)
    data, held = Data.of(record), np.zeros(len(start.entries), bool)
    # A moving base leaves the scale of the masses open.
    held[0] = True
    stage = stage_of(simulator, start, data)
    white = white_noise_model(stage.e, data.kept, stage.system)
    fitted = refit(simulator, start, [data], white, held=held)
    stage = stage_of(simulator, fitted.candidate, data)
    names = record.input_names, record.output_names
    score = screen_simulated(stage, data, LAWS[:1], names, surrogates=0).best_by_place()["coulomb_friction", PLACE.name]
    context = type("Context", (), {"simulator": simulator, "data": [data], "held": held})
    begun = along_measured_motion(context, stage, score, tolerance=ROUGH)
    assert abs(begun.terms[-1].parameter("Fc") / 160.0 - 1) < 0.02
    D = np.asarray(simulator.plant(begun).damping)
    assert np.linalg.norm(D - frame.damping) < 0.1 * np.linalg.norm(frame.damping)


def test_a_body_that_dry_friction_holds_is_begun_from_rest(rubbing):
    frame, record, _ = rubbing
    simulator, start = linear(frame, record)
    data = Data.of(record)
    law = (Term(by_id("coulomb_friction"), PLACE, np.array([160.0, 1e-4])),)
    true, moving = start.with_terms(law), np.array([1e-3, -5e-4, 4e-3, 6e-3])
    astray = dataclasses.replace(true, x0=(moving,))
    e = np.where(data.kept, data.y - simulator.run(true, data), 0.0)
    white = white_noise_model(e, data.kept, stage_of(simulator, start, data).system)
    equations = Equations(simulator, [data], white, Layout(simulator.setup, true))
    assert not np.any(equations.moved_or_at_rest(astray).x0[0])
    # Without friction the slopes lead to the first state, from wherever it begins.
    assert equations.moved_or_at_rest(astray.with_terms(())) == astray.with_terms(())
