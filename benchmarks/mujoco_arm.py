"""A two-link arm in MuJoCo, on trial against the arm that its MJCF should be.

    python benchmarks/mujoco_arm.py [--first 1] [--records 104] [--without 100] [--json OUT]

The machine is MuJoCo as well, with what its user's MJCF lacks: damping or dry friction of a joint, backlash in the gear
of the elbow, a delay or a limit of a motor, cogging, a stop, or a payload at the tip; every number that the MJCF has is
up to 5 % off. Noise is 0.2 to 1 % of the motion. Damping, dry friction, backlash and payload are numbers that are 0
there. Right is a law at its joint or motor, alone or in a class, and no other, be it that a part stays unexplained; of
numbers, that the missing one is off, and no other but those that are, alone or in a class. A lag counts as the delay, a
dead zone as the stop. Where all that was found can be written as MJCF, the gain of that file is measured on eight other
records together, so that it is known better than the interval is wide.
"""

import dataclasses
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

H, STEP, OTHERS = 0.01, 0.001, 8
JOINTS, MOTORS = ("shoulder", "elbow"), ("m1", "m2")
EFFECTS = (
    "damping",
    "frictionloss",
    "backlash",
    "delay",
    "saturation",
    "cogging",
    "stop",
    "payload",
)
SIZES = {
    "damping": (0.06, 0.15),
    "frictionloss": (0.02, 0.08),
    "backlash": (0.01, 0.05),
    "delay": (0.004, 0.015),
    "saturation": (0.6, 0.85),
    "cogging": (0.03, 0.12),
    "stop": (0.6, 0.85),
    "payload": (0.03, 0.15),
}
"""Least and largest: N m s/rad, N m, rad, s, share of the largest torque, N m, share of the largest angle, kg."""

ARM = """<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="implicitfast"/>
<worldbody><body name="upper"><joint name="shoulder" type="hinge" axis="0 1 0" damping="{d1}" frictionloss="{f1}"
 armature="0.02" {range1}/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>{drive}
<body name="lower" pos="0 0 -0.3"><joint name="elbow" type="hinge" axis="0 1 0" damping="{d2}" frictionloss="{f2}"
 armature="{armature}" {range2}/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/>{payload}
<site name="flange" pos="0 0 -0.25"/></body></body></worldbody>{gear}
<actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="{driven}"/></actuator></mujoco>"""

DRIVE = """<body name="rotor"><joint name="drive" type="hinge" axis="0 1 0" damping="0.01" armature="0.01"/>
<geom type="sphere" size="0.02" mass="0.05"/></body>"""
GEAR = """<tendon><fixed name="gear" stiffness="{stiffness}" damping="0.02" springlength="{low} {high}">
<joint joint="drive" coef="1"/><joint joint="elbow" coef="-1"/></fixed></tendon>"""


def arm(numbers, *, backlash=None, payload=0.0, stop=None):
    """The arm as MJCF; with a drive and a gear at the elbow where a backlash is given, be it 0."""
    limits = ["", ""]
    if stop is not None:
        joint, most = stop
        limits[joint] = f'range="{-most} {most}" limited="true" solreflimit="-400 -2"'
    mass = f'<geom type="sphere" size="0.01" pos="0 0 -0.25" mass="{payload}"/>' if payload else ""
    geared = backlash is not None
    half = (backlash or 0.0) / 2
    return ARM.format(
        step=STEP,
        d1=numbers["shoulder.damping"],
        d2=numbers["elbow.damping"],
        f1=numbers["shoulder.frictionloss"],
        f2=numbers["elbow.frictionloss"],
        range1=limits[0],
        range2=limits[1],
        payload=mass,
        drive=DRIVE if geared else "",
        gear=GEAR.format(stiffness=40.0, low=-half, high=half) if geared else "",
        armature=0.001 if geared else 0.01,
        driven="drive" if geared else "elbow",
    )


def torques(samples, rng, size, highest):
    sections = scipy.signal.butter(4, highest * 2 * H, output="sos")
    u = scipy.signal.sosfilt(sections, rng.standard_normal((samples, 2)), axis=0)
    return u / u.std(axis=0) * size


def machine(text, u, outputs, *, delay=None, cogging=None):
    """Angles of the joints of a model under held torques, step by step: `delay` of a motor in steps, `cogging` of a
    joint as its size and its waves a turn."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    at = [int(model.joint(name).qposadr[0]) for name in outputs]
    fine = np.repeat(u, round(H / STEP), axis=0)
    if delay is not None:
        motor, late = delay
        fine[:, motor] = np.concatenate([np.zeros(late), fine[: len(fine) - late, motor]])
    y = np.empty((len(fine), len(at)))
    for k, now in enumerate(fine):
        y[k] = data.qpos[at]
        data.ctrl[:] = now
        if cogging is not None:
            joint, size, waves = cogging
            data.qfrc_applied[joint] = -size * np.sin(waves * data.qpos[joint])
        mujoco.mj_step(model, data)
    return y[:: round(H / STEP)]


def drawn(seed, effect):
    """A record of the machine, others of it, the user's MJCF, and what is true."""
    rng = np.random.default_rng([seed, 41])
    at = int(rng.integers(2)) if effect not in ("payload", "backlash") else 1
    low, high = SIZES.get(effect, (1.0, 1.0))
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    true = {"shoulder.damping": rng.uniform(0.2, 0.4), "elbow.damping": rng.uniform(0.1, 0.2)}
    true |= {"shoulder.frictionloss": 0.0, "elbow.frictionloss": 0.0}
    own = {name: value * (1 + rng.uniform(-0.05, 0.05)) for name, value in true.items()}
    if effect in ("damping", "frictionloss"):
        name = f"{JOINTS[at]}.{effect}"
        true[name], own[name] = size, 0.0
    geared = effect == "backlash" or (effect is None and seed % 8 == 0)
    outputs = (*JOINTS[:1], "drive", "elbow") if geared else JOINTS
    samples = int(rng.choice([2000, 3000]))
    level, highest = rng.uniform(0.8, 1.2) * np.array([1.2, 0.4]), rng.uniform(2.0, 4.0)
    us = [torques(samples, rng, level, highest) for _ in range(2)]
    plain = arm(true, backlash=0.0 if geared else None)
    free = [machine(plain, u, outputs) for u in us]
    more, text = {}, plain
    if effect == "backlash":
        text = arm(true, backlash=size)
    elif effect == "payload":
        text = arm(true, payload=size)
    elif effect == "stop":
        most = size * min(np.max(np.abs(y[part, at])) for y in free for part in _parts(samples))
        text, size = arm(true, stop=(at, most)), most
    elif effect == "delay":
        size = round(size / STEP) * STEP
        more = {"delay": (at, round(size / STEP))}
    elif effect == "cogging":
        more = {"cogging": (at, size, 12.0)}
    if effect == "saturation":
        size *= min(np.max(np.abs(u[part, at])) for u in us for part in _parts(samples))
    noise = np.exp(rng.uniform(np.log(0.002), np.log(0.01)))
    names = {"input_names": MOTORS, "output_names": outputs, "input_units": ["N m"] * 2}
    names |= {"output_units": ["rad"] * len(outputs)}
    records, spread = [], None
    for k in range(1 + OTHERS):
        u = us[k] if k < len(us) else torques(samples, rng, level, highest)
        driven = u.copy()
        if effect == "saturation":
            driven[:, at] = np.clip(u[:, at], -size, size)
        y = machine(text, driven, outputs, **more)
        spread = y.std(axis=0) if spread is None else spread
        records.append(jaxgray.Record(u, y + noise * spread * rng.standard_normal(y.shape), H, **names))
    truth = {"effect": effect, "at": at, "size": size, "numbers": true}
    return records[0], records[1:], arm(own, backlash=0.0 if geared else None), truth


def _parts(samples):
    return slice(0, int(0.7 * samples)), slice(int(0.7 * samples), samples)


WANTED = {
    "delay": ({"input_delay", "actuator_lag"}, MOTORS),
    "saturation": ({"input_saturation"}, MOTORS),
    "cogging": ({"sine_stiffness"}, JOINTS),
    "stop": ({"end_stop", "dead_zone_stiffness"}, JOINTS),
}
"""Laws that count as the hidden one, and their places by joint."""


def judged(seed, effect, folder):
    record, others, text, truth = drawn(seed, effect)
    path = folder / f"arm{seed}.xml"
    path.write_text(text)
    simulator = MujocoSimulator(path, record)
    row = {"seed": seed, **truth, "gear": record.outputs == 3}
    calls, own = [0], simulator

    def counted(u, w, numbers):
        calls[0] += 1
        return own(u, w, numbers)

    began = time.perf_counter()
    try:
        found = jaxgray.diagnose(record, simulator=counted, parameters=simulator.numbers)
    except jaxgray.ComputationError as error:
        return row | {"failed": str(error), "seconds": time.perf_counter() - began}
    laws = laws_of(found)
    off = [
        {m.location: m.parameters["value"] for m in f.members} for f in found.findings if f.effect == "parameter_error"
    ]
    members = [{(m.effect, m.location) for m in f.members} | {(f.effect, f.location)} for f in laws]
    number = {"payload": "flange.payload", "backlash": "gear.backlash"}.get(effect, f"{JOINTS[truth['at']]}.{effect}")
    true = truth["numbers"] | ({number: truth["size"]} if effect in ("payload", "backlash") else {})
    wrong = {name for name, value in true.items() if value != simulator.numbers[name]}
    row["right"] = all(names.keys() & wrong for names in off)
    if effect in WANTED:
        ids, places = WANTED[effect]
        names = {(one, places[truth["at"]]) for one in ids}
        row["right"] &= len(laws) == 1 and bool(members[0] & names)
        row["alone"] = row["right"] and members[0] <= names
    else:
        row["right"] &= not laws and found.verdict not in ("partly", "unexplained")
        row["right"] &= sum(number in names for names in off) == (effect is not None)
    row |= {"verdict": found.verdict, "found": [sorted(m) for m in members], "off": sorted(map(sorted, off))}
    row |= {"calls": calls[0], "seconds": time.perf_counter() - began}
    row |= {"excess": found.excess, "baseline_excess": found.baseline_excess}
    # Of several that stand for one another, the one that is off.
    alone = {s.name: (s.after, s.standard_error) for s in found.shifts if s.name in true and s.standard_error}
    for names in off:
        alone = {name: one for name, one in alone.items() if len(names) == 1 or name not in names}
        alone |= {name: (names[name].value, names[name].standard_error) for name in names if name in wrong}
    row["deviations"] = {name: (value - true[name]) / error for name, (value, error) in alone.items()}
    if (laws or off) and not simulator.unwritten(found):
        row |= _measured(simulator, found, others, folder / f"arm{seed}_mended.xml")
    return row


def _measured(simulator, found, others, path):
    """Gain on other records of the model that was written, and by how much its run differs from that of the
    simulator with the same numbers."""
    path.write_text(simulator.mended(found))
    none = np.zeros_like(others[0].y)
    # Both begin where the machine does, not at a first sample with its noise.
    resting = dataclasses.replace(others[0], y=none)
    own, mended = MujocoSimulator(simulator.path, resting), MujocoSimulator(path, resting)
    before = [own(other.u, none, simulator.numbers) for other in others]
    after = [mended(other.u, none, {}) for other in others]
    # In units of the noise, as the gain of a diagnosis is.
    floor = np.array(list(found.noise_floor.values()))
    left = [np.linalg.norm([(other.y - y) / floor for other, y in zip(others, ys)]) for ys in (before, after)]
    row = {"gain": float(100 * (1 - left[1] / left[0]))}
    row["gain_interval"] = list(found.gain.ci95) if found.gain else None
    if all(f.effect == "parameter_error" for f in found.findings if f.stage == "model"):
        new = {s.name: s.after for s in found.shifts if any(f.location == s.name for f in found.findings)}
        same = own(others[0].u, none, simulator.numbers | new)
        row["written"] = float(np.max(np.abs(after[0] - same)) / np.std(same))
    return row


def main():
    with tempfile.TemporaryDirectory() as folder:
        campaign("arm", functools.partial(judged, folder=pathlib.Path(folder)), EFFECTS, 104, 100)


if __name__ == "__main__":
    main()
