"""Laws that can imitate one another: one that went astray is begun where the other ended."""

import zlib
from types import SimpleNamespace

import hidden
import numpy as np
import pytest
from found import check_found, diagnosed

import jaxgray
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.simulator import Simulator
from jaxgray.diagnosis.screening.features import Shape
from jaxgray.diagnosis.starts.force_matching import _left, imitating
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place, Scales, Term

SPRINGS = ["cubic_stiffness", "sine_stiffness"]


def spring(effect, seed, number):
    """A record of a campaign."""
    rng = np.random.default_rng([seed, 0, zlib.crc32(effect.encode()), number])
    return hidden.random_case(rng, effect, excess=(1.5, 4.0), samples=4000, dofs=(1, 2, 3))


@pytest.mark.slow
def test_a_law_that_went_astray_is_begun_where_one_ended_that_it_can_imitate():
    # A spring that softens to nothing: from the linear model a cubic one ends far behind a sine, which stays bounded.
    case = spring("cubic_stiffness", 92001, 2)
    diagnosis = diagnosed(case, only=SPRINGS)
    assert [f.effect for f in diagnosis.findings] == ["cubic_stiffness"], str(diagnosis)
    check_found(case, diagnosis)


@pytest.mark.parametrize("length, said", [(3.0, True), (0.8, False)])
def test_within_a_small_angle_a_sine_is_a_cubic_spring(length, said):
    scales = Scales(0.5, 1.0, 1.0, 2.0, (0.1, 0.5), 1.0, 1.0, (0.1, 0.5), 1.0, 1.0, 0.01, 10.0, (1.0,))
    why = by_id("sine_stiffness").unresolved(np.array([1.0, length]), scales)
    assert (why == "in 0.33 rad it is a cubic spring") if said else why is None


def test_what_a_cubic_spring_leaves_of_a_sine_is_of_fifth_order():
    angle = 0.5 * np.sin(np.linspace(0, 20, 500))
    left, (line, cube) = _left(np.stack([angle, angle**3]), np.sin(angle))
    assert line == pytest.approx(1.0, abs=1e-3) and cube == pytest.approx(-1 / 6, rel=0.05)
    assert left < 1e-3 * np.linalg.norm(np.sin(angle))


def test_a_law_begins_where_it_is_the_other_one_and_where_it_differs_most_but_can_imitate_it():
    cubic, sine, place = by_id("cubic_stiffness"), by_id("sine_stiffness"), Place("y1", 0)
    time = 0.05 * np.arange(600)
    record = jaxgray.Record(8.0 * np.sin(2.0 * time)[:, None], np.sin(2.0 * time)[:, None], 0.05)
    names = {"input_names": record.input_names, "output_names": record.output_names}
    model = jaxgray.MechanicalModel(np.array([[1.0]]), np.array([[2.0]]), np.array([[40.0]]), **names)
    baseline = baseline_of([record], None, model)
    simulator, data = Simulator(baseline.setup, (cubic, sine)), Data.of(record)
    candidate = baseline.start.with_terms((Term(cubic, place, np.array([-2.0])),))
    most = np.max(np.abs(simulator.motion(candidate, data)[0]))

    def shape(length):
        values = np.array([1.0, length * most])
        return Shape(sine, place, values, (values,), 1, SimpleNamespace())

    context = SimpleNamespace(simulator=simulator, data=[data])
    near, apart = imitating(context, candidate, (0,), [shape(length) for length in (0.1, 0.5, 4.0, 1.0)])
    lengths = [float(start.candidate.terms[-1].values[1]) / most for start in (near, apart)]
    assert (
        lengths == pytest.approx([4.0, 0.5]) and near.left < apart.left < 0.2 and (near.number, apart.number) == (2, 1)
    )
    for start in (near, apart):
        # Of the spring that softens, and of what it leaves to the linear one, the sum is as stiff about rest.
        k, length = start.candidate.terms[-1].values
        before, now = (float(baseline.setup.matrices(c.entries)[2][0, 0]) for c in (candidate, start.candidate))
        assert now + k / length == pytest.approx(before, rel=0.1)
    assert imitating(context, candidate, (0,), [shape(0.1)]) == []
    # Two of them, between which another law stands, as their sum.
    (cubed,) = candidate.terms
    friction = Term(by_id("coulomb_friction"), place, np.array([0.1, 1e-3]))
    half = Term(cubic, place, cubed.values / 2)
    both = imitating(context, candidate.with_terms((half, friction, half)), (0, 2), [shape(0.5)])
    assert [term.effect.id for term in both[0].candidate.terms] == ["coulomb_friction", "sine_stiffness"]
    assert both[0].candidate.terms[-1].values == pytest.approx(apart.candidate.terms[-1].values, rel=0.1)
