"""A model of MuJoCo as a simulator: runs, numbers by name, what is written back, what does not fit."""

import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

import jaxgray
from jaxgray.simulators import MujocoSimulator

mujoco = pytest.importorskip("mujoco")

H, SAMPLES = 0.01, 400
ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="upper"><joint name="shoulder" type="hinge" axis="0 1 0" damping="{damping}" armature="0.02"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
<body name="lower" pos="0 0 -0.3"><joint name="elbow" type="hinge" axis="0 1 0" damping="0.2" armature="0.01"
 stiffness="0.5" frictionloss="{friction}"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/></body></body></worldbody>
<actuator><motor name="m2" joint="elbow" gear="2"/><motor name="m1" joint="shoulder"/></actuator></mujoco>"""
NAMES = {"input_names": ["m1", "m2"], "output_names": ["shoulder", "elbow"]}


def torques(samples, seed, highest=3.0):
    sections = scipy.signal.butter(4, 2 * H * highest, output="sos")
    u = scipy.signal.sosfilt(sections, np.random.default_rng(seed).standard_normal((samples, 2)), axis=0)
    return u / u.std(axis=0) * [1.2, 0.2]


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(damping=0.4, friction=0.0))
    u = torques(SAMPLES, 1)
    y = np.zeros((SAMPLES, 2))
    y[0] = 0.3, -0.1
    return path, jaxgray.Record(u, y, H, **NAMES)


def stepped(path, record, w, hold):
    """The same by steps of one's own."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = record.y[0]
    found = []
    for k, (u, force) in enumerate(zip(record.u, w)):
        found.append(data.qpos.copy())
        later = [min(k + 1, len(w) - 1)]
        for step in range(5):
            share = (step + 0.5) / 5 if hold == "linear" else 0.0
            now = u + share * (record.u[later[0]] - u)
            data.ctrl[:] = now[1], now[0]
            data.qfrc_applied[:] = force + share * (w[later[0]] - force)
            mujoco.mj_step(model, data)
    return np.array(found)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_run_is_that_of_the_model(arm, hold):
    path, record = arm
    record = dataclasses.replace(record, hold=hold)
    simulator = MujocoSimulator(path, record)
    w = 0.1 * np.random.default_rng(2).standard_normal((SAMPLES, 2))
    y = simulator(record.u, w, simulator.numbers)
    np.testing.assert_allclose(y, stepped(path, record, w, hold), atol=1e-9)
    again = pickle.loads(pickle.dumps(simulator))
    np.testing.assert_array_equal(again(record.u, w, simulator.numbers), y)


def test_numbers_have_names(arm):
    path, record = arm
    known = {"shoulder.damping": 0.4, "shoulder.armature": 0.02, "elbow.damping": 0.2, "elbow.armature": 0.01}
    added = {"shoulder.frictionloss": 0.0, "elbow.frictionloss": 0.0}
    assert MujocoSimulator(path, record).numbers == known | added | {"elbow.stiffness": 0.5}
    some = MujocoSimulator(path, record, ["lower.mass", "m2.gear", "elbow.frictionloss"])
    assert some.numbers == {"lower.mass": 0.6, "m2.gear": 2.0, "elbow.frictionloss": 0.0}
    assert MujocoSimulator(path, record, {"lower.mass": 0.5}).numbers == {"lower.mass": 0.5}
    for number in some.numbers:
        as_given, more = (some(record.u, 0 * record.u, {number: some.numbers[number] + x}) for x in (0.0, 0.05))
        assert np.max(np.abs(more - as_given)) > 1e-4, number
    heavier = some.changed({"lower.mass": 1.2})
    assert heavier.body("lower").inertia[0] == pytest.approx(2 * some.model.body("lower").inertia[0])
    assert some.model.body("lower").mass[0] == 0.6, "the model that was given stays as it is"


def test_a_payload_is_a_point_mass_at_a_site(arm, tmp_path):
    path, record = arm
    text = path.read_text()
    site = '<site name="flange" pos="0.04 0.01 -0.25"/></body></body>'
    path.write_text(text.replace("</body></body>", site))
    loaded = tmp_path / "loaded.xml"
    point = '<geom type="sphere" size="0.001" pos="0.04 0.01 -0.25" mass="0.15" contype="0" conaffinity="0"/>'
    loaded.write_text(text.replace("</body></body>", f"{point}</body></body>"))
    simulator, none = MujocoSimulator(path, record), 0 * record.u
    assert simulator.numbers["flange.payload"] == 0.0
    expected = MujocoSimulator(loaded, record)(record.u, none, {})
    made = simulator(record.u, none, {"flange.payload": 0.15})
    assert np.max(np.abs(simulator(record.u, none, {}) - made)) > 0.01
    np.testing.assert_allclose(made, expected, atol=1e-5)
    found = SimpleNamespace(
        shifts=[SimpleNamespace(name="flange.payload", after=0.15)],
        findings=[
            SimpleNamespace(effect="parameter_error", location="flange.payload", stage="model", parameters={}),
        ],
    )
    path.write_text(simulator.mended(found))
    np.testing.assert_allclose(MujocoSimulator(path, record)(record.u, none, {}), expected, atol=1e-9)


SITES = {
    "inertial": (
        '<inertial pos="0 0 -0.1" mass="0.6" diaginertia="0.004 0.003 0.001"/><site name="tip" pos="0 0 -0.2"/>'
    ),
    "frame": '<frame pos="0 0 -0.1"><site name="tip" pos="0 0 -0.1"/></frame>',
    "points": '<site name="tip" type="capsule" size="0.01" fromto="0 0 -0.1 0 0 -0.3"/>',
    "origin": '<geom type="sphere" size="0.02" mass="0.1"/><site name="tip" pos="0 0 -0.2"/>',
    "tool": '<body name="tool" pos="0 0 -0.1"><site name="tip" pos="0 0 -0.1"/></body>',
}


@pytest.mark.parametrize("how", SITES)
def test_a_payload_is_written_wherever_its_site_is(arm, tmp_path, how):
    path, record = arm
    text = path.read_text()
    path.write_text(text.replace("</body></body>", f"{SITES[how]}</body></body>"))
    simulator, none = MujocoSimulator(path, record), 0 * record.u
    assert simulator.numbers["tip.payload"] == 0.0
    plain = MujocoSimulator(path, record, ["elbow.damping"])(record.u, none, {})
    np.testing.assert_allclose(simulator(record.u, none, {}), plain, atol=1e-9)
    made = simulator(record.u, none, {"tip.payload": 0.12, "lower.mass": 0.7})
    assert np.max(np.abs(made - plain)) > 0.01
    # The same by a body of its own.
    point = "<body pos='0 0 -0.2'><inertial pos='0 0 0' mass='0.12' diaginertia='4.8e-8 4.8e-8 4.8e-8'/></body>"
    other = tmp_path / "other.xml"
    other.write_text(text.replace("</body></body>", f"{SITES[how]}{point}</body></body>"))
    expected = MujocoSimulator(other, record, ["lower.mass"])(record.u, none, {"lower.mass": 0.7})
    np.testing.assert_allclose(made, expected, atol=1e-7)
    number = SimpleNamespace(effect="parameter_error", location="tip.payload", stage="model", parameters={})
    found = SimpleNamespace(shifts=[SimpleNamespace(name="tip.payload", after=0.12)], findings=[number])
    # Written once, and found to be another later.
    for mass in (0.12, 0.2):
        found.shifts[0].after = mass
        expected = simulator(record.u, none, {"tip.payload": mass})
        path.write_text(MujocoSimulator(path, record).mended(found))
        np.testing.assert_allclose(MujocoSimulator(path, record)(record.u, none, {}), expected, atol=1e-9)
        assert MujocoSimulator(path, record).numbers["tip.payload"] == pytest.approx(mass, rel=1e-12)


def test_a_payload_that_was_not_among_the_numbers_is_refused(arm):
    path, record = arm
    path.write_text(path.read_text().replace("</body></body>", '<site name="tip"/></body></body>'))
    simulator = MujocoSimulator(path, record, ["elbow.damping"])
    before = simulator.model.body_inertia.copy()
    with pytest.raises(ValueError, match="'tip.payload' was not among the numbers"):
        simulator(record.u, 0 * record.u, {"tip.payload": 0.1})
    np.testing.assert_array_equal(simulator.model.body_inertia, before)


def test_a_fixture_has_no_payload_and_a_link_one(arm):
    path, record = arm
    text = path.read_text().replace("<worldbody>", '<worldbody><body name="wall"><site name="hook"/></body>')
    path.write_text(text.replace("</body></body>", '<site name="tip"/><site name="cup"/></body></body>'))
    payloads = [name for name in MujocoSimulator(path, record).numbers if name.endswith("payload")]
    assert payloads == ["tip.payload"]


DRIVE = """<mujoco><option timestep="0.002"/><worldbody>
<body><joint name="motor" type="hinge" axis="0 1 0" damping="0.1"/><geom size="0.1" mass="1"/></body>
<body><joint name="load" type="hinge" axis="0 1 0" damping="{damping}"/><geom size="0.2" mass="1"/></body></worldbody>
<tendon><fixed name="gear" stiffness="{stiffness}" damping="0.01" {slack}><joint joint="motor" coef="1"/>
<joint joint="load" coef="-1"/></fixed></tendon><actuator><motor name="m" joint="motor"/></actuator></mujoco>"""
GEARED = {"input_names": ["m"], "output_names": ["motor", "load"]}


def test_a_tendon_that_is_a_spring_has_a_backlash(tmp_path):
    path, other = tmp_path / "drive.xml", tmp_path / "other.xml"
    path.write_text(DRIVE.format(damping=0.1, stiffness=5, slack=""))
    other.write_text(DRIVE.format(damping=0.1, stiffness=4, slack='springlength="-0.03 0.03"'))
    u = torques(SAMPLES, 3)[:, :1]
    record = jaxgray.Record(u, np.zeros((SAMPLES, 2)), H, **GEARED)
    simulator = MujocoSimulator(path, record)
    tendon = {name: value for name, value in simulator.numbers.items() if name.startswith("gear")}
    assert tendon == {"gear.stiffness": 5.0, "gear.damping": 0.01, "gear.backlash": 0.0}
    new = {"gear.stiffness": 4.0, "gear.backlash": 0.06}
    expected = MujocoSimulator(other, record)(record.u, 0 * record.y, {})
    np.testing.assert_allclose(simulator(record.u, 0 * record.y, new), expected, atol=1e-12)
    assert np.max(np.abs(simulator(record.u, 0 * record.y, {}) - expected)) > 1e-3
    found = SimpleNamespace(
        shifts=[SimpleNamespace(name=name, after=value) for name, value in new.items()],
        findings=[SimpleNamespace(effect="parameter_error", location=name, stage="model") for name in new],
    )
    path.write_text(simulator.mended(found))
    np.testing.assert_allclose(MujocoSimulator(path, record)(record.u, 0 * record.y, {}), expected, atol=1e-9)


def test_what_was_found_is_written_back(arm, tmp_path):
    path, record = arm
    simulator = MujocoSimulator(path, record, ["shoulder.damping", "elbow.stiffness", "lower.mass", "m2.gear"])
    wanted = {"shoulder.damping": 0.55, "elbow.stiffness": 0.8, "lower.mass": 0.7, "m2.gear": 1.9}

    def finding(effect, location, **parameters):
        values = {name: SimpleNamespace(value=value) for name, value in parameters.items()}
        return SimpleNamespace(effect=effect, location=location, stage="model", parameters=values)

    found = SimpleNamespace(
        shifts=[SimpleNamespace(name=name, after=value) for name, value in wanted.items()],
        findings=[finding("parameter_error", name) for name in wanted]
        + [finding("coulomb_friction", "elbow", Fc=0.03), finding("end_stop", "elbow", k=9.0, gap=0.2)],
    )
    out = tmp_path / "mended.xml"
    assert simulator.unwritten(found) == ("end_stop at elbow",)
    out.write_text(simulator.mended(found))
    mended = MujocoSimulator(out, record)
    reference = MujocoSimulator(path, record, [*wanted, "elbow.frictionloss"])
    expected = reference(record.u, 0 * record.u, wanted | {"elbow.frictionloss": 0.03})
    np.testing.assert_allclose(mended(record.u, 0 * record.u, {}), expected, atol=1e-9)
    # What was not found off stays.
    found.findings = []
    assert simulator.unwritten(found) == ()
    out.write_text(simulator.mended(found))
    np.testing.assert_allclose(
        MujocoSimulator(out, record)(record.u, 0 * record.u, {}), simulator(record.u, 0 * record.u, {}), atol=1e-9
    )


@pytest.mark.parametrize(
    ("effect", "location", "parameters"),
    [
        ("cubic_stiffness", "elbow", {"k3": 0.8}),
        ("quadratic_stiffness", "shoulder", {"k2": -0.9}),
        ("quadratic_drag", "elbow", {"c2": 0.1}),
        ("input_saturation", "m1", {"limit": 0.7}),
        ("input_delay", "m2", {"tau": 0.006}),
    ],
)
def test_laws_are_written_back(arm, tmp_path, effect, location, parameters):
    path, record = arm
    simulator, out = MujocoSimulator(path, record), tmp_path / "mended.xml"
    values = {name: SimpleNamespace(value=value) for name, value in parameters.items()}
    law = SimpleNamespace(effect=effect, location=location, stage="model", parameters=values)
    found = SimpleNamespace(shifts=[], findings=[law])
    assert simulator.unwritten(found) == ()
    out.write_text(simulator.mended(found))
    made = MujocoSimulator(out, record)(record.u, 0 * record.u, {})
    plain = simulator(record.u, 0 * record.u, {})
    assert np.max(np.abs(made - plain)) > 1e-3
    (size,) = parameters.values()
    # The same from what is given to every step of the model as it was.
    model = mujoco.MjModel.from_xml_path(str(path))
    data, dof = mujoco.MjData(model), {"shoulder": 0, "elbow": 1}.get(location)
    data.qpos[:] = record.y[0]
    fine = np.repeat(record.u[:, ::-1], 5, axis=0)
    if effect == "input_saturation":
        fine[:, 1] = np.clip(fine[:, 1], -size, size)
    if effect == "input_delay":
        fine[:, 0] = np.concatenate([np.zeros(3), fine[:-3, 0]])
    expected = []
    for k, now in enumerate(fine):
        if k % 5 == 0:
            expected.append(data.qpos.copy())
        data.ctrl[:] = now
        if dof is not None:
            q, v = data.qpos[dof], data.qvel[dof]
            force = {"cubic_stiffness": q**3, "quadratic_stiffness": q**2, "quadratic_drag": v * abs(v)}[effect]
            data.qfrc_applied[dof] = -size * force
        mujoco.mj_step(model, data)
    # An implicit integrator takes what depends on velocity at the end of a step.
    np.testing.assert_allclose(made, expected, atol=0.02 * np.std(expected) if effect == "quadratic_drag" else 1e-9)


def test_a_law_that_a_model_has_no_room_for_is_not_written(arm):
    path, record = arm
    path.write_text(path.read_text().replace('name="m1"', 'name="m1" ctrllimited="true" ctrlrange="-1 1"'))
    simulator = MujocoSimulator(path, record)
    laws = [("input_saturation", "m1"), ("cubic_stiffness", "shoulder-elbow"), ("stribeck_friction", "elbow")]
    laws += [("input_delay", "m2")]
    values = {"tau": SimpleNamespace(value=0.001)}
    findings = [SimpleNamespace(effect=e, location=p, stage="model", parameters=values) for e, p in laws]
    found = SimpleNamespace(shifts=[], findings=findings)
    assert simulator.unwritten(found) == tuple(f"{e} at {p}" for e, p in laws)
    assert "stribeck" not in simulator.mended(found)


def test_what_does_not_fit_is_said(arm, tmp_path):
    path, record = arm
    cases = (
        (
            dataclasses.replace(record, output_names=("hip", "elbow")),
            None,
            "'hip'; the model has shoulder, elbow",
        ),
        (dataclasses.replace(record, input_names=("m1", "m3")), None, "there is no 'm3'; the model has m2, m1"),
        (dataclasses.replace(record, sampling_time=0.003), None, "does not divide the sampling time 0.003 s"),
        (record, ["elbow.colour"], "'elbow.colour' is no number; give JOINT.damping"),
        (record, ["wrist.damping"], "there is no 'wrist'; the model has shoulder, elbow"),
        (jaxgray.Record(record.u, record.y[:, :1], H), None, "has 2 degrees of freedom, the record 1 outputs"),
    )
    for given, numbers, message in cases:
        with pytest.raises(ValueError, match=message):
            MujocoSimulator(path, given, numbers)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    for bad in (broken, tmp_path / "nowhere.xml"):
        with pytest.raises(ValueError, match="MuJoCo does not read it"):
            MujocoSimulator(bad, record)


def test_a_run_that_goes_astray_is_none(arm, tmp_path, monkeypatch):
    path, record = arm
    monkeypatch.chdir(tmp_path)
    y = MujocoSimulator(path, record)(1e9 * record.u, 0 * record.u, {})
    assert np.isfinite(y[0]).all() and np.isnan(y[-1]).all()
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.slow
def test_dry_friction_and_wrong_damping_of_an_arm_are_found(tmp_path):
    true, own = tmp_path / "true.xml", tmp_path / "own.xml"
    true.write_text(ARM.format(damping=0.4, friction=0.05))
    own.write_text(ARM.format(damping=0.36, friction=0.0))
    u = torques(2500, 7)
    blank = jaxgray.Record(u, np.zeros((2500, 2)), H, **NAMES)
    y = MujocoSimulator(true, blank)(u, 0 * u, {})
    y = y + 0.003 * y.std(axis=0) * np.random.default_rng(8).standard_normal(y.shape)
    record = jaxgray.Record(u, y, H, input_units=["N m"] * 2, output_units=["rad"] * 2, **NAMES)
    simulator = MujocoSimulator(own, record, ["shoulder.damping", "elbow.damping"])
    laws = "coulomb_friction,cubic_stiffness,input_delay"
    found = jaxgray.diagnose(record, simulator=simulator, parameters=simulator.numbers, only=laws, max_effects=1)
    law = next(f for f in found.findings if f.stage == "model" and f.effect != "parameter_error")
    assert (law.effect, law.location) == ("coulomb_friction", "elbow")
    assert abs(law.parameters["Fc"].value - 0.05) < 0.002
    assert {s.name: round(s.after, 2) for s in found.shifts} == {"shoulder.damping": 0.4, "elbow.damping": 0.2}


def test_a_backlash_that_was_given_as_none_is_found(tmp_path):
    # No linear plant about the closed gear shows it: what is left there looks like a law.
    path, true = tmp_path / "own.xml", tmp_path / "true.xml"
    path.write_text(DRIVE.format(damping=0.1, stiffness=40, slack=""))
    true.write_text(DRIVE.format(damping=0.12, stiffness=40, slack='springlength="-0.03 0.03"'))
    u = torques(1500, 5)[:, :1] / 2
    y = MujocoSimulator(true, jaxgray.Record(u, np.zeros((1500, 2)), H, **GEARED))(u, np.zeros((1500, 2)), {})
    y = y + 0.003 * y.std(axis=0) * np.random.default_rng(6).standard_normal(y.shape)
    record = jaxgray.Record(u, y, H, input_units=["N m"], output_units=["rad"] * 2, **GEARED)
    simulator = MujocoSimulator(path, record)
    laws = "play_hysteresis,sine_stiffness,dead_zone_stiffness"
    found = jaxgray.diagnose(record, simulator=simulator, parameters=simulator.numbers, only=laws)
    assert found.verdict == "named"
    assert {f.effect for f in found.findings if f.stage == "model"} == {"parameter_error"}
    backlash = next(s for s in found.shifts if s.name == "gear.backlash")
    assert abs(backlash.after - 0.06) < 4 * backlash.standard_error < 0.003
