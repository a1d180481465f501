"""A force that a simulator lacks, foretold where the measured motion comes back to where it was."""

import numpy as np
import pendulum
import pytest

import jaxgray
from jaxgray.diagnosis.own_simulator.runs.forecast import forecast

KNOWN, SAMPLES = 900, 1500


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(5)
    u = pendulum.torque(SAMPLES, rng)
    q = pendulum.run(u, pendulum.TRUTH, pendulum.stop, 0.5)
    y = q + 0.003 * q.std() * rng.standard_normal(SAMPLES)
    y[1200:1210] = np.nan
    return jaxgray.Record(u, y, 0.01), q


def test_a_law_of_the_motion_is_foretold(record):
    record, q = record
    force = pendulum.stop(0.5, q, 0.0)[:, None] + 0.1 * record.u
    otherwise = np.zeros((SAMPLES - KNOWN, 1))
    told = forecast(record, record.u, np.asarray(force[:KNOWN]), otherwise)
    error = np.sqrt(np.mean((told - force[KNOWN:]) ** 2))
    assert error < 0.2 * np.sqrt(np.mean(force[KNOWN:] ** 2))


@pytest.mark.parametrize("value", [None, np.nan])
def test_what_nothing_foretells_stays_as_it_was(record, value):
    record, _ = record
    known = np.random.default_rng(6).standard_normal((KNOWN, 1))
    known[0] = known[0] if value is None else value
    otherwise = np.full((SAMPLES - KNOWN, 1), 7.0)
    assert np.array_equal(forecast(record, record.u, known, otherwise), otherwise)
