"""Effects hidden at inputs, outputs, in the structure or tied to the clock, looked for with the whole catalogue."""

import pytest
from found import REST, check_found, diagnosed, hidden_case


@pytest.mark.parametrize("effect_id", REST)
def test_a_hidden_effect_is_found(effect_id):
    case = hidden_case(effect_id)
    check_found(case, diagnosed(case))


@pytest.mark.parametrize("effect_id, dofs", [("coulomb_friction", 1), ("cubic_stiffness", 3), ("input_delay", 3)])
def test_other_numbers_of_coordinates(effect_id, dofs):
    case = hidden_case(effect_id, dofs=(dofs,))
    check_found(case, diagnosed(case))
