"""Laws that the linear plant about one motion rules out, and the simulator does not: which are tried there."""

from types import SimpleNamespace

import pytest

from jaxgray.diagnosis.findings import Reason
from jaxgray.diagnosis.own_simulator.contenders import _ruled_out_elsewhere
from jaxgray.mechanics.effects import CATALOGUE

EFFECTS = {effect.id: effect for effect in CATALOGUE}
PLACES = {"input_delay": "u1", "actuator_lag": "u1", "sensor_delay": "y1", "sensor_lag": "y1", "cubic_stiffness": "y1"}


def searched(*rejected):
    """A round that screened all of them and rejected some."""
    scores = {name: SimpleNamespace(shape=SimpleNamespace(effect=EFFECTS[name[0]])) for name in PLACES.items()}
    gone = [SimpleNamespace(effect=law, location=PLACES[law], reason=reason) for law, reason in rejected]
    return SimpleNamespace(first=SimpleNamespace(best_by_place=lambda: scores), rejected=gone)


def ended(law):
    return SimpleNamespace(candidate=SimpleNamespace(terms=(SimpleNamespace(effect=EFFECTS[law]),)))


ALL = [(law, Reason.DOMINATED) for law in PLACES]


@pytest.mark.parametrize(
    ("best", "others"),
    [
        ("input_delay", {"sensor_delay", "sensor_lag"}),
        ("sensor_delay", {"input_delay", "actuator_lag"}),
        ("cubic_stiffness", set()),
    ],
)
def test_look_alikes_with_another_motion_behind_the_same_outputs_are_tried(best, others):
    state = searched(*(one for one in ALL if one[0] != best))
    assert {law for law, _ in _ruled_out_elsewhere(state, ended(best), {(best, PLACES[best])})} == others


def test_neither_what_was_tried_nor_what_is_refused_for_good_is():
    state = searched(("sensor_delay", Reason.DOMINATED), ("sensor_lag", Reason.OTHER_LAW))
    assert _ruled_out_elsewhere(state, ended("input_delay"), {("sensor_delay", "y1")}) == []
