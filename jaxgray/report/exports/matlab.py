"""A model as variables for MATLAB: `load arm.mat; sys = ss(A, B, C, D)`."""

import io

import numpy as np
from scipy.io import savemat

from ...mechanics.linear import linear_plant
from ...mechanics.model import MechanicalModel
from ..documents.export import model_document
from .arrays import arrays_of

TEXTS = ("measured", "input_names", "output_names", "input_units", "output_units")


def mat_file(model: MechanicalModel, name: str, *, sampling_time: float | None, hold: str, linear: bool) -> bytes:
    """A MAT file, version 5.

    `A`, `B`, `C`, `D` in continuous time, state (q, q̇); `mass`, `damping`, `stiffness`, effects that change them put
    in; `input_map`, or `base_kind`, `base_direction`, `base_relative`; names and units as cell arrays of text. With a
    sampling time `Ad`, `Bd`, `Cd`, `Dd`, `Ts`, `hold`, and `Hd`: the sampled state is (q, q̇) − Hd u.

    **Arguments:** `model`; `name` of the file, not used; `sampling_time` [s] or None; `hold`; `linear`.

    **Returns:** the content of the file.
    """
    continuous = arrays_of(model, None, hold, linear)
    variables = {key: getattr(continuous, key) for key in "ABCD"}
    plant, _ = linear_plant(model, linear=linear)
    variables |= {key: np.asarray(getattr(plant, key)) for key in ("mass", "damping", "stiffness")}
    document = model_document(model)
    if "base" in document:
        variables |= {f"base_{key}": value for key, value in document["base"].items()}
    else:
        variables["input_map"] = np.asarray(plant.drive.input_map)
    for key in TEXTS:
        variables[key] = np.array(getattr(model, key), dtype=object)[:, None]
    if model.hidden:
        variables["coordinates"] = np.array(model.coordinates, dtype=object)[:, None]
    if sampling_time is not None:
        sampled = arrays_of(model, sampling_time, hold, linear)
        variables |= {f"{key}d": getattr(sampled, key) for key in "ABCDH"}
        variables |= {"Ts": sampling_time, "hold": hold}
    buffer = io.BytesIO()
    savemat(buffer, variables)
    return buffer.getvalue()
