"""What an MJCF has names for: numbers of a compiled model, and numbers and laws in a model that is written.

**Reference:** Todorov, Erez & Tassa, *MuJoCo: A physics engine for model-based control*, IROS 2012.
"""

import contextlib
import ctypes
import importlib
import pathlib
from collections.abc import Iterable

import numpy as np

from .inputs import named

JOINT = {
    "damping": "dof_damping",
    "frictionloss": "dof_frictionloss",
    "armature": "dof_armature",
    "stiffness": "jnt_stiffness",
}
"""Attributes of a joint that are numbers, and the arrays of a compiled model that hold them."""

TENDON = {"damping": "tendon_damping", "frictionloss": "tendon_frictionloss", "stiffness": "tendon_stiffness"}
"""The same of a tendon."""

ADDED = ("damping", "frictionloss")
"""Those of them that a joint may well have, and a model lack."""

LIBRARY = "libmujoco", "mujoco.dll"
"""How the file of its library begins, beside MuJoCo's package."""

DIGITS = 17
"""Decimal digits that hold a number exactly."""

PAYLOAD_RADIUS = 1e-3
"""Radius [m] of the sphere that a payload is."""


def library():
    """MuJoCo.

    **Raises:** `ImportError` with what to install where it is missing.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise ImportError("models of MuJoCo need it: pip install 'jaxgray[mujoco]'") from None


def found(model, element: str, name: str, where: str) -> int:
    """The id of a "JOINT", "TENDON", "BODY", "SITE" or "ACTUATOR" in a compiled model.

    **Raises:** `ValueError` that begins with `where`, and says which there are.
    """
    mujoco = library()
    kind = getattr(mujoco.mjtObj, f"mjOBJ_{element}")
    at = mujoco.mj_name2id(model, kind, name)
    if at < 0:
        raise ValueError(f"{where}: there is no {name!r}; the model has {named(_names(model, element)) or 'none'}.")
    return at


def _names(model, element: str) -> list[str]:
    """Names of all elements of a kind that have one."""
    mujoco = library()
    counts = {"JOINT": model.njnt, "TENDON": model.ntendon, "BODY": model.nbody, "SITE": model.nsite}
    kind, count = getattr(mujoco.mjtObj, f"mjOBJ_{element}"), counts.get(element, model.nu)
    names = (mujoco.mj_id2name(model, kind, k) for k in range(count))
    return [name for name in names if name]


def usual_numbers(model, joints: tuple[str, ...]) -> list[str]:
    """Names of what may be off in a model: damping and friction of its joints, what these have of stiffness and
    armature; of tendons that are springs stiffness, damping and backlash; a payload at the named sites of moving bodies
    that carry no other."""
    names = [f"{joint}.{attribute}" for joint in joints for attribute in JOINT]
    names = [name for name in names if name.endswith(ADDED) or number(model, name) != 0.0]
    tendons = [name for name in _names(model, "TENDON") if name not in _names(model, "JOINT")]
    springs = [name for name in tendons if number(model, f"{name}.stiffness") > 0]
    names += [f"{tendon}.{attribute}" for tendon in springs for attribute in ("stiffness", "damping", "backlash")]
    # What is welded to a body belongs to it.
    moving = [k for k in range(model.nbody) if model.body_jntnum[k]]
    carrying = {int(model.body_weldid[model.body_parentid[k]]) for k in moving}
    sites = {}
    for site in _names(model, "SITE"):
        body = int(model.body_weldid[model.site(site).bodyid[0]])
        if body > 0 and body not in carrying:
            sites.setdefault(body, site)
    return names + [f"{site}.payload" for site in sites.values()]


def compiled(path: str, numbers: Iterable[str] = ()):
    """A model from its file, with a body of no mass for every payload among some numbers.

    **Raises:** `ValueError` for a file that MuJoCo does not read.
    """
    mujoco = library()
    payloads = [name for name in numbers if name.endswith(".payload")]
    try:
        if not payloads:
            return mujoco.MjModel.from_xml_path(path)
        spec = mujoco.MjSpec.from_file(path)
        for name in payloads:
            _payload(spec, name)
        return spec.compile()
    except (ValueError, FileNotFoundError) as error:
        raise ValueError(f"{path}: MuJoCo does not read it: {error}") from error


def written(spec) -> str:
    """A model as XML."""
    with _all_digits():
        return spec.to_xml()


@contextlib.contextmanager
def _all_digits():
    """MuJoCo writes six digits; here all of them, where its library lets their number be set."""
    folder = pathlib.Path(library().__file__).parent
    try:
        file = next(path for path in folder.iterdir() if path.name.startswith(LIBRARY))
        setting = ctypes.CDLL(str(file))
        before = setting._mjPRIVATE__get_xml_precision()
        setting._mjPRIVATE__set_xml_precision(DIGITS)
    except (StopIteration, OSError, AttributeError):
        yield
        return
    try:
        yield
    finally:
        setting._mjPRIVATE__set_xml_precision(before)


def _payload(spec, name: str):
    """The body of a payload at a site, added without mass where there is none yet."""
    body = spec.body(name)
    if body is None:
        site = name.removesuffix(".payload")
        # Where it is in its body, whatever frame or pair of points it was given by.
        pos = np.array(spec.compile().site(site).pos)
        body = spec.site(site).parent.add_body(name=name, pos=pos)
        body.explicitinertial, body.mass, body.ipos, body.inertia = True, 0.0, np.zeros(3), np.zeros(3)
    return body


def number(model, name: str) -> float:
    """A number of a compiled model by its name, in units of MJCF; 0 of a payload that it has no body for.

    **Raises:** `ValueError` for a name of nothing.
    """
    array, at = _place(model, name)
    if name.endswith(".backlash"):
        return float(np.ptp(array[at]))
    return 0.0 if array is None else float(array[at])


def set_number(model, name: str, value: float) -> None:
    """Change a number of a compiled model, whose constants are to be set again.

    **Raises:** `ValueError` for a name of nothing, or a payload that the model was not compiled with.
    """
    array, at = _place(model, name)
    if array is None:
        raise ValueError(f"numbers: {name!r} was not among the numbers of this simulator; name it there.")
    if name.endswith(".backlash"):
        array[at] = _spread(array[at], value)
        return
    if name.endswith(".payload"):
        model.body_inertia[at] = _inertia(value)
    elif name.endswith(".mass"):
        model.body_inertia[at] *= value / array[at]
    array[at] = value


def _place(model, name: str):
    """The array that holds a number, and where; no array for a payload that a model has no body for."""
    element, _, attribute = name.rpartition(".")
    where = f"numbers: {name!r}"
    if attribute == "backlash":
        return model.tendon_lengthspring, found(model, "TENDON", element, where)
    if attribute in TENDON and element in _names(model, "TENDON") and element not in _names(model, "JOINT"):
        return getattr(model, TENDON[attribute]), found(model, "TENDON", element, where)
    if attribute in JOINT:
        joint = found(model, "JOINT", element, where)
        array = getattr(model, JOINT[attribute])
        return array, joint if attribute == "stiffness" else int(model.jnt_dofadr[joint])
    if attribute == "mass":
        return model.body_mass, found(model, "BODY", element, where)
    if attribute == "gear":
        return model.actuator_gear, (found(model, "ACTUATOR", element, where), 0)
    if attribute == "payload":
        found(model, "SITE", element, where)
        if name not in _names(model, "BODY"):
            return None, None
        return model.body_mass, found(model, "BODY", name, where)
    raise ValueError(
        f"{where} is no number; give JOINT.{'|'.join(JOINT)}, TENDON.{'|'.join((*TENDON, 'backlash'))}, BODY.mass, "
        "ACTUATOR.gear or SITE.payload."
    )


def _spread(lengths: np.ndarray, play: float) -> np.ndarray:
    """Lengths between which a tendon is slack, so far apart, with the same middle."""
    return np.mean(lengths) + np.array([-play / 2, play / 2])


def _inertia(mass: float) -> list[float]:
    """Inertia of a payload, a small sphere."""
    return [0.4 * mass * PAYLOAD_RADIUS**2] * 3


def write_number(spec, name: str, value: float) -> None:
    """Set a number in a model that is written."""
    element, _, attribute = name.rpartition(".")
    if attribute == "gear":
        _first(spec.actuator(element), "gear", value)
    elif attribute == "backlash":
        array, at = _place(spec.compile(), name)
        spec.tendon(element).springlength = _spread(array[at], value)
    elif attribute == "payload":
        body = _payload(spec, name)
        body.mass, body.inertia = value, _inertia(value)
    elif attribute == "mass":
        body = spec.body(element)
        factor = value / spec.compile().body(element).mass[0]
        for geom in body.geoms:
            geom.mass, geom.density = geom.mass * factor, geom.density * factor
        body.mass, body.fullinertia, body.inertia = (
            np.asarray(x) * factor for x in (body.mass, body.fullinertia, body.inertia)
        )
    else:
        _first(spec.joint(element) or spec.tendon(element), attribute, value)


def _first(element, attribute: str, value: float, order: int = 0, more: float = 0.0) -> None:
    """Set one of the coefficients of an attribute, which older releases have as a number, to `value` and `more` times
    what it was."""
    old = np.array(getattr(element, attribute), dtype=float)
    if old.ndim:
        old.flat[order] = value + more * old.flat[order]
        setattr(element, attribute, old)
    else:
        setattr(element, attribute, value + more * float(old))


def _friction(spec, place, p):
    _first(spec.joint(place), "frictionloss", p["Fc"], more=1.0)


def _of_order(attribute: str, order: int, parameter: str):
    def write(spec, place, p):
        _first(spec.joint(place), attribute, p[parameter], order, more=1.0)

    return write


def _limit(spec, place, p):
    motor = spec.actuator(place)
    motor.ctrllimited, motor.ctrlrange = library().mjtLimited.mjLIMITED_TRUE, [-p["limit"], p["limit"]]


def _delay(spec, place, p):
    motor = spec.actuator(place)
    # Between samples what is held over the steps of both.
    motor.delay, motor.interp = p["tau"], 1
    motor.nsample = int(np.ceil(p["tau"] / spec.option.timestep)) + 2


LAWS = {
    "coulomb_friction": _friction,
    "quadratic_stiffness": _of_order("stiffness", 1, "k2"),
    "cubic_stiffness": _of_order("stiffness", 2, "k3"),
    "quadratic_drag": _of_order("damping", 1, "c2"),
    "input_saturation": _limit,
    "input_delay": _delay,
}
"""Laws that an MJCF has attributes for."""

POLYNOMIALS = ("quadratic_stiffness", "cubic_stiffness", "quadratic_drag")
"""Those of them that need coefficients beyond the first."""


def writes(spec, law: str, place: str, parameters: dict[str, float]) -> bool:
    """Whether a law at a place can be written into a model; arguments as of `write_law`."""
    of_motor = law in ("input_saturation", "input_delay")
    element = spec.actuator(place) if of_motor else spec.joint(place)
    if law not in LAWS or element is None:
        return False
    if law == "input_saturation":
        # Within a range of its own a motor keeps that.
        limited = library().mjtLimited
        ranged = element.ctrllimited == limited.mjLIMITED_TRUE or np.any(element.ctrlrange)
        return element.ctrllimited == limited.mjLIMITED_FALSE or not ranged
    if law == "input_delay":
        # A motor that is late at all is late by a step at least.
        return getattr(element, "delay", None) == 0.0 and parameters["tau"] >= spec.option.timestep
    if law in POLYNOMIALS:
        # Its springs act about springref, laws about 0.
        about_zero = law == "quadratic_drag" or element.springref == 0.0
        return about_zero and np.ndim(element.stiffness) > 0
    return True


def write_law(spec, law: str, place: str, parameters: dict[str, float]) -> None:
    """Add a law at a place to a model that is written.

    **Arguments:** `spec`, an `MjSpec`; `law`: one of `LAWS`; `place`: a joint or a motor; `parameters` of the law by
    name, in units of MJCF.
    """
    LAWS[law](spec, place, parameters)
