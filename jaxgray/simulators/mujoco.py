"""Models of MuJoCo as simulators: joints are coordinates, actuators inputs, `qfrc_applied` the forces beside them.

**Reference:** Todorov, Erez & Tassa, *MuJoCo: A physics engine for model-based control*, IROS 2012.
"""

import contextlib
import copy
import importlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..diagnosis.result import Diagnosis
from ..records import Record
from . import mjcf
from .inputs import held, named

TIME = 1e-6
"""Part of a step by which a sampling time may miss a whole number of them."""


class MujocoSimulator:
    """A model of MuJoCo, run from the first sample of a record at rest.

    Every degree of freedom must be measured: a hinge or slide for each output, by name; an actuator for each input.

    **Arguments:** `path` of the MJCF file; `record`, whose names of inputs and outputs are those of actuators and
    joints; `numbers`: names such as "elbow.damping", "forearm.mass", "motor.gear", "belt.stiffness" of a tendon, its
    "belt.backlash" (between the lengths at which it is slack), or "flange.payload" (a point mass [kg] at a site), with
    a value each where it is a mapping; default damping and frictionloss of the joints of the outputs, what they have of
    stiffness and armature, stiffness, damping and backlash of tendons that are springs, and a payload at a site of
    every last link.

    **Raises:** `ValueError` for a file that MuJoCo does not read, or that does not fit the record; `ImportError` with
    what to install where MuJoCo is missing.

    **Example:**

        >>> import pathlib
        >>> import numpy as np, jaxgray
        >>> _ = pathlib.Path("cart.xml").write_text('''
        ... <mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="3" stiffness="80"/>
        ... <geom size="0.1" mass="2"/></body></worldbody><actuator><motor name="F" joint="x"/></actuator></mujoco>''')
        >>> record = jaxgray.Record(np.ones(500), np.zeros(500), 0.01, input_names=["F"], output_names=["x"])
        >>> simulator = jaxgray.MujocoSimulator("cart.xml", record)
        >>> y = simulator(record.u, np.zeros((500, 1)), simulator.numbers)
        >>> y[-1].round(3)  # F/k
        array([0.012])
    """

    def __init__(self, path: str | Path, record: Record, numbers: Iterable[str] | Mapping[str, float] | None = None):
        self.path = str(path)
        self.inputs, self.outputs = record.input_names, record.output_names
        self.sampling_time, self.hold = record.sampling_time, record.hold
        known = np.where(np.isfinite(record.y[0]), record.y[0], 0.0)
        self.begin = tuple(map(float, known))
        self._check()
        model = self.model
        if numbers is None:
            numbers = mjcf.usual_numbers(model, self.outputs)
        given = {name: mjcf.number(model, name) for name in numbers}
        if isinstance(numbers, Mapping):
            given |= {name: float(value) for name, value in numbers.items()}
        self.numbers: dict[str, float] = given
        if any(name.endswith(".payload") for name in given):
            # With bodies for payloads.
            del self._model

    def __getstate__(self):
        # The model is read again where it is needed: other processes have the file.
        return {name: value for name, value in vars(self).items() if name != "_model"}

    @property
    def model(self):
        """The compiled model as it was given."""
        if "_model" not in vars(self):
            self._model = mjcf.compiled(self.path, vars(self).get("numbers", ()))
        return self._model

    def __call__(
        self,
        u: Float[np.ndarray, "samples inputs"],
        w: Float[np.ndarray, "samples outputs"],
        numbers: Mapping[str, float],
    ) -> Float[np.ndarray, "samples outputs"]:
        """Positions of the joints at the samples, [rad] of hinges and [m] of slides, from the first state on; NaN from
        where the run goes astray.

        **Arguments:** `u`: controls of the actuators; `w`: torques [N m] or forces [N] at the joints beside them, both
        held as the record's inputs are; `numbers` by name, in units of MJCF.
        """
        mujoco = mjcf.library()
        rollout = importlib.import_module("mujoco.rollout")
        model = self.changed(numbers)
        data = mujoco.MjData(model)
        at, dofs = self._joints(model)
        data.qpos[at] = self.begin
        mujoco.mj_forward(model, data)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        steps = self._steps(model)
        forces = np.zeros((len(u), model.nu + model.nv))
        forces[:, self._actuators(model)], forces[:, model.nu + dofs] = u, w
        spec = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        control = held(forces, steps, self.hold)
        with _quiet(mujoco):
            states, _ = rollout.rollout(model, data, state, control[:-steps], control_spec=spec)
        # Time comes first in a state, then the positions.
        y = np.concatenate([[self.begin], states[0, steps - 1 :: steps][:, 1 + at]])
        # It begins anew by itself where it goes astray.
        astray = np.diff(states[0, :, 0]) < 0
        if np.any(astray):
            y[1 + int(np.argmax(astray)) // steps :] = np.nan
        return y

    def changed(self, numbers: Mapping[str, float]):
        """A compiled model with other numbers."""
        mujoco = mjcf.library()
        model = copy.copy(self.model)
        for name, value in numbers.items():
            mjcf.set_number(model, name, value)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def unwritten(self, found: Diagnosis) -> tuple[str, ...]:
        """What a diagnosis of this simulator found that MJCF has no attribute for."""
        spec = mjcf.library().MjSpec.from_file(self.path)
        laws = [f for f in _laws(found) if not mjcf.writes(spec, f.effect, f.location, _values(f))]
        return tuple(f"{f.effect} at {f.location}" for f in laws)

    def mended(self, found: Diagnosis) -> str:
        """The model as MJCF, with the numbers that a diagnosis of this simulator found off, and the laws that MJCF has
        attributes for: dry friction, quadratic and cubic springs and quadratic drag of joints, limits and delays of
        motors. A payload is a small body at its site."""
        spec = mjcf.library().MjSpec.from_file(self.path)
        for shift in found.shifts:
            if any(f.effect == "parameter_error" and f.location == shift.name for f in found.findings):
                mjcf.write_number(spec, shift.name, shift.after)
        for f in _laws(found):
            if mjcf.writes(spec, f.effect, f.location, _values(f)):
                mjcf.write_law(spec, f.effect, f.location, _values(f))
        spec.compile()
        return mjcf.written(spec)

    def _check(self) -> None:
        model = self.model
        if model.nv != len(self.outputs) or model.nq != model.nv:
            raise ValueError(
                f"{self.path} has {model.nv} degrees of freedom, the record {len(self.outputs)} outputs "
                f"({named(self.outputs)}): a hinge or slide for every output, and no other joint."
            )
        self._joints(model), self._actuators(model), self._steps(model)

    def _steps(self, model) -> int:
        ratio = self.sampling_time / model.opt.timestep
        steps = max(int(round(ratio)), 1)
        if abs(ratio - steps) > TIME * steps:
            raise ValueError(
                f"{self.path}: its timestep {model.opt.timestep:g} s does not divide the sampling time "
                f"{self.sampling_time:g} s; set <option timestep> to a part of it."
            )
        return steps

    def _joints(self, model) -> tuple[np.ndarray, np.ndarray]:
        """Positions in qpos and in qvel of the joints of the outputs."""
        ids = [mjcf.found(model, "JOINT", name, f"{self.path}: outputs are joints by name") for name in self.outputs]
        return np.array(model.jnt_qposadr)[ids], np.array(model.jnt_dofadr)[ids]

    def _actuators(self, model) -> np.ndarray:
        return np.array(
            [mjcf.found(model, "ACTUATOR", name, f"{self.path}: inputs are actuators by name") for name in self.inputs]
        )


@contextlib.contextmanager
def _quiet(mujoco):
    """Its warnings go nowhere meanwhile, not into a file of the working folder: runs that go astray are told by their
    outputs."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _laws(found: Diagnosis):
    """The laws among the findings of a diagnosis."""
    return [f for f in found.findings if f.stage == "model" and f.effect not in ("parameter_error", "unexplained")]


def _values(finding) -> dict[str, float]:
    return {name: one.value for name, one in finding.parameters.items()}
