"""A two-link arm that its controller holds upright, on trial as a model of MuJoCo.

    python benchmarks/held_arm.py [--first 1] [--records 24] [--without 12] [--json OUT]

Played back without the controller, the recorded torques let any arm fall: no run of the simulator follows the record.
The machine is MuJoCo as well, stepped with its controller in the loop; both dampings of the user's MJCF are up to 5 %
off, and it lacks dry friction, a payload, cogging, a cubic spring or quadratic drag. Noise of the encoders is 0.02 to
0.1 % of the motion. Right is the law at its joint, alone or in a class, or of numbers that the missing one is off; and
nothing else but the dampings. Without: nothing but the dampings. Seeds 1 to 80 served development.
"""

import functools
import pathlib
import tempfile
import time

import jax
import numpy as np
import scipy.signal

jax.config.update("jax_enable_x64", True)

import mujoco  # noqa: E402
from simulator_campaign import campaign, laws_of  # noqa: E402

import jaxgray  # noqa: E402
from jaxgray.simulators import MujocoSimulator  # noqa: E402

H, STEPS, SAMPLES = 0.01, 10, 3000
JOINTS = ("shoulder", "elbow")
SIZES = {
    "frictionloss": (0.05, 0.2),
    "payload": (0.05, 0.3),
    "sine_stiffness": (0.06, 0.25),
    "cubic_stiffness": (0.5, 2.0),
    "quadratic_drag": (0.1, 0.4),
}
"""Least and largest: N m, kg, N m, N m/rad³, N m s²/rad²."""

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
<joint name="shoulder" type="hinge" axis="0 1 0" damping="{d1}" frictionloss="{f1}" armature="0.02"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="1"/><body pos="0 0 0.3">
<joint name="elbow" type="hinge" axis="0 1 0" damping="{d2}" frictionloss="{f2}" armature="0.01"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.25" mass="0.6"/>{payload}<site name="flange" pos="0 0 0.25"/>
</body></body></worldbody><actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
</mujoco>"""


def law_of(effect, at, size):
    """Torques at the joints of a law that MJCF has no attribute for."""

    def torque(q, v):
        w = np.zeros(2)
        if effect == "sine_stiffness":
            w[at] = -size * np.sin(12.0 * q[at])
        elif effect == "cubic_stiffness":
            w[at] = -size * q[at] ** 3
        elif effect == "quadratic_drag":
            w[at] = -size * v[at] * abs(v[at])
        return w

    return torque


def held(text, torque, rng, noise):
    """Torques of a controller and the angles that its encoders saw."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    sections = scipy.signal.butter(3, rng.uniform(0.4, 0.8) * 2 * H, output="sos")
    wanted = scipy.signal.sosfilt(sections, rng.standard_normal((SAMPLES, 2)), axis=0)
    wanted = wanted / wanted.std(axis=0) * rng.uniform(0.4, 0.8, 2)
    stiff, damped = np.array([40.0, 15.0]), np.array([2.0, 0.6])
    u, y = np.zeros((2, SAMPLES, 2))
    for k in range(SAMPLES):
        y[k] = data.qpos + noise * rng.standard_normal(2)
        speed = (y[k] - y[k - 1]) / H if k else 0.0
        u[k] = stiff * (wanted[k] - y[k]) - damped * speed
        data.ctrl[:] = u[k]
        for _ in range(STEPS):
            data.qfrc_applied[:] = torque(data.qpos, data.qvel)
            mujoco.mj_step(model, data)
    return u, y


def judged(seed, effect, folder):
    rng = np.random.default_rng([seed, 47])
    at = int(rng.integers(2)) if effect != "payload" else 1
    low, high = SIZES.get(effect, (1.0, 1.0))
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    true = {"d1": rng.uniform(0.2, 0.4), "d2": rng.uniform(0.1, 0.2), "f1": 0.0, "f2": 0.0, "payload": ""}
    own = true | {name: true[name] * (1 + rng.uniform(-0.05, 0.05)) for name in ("d1", "d2")}
    if effect == "frictionloss":
        true[f"f{at + 1}"] = size
    elif effect == "payload":
        true["payload"] = f'<geom type="sphere" size="0.01" pos="0 0 0.25" mass="{size}"/>'
    noise = float(np.exp(rng.uniform(np.log(2e-4), np.log(1e-3)))) * 0.6
    u, y = held(ARM.format(**true), law_of(effect, at, size), rng, noise)
    names = {"input_names": ["m1", "m2"], "output_names": JOINTS}
    record = jaxgray.Record(u, y, H, **names, input_units=["N m"] * 2, output_units=["rad"] * 2)
    path = folder / f"held{seed}.xml"
    path.write_text(ARM.format(**own))
    simulator = MujocoSimulator(path, record)
    row = {"seed": seed, "effect": effect, "at": at, "size": size, "noise": noise}
    began = time.perf_counter()
    try:
        found = jaxgray.diagnose(record, simulator=simulator, parameters=simulator.numbers)
    except jaxgray.ComputationError as error:
        return row | {"failed": str(error)}
    laws = [[(m.effect, m.location) for m in f.members] for f in laws_of(found)]
    off = [[m.location for m in f.members] for f in found.findings if f.effect == "parameter_error"]
    wanted = {"frictionloss": f"{JOINTS[at]}.frictionloss", "payload": "flange.payload"}.get(effect)
    expected = {"shoulder.damping", "elbow.damping", wanted}
    right = all(set(one) & expected for one in off)
    if wanted is not None:
        right &= not laws and any(wanted in one for one in off)
    else:
        right &= not laws if effect is None else len(laws) == 1 and (effect, JOINTS[at]) in laws[0]
    truth = {"shoulder.damping": true["d1"], "elbow.damping": true["d2"], "flange.payload": 0.0}
    truth |= {"shoulder.frictionloss": true["f1"], "elbow.frictionloss": true["f2"]}
    truth |= {"shoulder.armature": 0.02, "elbow.armature": 0.01}
    if effect == "payload":
        truth["flange.payload"] = size
    moved = {one[0] for one in off}
    row["deviations"] = {
        s.name: (s.after - truth[s.name]) / s.standard_error
        for s in found.shifts
        if s.name in moved and s.standard_error
    }
    row |= {"verdict": found.verdict, "laws": laws, "off": off, "right": bool(right), "white": found.white}
    row |= {"seconds": time.perf_counter() - began, "excess": found.excess, "baseline_excess": found.baseline_excess}
    return row | {"gain": None if found.gain is None else [found.gain.percent, *found.gain.ci95]}


def main():
    with tempfile.TemporaryDirectory() as folder:
        rows = campaign("held arm", functools.partial(judged, folder=pathlib.Path(folder)), tuple(SIZES), 24, 12)
    deviations = [abs(d) for row in rows for d in row.get("deviations", {}).values()]
    print(f"numbers beyond 3 standard errors: {sum(d > 3 for d in deviations)} of {len(deviations)}")


if __name__ == "__main__":
    main()
