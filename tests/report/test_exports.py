"""A model in other programs: each export is simulated where it goes, and agrees with ours.

Tolerances are relative to the largest value of each output.
"""

import dataclasses
import re
import shutil
import subprocess

import control
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.io
import scipy.signal
from made_diagnosis import diagnosis

import jaxgray
from jaxgray.cli import main
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.systems.drives import BaseAcceleration, BaseDisplacement, Force
from jaxgray.report.documents.terms import term_of
from jaxgray.report.exports import EXPORTS

H, SAMPLES = 0.02, 250
AGREEMENT = 1e-10
SAMPLED = 1e-12
MUJOCO = 1e-7
M = np.array([[5.0, -1.0], [-1.0, 1.0]])
D = np.array([[5.0, -0.01], [-0.01, 1.0]])
K = np.array([[100.0, -5.0], [-5.0, 100.0]])
X0 = np.array([0.02, -0.01, 0.3, -0.1])


def term(id, place, **parameters):
    return term_of({"effect": id, "location": place, "parameters": parameters}, ("u1", "u2"), ("y1", "y2"))


CUBIC = term("cubic_stiffness", "y1", k3=1e4)
LINEAR_EFFECTS = (
    term("stiffness_error", "y1-y2", delta=3.0),
    term("gyroscopic_coupling", "y1-y2", g=0.5),
    term("unmodelled_mode", "y2", frequency_hz=3.0, damping_ratio=0.05, mass_ratio=0.2),
)
ONE = jnp.ones((2, 1))
MODELS = {
    "forces": MechanicalModel(M, D, K, measured=("displacement", "acceleration"), output_names=["y.1", "y[2]"]),
    "one force on two": MechanicalModel(M, D, K, drive=Force(jnp.array([[1.0], [-2.0]])), measured="velocity"),
    "base acceleration": MechanicalModel(M, D, K, drive=BaseAcceleration(ONE, True)),
    "base displacement": MechanicalModel(M, D, K, drive=BaseDisplacement(ONE), measured=("displacement", "velocity")),
    "linear effects": MechanicalModel(M, D, K, effects=LINEAR_EFFECTS),
    "fast and slow": MechanicalModel(1e-6 * M, 1e-3 * D, K),
}


def inputs(model, seed=0, samples=SAMPLES):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-1.0, 1.0], (samples // 10, model.inputs)), 10, axis=0)


def close(found, ours, tolerance=AGREEMENT):
    np.testing.assert_allclose(
        np.reshape(found, ours.shape) / np.max(np.abs(ours), 0), ours / np.max(np.abs(ours), 0), atol=tolerance
    )


def first(model, u0):
    """The continuous state that goes with (q, q̇), an added coordinate at rest."""
    q, v = np.split(X0, 2)
    if isinstance(model.drive, BaseDisplacement):
        v = v - np.linalg.solve(M, D) @ np.ones(2) * u0[0]
    rest = np.zeros(1 if model.effects else 0)
    return np.concatenate([q, rest, v, rest])


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_scipy_in_continuous_time(name, hold):
    model, u = MODELS[name], inputs(MODELS[name])
    system = jaxgray.to_scipy(model)
    assert isinstance(system, scipy.signal.StateSpace) and system.dt is None
    t = H * np.arange(SAMPLES)
    found = scipy.signal.lsim(system, u, t, X0=first(model, u[0]), interp=hold == "linear")[1]
    close(found, model.simulate(u, H, hold=hold, x0=X0))


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_scipy_sampled(name, hold):
    model, u = MODELS[name], inputs(MODELS[name])
    system = jaxgray.to_scipy(model, sampling_time=H, hold=hold)
    assert system.dt == H
    ours = model.simulate(np.concatenate([np.zeros((1, model.inputs)), u]), H, hold=hold)
    # At rest where the input begins with nothing, whatever the state holds of it.
    close(scipy.signal.dlsim(system, np.concatenate([np.zeros((1, model.inputs)), u]))[1], ours, SAMPLED)


@pytest.mark.parametrize("name", MODELS)
def test_python_control(name):
    model, u = MODELS[name], inputs(MODELS[name])
    t = H * np.arange(SAMPLES)
    system = jaxgray.to_control(model)
    assert isinstance(system, control.StateSpace) and system.isctime()
    found = control.forced_response(system, t, u.T, first(model, u[0]))
    close(np.atleast_2d(found.outputs).T, model.simulate(u, H, hold="linear", x0=X0))
    sampled = jaxgray.to_control(model, sampling_time=H)
    assert sampled.dt == H and sampled.input_labels == [f"u{k + 1}" for k in range(model.inputs)]
    assert sampled.output_labels == [one.replace(".", "_") for one in model.output_names]
    u[0] = 0
    close(np.atleast_2d(control.forced_response(sampled, t, u.T).outputs).T, model.simulate(u, H))


@pytest.mark.parametrize("name", MODELS)
def test_matlab(name, tmp_path):
    model, path = MODELS[name], tmp_path / "model.mat"
    jaxgray.export(model, path, sampling_time=H, hold="linear")
    found = scipy.io.loadmat(path, simplify_cells=True)
    u = inputs(model)
    B, Bd, D, Dd, Hd = (found[key].reshape(-1, model.inputs) for key in ("B", "Bd", "D", "Dd", "Hd"))
    t = H * np.arange(SAMPLES)
    ours = model.simulate(u, H, hold="linear", x0=X0)
    close(scipy.signal.lsim((found["A"], B, found["C"], D), u, t, X0=first(model, u[0]))[1], ours)
    start = X0 if not model.effects else np.insert(X0, [2, 4], 0.0)
    close(
        scipy.signal.dlsim((found["Ad"], Bd, found["Cd"], Dd, found["Ts"]), u, x0=start - Hd @ u[0])[1], ours, SAMPLED
    )
    assert list(found["output_names"]) == list(model.output_names)
    assert list(np.atleast_1d(found["input_names"])) == list(model.input_names)
    assert found["hold"] == "linear" and found["mass"].shape == (len(start) // 2,) * 2
    assert ("input_map" in found) == isinstance(model.drive, Force)
    if not model.effects:
        np.testing.assert_array_equal(found["damping"], model.damping)
    jaxgray.export(model, path)
    assert "Ad" not in scipy.io.loadmat(path)


IN_THE_MATLAB_LANGUAGE = """
load model.mat; load input.mat;
x = x0 - Hd * u(1, :)'; y = zeros(size(u, 1), size(Cd, 1));
for k = 1:size(u, 1)
  y(k, :) = Cd * x + Dd * u(k, :)'; x = Ad * x + Bd * u(k, :)';
end
assert(iscellstr(output_names) && ischar(hold)); save -v7 output.mat y output_names;
"""


@pytest.mark.skipif(not shutil.which("octave-cli"), reason="GNU Octave is not installed")
@pytest.mark.parametrize("name", MODELS)
def test_matlab_in_its_language(name, tmp_path):
    model, u = MODELS[name], inputs(MODELS[name])
    jaxgray.export(model, tmp_path / "model.mat", sampling_time=H, hold="linear")
    start = X0 if not model.effects else np.insert(X0, [2, 4], 0.0)
    scipy.io.savemat(tmp_path / "input.mat", {"u": u, "x0": start[:, None]})
    subprocess.run(["octave-cli", "--eval", IN_THE_MATLAB_LANGUAGE], cwd=tmp_path, check=True, timeout=60)
    found = scipy.io.loadmat(tmp_path / "output.mat", simplify_cells=True)
    close(found["y"], model.simulate(u, H, hold="linear", x0=X0), SAMPLED)
    assert list(found["output_names"]) == list(model.output_names)


PROGRAM = """
#include <stdio.h>
#include "{name}.h"
int main(void)
{{
    double x[{P}_STATES], u[{P}_INPUTS], y[{P}_OUTPUTS];
    const double q[{P}_STATES / 2] = {{0.02, -0.01}}, v[{P}_STATES / 2] = {{0.3, -0.1}};
    int i, begun = 0;
    for (;;) {{
        for (i = 0; i < {P}_INPUTS; i++)
            if (scanf("%lf", u + i) != 1) return 0;
        if (!begun) {p}_start(x, q, {rest} ? 0 : v, u);
        begun = 1;
        {p}_step(x, u, y);
        for (i = 0; i < {P}_OUTPUTS; i++) printf("%.17g ", y[i]);
        printf("\\n");
    }}
}}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("name", MODELS)
def test_c(name, tmp_path):
    model, hold = MODELS[name], "linear" if "base" in name else "zero"
    rest = name == "forces"
    jaxgray.export(model, tmp_path / "3-arm.h", sampling_time=H, hold=hold)
    text = PROGRAM.format(name="3-arm", p="model_3_arm", P="MODEL_3_ARM", rest=int(rest))
    (tmp_path / "main.c").write_text(text)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1"]
    subprocess.run(["cc", *strict, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    u = inputs(model)
    asked = "\n".join(" ".join(map(repr, row)) for row in u.tolist())
    said = subprocess.run([tmp_path / "main"], input=asked, capture_output=True, text=True, check=True).stdout
    x0 = np.where(np.arange(4) < 2, X0, 0.0) if rest else X0
    close(
        np.array([line.split() for line in said.splitlines()], float), model.simulate(u, H, hold=hold, x0=x0), SAMPLED
    )


def in_mujoco(path, u, x0, dofs, outputs, sampling_time=H):
    """Outputs of the file's sensors for inputs that are held."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    steps = round(float(model.numeric("steps_per_sample").data[0]))
    assert model.opt.timestep * steps == pytest.approx(sampling_time, rel=1e-12)
    data.qpos[:dofs], data.qvel[:dofs] = np.split(np.asarray(x0), 2)
    y = []
    for row in u:
        data.ctrl[:] = row
        mujoco.mj_forward(model, data)
        y.append(
            [
                data.joint(name).qacc[0] if kind == "acceleration" else data.sensor(name).data[0]
                for name, kind in outputs
            ]
        )
        for _ in range(steps):
            mujoco.mj_step(model, data)
    return np.array(y)


CHAIN = np.array([[3.0, -2.0, 0.0], [-2.0, 5.0, -3.0], [0.0, -3.0, 3.0]])
IN_MUJOCO = {
    "nested": MechanicalModel(M, D, K, measured=("displacement", "acceleration")),
    "one force on two": MODELS["one force on two"],
    "a chain of hinges": MechanicalModel(
        np.diag([0.5, 0.2, 0.3]), 0.05 * CHAIN + 0.1 * np.eye(3), 40 * CHAIN, output_units=["rad"] * 3,
        drive=Force(jnp.eye(3)[:, :1]), output_names=["motor", "gear & belt", "load"],
    ),
    "not dominant": MechanicalModel(np.eye(2), D, np.array([[100.0, 30.0], [30.0, 10.0]])),
    "a mode more": MechanicalModel(np.diag([5.0, 1.0]), D, K, effects=LINEAR_EFFECTS[2:]),
}  # fmt: skip


@pytest.mark.parametrize("name", IN_MUJOCO)
def test_mujoco(name, tmp_path):
    model, path = IN_MUJOCO[name], tmp_path / "model.xml"
    u = inputs(model, samples=100)
    x0 = 0.02 * np.cos(np.arange(2 * model.dofs))
    jaxgray.export(model, path, sampling_time=H)
    found = in_mujoco(path, u, x0, model.dofs, list(zip(model.output_names, model.measured)))
    close(found, model.simulate(u, H, x0=x0), MUJOCO)
    assert ("hinge" in path.read_text()) == ("hinges" in name)


def test_friction_in_mujoco_is_that_of_a_constraint(tmp_path):
    """MuJoCo holds a sticking joint by a soft constraint: agreement to 1 % of the motion that friction leaves."""
    friction = (term("coulomb_friction", "y1", Fc=0.4, eps=1e-4), term("coulomb_friction", "y1-y2", Fc=0.1, eps=1e-4))
    model = MechanicalModel(np.diag([5.0, 1.0]), D, K, effects=friction)
    path, u = tmp_path / "model.xml", inputs(model, samples=200)
    jaxgray.export(model, path, sampling_time=H)
    found = in_mujoco(path, u, np.zeros(4), 2, [("y1", "displacement"), ("y2", "displacement")])
    ours = model.simulate(u, H, substeps=64)
    close(found, ours, 0.01)
    free = dataclasses.replace(model, effects=()).simulate(u, H)
    assert np.max(np.abs(free - ours)) > 0.2 * np.max(np.abs(ours))


def test_mujoco_without_a_sampling_time_takes_a_step_of_its_own(tmp_path):
    jaxgray.export(IN_MUJOCO["nested"], tmp_path / "a.xml")
    step = float(re.search(r'timestep="([^"]+)"', (tmp_path / "a.xml").read_text())[1])
    fastest = np.max(np.abs(np.linalg.eigvals(jaxgray.to_scipy(IN_MUJOCO["nested"]).A)))
    assert step == pytest.approx(0.02 / fastest, rel=1e-6)


@pytest.mark.parametrize(
    "model, match",
    [
        (MODELS["base displacement"], "driven by its base, and MJCF knows forces"),
        (MechanicalModel(M, D, K, effects=(CUBIC,)), r"does not know \(cubic_stiffness at y1\); say linear"),
        (MechanicalModel(M, D, K, effects=LINEAR_EFFECTS[1:2]), "damping with the model's effects is not symmetric"),
        (MechanicalModel(M, -D, K), "damping has the eigenvalue -5"),
    ],
)
def test_what_mujoco_has_no_word_for(model, match, tmp_path):
    with pytest.raises(ValueError, match=match):
        jaxgray.export(model, tmp_path / "a.xml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", EXPORTS)
def test_effects_are_refused_or_left_out_by_order(ending, tmp_path):
    model = MechanicalModel(M, D, K, effects=(CUBIC,))
    path = tmp_path / f"model{ending}"
    with pytest.raises(ValueError, match="does not know .cubic_stiffness at y1."):
        jaxgray.export(model, path, sampling_time=H)
    jaxgray.export(model, path, sampling_time=H, linear=True)
    left = path.read_bytes()
    jaxgray.export(MechanicalModel(M, D, K), path, sampling_time=H)
    # A MAT file begins with the date.
    assert path.read_bytes()[128:] == left[128:]
    with pytest.raises(ValueError, match="does not know"):
        jaxgray.to_scipy(model)
    np.testing.assert_array_equal(jaxgray.to_scipy(model, linear=True).A, jaxgray.to_scipy(MechanicalModel(M, D, K)).A)


def test_our_own_formats_keep_effects_unless_told(tmp_path):
    model = MechanicalModel(M, D, K, effects=(*LINEAR_EFFECTS[:1], CUBIC))
    for ending in (".json", ".npz"):
        path = tmp_path / f"model{ending}"
        jaxgray.export(model, path)
        assert [one.effect.id for one in jaxgray.load(path).effects] == ["stiffness_error", "cubic_stiffness"]
        jaxgray.export(model, path, linear=True)
        linear = jaxgray.load(path)
        assert linear.effects == () and linear.stiffness[0, 1] == linear.stiffness[1, 0] == K[0, 1] + 3.0


def test_a_diagnosis_is_its_extended_model(tmp_path):
    found = diagnosis()
    jaxgray.save(found, tmp_path / "model.json")
    model = jaxgray.load(tmp_path / "model.json")
    np.testing.assert_array_equal(model.stiffness, found.extended.model.stiffness)
    assert len(model.effects) == len(found.extended.model.effects)
    jaxgray.export(found, tmp_path / "model.mat", linear=True)
    np.testing.assert_array_equal(scipy.io.loadmat(tmp_path / "model.mat")["mass"], found.extended.model.mass)


def test_wrong_arguments(tmp_path, monkeypatch):
    model = MODELS["forces"]
    with pytest.raises(ValueError, match="the ending '.docx' is not known; give one of .json, .npz, .mat, .xml, .h"):
        jaxgray.export(model, tmp_path / "a.docx")
    with pytest.raises(ValueError, match="sampling_time is missing, and C runs sample by sample"):
        jaxgray.export(model, tmp_path / "a.h")
    with pytest.raises(ValueError, match="hold='cubic'"):
        jaxgray.to_scipy(model, sampling_time=H, hold="cubic")
    with pytest.raises(ValueError, match="sampling_time is -1"):
        jaxgray.to_scipy(model, sampling_time=-1)
    with pytest.raises(ValueError, match="there is no model in a dict"):
        jaxgray.export({}, tmp_path / "a.mat")
    monkeypatch.setitem(__import__("sys").modules, "control", None)
    with pytest.raises(ImportError, match=r"needs python-control: pip install 'jaxgray\[control\]'"):
        jaxgray.to_control(model)


def test_the_command(tmp_path, capsys):
    model = MechanicalModel(M, D, K, effects=(CUBIC,))
    given = tmp_path / "model.json"
    jaxgray.save(model, given)
    target = tmp_path / "out.mat"
    assert main(["export", str(given), str(target)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: the model has effects") and "--linear" in said.err and not target.exists()
    assert main(["export", str(given), str(target), "--linear", "--sampling-time", "0.02"]) == 0
    assert capsys.readouterr().out == f"{target}: 2 coordinates, 2 inputs\n"
    assert scipy.io.loadmat(target)["Ts"] == H
    assert main(["export", str(given), str(tmp_path / "no" / "a.mat"), "--linear"]) == 2
    # The sampling time and the hold of the record that a result came from.
    document = jaxgray.report.documents.export.model_document(MODELS["forces"])
    result = {"model": document, "records": {"estimation": [{"sampling_time": 0.004, "hold": "linear"}]}}
    jaxgray.report.documents.export.write_json(result, given)
    assert main(["export", str(given), str(tmp_path / "a.h"), "--quiet"]) == 0
    text = (tmp_path / "a.h").read_text()
    assert "#define A_SAMPLING_TIME 0.004\n" in text and "is straight between samples" in text


def test_a_simulation_is_written_with_what_it_leaves(tmp_path):
    rng = np.random.default_rng(3)
    model = MechanicalModel(np.eye(1), 0.5 * np.eye(1), 20 * np.eye(1), output_names=("x",), output_units=("m",))
    u = rng.standard_normal((SAMPLES, 1))
    truth = model.simulate(u, H, x0=np.array([0.1, -0.2]))
    y = truth + 1e-3 * rng.standard_normal(truth.shape)
    y[7] = np.nan
    record = jaxgray.Record(u, y, H, output_names=("x",), output_units=("m",))
    jaxgray.write_simulation(model, record, tmp_path / "run.csv")
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", skip_header=1)
    header = (tmp_path / "run.csv").read_text().splitlines()[0]
    assert header == "time [s],x measured [m],x simulated [m],x residual [m]"
    np.testing.assert_array_equal(table[:, 1], y[:, 0])
    np.testing.assert_allclose(table[:, 2], truth[:, 0], atol=1e-3)
    np.testing.assert_array_equal(table[:, 3], table[:, 1] - table[:, 2])
    with pytest.raises(ValueError, match="is not there; create it first"):
        jaxgray.write_simulation(model, record, tmp_path / "no" / "run.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]
