"""The commands around the diagnosis, with a diagnosis made by hand in place of the computation."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from independent import REFERENCE
from made_diagnosis import diagnosis, equivalent, experiment

import jaxgray
from jaxgray import demonstration_effects as effects
from jaxgray.cli import main
from jaxgray.diagnosis.findings import Estimate, Finding, ParameterShift

CHANNELS = ["--inputs", "u1,u2", "--outputs", "y1,y2"]
MATRICES = {"mass": [[2, 0], [0, 1]], "damping": [[3, 0], [0, 1]], "stiffness": [[100, -5], [-5, 100]]}


def strict(text):
    """JSON without NaN and infinity, which Python would read."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def run(*argv):
    assert main([str(one) for one in argv]) == 0


def fails(capsys, argv, *texts):
    """The command blames its arguments in one line that says these texts."""
    assert main([str(one) for one in argv]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1, said.err
    for text in texts:
        assert text in said.err, said.err


@pytest.fixture
def asked(monkeypatch):
    """What `diagnose` was asked; it answers with `asked.answer`."""
    asked = SimpleNamespace(answer=diagnosis())

    def diagnose(record, **options):
        asked.record, asked.options = record, options
        return asked.answer

    monkeypatch.setitem(sys.modules, "jaxgray.diagnosis.diagnose", SimpleNamespace(diagnose=diagnose))
    return asked


@pytest.fixture
def model(tmp_path):
    """The way to write a model file."""

    def write(**changes):
        path = tmp_path / "model.json"
        path.write_text(json.dumps(MATRICES | changes))
        return path

    return write


def test_diagnose_holds_out_the_last_part_by_itself(asked, records, capsys):
    options = ["--max-effects", "2", "--seed", "3", "--budget", "60"]
    run("diagnose", records[0], *CHANNELS, "--only", "coulomb_friction, end_stop", *options)
    said = capsys.readouterr()
    assert said.err == "" and said.out.splitlines()[0] == asked.answer.sentence
    assert asked.record.samples == 2000
    names = ("validation", "model", "only", "exclude", "max_effects", "budget", "seed")
    chosen = {name: asked.options[name] for name in names}
    assert chosen == {
        "validation": None,
        "model": None,
        "only": ("coulomb_friction", "end_stop"),
        "exclude": None,
        "max_effects": 2,
        "budget": 60.0,
        "seed": 3,
    }
    assert asked.options["holdout"] == 0.3 and asked.options["excitation"] == "force"
    run("diagnose", records[0], *CHANNELS, "--holdout", "0.5", "--quiet", "--exclude", "end_stop")
    assert asked.options["holdout"] == 0.5 and asked.options["exclude"] == ("end_stop",)
    assert capsys.readouterr().out == ""


def test_diagnose_writes_json_figures_and_the_experiment(asked, records, tmp_path, capsys):
    asked.answer = equivalent()
    target, csv = tmp_path / "out.json", tmp_path / "next.csv"
    options = ["--validation", records[1], "--json", target, "--figures", tmp_path / "drawn", "--experiment", csv]
    options += ["--report", tmp_path / "out.html"]
    run("diagnose", records[0], *CHANNELS, *options)
    assert asked.options["validation"].samples == 2000
    found = strict(target.read_text())
    assert (found["schema"], found["verdict"]) == ("jaxgray/diagnosis/1", "equivalent")
    assert (tmp_path / "drawn" / "extension.png").read_bytes().startswith(b"\x89PNG")
    assert {one.stem for one in (tmp_path / "drawn").iterdir()} >= {"extension", "spectrum", "ranking", "error_budget"}
    assert equivalent().sentence in (tmp_path / "out.html").read_text()
    table = np.loadtxt(csv, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 1:], experiment().input)
    assert csv.read_text().startswith("time [s],u1 [N],u2 [N]\n")
    assert "next experiment" in capsys.readouterr().out


def test_no_experiment_is_said_and_not_written(asked, records, tmp_path, capsys):
    run("diagnose", records[0], *CHANNELS, "--experiment", tmp_path / "next.csv", "--json", "-")
    said = capsys.readouterr()
    assert strict(said.out)["warnings"][0].endswith("no experiment to propose.")
    assert "next.csv is not written" in said.err and not (tmp_path / "next.csv").exists()


def test_the_users_own_model_takes_the_names_of_the_record(asked, records, model, tmp_path):
    run("diagnose", records[0], *CHANNELS, "--model", model(), "--quiet")
    given = asked.options["model"]
    np.testing.assert_array_equal(given.stiffness, MATRICES["stiffness"])
    assert given.input_units == ("N", "N") and given.output_units == ("m", "m")
    inner = {"schema": "jaxgray/diagnosis/1", "baseline": {"model": MATRICES}, "extended": None}
    path = tmp_path / "result.json"
    path.write_text(json.dumps(inner))
    run("diagnose", records[0], *CHANNELS, "--model", path, "--quiet", "--input-map", "u1:y1-y2,u2:y2")
    np.testing.assert_array_equal(asked.options["model"].drive.input_map, [[1, 0], [-1, 1]])


def test_a_given_model_keeps_its_effects(asked, records, model):
    stop = {"effect": "end_stop", "location": "a-b", "parameters": {"ks": 30.0, "gap": 0.1}}
    run("diagnose", records[0], *CHANNELS, "--model", model(effects=[stop], output_names=["a", "b"]), "--quiet")
    given = asked.options["model"]
    assert given.output_names == ("y1", "y2") and [one.effect.id for one in given.effects] == ["end_stop"]
    np.testing.assert_array_equal(given.effects[0].values, [30.0, 0.1])


@pytest.mark.parametrize(
    "changes, options, texts",
    [
        ({"mass": [[1]], "damping": [[1]], "stiffness": [[1]]}, [], ("1 coordinates", "names 2")),
        ({"input_map": [[1], [0]]}, [], ("1 inputs", "names 2")),
        ({"input_map": [[1, 0], [0, 1]]}, ["--input-map", "u1:y1,u2:y2"], ("--input-map",)),
        ({"output_names": ["y2", "y1"]}, [], ("y2, y1", "order")),
        ({"output_units": ["mm", "mm"]}, [], ("mm", "convert")),
        ({"measured": ["acceleration"] * 2}, [], ("--measured acceleration,acceleration",)),
        ({"stiffness": None}, [], ("stiffness",)),
        ({}, ["--fix", "mass[0,0]=2"], ("--fix", "--model")),
    ],
    ids=["coordinates", "inputs", "map twice", "order", "units", "measured", "missing", "fix"],
)
def test_models_that_do_not_fit(asked, capsys, records, model, changes, options, texts):
    fails(capsys, ["diagnose", records[0], *CHANNELS, "--model", model(**changes), *options], *texts)


@pytest.mark.parametrize(
    "options, texts",
    [
        (["--only", "coulomb_fricton"], ("--only", "did you mean coulomb_friction?")),
        (["--exclude", "end_stop,zzz"], ("--exclude", "zzz")),
        (["--only", "outliers"], ("--only", "finding on the record")),
        (["--only", ","], ("--only", "empty")),
        (["--max-effects", "-1"], ("--max-effects",)),
        (["--max-effects", "few"], ("--max-effects",)),
        (["--budget", "0"], ("--budget",)),
        (["--budget", "soon"], ("--budget",)),
        (["--seed", "-1"], ("--seed",)),
        (["--no-refine"], ("--no-refine",)),
        (["--model", "nowhere.json"], ("nowhere.json",)),
        (["--holdout", "2"], ("--holdout",)),
        (["--holdout", "0.2", "--validation", "x.csv"], ("--holdout", "--validation")),
        (["--experiment", "no/such/next.csv"], ("no/such",)),
    ],
)
def test_wrong_arguments(asked, capsys, records, options, texts):
    fails(capsys, ["diagnose", records[0], *CHANNELS, *options], *texts)


def test_effects_are_listed(capsys, tmp_path):
    run("effects")
    said = capsys.readouterr().out
    assert "  cubic_stiffness: f = k3·q³\n      parameters: k3 [force/length^3]\n" in said
    assert "mass_error" in said and "  outliers: " in said
    run("effects", "--json", tmp_path / "effects.json")
    assert strict((tmp_path / "effects.json").read_text())["schema"] == "jaxgray/effects/1"
    capsys.readouterr()
    fails(capsys, ["effects", "--json", tmp_path / "no" / "effects.json"], "create it first")


@pytest.fixture
def shown(monkeypatch):
    """`demo` with 300 samples, and a made diagnosis."""
    from jaxgray import demonstration

    monkeypatch.setattr(demonstration, "diagnose", lambda *_, **__: diagnosis())
    plain = demonstration.demonstrate
    monkeypatch.setattr(
        demonstration, "demonstrate", lambda effect, seed, progress: plain(effect, seed, samples=300, progress=progress)
    )
    return demonstration


def test_demo_writes_what_it_simulated(shown, tmp_path, capsys):
    run("demo", "--seed", "7", "--out", tmp_path / "new" / "demo")
    folder = tmp_path / "new" / "demo"
    said = capsys.readouterr().out
    made = shown.demonstrate("coulomb_friction", 7, progress=None)
    for name in ("estimation", "validation"):
        again = jaxgray.read_record(folder / f"{name}.csv", inputs=["u1", "u2"], outputs=["y1", "y2"])
        record = getattr(made, name)
        np.testing.assert_array_equal(again.u, record.u)
        np.testing.assert_array_equal(again.y, record.y)
        assert again.sampling_time == record.sampling_time
        assert again.input_units == ("N", "N") and again.output_units == ("m", "m")
    truth = strict((folder / "truth.json").read_text())
    np.testing.assert_array_equal(truth["stiffness"], REFERENCE["K"])
    assert truth["effects"] == [{"effect": "coulomb_friction", "location": "y1", "parameters": {"Fc": 0.2}}]
    assert strict((folder / "result.json").read_text())["schema"] == "jaxgray/diagnosis/1"
    assert made.diagnosis.sentence in (folder / "report.html").read_text()
    assert said.startswith("The linear model misses")
    for text in ("Coulomb friction at y1: Fc", "0.2412 ± 0.0023 N", "extended model", "3.390 ± 0.010", "noisy output"):
        assert text in said
    assert "published" not in said and "without being there" not in said
    run("demo", "--seed", "7", "--quiet")
    assert capsys.readouterr().out == ""


def test_demo_says_what_was_missed_and_what_is_not_there(shown, capsys):
    run("demo", "--effect", "play_hysteresis")
    said = capsys.readouterr().out
    assert "play hysteresis at u2: w   0.1, 0.08, 0.06" in said and said.count("not found") == 2
    assert "found without being there: Coulomb friction at y1" in said
    run("demo", "--effect", "none")
    assert "published" in capsys.readouterr().out


def test_demo_of_other_effects(capsys):
    fails(capsys, ["demo", "--effect", "coulomb_frictio"], "did you mean coulomb_friction?", "end_stop")
    fails(capsys, ["demo", "--effect", "gyroscopic_coupling"], "gyroscopic_coupling", "sensor_offset, none")
    fails(capsys, ["demo", "--seed", "-1"], "seed")


def held_apart(one, u):
    """Outputs of the demonstrated system by an adaptive integrator, restarted at every change of the input."""
    M, D, K = REFERENCE.values()
    inverse, step, i = np.linalg.inv(M), effects.SAMPLING_TIME, int(one.location[1]) - 1
    law = effects.LAWS.get(one.effect)
    if one.effect == "coulomb_friction":
        law = lambda p, q, v, t: p["Fc"] * np.tanh(v / 2e-6)  # noqa: E731

    def rate(t, z, push):
        f = push - D @ z[2:] - K @ z[:2]
        if law is not None:
            f[i] -= law(one.parameters, z[i], z[2 + i], t)
        return np.concatenate([z[2:], inverse @ f])

    z, y = np.zeros(4), np.empty((len(u), 2))
    for k in range(len(u)):
        y[k] = z[:2]
        parts = [(0.0, step, u[k])]
        if one.effect == "input_delay":
            late = [np.array([u[max(k - m, 0), 0], u[k, 1]]) for m in (3, 2)]
            parts = [(0.0, step / 2, late[0]), (step / 2, step, late[1])]
        for first, last, push in parts:
            span = k * step + first, k * step + last
            z = scipy.integrate.solve_ivp(rate, span, z, "LSODA", args=(push,), rtol=1e-8, atol=1e-11).y[:, -1]
    return y


@pytest.mark.parametrize("id", ["none", "coulomb_friction", "cubic_stiffness", "end_stop", "input_delay"])
def test_the_demonstrated_motion(id):
    hidden = effects.hidden_of(id)
    u = 3.0 * effects.excitation(np.random.default_rng(2), 300, hidden)
    one = hidden[0] if hidden else effects.Hidden("none", "y1")
    np.testing.assert_allclose(effects.simulate(u[None], hidden)[0], held_apart(one, u), atol=2e-5)


def test_the_demonstrated_mode_is_an_added_mass_on_a_spring():
    hidden = effects.hidden_of("unmodelled_mode")
    p = hidden[0].parameters
    M, D, K = (scipy.linalg.block_diag(X, 0.0) for X in REFERENCE.values())
    omega, mass = 2 * np.pi * p["frequency_hz"], p["mass_ratio"] * M[0, 0]
    link = np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    M[2, 2] = mass
    D, K = D + 2 * p["damping_ratio"] * omega * mass * link, K + omega**2 * mass * link
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.vstack([np.zeros((3, 2)), np.linalg.inv(M)[:, :2]])
    u = effects.excitation(np.random.default_rng(2), 1000, hidden)
    system = scipy.signal.cont2discrete((A, B, np.eye(2, 6), np.zeros((2, 2))), effects.SAMPLING_TIME)
    np.testing.assert_allclose(effects.simulate(u[None], hidden)[0], scipy.signal.dlsim(system, u)[1], atol=1e-10)


def test_every_demonstrated_effect_moves_the_outputs():
    u = effects.excitation(np.random.default_rng(2), 3000, effects.hidden_of("sensor_offset"))
    linear = effects.simulate(u[None], ())
    for id, one in effects.DEMONSTRATED.items():
        assert id == one.effect
        change = effects.simulate(u[None], (one,)) - linear
        assert np.sqrt(np.mean(change**2)) > effects.NOISE / 2, id


def test_public_names():
    assert {"diagnose", "Diagnosis", "CATALOGUE", "save", "load"} <= set(jaxgray.__all__)
    assert jaxgray.Diagnosis is type(diagnosis()) and len(jaxgray.CATALOGUE) > 30
    assert jaxgray.load.__module__ == jaxgray.save.__module__ == "jaxgray.report.documents.export"


SIMULATOR = """
def simulate(u, w, numbers):
    return numbers["gain"] * u[:, :1]
"""


def test_a_simulator_comes_from_a_file_with_its_numbers(asked, tmp_path, records):
    program = tmp_path / "bench_simulator.py"
    program.write_text(SIMULATOR)
    run("diagnose", records[0], *CHANNELS, "--simulator", f"{program}:simulate", "--parameters", "gain=2, loss=1e-3")
    assert asked.options["parameters"] == {"gain": 2.0, "loss": 0.001} and asked.options["workers"] == 1
    assert asked.options["simulator"](np.ones((3, 2)), None, {"gain": 2.0}).tolist() == [[2.0]] * 3
    assert "structure" not in asked.options and "excitation" not in asked.options


PENDULUM = """<mujoco><option timestep="{step}"/><worldbody>
<body name="rod"><joint name="y1" axis="0 1 0" damping="0.1"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
<body name="tip" pos="0 0 -0.3"><joint name="y2" axis="0 1 0" damping="0.2"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/></body></body></worldbody>
<actuator><motor name="u1" joint="y1"/><motor name="u2" joint="y2"/></actuator></mujoco>"""


def test_a_model_of_mujoco_is_judged_and_written_with_what_was_found(asked, capsys, tmp_path, records):
    pytest.importorskip("mujoco")
    program, out = tmp_path / "arm.xml", tmp_path / "mended.xml"
    program.write_text(
        PENDULUM.format(step=jaxgray.read_record(records[0], inputs=["u1"], outputs=["y1"]).sampling_time)
    )
    number = Finding("parameter_error", "y1.damping", "named", "model", (), {}, None, None)
    law = Finding("coulomb_friction", "y2", "named", "model", (), {"Fc": Estimate(0.03, 0.01, "N m")}, None, None)
    stop = Finding("end_stop", "y1", "named", "model", (), {}, None, None)
    shift = ParameterShift("y1.damping", 0.1, 0.15, 0.01)
    asked.answer = diagnosis(own_model=True, findings=(number, law, stop), shifts=(shift,))
    given = ["diagnose", records[0], *CHANNELS, "--simulator", program]
    run(*given, "--parameters", "y1.damping,y2.damping=0.25", "--mended", out)
    assert asked.options["parameters"] == {"y1.damping": 0.1, "y2.damping": 0.25}
    assert asked.options["simulator"].outputs == ("y1", "y2")
    assert "lacks end_stop at y1: MJCF has no attribute" in " ".join(capsys.readouterr().err.split())
    mended = jaxgray.MujocoSimulator(out, asked.record, ["y1.damping", "y2.damping", "y2.frictionloss"])
    assert mended.numbers == {"y1.damping": 0.15, "y2.damping": 0.2, "y2.frictionloss": 0.03}
    fails(capsys, [*given, "--parameters", "y1.colour"], "'y1.colour' is no number")
    fails(capsys, ["diagnose", records[0], *CHANNELS, "--mended", out], "--mended writes a model of MuJoCo")


def test_a_simulator_that_is_not_there_is_said_to_be(capsys, tmp_path, records):
    program = tmp_path / "other_simulator.py"
    program.write_text("raise RuntimeError('no licence')")
    diagnose = ["diagnose", records[0], *CHANNELS]
    fails(capsys, [*diagnose, "--simulator", "nowhere.py:simulate"], "nowhere.py:simulate", "such as robot.py:simulate")
    fails(capsys, [*diagnose, "--simulator", f"{program}:simulate"], "raised RuntimeError: no licence")
    program = tmp_path / "third_simulator.py"
    program.write_text(SIMULATOR)
    fails(capsys, [*diagnose, "--simulator", f"{program}:run"], "has no function run")
    given = [*diagnose, "--simulator", f"{program}:simulate"]
    fails(capsys, [*given, "--parameters", "gain"], "'gain'", "NAME=X")
    fails(capsys, [*given, "--workers", "0"], "--workers=0")
    fails(capsys, [*given, "--model", program], "--simulator and --model")
    fails(capsys, [*given, "--structure", "chain"], "--structure is about a model that is fitted")
    fails(capsys, [*given, "--input-map", "u1:y1"], "--input-map is about a model that is fitted")
    known = tmp_path / "select.py"
    known.write_text("def simulate(u, w, numbers):\n    return u\n")
    fails(capsys, [*diagnose, "--simulator", f"{known}:simulate"], "another module of the name select; rename")
    simulated = [*diagnose, "--simulated", CHANNELS[3]]
    fails(capsys, [*simulated, "--model", program], "--simulated is judged in the place of")
    fails(capsys, [*diagnose, "--simulated", ","], "--simulated is empty")
    fails(capsys, [*diagnose, "--parameters", "gain=1"], "--parameters are those of a simulator")
    fails(capsys, [*diagnose, "--simulator", "axis.fmu"], "an FMU needs the names of its inputs that are forces")
    fails(capsys, [*given, "--forces", "push"], "no other simulator takes --forces")
    fails(
        capsys, [*diagnose, "--simulator", "axis.fmu", "--forces", "push"], "give the input that is the force at each"
    )
