"""A disturbance that has another phase in every record: held-out data are judged with that of their own."""

import dataclasses

import numpy as np
import pytest
from independent import random_steps, simulate

import jaxgray
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.free_run import free_run
from jaxgray.diagnosis.model.simulator import Simulator, Steps
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Term

M, D, K, H, SAMPLES, NOISE = 1.0, 0.8, 40.0, 0.05, 1500, 1e-3
DISTURBED = by_id("periodic_disturbance")


def record_of(amplitude, phase, seed):
    """A record of a spring-mass system under known steps and an unknown sine, held over short pieces of a sample."""
    rng, fine = np.random.default_rng(seed), 40
    u = random_steps(rng, SAMPLES, 1, H)
    t = np.arange(SAMPLES * fine) * H / fine
    unknown = -amplitude * np.sin(2 * np.pi * 1.3 * (t + H / fine / 2) + phase)[:, None]
    one = np.array([[1.0]])
    y = simulate(M * one, D * one, K * one, np.repeat(u, fine, axis=0) + unknown, H / fine)[::fine]
    return jaxgray.Record(u, y + NOISE * rng.standard_normal(y.shape), H)


@pytest.fixture(scope="module")
def fitted():
    """Simulator and candidate of the true system, its disturbance as in a record of phase 0.3."""
    one, record = np.array([[1.0]]), record_of(0.5, 0.3, 1)
    names = {"input_names": record.input_names, "output_names": record.output_names}
    baseline = baseline_of([record], None, jaxgray.MechanicalModel(M * one, D * one, K * one, **names))
    term = Term(DISTURBED, Place("y1", 0), np.array([0.5, 1.3, 0.3]))
    return Simulator(baseline.setup, (DISTURBED,), steps=Steps(4)), baseline.start.with_terms((term,))


@pytest.mark.parametrize("amplitude, phase", [(0.5, 0.3), (0.5, 0.3 + np.pi), (0.2, -1.8), (1.5, 2.0), (0.0, 0.0)])
def test_held_out_data_have_an_amplitude_and_a_phase_of_their_own(fitted, amplitude, phase):
    simulator, candidate = fitted
    data = Data.of(record_of(amplitude, phase, 2))
    assert free_run(simulator, candidate, data).rmse == pytest.approx([NOISE], rel=0.1)
    # With the frequency of another disturbance nothing is explained but by chance.
    (term,) = candidate.terms
    other = candidate.with_terms((dataclasses.replace(term, values=np.array([0.5, 2.1, 0.3])),))
    without = free_run(simulator, candidate.with_terms(()), data).rmse
    assert free_run(simulator, other, data).rmse == pytest.approx(without, rel=0.05)


def test_a_large_step_of_phase_is_straight_where_the_force_is_linear():
    p, wanted = np.array([0.5, 1.3, 0.3]), np.array([0.2, 1.3, 0.3 + 2.5])
    # To first order: along the amplitude and across it.
    turned = wanted[0] * np.exp(1j * (wanted[2] - p[2]))
    change = np.array([turned.real - p[0], 0.0, turned.imag / p[0]])
    assert np.allclose(DISTURBED.moved(p, change), wanted)
