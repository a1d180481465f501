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

TURN = 1e-4
"""Time [s] ahead and back over which the change of the masses along a motion is taken."""


class MujocoSimulator:
    """A model of MuJoCo, run from the first sample of a record at rest.

    Every degree of freedom must be measured: a hinge or slide for each output, by name; an actuator for each input.

    **Arguments:** `path` of the MJCF file; `record`, whose names of inputs and outputs are those of actuators and
    joints; `numbers`: names such as "elbow.damping", "forearm.mass", "motor.gear", "belt.stiffness" of a tendon, its
    "belt.backlash" (between the lengths at which it is slack), or "flange.payload" (a point mass [kg] at a site), with
    a value each where it is a mapping; by default damping and frictionloss of the joints of the outputs; their
    stiffness and armature where they have any; stiffness, damping and backlash of tendons that are springs; and a
    payload at a site of every last link.

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
        model = self.changed(numbers)
        first = np.concatenate([self.begin, np.zeros(len(self.begin))])
        return self._run(model, first[None], u[None], w[None])[0]

    def windows(
        self,
        first: Float[np.ndarray, "windows states"],
        u: Float[np.ndarray, "windows samples inputs"],
        w: Float[np.ndarray, "windows samples outputs"],
        numbers: Mapping[str, float],
    ) -> Float[np.ndarray, "windows samples outputs"]:
        """Positions of the joints in several runs of one length, each from a state of its own.

        **Arguments:** `first`: positions, then velocities of the joints, at the first sample; `u`, `w`, `numbers` as of
        a call.
        """
        return self._run(self.changed(numbers), first, u, w)

    @property
    def lead(self) -> float:
        """Time [s] by which forces act early: the position at the end of a time step is as if the force had acted for
        half a step longer; 0 with the Runge-Kutta integrator."""
        exact = self.model.opt.integrator == mjcf.library().mjtIntegrator.mjINT_RK4
        return 0.0 if exact else self.model.opt.timestep / 2

    def momenta(
        self,
        q: Float[np.ndarray, "samples outputs"],
        v: Float[np.ndarray, "samples outputs"],
        numbers: Mapping[str, float],
    ) -> Float[np.ndarray, "samples outputs"]:
        """Generalised momenta M(q) q̇ at some positions and velocities of the joints, [kg m²/s] of hinges and [kg m/s]
        of slides. MuJoCo takes the damping of joints at the end of a time step: half a step of it counts as mass."""
        mujoco = mjcf.library()
        model, of = self.changed(numbers), np.empty((len(q), len(self.outputs)))
        data, made = mujoco.MjData(model), np.zeros(model.nv)
        at, dofs = self._joints(model)
        for k in range(len(q)):
            data.qpos[at], data.qvel[dofs] = q[k], v[k]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_mulM(model, data, made, data.qvel.copy())
            of[k] = made[dofs]
        return of + self.lead * np.ravel(model.dof_damping)[dofs] * v

    def forces(
        self,
        q: Float[np.ndarray, "samples outputs"],
        v: Float[np.ndarray, "samples outputs"],
        a: Float[np.ndarray, "samples outputs"],
        u: Float[np.ndarray, "samples inputs"],
        numbers: Mapping[str, float],
    ) -> tuple[Float[np.ndarray, "samples outputs"], Float[np.ndarray, "samples outputs"]]:
        """What changes these momenta, [N m] of hinges and [N] of slides: what goes with the motion (weight, centrifugal
        forces, damping, friction, springs), and what the actuators do. Accelerations are used for dry friction and
        stops alone, whose forces depend on them in MuJoCo, too."""
        mujoco = mjcf.library()
        model, made = self.changed(numbers), np.empty((2, len(q), len(self.outputs)))
        data, turned = mujoco.MjData(model), np.zeros(model.nv)
        at, dofs = self._joints(model)
        actuators = self._actuators(model)
        for k in range(len(q)):
            data.qpos[at], data.qvel[dofs], data.ctrl[actuators] = q[k], v[k], u[k]
            mujoco.mj_forward(model, data)
            made[1, k] = data.qfrc_actuator[dofs]
            data.qacc[:] = 0.0
            data.qacc[dofs] = a[k]
            mujoco.mj_inverse(model, data)
            # Less what the acceleration itself takes.
            mujoco.mj_mulM(model, data, turned, data.qacc.copy())
            own, speed = turned[dofs] - data.qfrc_inverse[dofs], data.qvel.copy()
            for ahead in (TURN, -TURN):
                data.qpos[at] = q[k] + ahead * v[k]
                mujoco.mj_fwdPosition(model, data)
                mujoco.mj_mulM(model, data, turned, speed)
                own = own + turned[dofs] / (2 * ahead)
            made[0, k] = own
        return made[0], made[1]

    def _run(self, model, first, u, w) -> Float[np.ndarray, "runs samples outputs"]:
        """Positions of the joints in several runs of one length; NaN from where one goes astray."""
        mujoco = mjcf.library()
        rollout = importlib.import_module("mujoco.rollout")
        data = mujoco.MjData(model)
        at, dofs = self._joints(model)
        # Time comes first in a state, then positions and velocities; an actuator begins with nothing in it.
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty((len(first), mujoco.mj_stateSize(model, kind)))
        positions, velocities = np.split(first, 2, axis=1)
        for k in range(len(first)):
            data.qpos[at], data.qvel[dofs] = positions[k], velocities[k]
            mujoco.mj_forward(model, data)
            mujoco.mj_getState(model, data, state[k], kind)
        steps = self._steps(model)
        forces = np.zeros((*u.shape[:2], model.nu + model.nv))
        forces[:, :, self._actuators(model)], forces[:, :, model.nu + dofs] = u, w
        spec = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        control = np.stack([held(one, steps, self.hold)[:-steps] for one in forces])
        with _quiet(mujoco):
            states, _ = rollout.rollout(model, data, state, control, control_spec=spec)
        y = np.concatenate([positions[:, None], states[:, steps - 1 :: steps][:, :, 1 + at]], axis=1)
        # It begins anew by itself where it goes astray.
        for one, times in zip(y, states[:, :, 0]):
            astray = np.diff(times) < 0
            if np.any(astray):
                one[1 + int(np.argmax(astray)) // steps :] = np.nan
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
        ids = [mjcf.found(model, "JOINT", name, f"{self.path}: outputs are named as joints") for name in self.outputs]
        return np.array(model.jnt_qposadr)[ids], np.array(model.jnt_dofadr)[ids]

    def _actuators(self, model) -> np.ndarray:
        return np.array(
            [mjcf.found(model, "ACTUATOR", name, f"{self.path}: inputs are named as actuators") for name in self.inputs]
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
