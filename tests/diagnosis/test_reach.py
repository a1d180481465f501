"""What is said of held-out data that move farther than the data of the fit."""

import hidden
import numpy as np
import pytest

from jaxgray import Record, diagnose
from jaxgray.diagnosis.data_checks.extrapolation import beyond_the_fit


def record(*ranges):
    """A record whose outputs sweep the ranges, with a sample missing in each."""
    y = np.stack([np.linspace(low, high, 50) for low, high in ranges], axis=1)
    y[7] = np.nan
    return Record(np.ones((50, 1)), y, 0.01, output_names=("arm", "base"), output_units=("rad", ""))


def test_outputs_that_leave_the_range_of_the_fit_are_named():
    fit = [record((-1.0, 0.5), (0, 1)), record((-0.5, 1.0), (0, 1))]
    (said,) = beyond_the_fit(fit, [record((-2.5, 1.2), (-0.2, 1.2))])
    assert said.startswith("The held-out data take arm to -2.5 rad, the data of the fit only from -1 to 1 rad:")
    (said,) = beyond_the_fit(fit, [record((-1.0, 1.0), (0.5, 1.3))])
    assert said.startswith("The held-out data take base to 1.3, the data of the fit only from 0 to 1:")


@pytest.mark.parametrize("held", [[], [record((-1.3, 1.3), (0.1, 1.1))]])
def test_what_stays_near_it_is_not(held):
    assert beyond_the_fit([record((-1.0, 1.0), (0, 1))], held) == ()


@pytest.mark.slow
def test_what_a_short_record_hardly_determines_does_not_go_astray_at_the_end():
    # One of two carts sticks in the data of the fit; refitted in finer steps its spring and damper went where they
    # liked, and an error of a thousandth of the held-out motion became one of half of it.
    rng = np.random.default_rng(1)
    carts = hidden.System(np.diag([2.0, 1.0]), 0.3 * np.array([[0.6, -0.2], [-0.2, 0.3]]), np.zeros((2, 2)))
    u = 2.0 * np.repeat(rng.standard_normal((8, 2)), 20, axis=0)[:150]
    y = hidden.simulate(carts, u, 0.01, (hidden.Effect("coulomb_friction", "y1", {"Fc": 0.4}),))
    y = y + 1e-4 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    diagnosis = diagnose(Record(u, y, 0.01), only=["coulomb_friction", "constant_force"])
    (finding,) = [f for f in diagnosis.findings if f.stage == "model"]
    assert finding.effect == "coulomb_friction" and abs(finding.parameters["Fc"].value - 0.4) < 0.01
    assert diagnosis.gain.held_out and diagnosis.gain.percent > 90
