"""The commands of the manual that need simulators or many files: each runs as it stands on files made for it."""

import re

import numpy as np
import pendulum
import pytest
from independent import REFERENCE, random_steps, simulate
from shown import ROOT
from test_readme import PAGES, blocks, command

import jaxgray

pytestmark = pytest.mark.slow

SIMULATORS = blocks(PAGES / "diagnosis.md", "sh")
H = 0.01


def write(path, **columns):
    """A csv with a column of times."""
    values = np.column_stack([H * np.arange(len(next(iter(columns.values())))), *columns.values()])
    rows = "\n".join(",".join(map(repr, row)) for row in values.tolist())
    path.write_text(f"{','.join(('t', *columns))}\n{rows}\n")


def noisy(rng, y, share=0.003):
    return y + share * y.std(axis=0) * rng.standard_normal(y.shape)


ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="arm"><joint name="shoulder" type="hinge" axis="0 1 0" damping="0.4" armature="0.02"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
<body name="forearm" pos="0 0 -0.3"><joint name="elbow" type="hinge" axis="0 1 0" damping="0.2" armature="0.01"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/></body></body></worldbody>
<actuator><motor name="motor1" joint="shoulder"/><motor name="motor2" joint="elbow"/></actuator></mujoco>"""


def test_a_model_of_mujoco_is_judged_and_mended(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(ARM)
    rng = np.random.default_rng(1)
    u = random_steps(rng, 1200, 2, H, (0.05, 0.3)) * [1.2, 0.2]
    names = {"input_names": ["motor1", "motor2"], "output_names": ["shoulder", "elbow"]}
    record = jaxgray.Record(u, np.zeros_like(u), H, **names)
    machine = jaxgray.MujocoSimulator(tmp_path / "arm.xml", record, ["elbow.damping"])
    y = noisy(rng, machine(u, np.zeros_like(u), {"elbow.damping": 0.25}))
    write(tmp_path / "arm.csv", motor1=u[:, 0], motor2=u[:, 1], shoulder=y[:, 0], elbow=y[:, 1])
    said = " ".join(command(SIMULATORS[0], tmp_path).split())
    assert "elbow.damping is 0.2" in said and "not 0.2" in said, said
    mended = re.search(r'name="elbow"[^>]*damping="([\d.]+)"', (tmp_path / "mended.xml").read_text())
    assert float(mended[1]) == pytest.approx(0.25, rel=0.02)


def test_a_functional_mock_up_unit_is_judged(tmp_path):
    pytest.importorskip("fmpy")
    pythonfmu = pytest.importorskip("pythonfmu")
    made = pythonfmu.FmuBuilder.build_FMU(str(ROOT / "tests" / "simulators" / "unit_pendulum.py"), dest=tmp_path)
    made.rename(tmp_path / "axis.fmu")
    rng = np.random.default_rng(2)
    u = pendulum.torque(1200, rng)
    y = noisy(rng, np.asarray(pendulum.run(u, pendulum.TRUTH | {"friction": 0.2})))
    write(tmp_path / "axis.csv", torque=u, angle=y)
    said = " ".join(command(SIMULATORS[1], tmp_path).split())
    assert "friction is 0." in said and "not 0.15" in said, said


def rubbing(u, friction):
    """A mass of 2 kg on a spring, in small steps; friction takes what speed is left."""
    q, v, y, h = 0.0, 0.0, np.empty(len(u)), H / 40
    for k in range(len(u)):
        y[k] = q
        for _ in range(40):
            v += h / 2.0 * (u[k] - 4.0 * v - 200.0 * q)
            v = np.sign(v) * max(abs(v) - h / 2.0 * friction, 0.0)
            q += h * v
    return y


def test_simulated_outputs_alone_are_judged(tmp_path):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-10, 10, 100), 20)
    write(tmp_path / "axis.csv", force=u, position=noisy(rng, rubbing(u, 1.3)), position_sim=rubbing(u, 1.0))
    said = " ".join(command(SIMULATORS[2], tmp_path).split())
    assert "It moves as M, D, K with Coulomb friction at position" in said and "Fc of Coulomb friction" in said, said


def test_friction_of_a_hidden_load_is_named(tmp_path):
    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-3, 3, 150), 20)
    inertia, h = np.array([0.02, 0.03]), H / 40
    q, v, y = np.zeros(2), np.zeros(2), np.empty(len(u))
    for k in range(len(u)):
        y[k] = q[0]
        for _ in range(40):
            shaft = 8.0 * (q[0] - q[1]) + 0.02 * (v[0] - v[1])
            v = v + h / inertia * (np.array([u[k] - shaft, shaft]) - [0.3, 0.2] * v)
            v[1] = np.sign(v[1]) * max(abs(v[1]) - h / inertia[1] * 0.4, 0.0)
            q = q + h * v
    write(tmp_path / "drive.csv", torque=u, motor=noisy(rng, y, 0.001))
    (line,) = blocks(PAGES / "hidden.md", "sh")
    said = " ".join(command(line, tmp_path).split())
    assert "Coulomb friction at load" in said, said


def test_a_fleet_of_files_is_diagnosed(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    pytest.importorskip("distributed")
    (tmp_path / "data").mkdir()
    for k in range(3):
        rng = np.random.default_rng(10 + k)
        u = random_steps(rng, 1500, 2, 0.02, (0.2, 1.5))
        y = noisy(rng, simulate(*REFERENCE.values(), u, 0.02), 0.01)
        columns = dict(zip(("u1", "u2", "y1", "y2"), (*u.T, *y.T)))
        columns |= {"time": 0.02 * np.arange(1500), "temperature": np.full(1500, 20.0 + k)}
        parquet.write_table(pyarrow.table(columns), tmp_path / "data" / f"press_2026-01-0{k + 1}.parquet")
    (line,) = blocks(PAGES / "many.md", "sh")
    said = command(line, tmp_path)
    assert "Fleet of 3 records" in said and re.search(r"3 noise", said), said
    assert (tmp_path / "fleet" / "index.html").exists() and (tmp_path / "fleet" / "drift.json").exists()
