"""Shares of the error of the linear model: what may be called noise, and what may not."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxgray import Record
from jaxgray.diagnosis.conclusions.assembly import budget_of
from jaxgray.diagnosis.model.candidate import Data

SAMPLES, NOISE, SLOW = 4000, 0.1, 1.0


@pytest.fixture
def left():
    """White noise on something slow, and the data it was left on."""
    rng = np.random.default_rng(3)
    e = NOISE * rng.normal(size=(SAMPLES, 1)) + SLOW * np.sqrt(2) * np.sin(0.02 * np.arange(SAMPLES))[:, None]
    return e, Data.of(Record(np.ones((SAMPLES, 1)), e, 0.01))


def budget(left, floor, *, all_noise, accepted=()):
    e, data = left
    e = np.pad(e, ((0, len(data.y) - len(e)), (0, 0)))
    fits = [SimpleNamespace(fit=SimpleNamespace(residual=[e]), name=("coulomb_friction", "y1")) for _ in accepted]
    state = SimpleNamespace(
        start=SimpleNamespace(e=2 * e if accepted else e),
        stage=SimpleNamespace(e=e),
        accepted=[SimpleNamespace(attempt=one) for one in fits],
    )
    return budget_of(state, SimpleNamespace(data=[data]), np.array([floor]), all_noise=all_noise)


def test_what_is_left_and_unexplained_is_noise_in_its_white_part_alone(left):
    whole = np.sqrt(NOISE**2 + SLOW**2)
    found = budget(left, whole, all_noise=False)
    assert found["noise"] == pytest.approx(100 * (NOISE / whole) ** 2, rel=0.1)
    assert found["noise"] + found["unexplained"] == pytest.approx(100)
    assert budget(left, whole, all_noise=True)["noise"] == pytest.approx(100, rel=0.02)


def test_a_floor_of_its_own_says_how_much_is_noise(left):
    found = budget(left, NOISE, all_noise=True, accepted=("coulomb_friction",))
    assert found["coulomb_friction at y1"] == pytest.approx(75)
    assert found["noise"] == pytest.approx(25 * NOISE**2 / (NOISE**2 + SLOW**2), rel=0.05)
    assert sum(found.values()) == pytest.approx(100)
