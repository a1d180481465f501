"""The vector that a refit moves: matrices, parameters of the laws, and first states."""

import numpy as np
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects.base import Term
from .candidate import Candidate, Setup, estimated


class Layout:
    """Where each parameter stands in the vector that a refit moves.

    Linear entries, then the first state of every record, then the estimated values of every term.
    """

    def __init__(self, setup: Setup, candidate: Candidate):
        self.entries = len(candidate.entries)
        self.states = 2 * setup.dofs
        self.records = len(candidate.x0)
        self.terms = [(k, j) for k, term in enumerate(candidate.terms) for j in estimated(term)]
        self.first = self.entries + self.records * self.states
        self.size = self.first + len(self.terms)
        parameters = [candidate.terms[k].effect.parameters[j] for k, j in self.terms]
        self.lower = np.array([p.lower for p in parameters])
        self.upper = np.array([p.upper for p in parameters])
        self.scales = np.array([p.lower == 0.0 and not p.amplitude for p in parameters], bool)

    def widened(self, J: np.ndarray, record: int) -> np.ndarray:
        """The Jacobian of one record with columns for the other records' first states."""
        if self.records == 1:
            return J
        full = np.zeros((*J.shape[:2], self.size))
        full[:, :, : self.entries] = J[:, :, : self.entries]
        at = self.entries + record * self.states
        full[:, :, at : at + self.states] = J[:, :, self.entries : self.entries + self.states]
        full[:, :, self.first :] = J[:, :, self.entries + self.states :]
        return full

    def vector(self, candidate: Candidate) -> np.ndarray:
        """All parameters of a candidate."""
        values = [float(candidate.terms[k].values[j]) for k, j in self.terms]
        return np.concatenate([candidate.entries, *candidate.x0, values])

    def last(self, candidate: Candidate) -> np.ndarray:
        """Which parameters are of the last term."""
        owners = np.array([k for k, _ in self.terms], int)
        return np.concatenate([np.zeros(self.first, bool), owners == len(candidate.terms) - 1])

    def shape_of_last(self, candidate: Candidate) -> np.ndarray:
        """Which parameters are of the last term and not among its amplitudes."""
        amplitude = np.zeros(self.size, bool)
        amplitude[self.first :] = [candidate.terms[k].effect.parameters[j].amplitude for k, j in self.terms]
        return self.last(candidate) & ~amplitude

    def limited(self, change: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """A step shortened so that no positive scale (a length, a gap, a time) more than doubles or halves."""
        now, wanted = theta[self.first :][self.scales], change[self.first :][self.scales]
        most = np.where(wanted > 0, now, now / 2)
        moving = (now > 0) & (np.abs(wanted) > most)
        return change * np.min(most[moving] / np.abs(wanted[moving]), initial=1.0)

    def moved(self, theta: np.ndarray, change: np.ndarray, like: Candidate) -> np.ndarray:
        """The parameters after a step, along the curve that every effect prefers."""
        result = theta + change
        for k, term in enumerate(like.terms):
            at = [self.first + a for a, (owner, _) in enumerate(self.terms) if owner == k]
            own = [j for owner, j in self.terms if owner == k]
            step = np.zeros(len(term.effect.parameters))
            step[own] = change[at]
            if np.any(step):
                moved = term.effect.bounded(term.effect.moved(np.array(term.values, dtype=float), step))
                result[at] = moved[own]
        return result

    def candidate(self, theta: np.ndarray, like: Candidate) -> Candidate:
        """The candidate that a vector stands for, the rest as in another."""
        x0 = np.split(theta[self.entries : self.first], self.records)
        values = [np.array(term.values, dtype=float) for term in like.terms]
        for (k, j), value in zip(self.terms, theta[self.first :]):
            values[k][j] = value
        terms = tuple(Term(t.effect, t.place, v) for t, v in zip(like.terms, values))
        return Candidate(theta[: self.entries], tuple(x0), terms)


def state_step(
    e: Float[np.ndarray, "samples outputs"],
    J: Float[np.ndarray, "samples outputs states"],
    kept: Bool[np.ndarray, "samples outputs"],
    scale: Float[np.ndarray, " outputs"],
) -> Float[np.ndarray, " states"]:
    """Gauss-Newton step of a first state: residual `e` and sensitivities `J` of the samples `kept`, in units of
    `scale`."""
    table = np.where(kept[:, :, None], J / scale[:, None], 0.0).reshape(-1, J.shape[2])
    return pseudo_inverse(table.T @ table) @ (table.T @ np.where(kept, e / scale, 0.0).reshape(-1))
