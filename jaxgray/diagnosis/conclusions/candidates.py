"""How the candidates stood: evidence at the gate, and what the refits of those that were not taken came to."""

import dataclasses

from ...records import Record
from ..estimation.context import SearchContext
from ..findings import Gated, Rejected
from ..screening.flexible_force import FlexibleForce
from ..search.state import SearchState
from .assembly import estimates_of, term_errors

MOST = 40
"""Candidates of the gate that a result keeps: far more than anybody reads."""


def gate_of(state: SearchState) -> tuple[Gated, ...]:
    """Evidence for the best candidates at the first look, best first."""
    if state.first is None:
        return ()
    best = state.first.best_by_place().items()
    kept = [(name, score) for name, score in best if name[0] != FlexibleForce.id]
    return tuple(Gated(*name, float(score.delta_bic)) for name, score in kept[:MOST])


def rejected_of(context: SearchContext, state: SearchState, record: Record) -> tuple[Rejected, ...]:
    """What was refitted and not taken, with the parameters that its last refit found."""
    setup, made = context.simulator.setup, []
    for one in state.rejected:
        fit = state.tried.get((one.effect, one.location))
        if fit is not None:
            names = [(term.effect.id, term.place.name) for term in fit.candidate.terms]
            index = names.index((one.effect, one.location))
            estimates = estimates_of(
                fit.candidate.terms[index], term_errors(fit, setup, index), record, per_mass=setup.per_mass
            )
            one = dataclasses.replace(one, parameters=estimates)
        made.append(one)
    return tuple(made)
