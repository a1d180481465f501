"""Records searched on a part, reported on the whole."""

import numpy as np
import pytest
from found import check_found, diagnosed, hidden_case, model_findings

from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.search import parts
from jaxgray.identification.setup.padding import padded_samples

SLOW = [
    pytest.param(name, marks=pytest.mark.slow) for name in ("coulomb_friction", "cubic_stiffness", "stiffness_step")
]


@pytest.mark.parametrize("effect_id", SLOW)
def test_a_law_that_a_part_shows_is_refitted_on_the_whole(monkeypatch, effect_id):
    monkeypatch.setattr(parts, "PART", 700)
    case = hidden_case(effect_id)
    diagnosis = diagnosed(case, only=("cubic_stiffness", "coulomb_friction", "stiffness_step", "force_step"))
    check_found(case, diagnosis)
    said = [text for text in diagnosis.warnings if "The search worked on samples" in text]
    # A step belongs to the clock of the whole record, and is looked for there whether a part shows anything or not.
    assert said or effect_id == "stiffness_step", diagnosis.warnings
    whole = diagnosed(case, only=(effect_id,))
    (found,), (expected,) = model_findings(diagnosis), model_findings(whole)
    for name, one in expected.parameters.items():
        other = found.parameters[name]
        if one.standard_error:
            assert other.value == pytest.approx(one.value, abs=one.standard_error)
            assert other.standard_error == pytest.approx(one.standard_error, rel=0.3)


def test_the_liveliest_part_is_searched():
    y = np.concatenate([np.zeros((300, 1)), np.sin(np.arange(200.0))[:, None], np.zeros((500, 1))])
    data = Data(np.ones_like(y), y, np.ones(y.shape, bool), np.zeros(len(y)), len(y), 0.1, "zero")
    assert parts._liveliest(data, 200) == 300
    part = data.part(300, 200)
    assert part.samples == len(part.u) == len(part.kept) == 200 and np.array_equal(part.y, y[300:500])
    padded = data.part(300, 200, padded=True)
    assert padded.samples == 200 and len(padded.u) == padded_samples(200) and np.array_equal(padded.y[:200], y[300:500])
    assert padded.kept[:200].all() and not padded.kept[200:].any() and np.all(padded.u == 1)
    assert parts._liveliest(data, 1000) == 0 and data.part(0, 1000) is data
