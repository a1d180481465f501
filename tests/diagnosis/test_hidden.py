"""Effects hidden one at a time, in the forces, at inputs and outputs, in the structure or tied to the clock, and looked
for among many. In one file, since they share what is compiled."""

import pytest
from found import IDS, check_found, diagnosed, hidden_case, searched


@pytest.mark.parametrize("effect_id", IDS)
def test_a_hidden_effect_is_found(effect_id):
    case = hidden_case(effect_id)
    check_found(case, diagnosed(case, only=searched(effect_id)))


@pytest.mark.parametrize(
    "effect_id, dofs, rivals",
    [
        ("coulomb_friction", 1, ["cubic_stiffness", "sensor_offset"]),
        ("input_delay", 3, ["actuator_lag", "sensor_delay", "intersample_hold"]),
    ],
)
def test_other_numbers_of_coordinates(effect_id, dofs, rivals):
    case = hidden_case(effect_id, dofs=(dofs,))
    check_found(case, diagnosed(case, only=[effect_id, *rivals]))
