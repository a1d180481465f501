"""Effects hidden in the forces, one each, and looked for among many."""

import pytest
from found import FORCES, check_found, diagnosed, hidden_case, searched


@pytest.mark.parametrize("effect_id", FORCES)
def test_a_hidden_force_is_found(effect_id):
    case = hidden_case(effect_id)
    check_found(case, diagnosed(case, only=searched(effect_id)))
