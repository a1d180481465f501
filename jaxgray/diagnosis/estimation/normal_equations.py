"""Normal equations of a refit: whitened residuals and sensitivities of all records, as products."""

from typing import TYPE_CHECKING

import numpy as np

from ...mechanics.effects.base import AbstractForceEffect
from ..model.candidate import Candidate, Data
from ..model.reversals import decided_residual
from ..model.simulator import Simulator
from ..noise.whitening import SETTLING, NoiseModel, counted

if TYPE_CHECKING:
    from ..model.parameter_vector import Layout


AHEAD = 0.1
"""Share of a step after which the bend of a valley is measured."""

LARGEST = 1e50
"""Whitened values from which a residual or a sensitivity has no products to speak of."""


def weighted(noise_model: NoiseModel, X: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Whitened columns of the samples that count, as a matrix samples·outputs × columns."""
    used = counted(kept)
    if noise_model.is_white:
        # No sample looks at another: the columns stay where they are.
        return (np.linalg.inv(noise_model.lower) @ X * used[:, :, None]).reshape(-1, X.shape[2])
    return noise_model.whiten_rows(np.moveaxis(X, 2, 0), kept, used).reshape(X.shape[2], -1).T


class Equations:
    """Called with a candidate: information H = JᵀJ, gradient g = −Jᵀe, cost eᵀe and count of the whitened samples, then
    residuals e (samples × outputs) and Jacobians J of the outputs (by that record's parameters) of every record as they
    are; None where it overflows.

    The noise model does not count the first samples, of which it has no past, but these tell most of the first state,
    and after a rest in dry friction all of it: they enter as they are, in units of the noise model's level.
    """

    def __init__(self, simulator: Simulator, data: list[Data], noise_model: NoiseModel, layout: "Layout"):
        self.simulator, self.data, self.noise_model, self.layout = simulator, data, noise_model, layout

    def __call__(self, candidate: Candidate):
        runs = [self.simulator.run_and_jacobian(candidate, d, k) for k, d in enumerate(self.data)]
        if not all(np.all(np.isfinite(y)) and np.all(np.isfinite(J)) for y, J in runs):
            return None
        runs = [
            decided_residual(self.simulator, candidate, d, y, J, k)
            for k, (d, (y, J)) in enumerate(zip(self.data, runs))
        ]
        residuals = [e for e, _ in runs]
        H, g, cost, count = 0.0, 0.0, 0.0, 0
        for k, d in enumerate(self.data):
            both = self._rows(runs[k][1], residuals[k], d)
            if not np.max(np.abs(both)) <= LARGEST:
                return None
            table = self.layout.widened(both[None, :, :-1], k)[0]
            H = H + table.T @ table
            g = g - table.T @ both[:, -1]
            cost += float(both[:, -1] @ both[:, -1])
            count += int(counted(d.kept).sum() + d.kept[: self._head(d)].sum())
        return H, g, cost, count, tuple(residuals), tuple(J for _, J in runs)

    def cost(self, candidate: Candidate) -> float:
        """Cost alone; infinite where it overflows."""
        total = 0.0
        for k, d in enumerate(self.data):
            e, _ = decided_residual(self.simulator, candidate, d, self.simulator.run(candidate, d, k), record=k)
            if not np.max(np.abs(e)) <= LARGEST:
                return np.inf
            total += float(np.sum(self._rows(np.empty((*e.shape, 0)), e, d) ** 2))
        return total

    def moved_or_at_rest(self, candidate: Candidate) -> Candidate:
        """The candidate, or the same at rest at first where that is nearer to the records: no slope leads from a moving
        state to one that dry friction holds."""
        if not any(isinstance(term.effect, AbstractForceEffect) for term in self.simulator.completed(candidate).terms):
            return candidate
        rest = Candidate(candidate.entries, tuple(np.zeros_like(x0) for x0 in candidate.x0), candidate.terms)
        return rest if self.cost(rest) < self.cost(candidate) else candidate

    @staticmethod
    def _head(data: Data) -> int:
        return min(SETTLING, len(data.kept) // 4)

    def _rows(self, J: np.ndarray, e: np.ndarray, data: Data) -> np.ndarray:
        """Whitened columns of a Jacobian and a residual, the first samples as they are."""
        both, head = np.concatenate([J, e[:, :, None]], axis=2), self._head(data)
        first = np.where(data.kept[:head, :, None], both[:head] / self.noise_model.level[:, None], 0.0)
        return np.concatenate([first.reshape(-1, both.shape[2]), weighted(self.noise_model, both, data.kept)])

    def bend(self, theta: np.ndarray, candidate: Candidate, change: np.ndarray, now) -> np.ndarray | None:
        """Minus half of Jᵀ times the second derivative of the outputs along a step, by a finite difference.

        **Arguments:** `theta`: the parameters of `candidate`, where the step begins; `change`: the step; `now`: what
        a call gave there.

        **Returns:** the product, one number per parameter, or None where a part of the step overflows.
        """
        H, g, jacobians, slope = now[0], now[1], now[5], 0.0
        ahead = self.layout.candidate(self.layout.moved(theta, AHEAD * change, candidate), candidate)
        for k, d in enumerate(self.data):
            e, _ = decided_residual(self.simulator, ahead, d, self.simulator.run(ahead, d, k), record=k)
            if not np.max(np.abs(e)) <= LARGEST:
                return None
            both = self._rows(jacobians[k], e, d)
            slope = slope + self.layout.widened(both[None, :, :-1], k)[0].T @ both[:, -1]
        return (slope + g + AHEAD * (H @ change)) / AHEAD**2
