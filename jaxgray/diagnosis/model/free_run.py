"""A free run over data and its error: the first state is fitted to their head, phases of their own to all of them."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import Term
from ...numerics.matrices.bounded import bounded
from .candidate import Candidate, Data, estimated
from .parameter_vector import state_step
from .reversals import decided_residual
from .simulator import Simulator

HEAD, MOST = 0.05, 0.5
"""Share of a held-out record on which its first state is estimated, at least and at most."""

BY_STATE = 0.1
"""Variance that the error of that state may add to the rest of the record, relative to that of the noise."""

NOTHING = 1e-12
"""Part of the information of a whole record on a first state that counts as none."""

TURNS = 3
"""Of the fit of phases, each about the run before."""

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


def free_run(simulator: Simulator, candidate: Candidate, data: Data, *, steps: int = 4) -> FreeRun:
    """Free run on a record that the fit has not seen, its first state estimated on the first few samples, or on more
    where the motion remembers it for long.

    Gauss-Newton steps from rest and from the state of the model without its forces, shortened where they overshoot:
    from rest a body that dry friction holds shows nothing of where else it might have been. What has another phase in
    every record takes the amplitude and the phase that this one shows.

    **Arguments:** `simulator`; `candidate`, of which all else is kept; `data`; `steps`: of Gauss-Newton for the first
    state.

    **Returns:** a `FreeRun` that leaves the head out.
    """
    states = 2 * simulator.setup.dofs
    phased = tuple(term for term in candidate.terms if term.effect.own_phase)
    candidate = candidate.with_terms(term for term in candidate.terms if not term.effect.own_phase)
    size = np.sqrt(np.mean(data.y[: data.samples] ** 2, axis=0))
    size = np.where(size > 0, size, 1.0)
    starts, bare = [np.zeros(states)], simulator.without_forces(candidate)
    head = _head(*((simulator, candidate) if bare is None else bare), data, size)

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
            if not bounded(e, slopes[head]):
                break
            change = state_step(e, slopes, head, size)
            trials = (at(model, here.x0[0] + factor * change, simulator) for factor in SHORTENED)
            found = next((trial for trial in trials if trial[0] < cost * (1 - 1e-6)), None)
            if found is None:
                break
            cost, here = found
        return cost, here

    coarse = simulator if bare is None else simulator.in_first_steps(bare[0].plant(bare[1]), data)
    if bare is not None:
        starts.append(descended(bare[1], starts[0], 1, bare[0])[1].x0[0])
    ends = [descended(candidate, start, steps, coarse) for start in starts]
    if coarse is not simulator:
        # The nearer one in the simulator's own steps; both where they run away in longer ones.
        nearer = min(ends, key=lambda end: end[0])
        starts = [nearer[1].x0[0]] if np.isfinite(nearer[0]) else starts
        ends = [descended(candidate, start, steps) for start in starts]
    here = min(ends, key=lambda end: end[0])[1]
    if phased:
        known = _with_phases(simulator, here, phased, data, size)
        _, begun = descended(known, here.x0[0], steps)
        here = _with_phases(simulator, begun.with_terms(candidate.terms), phased, data, size)
    y = simulator.run(here, data)
    e, _ = decided_residual(simulator, here, data, y)
    return FreeRun(y, e, data.kept & ~head)


def _head(simulator: Simulator, linear: Candidate, data: Data, size: np.ndarray) -> np.ndarray:
    """Samples from which the first state is estimated: `HEAD` of the record, doubled up to `MOST` while the error of
    that state adds more than `BY_STATE` to the rest. What nothing holds moves on for ever as it began.

    To first order, of a linear model, with noise in proportion to the size of each output.
    """
    states = 2 * simulator.setup.dofs
    rest = Candidate(linear.entries, (np.zeros(states),), linear.terms)
    slopes = simulator.run_and_jacobian(rest, data)[1][: data.samples, :, len(linear.entries) :][:, :, :states]
    length, head = max(int(HEAD * data.samples), 3 * states), np.zeros_like(data.kept)
    if bounded(slopes):
        slopes = np.where(data.kept[: data.samples, :, None], slopes / size[:, None], 0.0)
        slopes = slopes / np.maximum(np.linalg.norm(slopes, axis=(0, 1)), 1e-300)
        while 2 * length <= MOST * data.samples and not _determined(slopes, data.kept, length):
            length *= 2
    head[:length] = data.kept[:length]
    return head


def _determined(slopes: Float[np.ndarray, "samples outputs states"], kept: np.ndarray, length: int) -> bool:
    """Whether the first samples determine a first state so well that its error hardly adds to the rest."""
    seen, later = (part.reshape(-1, slopes.shape[2]) for part in np.split(slopes, [length]))
    # What they do not determine may be anything.
    spread = np.linalg.inv(seen.T @ seen + NOTHING * np.eye(slopes.shape[2]))
    return bool(np.sum((later @ spread) * later) <= BY_STATE * np.sum(kept[length : len(slopes)]))


def _with_phases(simulator: Simulator, here: Candidate, terms: tuple[Term, ...], data: Data, size) -> Candidate:
    """A candidate with terms of which a record has its own amplitude and phase, those that least squares give."""
    best, after = (np.inf, here), here.with_terms((*here.terms, *terms))
    for _ in range(TURNS):
        y, J = simulator.run_and_jacobian(after, data)
        e = np.where(data.kept, data.y - y, 0.0)
        cost = float(np.sum((e / size) ** 2)) if bounded(e, J[data.kept]) else np.inf
        if not cost < best[0]:
            break
        best, moved, last = (cost, after), [], J.shape[2]
        for term in reversed(after.terms[len(here.terms) :]):
            p = np.array(term.values, dtype=float)
            own, first = _of_one_record(term), last - len(estimated(term))
            change = np.zeros(len(p))
            moved.append((term, p, own, [first + estimated(term).index(k) for k in own], change))
            last = first
        columns = [k for *_, at, _ in moved for k in at]
        step = state_step(e, J[:, :, columns], data.kept, size)
        for _, _, own, at, change in moved:
            change[own], step = step[: len(at)], step[len(at) :]
        new = [Term(t.effect, t.place, t.effect.bounded(t.effect.moved(p, change))) for t, p, *_, change in moved]
        after = here.with_terms((*here.terms, *reversed(new)))
    return best[1]


def _of_one_record(term: Term) -> list[int]:
    """Positions of the parameters of a term that every record has of its own: those that its linear parts differ in,
    and its amplitude."""
    parts = np.stack(term.effect.basis(np.array(term.values, dtype=float)))
    return [k for k in estimated(term) if term.effect.parameters[k].amplitude or np.ptp(parts[:, k]) > 0]


def overall(rmse: Float[np.ndarray, " outputs"], floor: Float[np.ndarray, " outputs"]) -> float:
    """RMS over outputs of the error in units of the noise floor."""
    return float(np.sqrt(np.mean((rmse / floor) ** 2)))


def on_the_same(*every: list[FreeRun]) -> tuple[list[FreeRun], ...]:
    """Sets of runs, each over the samples that count in all of them."""
    kept = [np.logical_and.reduce([run.kept for run in runs]) for runs in zip(*every)]
    return tuple([dataclasses.replace(run, kept=both) for run, both in zip(one, kept)] for one in every)


def rms_of(runs: list[FreeRun]) -> np.ndarray:
    """Root mean square error per output over several runs."""
    power = sum(np.sum(np.where(run.kept, run.e, 0.0) ** 2, axis=0) for run in runs)
    count = sum(run.kept.sum(axis=0) for run in runs)
    return np.maximum(np.sqrt(power / np.maximum(count, 1)), 1e-300)
