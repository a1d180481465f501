"""What the commands and programs of the README and the manual work on: files of a folder, and names of Python."""

import jax
import jax.numpy as jnp
import numpy as np
import pendulum
import pytest
from independent import REFERENCE, random_steps, simulate, smooth_noise
from shown import ROOT

import jaxgray
from jaxgray.demonstration import SAMPLES
from jaxgray.demonstration_effects import simulated
from jaxgray.report.documents.columns import columns_text, record_columns

H = 0.01
SHORT = 600
"""Samples of the records with one coordinate, which share what is compiled."""


def write(path, times=None, **columns):
    """A csv with a column of times."""
    count = len(next(iter(columns.values())))
    values = np.column_stack([H * np.arange(count) if times is None else times, *columns.values()])
    rows = "\n".join(",".join(map(repr, row)) for row in values.tolist())
    path.write_text(f"{','.join(('t', *columns))}\n{rows}\n", encoding="utf-8")


def noisy(rng, y, share=0.003):
    return y + share * y.std(axis=0) * rng.standard_normal(y.shape)


def steps(rng, samples, size=1.0):
    return size * np.repeat(rng.uniform(-1, 1, samples // 20), 20)


ROTOR = """
def f(u, w, numbers):
    angle, speed, angles = 0.0, 0.0, []
    for torque in u[:, 0] + w[:, 0]:
        angles.append(angle)
        for _ in range(10):
            rubs = numbers["friction"] * np.tanh(speed / 0.05)
            speed += 0.001 * (torque - rubs - 0.4 * speed - 8.0 * angle) / numbers["inertia"]
            angle += 0.001 * speed
    return np.array(angles)[:, None]
"""


def rotor(u, **numbers):
    """Angles of a rotor that rubs."""
    names = {"np": np}
    exec(ROTOR, names)
    return names["f"](u[:, None], np.zeros((len(u), 1)), numbers)[:, 0]


ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="forearm"><joint name="elbow" type="hinge" axis="0 1 0" damping="0.4"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="elbow"/></actuator></mujoco>"""


def an_arm(folder, rng):
    """A model of MuJoCo, and a record of it with more damping."""
    pytest.importorskip("mujoco")
    (folder / "arm.xml").write_text(ARM)
    u = steps(rng, SHORT, 2.0)[:, None]
    blank = jaxgray.Record(u, 0 * u, H, input_names=["motor"], output_names=["elbow"])
    machine = jaxgray.MujocoSimulator(folder / "arm.xml", blank, ["elbow.damping"])
    angle = machine(u, 0 * u, {"elbow.damping": 0.5})
    write(folder / "arm.csv", motor=u[:, 0], elbow=noisy(rng, angle[:, 0]))


FRAME = np.diag([120.0, 100.0]), np.array([[300.0, -100.0], [-100.0, 100.0]]), np.array([[6e4, -3e4], [-3e4, 3e4]])
"""Mass, damping, stiffness of two storeys."""


def of_the_demonstration(folder):
    """The records of `jaxgray demo --out demo`; a shaken frame, an arm, an axis and a saved model."""
    (folder / "demo").mkdir()
    for name, record in zip(("estimation", "validation"), simulated("coulomb_friction", 1, SAMPLES)):
        (folder / "demo" / f"{name}.csv").write_text(columns_text(record_columns(record)), encoding="utf-8")
    rng = np.random.default_rng(1)
    base = smooth_noise(rng, 2000, 1, bandwidth=0.3)
    M, D, K = FRAME
    relative = simulate(M, D, K, base, H, E=-M @ np.ones((2, 1)), hold="linear", measured="acceleration")
    floors = noisy(rng, relative + base)
    write(folder / "quake.csv", base=base[:, 0], floor1=floors[:, 0], floor2=floors[:, 1])
    an_arm(folder, rng)
    torque = steps(rng, SHORT, 2.0)
    (folder / "axis.py").write_text(f"import numpy as np\n\n{ROTOR}")
    write(folder / "axis.csv", torque=torque, angle=noisy(rng, rotor(torque, inertia=0.11, friction=0.2)))
    jaxgray.save(jaxgray.MechanicalModel(*FRAME), folder / "OUT.json")
    return {}


def of_two_files(folder):
    """An encoder's rows, and those of the force at times of their own, of a mass on a spring."""
    rng = np.random.default_rng(5)
    t, u = H * np.arange(1000), steps(rng, 1000)
    y = simulate(np.eye(1), np.eye(1), 60.0 * np.eye(1), u[:, None], H)[:, 0] + 1e-4 * rng.standard_normal(1000)
    write(folder / "encoder.csv", t, angle=y)
    # The force is sampled between the angles, and holds until its next row.
    write(folder / "force.csv", t - 0.004, F=u)
    return {"jaxgray": jaxgray, "time": t, "u": u, "y": y}


def sprung(u, stiffness):
    """Displacements of a mass of 2 kg on a spring."""
    return simulate(2.0 * np.eye(1), 4.0 * np.eye(1), stiffness * np.eye(1), u[:, None], H)[:, 0]


def of_simulators(folder):
    """An arm for MuJoCo; an axis as a functional mock-up unit, and as outputs of a simulation; a record of a rotor."""
    pythonfmu = pytest.importorskip("pythonfmu")
    rng = np.random.default_rng(2)
    an_arm(folder, rng)
    unit = ROOT / "tests" / "simulators" / "unit_pendulum.py"
    pythonfmu.FmuBuilder.build_FMU(str(unit), dest=folder).rename(folder / "axis.fmu")
    torque = pendulum.torque(SHORT, rng)
    angle = noisy(rng, np.asarray(pendulum.run(torque, pendulum.TRUTH | {"friction": 0.2})))
    force = steps(rng, SHORT, 10.0)
    moved = {"position": noisy(rng, sprung(force, 210.0)), "position_sim": sprung(force, 200.0)}
    write(folder / "axis.csv", torque=torque, angle=angle, force=force, **moved)
    u = steps(rng, SHORT, 2.0)
    record = jaxgray.Record(u, noisy(rng, rotor(u, inertia=0.11, friction=0.15), 0.001), H)
    return {"np": np, "jaxgray": jaxgray, "record": record}


def of_a_drive(folder):
    """A motor with a load behind a shaft, which no sensor sees."""
    rng = np.random.default_rng(4)
    # As many as the records of test_unmeasured.py, with which they share what is compiled.
    u = steps(rng, 3000, 3.0)
    shaft = np.array([[1.0, -1.0], [-1.0, 1.0]])
    motion = simulate(
        np.diag([0.02, 0.03]), np.diag([0.3, 0.2]) + 0.02 * shaft, 8.0 * shaft, u[:, None], H, E=np.eye(2, 1)
    )
    write(folder / "drive.csv", torque=u, motor=noisy(rng, motion[:, 0], 0.001))
    return {}


def quiet(seed, samples=SAMPLES):
    """Inputs and outputs of the paper's system, from which nothing is missing."""
    rng = np.random.default_rng(seed)
    u = random_steps(rng, samples, 2, 2 * H, (0.2, 1.5))
    return u, noisy(rng, simulate(*REFERENCE.values(), u, 2 * H), 0.01)


def of_presses(folder):
    """Three days of a press."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    (folder / "data").mkdir()
    for k in range(3):
        u, y = quiet(10 + k)
        columns = dict(zip(("u1", "u2", "y1", "y2"), (*u.T, *y.T)))
        columns |= {"time": 2 * H * np.arange(len(u)), "temperature": np.full(len(u), 20.0 + k)}
        parquet.write_table(pyarrow.table(columns), folder / "data" / f"press_2026-01-0{k + 1}.parquet")
    return {}


def of_effects(folder):
    """A record from which nothing is missing, with a channel on which it might depend, and a model of it."""
    u, y = quiet(10)
    times = 2 * H * np.arange(len(u))
    write(folder / "record.csv", times, u1=u[:, 0], u2=u[:, 1], y1=y[:, 0], y2=y[:, 1], p=np.sin(times))
    wrong = REFERENCE | {"K": REFERENCE["K"] + np.diag([5.0, 0.0])}
    jaxgray.save(jaxgray.MechanicalModel(*wrong.values()), folder / "model.json")
    return {}


def of_learning(folder):
    """Two records of a mass on a spring, and the matrix that is wanted."""
    rng = np.random.default_rng(2)
    u = np.stack([steps(rng, 400)[:, None] for _ in range(2)])
    M, D, K = np.eye(1), np.eye(1), 60.0 * np.eye(1)
    y = np.stack([simulate(M, D, K, one, H) for one in u]) + 1e-4 * rng.standard_normal(u.shape)
    wanted = jaxgray.MechanicalModel(M, D, K).state_space(H).A
    return {"jax": jax, "jnp": jnp, "jaxgray": jaxgray, "wanted": wanted, "u": u, "y": y}


def of_a_spring(folder):
    """A mass on a spring, from which no law is missing."""
    rng = np.random.default_rng(3)
    u = steps(rng, SHORT, 10.0)
    return {"record": jaxgray.Record(u, noisy(rng, sprung(u, 200.0)), H)}


FILES = {
    "README.md": of_the_demonstration,
    "start.md": of_the_demonstration,
    "verdicts.md": of_the_demonstration,
    "files.md": of_two_files,
    "diagnosis.md": of_simulators,
    "hidden.md": of_a_drive,
    "many.md": of_presses,
    "learning.md": of_learning,
    "own_effect.md": of_a_spring,
}
"""By page; those of the effects have `of_effects`."""
