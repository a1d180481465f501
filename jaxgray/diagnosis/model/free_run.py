"""A free run over data, its first state fitted to their head, and its error."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .candidate import Candidate, Data
from .parameter_vector import state_step
from .reversals import decided_residual
from .simulator import Simulator

HEAD = 0.05
"""Share of a held-out record on which its first state is estimated."""


SHORTENED = 1.0, 0.5, 0.25, 0.1, 0.02
"""Shares of a step for the first state that are tried, the first that brings the run nearer is taken."""


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

    Gauss-Newton steps from rest and from the state of the model without its forces, shortened where they overshoot:
    from rest a body that dry friction holds shows nothing of where else it might have been.

    **Arguments:** `simulator`; `candidate`, of which everything but the first state is kept; `data`; `steps`: of
    Gauss-Newton for the first state; `share` of the record used for it.

    **Returns:** a `FreeRun` that leaves the head out.
    """
    states = 2 * simulator.setup.dofs
    head = np.zeros_like(data.kept)
    length = max(int(share * data.samples), 3 * states)
    head[:length] = data.kept[:length]
    size = np.sqrt(np.mean(data.y[: data.samples] ** 2, axis=0))
    size = np.where(size > 0, size, 1.0)

    def at(model: Candidate, x0, simulator: Simulator = simulator) -> tuple[float, Candidate]:
        here = Candidate(model.entries, (x0,), model.terms)
        with np.errstate(over="ignore", invalid="ignore"):
            cost = float(np.sum((np.where(head, data.y - simulator.run(here, data), 0.0) / size) ** 2))
        return cost if np.isfinite(cost) else np.inf, here

    def descended(model: Candidate, x0, most: int, simulator: Simulator = simulator) -> tuple[float, Candidate]:
        cost, here = at(model, x0, simulator)
        for _ in range(most):
            y, J = simulator.run_and_jacobian(here, data)
            e = np.where(head, data.y - y, 0.0)
            slopes = J[:, :, len(here.entries) :][:, :, :states]
            if not (np.all(np.isfinite(e)) and np.all(np.isfinite(slopes[head]))):
                break
            change = state_step(e, slopes, head, size)
            trials = (at(model, here.x0[0] + factor * change, simulator) for factor in SHORTENED)
            found = next((trial for trial in trials if trial[0] < cost * (1 - 1e-6)), None)
            if found is None:
                break
            cost, here = found
        return cost, here

    rest = np.zeros(states)
    ends = [descended(candidate, rest, steps)]
    bare = simulator.without_forces(candidate)
    if bare is not None:
        ends.append(descended(candidate, descended(bare[1], rest, 1, bare[0])[1].x0[0], steps))
    here = min(ends, key=lambda end: end[0])[1]
    y = simulator.run(here, data)
    e, _ = decided_residual(simulator, here, data, y)
    return FreeRun(y, e, data.kept & ~head)


def overall(rmse: Float[np.ndarray, " outputs"], floor: Float[np.ndarray, " outputs"]) -> float:
    """RMS over outputs of the error in units of the noise floor."""
    return float(np.sqrt(np.mean((rmse / floor) ** 2)))


def rms_of(runs: list[FreeRun]) -> np.ndarray:
    """Root mean square error per output over several runs."""
    power = sum(np.sum(np.where(run.kept, run.e, 0.0) ** 2, axis=0) for run in runs)
    count = sum(run.kept.sum(axis=0) for run in runs)
    return np.maximum(np.sqrt(power / np.maximum(count, 1)), 1e-300)
