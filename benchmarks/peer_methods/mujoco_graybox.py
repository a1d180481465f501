"""`mujoco[sysid]` on the same gray-box problem.

What maps: two slide joints on crossed axes in one tree; diagonal entries are the joints' armature, damping and
stiffness, couplings a fixed tendon with coefficients (1, −c) with armature, damping and stiffness of its own; c is
chosen from the guess so that the true parameters are positive. What does not: couplings of the other sign (a tendon's
are all negative), the first state and offsets (no parameters of the fit: the run starts at rest).
"""

import importlib.metadata

import mujoco
import numpy as np
from mujoco import sysid
from physical import GUESS

VERSION = f"mujoco {importlib.metadata.version('mujoco')}"
CARRIED = 1e-9
COEFFICIENT = float(np.sqrt(GUESS[0][1, 1] / GUESS[0][0, 0]))

MODEL = f"""
<mujoco>
  <option timestep="{{step}}" integrator="RK4" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <body name="b1"><inertial pos="0 0 0" mass="{CARRIED}" diaginertia="{CARRIED} {CARRIED} {CARRIED}"/>
      <joint name="q1" type="slide" axis="1 0 0" armature="1" damping="1" stiffness="1"/>
      <body name="b2"><inertial pos="0 0 0" mass="{CARRIED}" diaginertia="{CARRIED} {CARRIED} {CARRIED}"/>
        <joint name="q2" type="slide" axis="0 1 0" armature="1" damping="1" stiffness="1"/></body></body>
  </worldbody>
  <tendon><fixed name="t" armature="1" damping="1" stiffness="1" springlength="0">
    <joint joint="q1" coef="1"/><joint joint="q2" coef="{-COEFFICIENT}"/></fixed></tendon>
  <actuator><motor name="u1" joint="q1"/><motor name="u2" joint="q2"/></actuator>
</mujoco>
"""
ARM = np.array([1.0, -COEFFICIENT])


def setter(kind, key):
    def apply(spec, parameter):
        for part, value in zip((spec.joint("q1"), spec.joint("q2"), spec.tendon("t")), parameter.value):
            if key == "armature":
                part.armature = float(value)
            else:
                setattr(part, key, [float(value), 0.0, 0.0])

    return apply


def parameters():
    found = sysid.ParameterDict()
    for matrix, key in zip(GUESS, ("armature", "damping", "stiffness")):
        between = 0.05 * matrix[0, 0]
        nominal = np.diag(matrix) - between * ARM**2
        start = np.array([*nominal, between])
        found.add(sysid.Parameter(key, start, 1e-4 * start, 10.0 * start + matrix.max(), modifier=setter("", key)))
    return found


def fit(u, y, h):
    spec = mujoco.MjSpec.from_string(MODEL.format(step=h))
    model = spec.compile()
    times = h * np.arange(len(u))
    state = sysid.create_initial_state(model, np.zeros(2), np.zeros(2))
    kinds = [("q1_qpos", sysid.SignalType.MjStateQPos), ("q2_qpos", sysid.SignalType.MjStateQPos)]
    measured = sysid.ModelSequences(
        "reference",
        spec,
        "record",
        state,
        sysid.TimeSeries.from_control_names(times, u, model),
        sysid.TimeSeries.from_names(times, y, model, kinds),
        allow_missing_sensors=True,
    )
    start = parameters()
    residual = sysid.build_residual_fn(models_sequences=[measured], enabled_observations=kinds)
    found, log = sysid.optimize(start, residual, optimizer="mujoco", verbose=False, x_scale="jac")
    matrices = [np.diag(found[key].value[:2]) + found[key].value[2] * np.outer(ARM, ARM) for key in found.parameters]
    return tuple(matrices), "from rest, no offsets"


METHODS = {"mujoco": fit}
