"""A change at once is found at its moment, not at one at which the structure rings alike."""

import zlib

import hidden
import numpy as np
from found import diagnosed, model_findings


def test_a_sudden_force_is_found_at_its_moment():
    rng = np.random.default_rng([96001, 0, zlib.crc32(b"force_step"), 0])
    case = hidden.random_case(rng, "force_step", excess=(1.5, 4.0), samples=4000, dofs=(1, 2, 3))
    diagnosis = diagnosed(case, only=["force_step", "constant_force"])
    (found,) = model_findings(diagnosis)
    assert (found.effect, found.location) == ("force_step", case.effects[0].place), str(diagnosis)
    for name in ("t0", "F"):
        number = found.parameters[name]
        assert abs(number.value - case.effects[0].parameters[name]) < 5 * number.standard_error, str(diagnosis)
        assert number.standard_error < 0.1 * abs(number.value), str(diagnosis)
