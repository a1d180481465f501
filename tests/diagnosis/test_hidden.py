"""Effects hidden one at a time, in the forces, at inputs and outputs, in the structure or tied to the clock, and looked
for among many. In one file, since they share what is compiled."""

import hidden
import pytest
from found import IDS, SAMPLES, check_found, diagnosed, generator, hidden_case, searched

ALWAYS = "cubic_stiffness end_stop coulomb_friction input_delay sensor_offset unmodelled_mode stiffness_step".split()
"""Of every kind some; the others run with the slow tests, and each at three sizes in benchmarks/yardstick.py."""


@pytest.mark.parametrize(
    "effect_id", [*ALWAYS, *(pytest.param(i, marks=pytest.mark.slow) for i in IDS if i not in ALWAYS)]
)
def test_a_hidden_effect_is_found(effect_id):
    case = hidden_case(effect_id)
    check_found(case, diagnosed(case, only=searched(effect_id)))


@pytest.mark.slow
def test_another_number_of_coordinates():
    # One coordinate: the notebook of the examples.
    case = hidden_case("input_delay", dofs=(3,))
    rivals = ["actuator_lag", "sensor_delay", "intersample_hold"]
    check_found(case, diagnosed(case, only=["input_delay", *rivals]))


@pytest.mark.parametrize("k", ["0", *(pytest.param(k, marks=pytest.mark.slow) for k in ("1", "6"))])
def test_a_mode_that_rings_like_coloured_noise_is_found(k):
    rng = generator("a mode that rings", k)
    case = hidden.random_case(rng, "unmodelled_mode", dofs=(2,), samples=SAMPLES, excess=(1.5, 3.0))
    rivals = ["sensor_crosstalk", "periodic_disturbance", "fractional_damping"]
    check_found(case, diagnosed(case, only=["unmodelled_mode", *rivals]))
