"""A mechanical model on one screen."""

import jax
import numpy as np

from .systems.drives import Force
from .systems.units import as_factor, displacement_unit

_TIMES = {"mass": " s^2", "damping": " s", "stiffness": ""}


def matrix_units(model) -> dict[str, str]:
    """Units of mass, damping and stiffness, composed from those of forces and coordinates.

    **Arguments:** `model`, a `MechanicalModel`.

    **Returns:** a unit for each of the three; empty where channels have none or differ, and for an excited
    base, which leaves the scale of the forces open.
    """
    lengths = {displacement_unit(unit, kind) for unit, kind in zip(model.output_units, model.measured)}
    forces = set(model.input_units)
    if not isinstance(model.drive, Force) or len(lengths) != 1 or len(forces) != 1 or "" in lengths | forces:
        return dict.fromkeys(("mass", "damping", "stiffness"), "")
    force, length = forces.pop(), lengths.pop()
    return {name: f"{force}{time}/{as_factor(length)}" for name, time in _TIMES.items()}


def describe(model) -> str:
    """Channels with units, how the input enters, and the three matrices.

    **Arguments:** `model`, a `MechanicalModel`.

    **Returns:** the text, not ending in a newline.
    """

    def channels(names, units, *more):
        return ", ".join(
            name + (f" [{unit}]" if unit else "") + "".join(f" {text}" for text in rest)
            for name, unit, *rest in zip(names, units, *more)
        )

    lines = [
        f"MechanicalModel: {model.dofs} coordinates, {model.inputs} inputs",
        f"  inputs   {channels(model.input_names, model.input_units)}",
        f"  outputs  {channels(model.output_names, model.output_units, model.measured)}",
    ]
    if model.hidden:
        lines.append(f"  hidden   {', '.join(model.hidden)}, measured by no output")
    drive = model.drive
    if isinstance(drive, Force):
        lines += _matrix("force map", "", drive.input_map)
    else:
        motion = "relative to the base" if drive.relative else "absolute"
        lines += _matrix(f"{type(drive).__name__}, outputs {motion}; direction", "", drive.direction)
    for name, unit in matrix_units(model).items():
        lines += _matrix(name, unit, getattr(model, name))
    for term in model.effects:
        values = ", ".join(f"{p.name} = {float(v):.6g}" for p, v in zip(term.effect.parameters, term.values))
        lines.append(f"  effect   {term.effect.id} at {term.place.name}: {values}")
    return "\n".join(lines)


def _matrix(name: str, unit: str, X) -> list[str]:
    head = f"  {name}" + (f" [{unit}]" if unit else "")
    if isinstance(X, jax.core.Tracer) or not hasattr(X, "shape"):
        return [f"{head}: {X}"]
    text = np.array2string(np.asarray(X), precision=6, threshold=200, max_line_width=100)
    return [head, *("    " + line for line in text.splitlines())]
