"""What is said of held-out data that move farther than the data of the fit."""

import numpy as np
import pytest

from jaxgray import Record
from jaxgray.diagnosis.reach import beyond_the_fit


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
