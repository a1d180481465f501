"""A body that nothing holds, moved by a controller: its encoder counts from anywhere, and no motion dies away."""

from types import SimpleNamespace

import pytest
from servo_axis import MASS, NOISE, axis, friction

import jaxgray
from jaxgray.diagnosis.model import free_run as held_out
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.model.candidate import Data
from jaxgray.diagnosis.model.free_run import free_run
from jaxgray.diagnosis.model.simulator import Simulator
from jaxgray.diagnosis.search import parts

LAWS = ("coulomb_friction", "quadratic_drag", "input_delay", "constant_force", "sine_stiffness")
SENSORS = ("sensor_offset", "sensor_drift", "sensor_lag")


def laws_in(diagnosis):
    return [{member.effect for member in one.members} for one in diagnosis.findings if one.stage == "model"]


def floor_of(diagnosis):
    (floor,) = diagnosis.noise_floor.values()
    return floor


@pytest.mark.parametrize("seed, zero, damping", [(1, 0.0, 0.0), (2, 5.0, 0.0), (3, -3.0, 0.2), (4, 0.0, 0.4)])
def test_an_axis_without_friction_leaves_noise_wherever_its_encoder_counts_from(seed, zero, damping):
    found = jaxgray.diagnose(axis(seed, zero=zero, damping=damping), only=LAWS + SENSORS)
    assert (found.verdict, laws_in(found)) == ("noise", [])
    # Neither the zero of the encoder nor what a first velocity makes of the held-out data counts as noise.
    assert floor_of(found) == pytest.approx(NOISE, rel=0.1)


@pytest.mark.parametrize("seed, zero", [(11, 0.0), (12, 2.5), (13, -6.0)])
def test_friction_of_such_an_axis_is_found(seed, zero):
    record = axis(seed, zero=zero, damping=0.1, law=friction(0.02))
    found = jaxgray.diagnose(record, only=LAWS + SENSORS)
    assert laws_in(found) == [{"coulomb_friction"}] and found.verdict == "named"
    assert floor_of(found) == pytest.approx(NOISE, rel=0.15)
    size = found.findings[-1].parameters["Fc"]
    assert size.value == pytest.approx(0.02, abs=4 * size.standard_error)


def test_a_constant_force_on_it_is_no_spring_that_is_stretched_for_miles():
    found = jaxgray.diagnose(axis(26, zero=-3.1, law=lambda q, v: 0.01), only=LAWS + SENSORS)
    # A zero that wanders faster and faster looks the same.
    (law,) = laws_in(found)
    assert "constant_force" in law and law <= {"constant_force", "sensor_drift", "sensor_offset"}
    assert floor_of(found) == pytest.approx(NOISE, rel=0.1)


@pytest.mark.parametrize(
    "left, laws, unexplained, begun",
    [
        ((True, False), ("model", "record"), False, "as given"),
        ((True, True), ("model",), False, "anywhere"),
        ((True, False), ("model",), True, "anywhere"),
        ((True, False), ("record",), False, "anywhere"),
        ((False, False), ("model",), False, "anywhere"),
    ],
)
def test_laws_of_position_may_tell_where_the_encoder_has_its_zero(monkeypatch, left, laws, unexplained, begun):
    """Searched from the model that may stand anywhere and, where that leaves more than noise, from the one with the
    offset that was fitted: laws of that one count if they mend the model and leave nothing."""
    states = {
        "anywhere": SimpleNamespace(accepted=[], unexplained=False, stage=SimpleNamespace(e=left[0])),
        "as given": SimpleNamespace(
            accepted=[SimpleNamespace(stage=one) for one in laws],
            unexplained=unexplained,
            stage=SimpleNamespace(e=left[1]),
        ),
    }
    starts = {name: SimpleNamespace(entries=(), name=name) for name in states}
    monkeypatch.setattr(parts, "without_free_offset", lambda context, start: starts["anywhere"])
    monkeypatch.setattr(parts, "select_forward", lambda context, start, most, **more: states[start.name])
    monkeypatch.setattr(parts, "more_than_noise", lambda e, data: e)
    context = SimpleNamespace(data=[SimpleNamespace(samples=100)], first_trials=None)
    state, _ = parts.search(context, SimpleNamespace(start=starts["as given"]), 3)
    assert state is states[begun]


def linear(stiffness, record):
    """A simulator of a mass on a spring, and the model at the true mass."""
    model = jaxgray.MechanicalModel([[MASS]], [[0.0 if stiffness == 0.0 else 1.0]], [[stiffness]])
    baseline = baseline_of([record], None, model)
    return Simulator(baseline.setup, ()), baseline.start


def test_the_head_is_as_long_as_the_motion_remembers():
    record = axis(7, samples=1200)
    data, kept = Data.of(record), []
    for stiffness in (0.0, 100.0):
        simulator, start = linear(stiffness, record)
        run = free_run(simulator, start, data)
        kept.append(int(run.kept.sum()))
        if stiffness == 0.0:
            assert run.rmse == pytest.approx([NOISE], rel=0.15)
    assert kept[1] == 1200 - int(held_out.HEAD * 1200)
    assert 0.5 * 1200 <= kept[0] < 0.8 * 1200
