"""Laws that can imitate one another: one that went astray is begun where the other ended."""

import zlib

import hidden
import numpy as np
import pytest
from found import check_found, diagnosed

from jaxgray.diagnosis.starts.force_matching import _left
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Scales

SPRINGS = ["cubic_stiffness", "sine_stiffness"]


def spring(effect, seed, number):
    """A record of a campaign."""
    rng = np.random.default_rng([seed, 0, zlib.crc32(effect.encode()), number])
    return hidden.random_case(rng, effect, excess=(1.5, 4.0), samples=4000, dofs=(1, 2, 3))


@pytest.mark.slow
def test_a_law_that_went_astray_is_begun_where_one_ended_that_it_can_imitate():
    # A spring that softens to nothing: from the linear model a cubic one ends far behind a sine, which stays bounded.
    case = spring("cubic_stiffness", 92001, 2)
    diagnosis = diagnosed(case, only=SPRINGS)
    assert [f.effect for f in diagnosis.findings] == ["cubic_stiffness"], str(diagnosis)
    check_found(case, diagnosis)


@pytest.mark.parametrize("length, said", [(3.0, True), (0.8, False)])
def test_within_a_small_angle_a_sine_is_a_cubic_spring(length, said):
    scales = Scales(0.5, 1.0, 1.0, 2.0, (0.1, 0.5), 1.0, 1.0, (0.1, 0.5), 1.0, 1.0, 0.01, 10.0, (1.0,))
    why = by_id("sine_stiffness").unresolved(np.array([1.0, length]), scales)
    assert (why == "in 0.33 rad it is a cubic spring") if said else why is None


def test_what_a_cubic_spring_leaves_of_a_sine_is_of_fifth_order():
    angle = 0.5 * np.sin(np.linspace(0, 20, 500))
    left, (line, cube) = _left(np.stack([angle, angle**3]), np.sin(angle))
    assert line == pytest.approx(1.0, abs=1e-3) and cube == pytest.approx(-1 / 6, rel=0.05)
    assert left < 1e-3 * np.linalg.norm(np.sin(angle))
