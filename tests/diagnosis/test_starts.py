"""Which candidates are refitted, and where they begin."""

from types import SimpleNamespace

import numpy as np

from jaxgray.diagnosis.screening.features import Shape
from jaxgray.diagnosis.screening.score_test import Score, Screening
from jaxgray.diagnosis.screening.shortlist import shortlist
from jaxgray.diagnosis.starts.lookalikes import at_other_places
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place

SCALES = SimpleNamespace(lines_hz=())


def score(effect, place, delta_bic):
    """A score of a law with the shape that its parameters begin with."""
    law = by_id(effect)
    values = np.ones(len(law.parameters))
    shape = Shape(law, Place(place, 0), values, tuple(law.basis(values)), 1, SCALES)
    return Score(shape, np.ones(1), delta_bic + 20.0, float(delta_bic), 0.0, 0.1, 0)


def screening(scores, white):
    return Screening(tuple(scores), None, 4000, None, 10.0, 0, tuple(white))


def names(listed):
    return [(scores[0].shape.effect.id, scores[0].shape.place.name) for scores in listed]


def test_the_best_under_white_noise_is_refitted_first_at_its_own_place():
    coloured = [score("stiffness_step", "y2-y3", 90.0), score("sine_stiffness", "y2-y3", 80.0)]
    white = [score("stiffness_step", "y1", 5000.0), score("stiffness_step", "y2-y3", 4000.0)]
    listed = names(shortlist(screening(coloured, coloured), screening(coloured, white)))
    assert listed[0] == ("stiffness_step", "y1")
    assert {("stiffness_step", "y2-y3"), ("sine_stiffness", "y2-y3")} <= set(listed)


def test_nothing_is_refitted_for_white_noise_alone():
    coloured = [score("sine_stiffness", "y1", 80.0)]
    listed = names(shortlist(screening(coloured, coloured), screening(coloured, [score("end_stop", "y1", 9.0)])))
    assert listed == [("sine_stiffness", "y1")]


def test_the_law_of_the_best_is_looked_for_at_its_other_places():
    scores = [score("stiffness_step", place, 50.0 - k) for k, place in enumerate(("y1-y4", "y1-y2", "y4", "y2"))]
    table = screening([*scores, score("cubic_stiffness", "y1-y2", 45.0)], [])
    best = SimpleNamespace(score=scores[0])
    tried = {("stiffness_step", "y1-y4"), ("stiffness_step", "y4")}
    listed = names(at_other_places(best, table, screening([], []), tried))
    assert listed == [("stiffness_step", "y1-y2"), ("stiffness_step", "y2")]
