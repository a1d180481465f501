"""Which candidates are refitted, and where they begin."""

from types import SimpleNamespace

import hidden_draws as draws
import numpy as np
import pytest
from hidden_laws import Effect
from hidden_simulation import simulate

import jaxgray
from jaxgray.diagnosis.screening.features import Shape
from jaxgray.diagnosis.screening.score_test import Score, Screening
from jaxgray.diagnosis.screening.shortlist import in_other_forms, shortlist
from jaxgray.diagnosis.search import proposals
from jaxgray.diagnosis.starts.lookalikes import as_likely_places, at_other_places, untried_look_alikes
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


def test_places_that_explain_as_much_as_the_own_of_the_best_are_begun_as_well_and_none_where_there_is_no_other():
    own, near = score("end_stop", "y1", 500.0), score("end_stop", "y2", 450.0)
    far, other = score("end_stop", "y1-y2", 300.0), score("cubic_stiffness", "y2", 499.0)
    best = SimpleNamespace(score=own, name=("end_stop", "y1"))
    table, empty = screening([own, other, near, far], []), screening([], [])
    assert as_likely_places(best, table, empty) == [own, near]
    assert as_likely_places(best, empty, table) == [own, near]
    assert as_likely_places(best, screening([own, other, far], []), empty) == []
    # The best one came in by another door: nothing says how likely its own place is.
    assert as_likely_places(best, screening([other, near, far], []), empty) == []


def test_a_look_alike_that_explains_nothing_to_first_order_is_tried_where_the_best_is():
    best = SimpleNamespace(name=("end_stop", "y2"))
    silent = score("cubic_stiffness", "y1", 2.0), score("cubic_stiffness", "y2", -5.0)
    ids, empty = frozenset({"cubic_stiffness", "sine_stiffness"}), screening([], [])
    assert names(untried_look_alikes(ids, best, screening(silent, []), empty, set())) == [("cubic_stiffness", "y2")]
    heard = screening([score("cubic_stiffness", "y1", 30.0), silent[1]], [])
    assert names(untried_look_alikes(ids, best, heard, empty, set())) == [("cubic_stiffness", "y1")]
    # Whichever of the rankings it is in.
    assert names(untried_look_alikes(ids, best, heard, screening(silent, []), set())) == [("cubic_stiffness", "y1")]


def attempt(name, delta_bic, contains=()):
    shape = SimpleNamespace(effect=SimpleNamespace(id=name, contains=contains), place=SimpleNamespace(name="u1"))
    return SimpleNamespace(name=(name, "u1"), delta_bic=delta_bic, score=SimpleNamespace(shape=shape))


@pytest.mark.parametrize(
    "delta_bic, ahead, expected",
    [
        (60.0, False, ["crosstalk", "limit", "saturation"]),
        # It explains nothing; or the simpler law is ahead of it as it is.
        (5.0, False, ["crosstalk", "limit"]),
        (60.0, True, ["saturation", "crosstalk", "limit"]),
    ],
)
def test_the_laws_inside_the_first_wide_law_of_a_round_are_refitted_from_its_end(
    monkeypatch, delta_bic, ahead, expected
):
    ranked = [attempt("crosstalk", 900.0), attempt("limit", delta_bic, ("saturation",))]
    ranked = [attempt("saturation", 950.0)] * ahead + ranked
    simple = attempt("saturation", 61.0)

    def inside(wide, *_):
        return [[simple.score]] if wide.score.shape.effect.contains else []

    monkeypatch.setattr(proposals, "contained_laws", inside)
    monkeypatch.setattr(proposals, "refit_look_alikes", lambda *_: [simple])
    monkeypatch.setattr(proposals, "compared", lambda context, stage, attempts: attempts)
    assert [one.name[0] for one in proposals.narrowed(None, None, ranked, None, None)] == expected


def test_a_law_knows_its_values_under_the_names_of_those_that_it_contains():
    limit = by_id("speed_force_limit")
    values = limit.named_values(np.array([2.0, 0.5, 1.0]))
    assert values == {"u0": 2.0, "c": 0.5, "form": 1.0, "limit": 2.0}
    assert np.array_equal(limit.widened(np.array([9.0, 0.5, 1.0]), {"limit": values["limit"]}), [2.0, 0.5, 1.0])


def test_a_law_begins_in_each_of_its_forms_at_its_own_place():
    def limit(form, place="u1"):
        one = score("speed_force_limit", place, 50.0)
        values = np.array([2.0, 1.0, form])
        return Score(
            Shape(one.shape.effect, one.shape.place, values, (values,), 1, SCALES), *list(vars(one).values())[1:]
        )

    ranked = (limit(1.0), limit(0.0, "u2"), limit(0.0), limit(1.0), limit(0.0))
    assert in_other_forms([ranked[0]], ranked) == [ranked[2]]
    assert in_other_forms([ranked[0], ranked[2]], ranked) == []


@pytest.mark.slow
def test_friction_that_takes_the_free_run_out_of_phase_begins_with_the_force_equation():
    # Scores along the linear model's run lead to a wrong size and nothing that holds.
    rng = np.random.default_rng([201, 21])
    system, h, samples = draws.random_system(rng, 1), 0.01, 1500
    level, mu = draws.log_uniform(rng, 0.3, 30.0), rng.uniform(0.05, 0.25)
    records = []
    for load in (1.0, 3.0, 1.0, 3.0):
        u = load * level * np.where(draws.steps(rng, samples) > 0, 1.0, -1.0)[:, None]
        y = simulate(system, u, h, [Effect("load_friction", "u1", {"mu": mu})])
        records.append(jaxgray.Record(u, y + rng.uniform(0.005, 0.02) * y.std() * rng.standard_normal(y.shape), h))
    laws = ["load_friction", "coulomb_friction"]
    found = jaxgray.diagnose(records[:2], validation=records[2:], only=laws)
    assert [(one.effect, one.location) for one in found.findings] == [
        ("load_friction", "u1")
    ] and found.verdict == "named"
    size = found.findings[0].parameters["mu"]
    assert abs(size.value - mu) < 4 * size.standard_error < 0.01
