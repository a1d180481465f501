"""A model as MJCF for MuJoCo: a joint per coordinate, and tendons for what acts between coordinates.

A symmetric positive semidefinite matrix X is a sum X = diag(g) + Σ s c cᵀ: g goes into the joints (damping, stiffness,
armature), every s into a fixed tendon with the coefficients c. Where rows are diagonally dominant the tendons are the
springs and dampers between two coordinates, c = (1, −1); elsewhere they are the eigenvectors.
"""

import re
from xml.sax.saxutils import escape
from xml.sax.saxutils import quoteattr as quoted

import numpy as np
from jaxtyping import Float

from ...mechanics.linear import linear_plant
from ...mechanics.model import MechanicalModel
from ...mechanics.runs.extended import arm_of
from ...mechanics.systems.drives import Force
from .arrays import coordinate_names

ROUNDING = 1e-10
"""Size that counts as nothing, relative to the diagonal entries beside it."""

CARRIED = 1e-3
"""Share of the least inertia that is in bodies where the rest must be in joints and tendons."""

STEP = 0.02
"""Time step, in units of the fastest eigenvalue's time, at which the Runge-Kutta steps are exact to 1e-8 a radian."""

UNSAMPLED = 1e-3
"""Time step in s of a model without a time of its own."""

SENSORS = {"displacement": "jointpos", "velocity": "jointvel"}
FRICTION = "coulomb_friction"


def mjcf(model: MechanicalModel, name: str, *, sampling_time: float | None, hold: str, linear: bool) -> bytes:
    """An MJCF file, complete with motors for the inputs and sensors for the outputs.

    Coordinates with the unit rad are hinges, others slides. Coulomb friction becomes `frictionloss`. With a diagonal
    mass matrix each body has its mass; otherwise inertia is the armature of joints and tendons, and bodies are nested
    since MuJoCo couples the inertia of one tree only. The time step divides the sampling time.

    **Arguments:** `model`; `name` of the file without ending; `sampling_time` [s] or None; `hold`: not used, a motor's
    input is what the program sets; `linear`: whether effects that are not linear are left out.

    **Returns:** the content of the file.

    **Raises:** `ValueError` for what MJCF has no word for: a moving base, effects other than Coulomb friction, matrices
    that are not symmetric or have negative eigenvalues.
    """
    if not isinstance(model.drive, Force):
        raise ValueError("the model is driven by its base, and MJCF knows forces on joints; give a model of forces.")
    plant, frictions = linear_plant(model, linear=linear, known=(FRICTION,))
    M, D, K, E = (np.asarray(X) for X in (plant.mass, plant.damping, plant.stiffness, plant.drive.input_map))
    names = coordinate_names(model, len(M))
    own = np.sqrt(np.diag(M))
    nested = bool(np.any(np.abs(M / np.outer(own, own) - np.eye(len(M))) > ROUNDING))
    joints = [{} for _ in names]
    tendons: dict[tuple[float, ...], dict[str, float]] = {}
    carried = np.diag(M)
    if nested:
        # Bodies nested in the order of the coordinates, each carrying all that follow.
        carried = np.full(len(M), CARRIED * np.linalg.eigvalsh(M)[0] / len(M) ** 2)
        order = np.arange(len(M))
        M = M - carried[0] * (len(M) - np.maximum(order[:, None], order))
        _split("mass", M, "armature", joints, tendons)
    _split("damping", D, "damping", joints, tendons)
    _split("stiffness", K, "stiffness", joints, tendons)
    for term in frictions:
        arm = np.asarray(arm_of(term, plant))
        place = (
            joints[int(np.argmax(arm))] if np.count_nonzero(arm) == 1 else tendons.setdefault(tuple(arm.tolist()), {})
        )
        place["frictionloss"] = place.get("frictionloss", 0.0) + term.parameter("Fc")
    step = _step(np.asarray(plant.mass), D, K, sampling_time)
    text = _document(name, step, sampling_time) + _bodies(model, names, joints, carried, nested, step)
    motors = []
    lines = []
    for k, (arm, values) in enumerate(tendons.items()):
        lines.append(_fixed(f"between{k + 1}", _values(values, step), arm, names))
    for j, wanted in enumerate(model.input_names):
        acting = np.flatnonzero(E[:, j])
        if len(acting) == 1:
            target, gear = f"joint={quoteattr(names[acting[0]])}", E[acting[0], j]
        else:
            target, gear = f"tendon={quoteattr(wanted)}", 1.0
            lines.append(_fixed(wanted, "", E[:, j], names))
        motors.append(f'    <motor name={quoteattr(wanted)} {target} gear="{_number(gear)}"/>\n')
    text += "".join(["  <tendon>\n", *lines, "  </tendon>\n"]) if lines else ""
    text += "".join(["  <actuator>\n", *motors, "  </actuator>\n"])
    sensors = [
        f"    <{SENSORS[kind]} name={quoteattr(output)} joint={quoteattr(output)}/>\n"
        if kind in SENSORS
        else f"    <!-- {_remark(output)} is measured as acceleration: the entry of data.qacc of its joint -->\n"
        for output, kind in zip(model.output_names, model.measured)
    ]
    return (text + "".join(["  <sensor>\n", *sensors, "  </sensor>\n"]) + "</mujoco>\n").encode()


def _split(what: str, X, key: str, joints: list[dict], tendons: dict) -> None:
    """X = diag(g) + Σ s c cᵀ, by joints and tendons."""
    if np.any(np.abs(X - X.T) > ROUNDING * np.max(np.abs(X))):
        raise ValueError(f"{what} with the model's effects is not symmetric, and MJCF has no such force; say linear.")
    # In units of each coordinate's own entry, since coordinates may be of very different size.
    unit = np.sqrt(np.where(np.diag(X) > 0, np.diag(X), 1.0))
    sizes, vectors = np.linalg.eigh((X + X.T) / 2 / np.outer(unit, unit))
    if sizes[0] < -ROUNDING:
        least = np.linalg.eigvalsh(X)[0]
        raise ValueError(f"{what} has the eigenvalue {least:.3g}, and MJCF takes positive semidefinite ones only.")
    between = np.abs(X - np.diag(np.diag(X)))
    ground = np.diag(X) - between.sum(axis=1)
    parts = []
    if np.all(ground >= -ROUNDING * unit**2):
        for i, j in zip(*np.nonzero(np.triu(between > ROUNDING * np.outer(unit, unit)))):
            arm = np.zeros(len(X))
            arm[i], arm[j] = 1.0, np.sign(X[i, j])
            parts.append((arm, between[i, j]))
    else:
        ground = np.zeros(len(X))
        parts = [(unit * vector, size) for size, vector in zip(sizes, vectors.T) if size > ROUNDING]
    for joint, size in zip(joints, ground):
        if size > 0:
            joint[key] = size
    for arm, size in parts:
        tendons.setdefault(tuple(arm.tolist()), {})[key] = size


def _step(M, D, K, sampling_time: float | None) -> float:
    """A time step that divides the sampling time and follows the fastest motion."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    fastest = np.max(np.abs(np.linalg.eigvals(A)))
    if sampling_time is None:
        return STEP / fastest if fastest > 0 else UNSAMPLED
    return sampling_time / max(1, int(np.ceil(sampling_time * fastest / STEP)))


def _document(name: str, step: float, sampling_time: float | None) -> str:
    custom = ""
    if sampling_time is not None:
        count = f'<numeric name="steps_per_sample" data="{round(sampling_time / step)}"/>'
        custom = f"  <custom>\n    {count}\n  </custom>\n"
    return (
        f"<!-- {_remark(name)}, written by jaxgray: coordinates of an equation of motion, not a machine's shape -->\n"
        f"<mujoco model={quoteattr(name)}>\n"
        f'  <compiler angle="radian" autolimits="false"/>\n'
        f'  <option timestep="{_number(step)}" integrator="RK4" gravity="0 0 0">\n'
        f'    <flag contact="disable"/>\n  </option>\n{custom}'
    )


def _bodies(
    model: MechanicalModel, names, joints: list[dict], carried: Float[np.ndarray, " dofs"], nested: bool, step: float
):
    lines = ["  <worldbody>\n"]
    for k, (name, joint) in enumerate(zip(names, joints)):
        # One kind for all in a tree: a hinge would turn the slides that follow.
        turns = model.output_units[k] if k < model.outputs else ""
        kind = "hinge" if not nested and turns == "rad" else "slide"
        size = _number(carried[k])
        lines.append(f"    <body name={quoteattr(name)}>\n")
        lines.append(f'      <inertial pos="0 0 0" mass="{size}" diaginertia="{size} {size} {size}"/>\n')
        values = _values(joint, step)
        lines.append(f'      <joint name={quoteattr(name)} type="{kind}" axis="1 0 0"{values}/>\n')
        lines.append("" if nested else "    </body>\n")
    return "".join([*lines, "    " + "</body>" * len(names) + "\n" if nested else "", "  </worldbody>\n"])


def _values(values: dict[str, float], step: float) -> str:
    """Attributes; friction is a constraint in MuJoCo, and is made as fast as the time step admits."""
    text = "".join(f' {key}="{_number(value)}"' for key, value in values.items())
    return text + (f' solreffriction="{_number(2 * step)} 1"' if "frictionloss" in values else "")


def _fixed(name: str, given: str, arm, names) -> str:
    joints = "".join(
        f'      <joint joint={quoteattr(joint)} coef="{_number(factor)}"/>\n'
        for joint, factor in zip(names, arm)
        if factor
    )
    return f'    <fixed name={quoteattr(name)} springlength="0"{given}>\n{joints}    </fixed>\n'


def _number(value) -> str:
    return repr(float(value))


def quoteattr(text: str) -> str:
    """An attribute's value, in quotes; XML has no word for most control characters."""
    return quoted("".join(c if c.isprintable() else "?" for c in text))


def _remark(text: str) -> str:
    """Text in a comment, which holds no two hyphens in a row."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    return re.sub("-(?=-)", "- ", escape(text))
