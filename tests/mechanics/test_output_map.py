"""Models with coordinates that no output measures: simulation, responses, files."""

import numpy as np
import pytest
import scipy.signal

import jaxgray
from jaxgray.mechanics.effects import CATALOGUE
from jaxgray.mechanics.effects.base import Term, places_of
from jaxgray.mechanics.matrix_units import matrix_units
from jaxgray.mechanics.systems.drives import BaseAcceleration, Force
from jaxgray.report.documents.export import load, model_document, save
from jaxgray.report.exports.arrays import arrays_of

M = np.diag([2.0, 1.0, 0.5])
D = np.array([[3.0, -1.0, 0.0], [-1.0, 2.0, -0.5], [0.0, -0.5, 1.0]])
K = np.array([[300.0, -100.0, 0.0], [-100.0, 180.0, -80.0], [0.0, -80.0, 90.0]])
H = 0.01


def model_of(**options):
    return jaxgray.MechanicalModel(M, D, K, **({"hidden": 1} | options))


def system(rows, feed, E):
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros_like(E), np.linalg.solve(M, E)])
    return A, B, rows(A), feed(B)


def test_names_and_output_map():
    model = model_of()
    assert model.coordinates == ("y1", "y2", "h1") and model.hidden == ("h1",)
    assert (model.dofs, model.outputs, model.inputs) == (3, 2, 2)
    np.testing.assert_array_equal(model.output_map, np.eye(2, 3))
    assert "hidden   h1" in repr(model)
    assert model_of(hidden=["load"]).coordinates[-1] == "load"


@pytest.mark.parametrize("measured", ["displacement", "velocity", "acceleration"])
def test_simulation_is_that_of_scipy(measured):
    E = np.eye(3, 2)
    order = ["displacement", "velocity", "acceleration"].index(measured)
    rows = [
        lambda A: np.eye(2, 6),
        lambda A: np.eye(2, 6, 3),
        lambda A: A[3:5],
    ][order]
    own = system(rows, lambda B: B[3:5] if order == 2 else np.zeros((2, 2)), E)
    u = np.random.default_rng(0).standard_normal((200, 2))
    x0 = np.array([0.1, -0.2, 0.3, 1.0, 0.5, -1.0])
    wanted = scipy.signal.dlsim(scipy.signal.cont2discrete(own, H), u, x0=x0)[1]
    model = model_of(measured=measured)
    simulated = model.simulate(u, H, x0=x0)
    np.testing.assert_allclose(simulated, wanted, atol=1e-9 * np.max(np.abs(wanted)))
    if measured == "displacement":
        found = jaxgray.mechanics.runs.simulate.initial_state(model, u, wanted, H)
        np.testing.assert_allclose(found[0], x0, atol=1e-6)
    assert model.predict(u, wanted, H, force_noise_ratio=0.1).shape == (200, 2)


def test_frequency_response_modes_and_zeros_are_of_the_whole_system():
    model = model_of()
    omega = np.array([3.0, 11.0, 20.0])
    wanted = [np.linalg.inv(K + 1j * w * D - w**2 * M)[:2, :2] for w in omega]
    np.testing.assert_allclose(model.frequency_response(omega), wanted, rtol=1e-9)
    modes = model.modes()
    assert modes.mode_shapes.shape == (3, 3) and "(h1)" in repr(modes)
    # Both measured coordinates held still: the hidden mass on its own spring and damper.
    np.testing.assert_allclose(np.poly(model.zeros().values), [1.0, 2.0, 180.0], rtol=1e-8)


def test_a_force_on_a_hidden_coordinate_and_a_moving_base():
    model = model_of(drive=Force(np.array([[0.0], [0.0], [1.0]])), input_names=["torque"])
    w = 7.0
    wanted = np.linalg.inv(K + 1j * w * D - w**2 * M)[:2, 2:]
    np.testing.assert_allclose(model.frequency_response([w])[0], wanted, rtol=1e-9)
    base = model_of(drive=BaseAcceleration(np.ones((3, 1))), measured="acceleration")
    assert base.simulate(np.ones(20), H).shape == (20, 2)


@pytest.mark.parametrize("name", ["cubic_stiffness", "coulomb_friction", "hidden_mode"])
def test_effects_act_beside_hidden_coordinates(name):
    effect = next((e for e in CATALOGUE if e.id == name), None)
    if effect is None:
        pytest.skip(f"no effect {name}")
    place = places_of(effect, ("u1", "u2"), ("y1", "y2"))[0]
    values = np.full(len(effect.parameters), 1e-9)
    u = np.random.default_rng(0).standard_normal((60, 2))
    model = model_of()
    moved = model_of(effects=(Term(effect, place, values),))
    np.testing.assert_allclose(moved.simulate(u, H), model.simulate(u, H), atol=1e-6)


@pytest.mark.parametrize("ending", [".json", ".npz"])
def test_files_keep_hidden_coordinates(tmp_path, ending):
    model = model_of(hidden=["load"], output_names=["a", "b"])
    path = tmp_path / f"model{ending}"
    save(model, path)
    found = load(path)
    assert found.hidden == ("load",) and found.coordinates == ("a", "b", "load")
    np.testing.assert_array_equal(found.stiffness, model.stiffness)
    assert model_document(model)["coordinates"] == ["a", "b", "load"]
    assert "hidden" not in model_document(jaxgray.MechanicalModel(M, D, K))


def test_exports_have_all_states_and_the_measured_outputs():
    arrays = arrays_of(model_of(), H, "zero", False)
    assert arrays.A.shape == (6, 6) and arrays.C.shape == (2, 6) and arrays.states[2] == "h1"
    units = matrix_units(model_of(input_units=["N", "N"], output_units=["m", "m"]))
    assert units["mass"][2][2] == "N s^2/m"


@pytest.mark.parametrize(
    "options, message",
    [
        ({"hidden": 3}, "leaves no coordinate of 3 for an output"),
        ({"hidden": -1}, "hidden=-1 is not understood"),
        ({"hidden": "h1"}, "hidden='h1' is not understood"),
        ({"hidden": ["y1"]}, "repeats a name"),
        ({"output_names": ["a", "b", "c"]}, "has 3 entries, not 2"),
        ({"measured": ["displacement"] * 3}, "for each of the 2 measured coordinates"),
    ],
)
def test_what_does_not_fit_is_said(options, message):
    with pytest.raises(ValueError, match=message):
        model_of(**options)


def test_other_programs_simulate_the_measured_outputs(tmp_path):
    model = model_of(input_units=["N", "N"], output_units=["m", "m"])
    u = np.random.default_rng(0).standard_normal((50, 2))
    wanted = model.simulate(u, H)
    sampled = jaxgray.to_scipy(model, sampling_time=H)
    found = scipy.signal.dlsim(sampled, u)[1]
    np.testing.assert_allclose(found, wanted, atol=1e-10 * np.max(np.abs(wanted)))
    for ending in ("xml", "h", "mat"):
        jaxgray.export(model, tmp_path / f"model.{ending}", sampling_time=H)
    assert 'joint name="h1"' in (tmp_path / "model.xml").read_text()
