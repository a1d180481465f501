"""A change at once is found at its moment, not at one at which the structure rings alike."""

import zlib

import hidden
import numpy as np
import pytest
from found import diagnosed, model_findings


@pytest.mark.parametrize(
    ("effect", "size", "seed", "number"),
    [
        pytest.param("force_step", "F", 96001, 0, marks=pytest.mark.slow),
        pytest.param("stiffness_step", "dk", 97001, 2, marks=pytest.mark.slow),
    ],
)
def test_a_sudden_change_is_found_at_its_moment(effect, size, seed, number):
    # Of the second the likelihood has several hills, each far narrower than all of them.
    rng = np.random.default_rng([seed, 0, zlib.crc32(effect.encode()), number])
    case = hidden.random_case(rng, effect, excess=(1.5, 4.0), samples=4000, dofs=(1, 2, 3))
    diagnosis = diagnosed(case, only=[effect, "constant_force"])
    (found,) = model_findings(diagnosis)
    assert (found.effect, found.location) == (effect, case.effects[0].place), str(diagnosis)
    for name in ("t0", size):
        value = found.parameters[name]
        assert abs(value.value - case.effects[0].parameters[name]) < 5 * value.standard_error, str(diagnosis)
        assert value.standard_error < 0.1 * abs(value.value), str(diagnosis)
