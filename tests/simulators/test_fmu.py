"""A functional mock-up unit as a simulator: runs, numbers by name, what does not fit, and a diagnosis of it."""

import pathlib
import pickle

import numpy as np
import pendulum
import pytest

import jaxgray
from jaxgray.simulators import FmuSimulator

pytest.importorskip("fmpy")
pythonfmu = pytest.importorskip("pythonfmu")

H, SAMPLES = 0.01, 300
NAMES = {"input_names": ["torque"], "output_names": ["angle"]}


@pytest.fixture(scope="session")
def unit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    script = pathlib.Path(__file__).with_name("unit_pendulum.py")
    return pythonfmu.FmuBuilder.build_FMU(str(script), dest=folder)


def record_of(samples=SAMPLES, seed=1, **options):
    u = pendulum.torque(samples, np.random.default_rng(seed))
    return jaxgray.Record(u, np.zeros(samples), H, **NAMES, **options)


def test_a_run_is_that_of_the_same_equations(unit):
    record = record_of()
    simulator = FmuSimulator(unit, record, ["push"])
    assert simulator.numbers == pendulum.TRUTH
    w = 0.2 * np.sin(np.arange(SAMPLES))[:, None]
    made = simulator(record.u, w, {"gravity": 1.9})
    wanted = pendulum.run(record.u[:, 0] + w[:, 0], pendulum.TRUTH | {"gravity": 1.9})
    np.testing.assert_allclose(made[:, 0], wanted, atol=1e-9)
    again = pickle.loads(pickle.dumps(simulator))
    np.testing.assert_array_equal(again(record.u, w, {"gravity": 1.9}), made)


def test_inputs_on_straight_lines_are_means_over_parts_of_a_sample(unit):
    record = record_of(hold="linear")
    made = FmuSimulator(unit, record, ["push"])(record.u, 0 * record.u, {})
    fine = np.interp((np.arange(10 * SAMPLES) + 0.5) / 10, np.arange(SAMPLES), record.u[:, 0])
    wanted = pendulum.run(fine, pendulum.TRUTH, h=H / 10)[::10]
    np.testing.assert_allclose(made[:, 0], wanted, atol=1e-9)


@pytest.mark.parametrize(
    "change, said",
    [
        (
            {"forces": ["pull"]},
            "no variable 'pull'; inputs and forces are named as its .*; (did you mean|it has)",
        ),
        ({"forces": ["angle"]}, "'angle' is no input of it"),
        ({"forces": []}, "give the input that is the force at each of them"),
        ({"numbers": ["gravty"]}, "did you mean 'gravity'"),
        ({"numbers": ["angle"]}, "is no floating-point parameter with a start value"),
    ],
)
def test_what_does_not_fit_is_named(unit, change, said):
    with pytest.raises(ValueError, match=said):
        FmuSimulator(unit, record_of(), **{"forces": ["push"]} | change)


def test_a_file_that_is_no_unit_is_named(tmp_path):
    path = tmp_path / "no.fmu"
    path.write_text("nothing")
    with pytest.raises(ValueError, match="FMPy does not read it"):
        FmuSimulator(path, record_of(), ["push"])


@pytest.mark.slow
def test_a_unit_is_judged_as_the_same_equations_are(unit):
    rng = np.random.default_rng(5)
    u = pendulum.torque(1500, rng)
    q = pendulum.run(u, pendulum.TRUTH, pendulum.cubic, 0.2)
    record = jaxgray.Record(u, q + 0.003 * q.std() * rng.standard_normal(len(u)), H, **NAMES)
    numbers = pendulum.off(rng)
    simulator = FmuSimulator(unit, record, ["push"], numbers)
    laws = ["cubic_stiffness", "quadratic_drag", "input_delay"]
    found, same = (
        jaxgray.diagnose(record, simulator=one, parameters=numbers, only=laws)
        for one in (simulator, pendulum.simulator)
    )
    told = [[(f.effect, f.location) for f in one.findings] for one in (found, same)]
    assert told[0] == told[1] and ("cubic_stiffness", "angle") in told[0]
    for one, other in zip(found.shifts, same.shifts):
        assert one.after == pytest.approx(other.after, rel=1e-4)
