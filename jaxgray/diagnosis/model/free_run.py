"""A free run over data, its first state fitted to their head, and its error."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .candidate import Candidate, Data
from .parameter_vector import state_step
from .simulator import Simulator

HEAD = 0.05
"""Share of a held-out record on which its first state is estimated."""


@dataclass(frozen=True)
class FreeRun:
    """A candidate's free run on a record: `simulated`, residual `e`, `kept` samples (without the head and padding)."""

    simulated: Float[np.ndarray, "samples outputs"]
    e: Float[np.ndarray, "samples outputs"]
    kept: np.ndarray

    @property
    def rmse(self) -> Float[np.ndarray, " outputs"]:
        """Root mean square error per output."""
        return np.sqrt(np.sum(np.where(self.kept, self.e, 0.0) ** 2, axis=0) / np.maximum(self.kept.sum(axis=0), 1))


def free_run(simulator: Simulator, candidate: Candidate, data: Data, *, steps: int = 4, share: float = HEAD) -> FreeRun:
    """Free run on a record that the fit has not seen, its first state estimated on the first few samples.

    **Arguments:** `simulator`; `candidate`, of which everything but the first state is kept; `data`; `steps`: of
    Gauss-Newton for the first state; `share` of the record used for it.

    **Returns:** a `FreeRun` that leaves the head out.
    """
    states = 2 * simulator.setup.dofs
    head = np.zeros_like(data.kept)
    length = max(int(share * data.samples), 3 * states)
    head[:length] = data.kept[:length]
    here = Candidate(candidate.entries, (np.zeros(states),), candidate.terms)
    size = np.sqrt(np.mean(data.y[: data.samples] ** 2, axis=0))
    size = np.where(size > 0, size, 1.0)
    best = None
    for _ in range(steps):
        y, J = simulator.run_and_jacobian(here, data)
        e = np.where(head, data.y - y, 0.0)
        if not np.all(np.isfinite(e)):
            break
        cost = float(np.sum((e / size) ** 2))
        if best is not None and not cost < best[0] * (1 - 1e-6):
            break
        best = cost, here
        change = state_step(e, J[:, :, len(here.entries) :][:, :, :states], head, size)
        here = Candidate(here.entries, (here.x0[0] + change,), here.terms)
    here = here if best is None else best[1]
    y = simulator.run(here, data)
    kept = data.kept & ~head
    return FreeRun(y, np.where(data.kept, data.y - y, 0.0), kept)


def overall(rmse: Float[np.ndarray, " outputs"], floor: Float[np.ndarray, " outputs"]) -> float:
    """RMS over outputs of the error in units of the noise floor."""
    return float(np.sqrt(np.mean((rmse / floor) ** 2)))


def rms_of(runs: list[FreeRun]) -> np.ndarray:
    """Root mean square error per output over several runs."""
    power = sum(np.sum(np.where(run.kept, run.e, 0.0) ** 2, axis=0) for run in runs)
    count = sum(run.kept.sum(axis=0) for run in runs)
    return np.maximum(np.sqrt(power / np.maximum(count, 1)), 1e-300)
