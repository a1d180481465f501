"""A user's simulator as it is called: one record a call, several calls side by side, every failure with its inputs."""

import concurrent.futures
import multiprocessing
import pathlib
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ...numerics.outcomes import RESULTS, ComputationError

Simulation = Callable[[np.ndarray, np.ndarray, dict[str, float]], np.ndarray]
"""y = f(u, w, θ): inputs (samples × inputs), forces at the coordinates of the outputs (samples × outputs), numbers by
name → outputs (samples × outputs) at the samples of the record."""


@dataclass(frozen=True)
class Call:
    """One run: inputs `u`, forces `w`, `numbers` in the order of their names."""

    u: Float[np.ndarray, "samples inputs"]
    w: Float[np.ndarray, "samples outputs"]
    numbers: Float[np.ndarray, " numbers"]


@dataclass(frozen=True)
class Failure:
    """What a call came to instead of outputs."""

    text: str


@dataclass
class Simulator:
    """A simulator with the names of its numbers.

    `function`; `names`; `outputs`: how many it must give; `workers`: processes that run it, 1 for this one alone;
    `count`: calls so far.
    """

    function: Simulation
    names: tuple[str, ...]
    outputs: int
    workers: int = 1
    count: int = field(default=0)

    def run(self, call: Call) -> Float[np.ndarray, "samples outputs"]:
        """The outputs of one call.

        **Raises:** `ComputationError` where it fails; its message says where the inputs are.
        """
        made = self.runs([call])[0]
        if isinstance(made, Failure):
            raise ComputationError(
                RESULTS.simulator_failed, stage="simulator", detail=f"{made.text}; {self._saved(call)}"
            )
        return made

    def tried(self, call: Call) -> Float[np.ndarray, "samples outputs"] | None:
        """The outputs of one call, None where it fails."""
        made = self.runs([call])[0]
        return None if isinstance(made, Failure) else made

    def runs(self, calls: list[Call]) -> list[np.ndarray | Failure]:
        """The outputs of several calls, or why there are none, in their order."""
        self.count += len(calls)
        parts = [(self.function, call, self.names, self.outputs) for call in calls]
        if self.workers == 1 or len(calls) == 1:
            return [_made(*part) for part in parts]
        # Spawned: a fork would copy the threads of JAX in whatever state they are.
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(min(self.workers, len(calls)), mp_context=context) as pool:
            return list(pool.map(_made, *zip(*parts)))

    def _saved(self, call: Call) -> str:
        folder = pathlib.Path(tempfile.mkdtemp(prefix="jaxgray-simulator-"))
        path = folder / "inputs.npz"
        np.savez(path, u=call.u, w=call.w, names=np.array(self.names), numbers=call.numbers)
        return f"its inputs u, w, names and numbers are in {path}"


def _made(function: Simulation, call: Call, names: tuple[str, ...], outputs: int) -> np.ndarray | Failure:
    numbers = dict(zip(names, map(float, call.numbers)))
    try:
        y = np.asarray(function(call.u.copy(), call.w.copy(), numbers), dtype=float)
    except Exception as error:  # Whatever a user's function raises is what it says of these inputs.
        return Failure(f"it raised {type(error).__name__}: {error}")
    y = y[:, None] if y.ndim == 1 else y
    if y.shape != (len(call.u), outputs):
        return Failure(f"it gave outputs of shape {y.shape}, not {(len(call.u), outputs)} (samples × outputs)")
    if not np.all(np.isfinite(y)):
        return Failure(f"its outputs are not finite from sample {int(np.argmin(np.isfinite(y).all(axis=1)))} on")
    return y


def checked_numbers(parameters: Mapping[str, float] | None) -> dict[str, float]:
    """Numbers by name as floats.

    **Raises:** `ValueError` for anything but a mapping of names to finite numbers.
    """
    given = {} if parameters is None else parameters
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters={parameters!r}; give the simulator's numbers by name, such as {{'mass': 1.2}}.")
    made = {}
    for name, value in given.items():
        try:
            made[str(name)] = float(value)
        except (TypeError, ValueError):
            made[str(name)] = np.nan
        if not np.isfinite(made[str(name)]):
            raise ValueError(f"parameters[{name!r}]={value!r}; give a finite number.")
    return made
