"""Functional mock-up units (FMI 2 and 3) as simulators, run by FMPy: variables are inputs, outputs and numbers by name,
and some inputs the forces beside the others.

**Reference:** Modelica Association, *Functional Mock-up Interface Specification 3.0*, 2022.
"""

import difflib
import importlib
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..records import Record
from .inputs import held, named

FLOATS = ("Real", "Float64", "Float32")
"""Types of variables that are numbers with a fraction."""

TOLERANCE = 1e-10
"""Of the solver of a unit for model exchange: small changes of its forces must show."""

PARTS = 10
"""Steps a sample under a linear hold, over each of which an input stays at its mean."""


class FmuSimulator:
    """A functional mock-up unit, run from its own first state.

    **Arguments:** `path` of the FMU file; `record`, whose names of inputs and outputs are those of variables; `forces`:
    inputs of the unit that are forces [N] or torques [N m] at the coordinates of the outputs beside what acts there,
    one for each; `numbers`: names of parameters, with a value each where it is a mapping; default all parameters that
    have a start value other than 0.

    **Raises:** `ValueError` for a file that FMPy does not read, or that does not fit the record; `ImportError` with
    what to install where FMPy is missing.
    """

    def __init__(
        self,
        path: str | Path,
        record: Record,
        forces: Iterable[str],
        numbers: Iterable[str] | Mapping[str, float] | None = None,
    ):
        self.path = str(path)
        self.inputs, self.outputs, self.forces = record.input_names, record.output_names, tuple(forces)
        self.sampling_time, self.hold = record.sampling_time, record.hold
        if len(self.forces) != len(self.outputs):
            raise ValueError(
                f"forces={self.forces} for the outputs {self.outputs}: give the input that is the force at each of "
                "them."
            )
        if len({*self.inputs, *self.forces}) < len(self.inputs) + len(self.forces):
            raise ValueError(
                f"forces={self.forces} beside the inputs {self.inputs}: give an input of its own for each."
            )
        for name in (*self.inputs, *self.forces):
            if self._variable(name, "inputs and forces").causality != "input":
                raise ValueError(f"{self.path}: {name!r} is no input of it; inputs of the record and forces must be.")
        for name in self.outputs:
            self._variable(name, "outputs")
        if numbers is None:
            numbers = [v.name for v in self._description.modelVariables if _is_number(v) and float(v.start) != 0.0]
        given = {name: self._start(name) for name in numbers}
        if isinstance(numbers, Mapping):
            given |= {name: float(value) for name, value in numbers.items()}
        self.numbers: dict[str, float] = given

    def __getstate__(self):
        # The file is unpacked again where it is needed.
        return {name: value for name, value in vars(self).items() if not name.startswith("_unpacked")}

    def __call__(
        self,
        u: Float[np.ndarray, "samples inputs"],
        w: Float[np.ndarray, "samples outputs"],
        numbers: Mapping[str, float],
    ) -> Float[np.ndarray, "samples outputs"]:
        """Outputs at the samples.

        **Arguments:** `u`: inputs; `w`: forces at the outputs beside them, both held as the record's inputs are;
        `numbers` by name.
        """
        fmpy = _fmpy()
        given = np.concatenate([u, w], axis=1)
        parts = PARTS if self.hold == "linear" else 1
        h, together = self.sampling_time / parts, self._description.coSimulation is not None
        values = held(given, parts, self.hold)
        time = np.arange(len(values)) * h
        if not together:
            # Held to the next sample: an event there.
            time, values = np.repeat(time, 2)[1:], np.repeat(values, 2, axis=0)[:-1]
        signals = np.rec.fromarrays([time, *values.T], names=["time", *self.inputs, *self.forces])
        found = fmpy.simulate_fmu(
            self._folder,
            validate=False,
            start_time=0.0,
            stop_time=float((len(given) - 1) * self.sampling_time),
            output_interval=h,
            fmi_type="CoSimulation" if together else "ModelExchange",
            relative_tolerance=None if together else TOLERANCE,
            start_values={name: float(value) for name, value in numbers.items()},
            input=signals,
            output=list(self.outputs),
            model_description=self._description,
            record_events=False,
        )
        made = np.stack([np.asarray(found[name], float) for name in self.outputs], axis=1)
        return made[::parts]

    @property
    def _folder(self) -> str:
        return self._unpack()[0]

    @property
    def _description(self):
        return self._unpack()[1]

    def _unpack(self):
        """The folder with what the file holds, and the description of the model."""
        if "_unpacked" not in vars(self):
            fmpy, folder = _fmpy(), tempfile.mkdtemp(prefix="jaxgray-fmu-")
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            try:
                fmpy.extract(self.path, unzipdir=folder)
                self._unpacked = folder, fmpy.read_model_description(folder)
            except Exception as error:
                # Whatever is wrong with a file of another tool.
                raise ValueError(f"{self.path}: FMPy does not read it: {error}") from error
        return self._unpacked

    def _variable(self, name: str, what: str):
        known = {variable.name: variable for variable in self._description.modelVariables}
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"it has {named(known)}."
            raise ValueError(f"{self.path} has no variable {name!r}; {what} are named as its variables are; {hint}")
        return known[name]

    def _start(self, name: str) -> float:
        variable = self._variable(name, "numbers")
        if not _is_number(variable):
            raise ValueError(f"numbers: {name!r} of {self.path} is no floating-point parameter with a start value.")
        return float(variable.start)


def _fmpy():
    try:
        return importlib.import_module("fmpy")
    except ImportError:
        raise ImportError("functional mock-up units need FMPy: pip install 'jaxgray[fmu]'") from None


def _is_number(variable) -> bool:
    """Whether a variable is a parameter that is one number with a fraction."""
    alone = not getattr(variable, "dimensions", None)
    return variable.causality == "parameter" and variable.type in FLOATS and variable.start is not None and alone
