"""A model for other programs: one format per file, listed in a table.

state_spaces  SciPy and python-control
arrays        NumPy arrays of a state space
matlab        variables for MATLAB
mjcf          MJCF for MuJoCo
c_header      C for controllers
"""

from pathlib import Path

from ...mechanics.systems.statespace import check_hold
from ...numerics.whole_files import write_whole
from ...records.channels import as_seconds
from ..documents.export import model_of, save
from .arrays import linear_part
from .c_header import c_header
from .matlab import mat_file
from .mjcf import mjcf
from .state_spaces import to_control, to_scipy

__all__ = ["EXPORTS", "export", "to_control", "to_scipy"]

# A new format is one function and one row.
EXPORTS = {".mat": mat_file, ".xml": mjcf, ".h": c_header}
OURS = (".json", ".npz")


def export(
    result_or_model, path, *, sampling_time: float | None = None, hold: str = "zero", linear: bool = False
) -> None:
    """Write a model for another program, by the ending of the file; the file is whole or not there.

    `.mat` for MATLAB, `.xml` for MuJoCo, `.h` for C, `.json` and `.npz` for jaxgray. Effects that a format does not
    know are refused, not dropped.

    **Arguments:**

    - `result_or_model`: a `MechanicalModel`, or an identification or a diagnosis.
    - `path`: of the file.
    - `sampling_time`: in s, of the sampled system; needed for `.h`, otherwise default none.
    - `hold`: the input between samples of the sampled system, `"zero"` (default) or `"linear"`.
    - `linear`: leave out effects that are not linear; in `.json` and `.npz` all but errors of the matrices' entries.

    **Raises:** `ValueError` for another ending, or a model that the format cannot hold.

    **Example:**

        >>> import pathlib
        >>> import jaxgray
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> jaxgray.export(model, "model.xml")
        >>> "<mujoco" in pathlib.Path("model.xml").read_text()
        True
    """
    model = model_of(result_or_model)
    ending = Path(path).suffix.lower()
    if ending not in EXPORTS and ending not in OURS:
        known = ", ".join((*OURS, *EXPORTS))
        raise ValueError(f"{path}: the ending {ending!r} is not known; give one of {known}.")
    check_hold(hold)
    if sampling_time is not None:
        sampling_time = as_seconds("sampling_time", sampling_time)
    if ending in OURS:
        save(linear_part(model) if linear else model, path)
        return
    name = Path(path).stem
    content = EXPORTS[ending](model, name, sampling_time=sampling_time, hold=hold, linear=linear)
    write_whole(content, path)
