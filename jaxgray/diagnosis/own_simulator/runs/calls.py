"""A user's simulator as it is called: one record a call, several calls side by side, every failure with its inputs."""

import concurrent.futures
import contextlib
import multiprocessing
import pathlib
import pickle
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float

from ....numerics.outcomes import RESULTS, ComputationError

Simulation = Callable[[np.ndarray, np.ndarray, dict[str, float]], np.ndarray]
"""y = f(u, w, θ): inputs (samples × inputs), forces at the coordinates of the outputs (samples × outputs), numbers by
name → outputs (samples × outputs) at the samples of the record."""


@dataclass(frozen=True)
class Call:
    """One run: inputs `u`, forces `w`, `numbers` in the order of their names."""

    u: Float[np.ndarray, "samples inputs"]
    w: Float[np.ndarray, "samples outputs"]
    numbers: Float[np.ndarray, " numbers"]

    def until(self, end: int) -> "Call":
        """The same for the first samples alone."""
        return Call(self.u[:end], self.w[:end], self.numbers)


@dataclass(frozen=True)
class Failure:
    """What a call came to instead of outputs."""

    text: str


@dataclass
class Simulator:
    """A simulator with the names of its numbers.

    `function`; `names`; `outputs`: how many it must give; `workers`: processes that run it, 1 for this one alone;
    `count`: calls so far, and `samples` that they simulated; whether it `stops` early: of the first inputs alone it
    makes the same first outputs. As a context it ends its processes.
    """

    function: Simulation
    names: tuple[str, ...]
    outputs: int
    workers: int = 1
    count: int = 0
    samples: int = 0
    stops: bool = True
    _pool: concurrent.futures.ProcessPoolExecutor | None = field(default=None, repr=False)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def run(self, call: Call, end: int | None = None) -> Float[np.ndarray, "samples outputs"]:
        """The outputs of one call, as `runs` gives them.

        **Raises:** `ComputationError` where it fails; its message says where the inputs are.
        """
        return self.finished(call, self.runs([call], [end])[0])

    def finished(self, call: Call, made: np.ndarray | Failure) -> Float[np.ndarray, "samples outputs"]:
        """What a call came to.

        **Raises:** `ComputationError` where it failed; its message says where the inputs are.
        """
        if isinstance(made, Failure):
            detail = f"{made.text}; {self._saved(call)}"
            raise ComputationError(RESULTS.simulator_failed, stage="simulator", detail=detail)
        return made

    def tried(self, call: Call, end: int | None = None) -> Float[np.ndarray, "samples outputs"] | None:
        """The outputs of one call, as `runs` gives them, None where it fails."""
        made = self.runs([call], [end])[0]
        return None if isinstance(made, Failure) else made

    def runs(self, calls: list[Call], ends: list[int | None] | None = None) -> list[np.ndarray | Failure]:
        """The outputs of several calls, or why there are none, in their order; up to `ends`, where nothing else is
        asked for."""
        if ends is not None and not self.stops:
            return [made if isinstance(made, Failure) else made[:end] for made, end in zip(self.runs(calls), ends)]
        if ends is not None:
            calls = [call.until(len(call.u) if end is None else end) for call, end in zip(calls, ends)]
        self.count += len(calls)
        self.samples += sum(len(call.u) for call in calls)
        parts = [(self.function, call, self.names, self.outputs) for call in calls]
        if self.workers == 1 or len(calls) == 1:
            return [_made(*part) for part in parts]
        if self._pool is None:
            # Spawned: a fork would copy the threads of JAX in whatever state they are.
            context, wide = multiprocessing.get_context("spawn"), jax.config.jax_enable_x64
            self._pool = concurrent.futures.ProcessPoolExecutor(
                self.workers, mp_context=context, initializer=_as_here, initargs=(wide,)
            )
        waiting = [self._pool.submit(_made, *part) for part in parts]
        try:
            return [one.result() for one in waiting]
        except concurrent.futures.BrokenExecutor:
            self._pool = None
            text = "the process that ran it died; it must be importable, and its script guarded by __main__"
            return [Failure(text)] * len(calls)

    def _saved(self, call: Call) -> str:
        folder = pathlib.Path(tempfile.mkdtemp(prefix="jaxgray-simulator-"))
        path = folder / "inputs.npz"
        np.savez(path, u=call.u, w=call.w, names=np.array(self.names), numbers=call.numbers)
        return f"its inputs u, w, names and numbers are in {path}"


def _as_here(wide: bool) -> None:
    """Floats in another process as wide as in this one."""
    jax.config.update("jax_enable_x64", wide)


def _made(function: Simulation, call: Call, names: tuple[str, ...], outputs: int) -> np.ndarray | Failure:
    numbers = dict(zip(names, map(float, call.numbers)))
    try:
        # What it prints is no part of a result that is written there; what it keeps may change with its next run.
        with contextlib.redirect_stdout(sys.stderr):
            y = np.array(function(call.u.copy(), call.w.copy(), numbers), dtype=float)
    except Exception as error:  # Whatever a user's function raises is what it says of these inputs.
        return Failure(f"it raised {type(error).__name__}: {error}")
    y = y[:, None] if y.ndim == 1 else y
    if y.shape != (len(call.u), outputs):
        return Failure(f"it gave outputs of shape {y.shape}, not {(len(call.u), outputs)} (samples × outputs)")
    if not np.all(np.isfinite(y)):
        return Failure(f"its outputs are not finite from sample {int(np.argmin(np.isfinite(y).all(axis=1)))} on")
    return y


def checked_function(function: Simulation, workers: int) -> None:
    """Raise `ValueError` for what is no function, or one that other processes cannot have."""
    if not callable(function):
        raise ValueError(f"simulator={function!r}; give a function of inputs, forces and numbers.")
    if not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers={workers!r}; give a whole number, 1 or more.")
    if workers > 1:
        try:
            pickle.dumps(function)
        except Exception as error:
            raise ValueError(
                f"workers={workers} and simulator={function!r}: other processes cannot have it ({error}); define it at "
                "the top of a module, or leave workers at 1."
            ) from None


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
