"""Which numbers of a user's model are wrong: begun from the model that the record itself gives.

A frequency that is a little wrong puts a free run out of step, and no small change of the wrong entry seems to help.
Near the identified model θ̂ the cost is a parabola, cost(θ) = cost(θ̂) + (θ − θ̂)ᵀH(θ − θ̂); along one entry e of the
user's model θ its lowest point is δ = eᵀH(θ̂ − θ)/(eᵀHe), and lower by δ²eᵀHe.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..identification import identify
from ..identification.conic import pseudo_inverse
from ..mechanics.drives import Force
from ..mechanics.effects.base import AbstractMatrixEffect
from ..mechanics.simulate import initial_state
from ..numerics.outcomes import ComputationError
from ..records import Record
from .bench import Bench
from .equations import Equations
from .extension import Layout
from .problem import Candidate, Data
from .residual import white_chain
from .response import Simulator
from .screening import Score, Screening
from .stage import Stage, sampled_plant

COUNT = 3
"""Entries of a round that are begun so."""


@dataclasses.dataclass(frozen=True)
class Identified:
    """`entries`: joined blocks θ̂ of the identified M, D, K; `information`: H of them, first states taken out."""

    entries: Float[np.ndarray, " entries"]
    information: Float[np.ndarray, "entries entries"]


def identified(simulator: Simulator, records: list[Record], data: list[Data], options: dict) -> Identified | None:
    """The model that the records themselves give, inputs acting where they do in the user's; None where there is none.

    **Arguments:** `simulator` of the user's model; `records`, and as `data`; `options` of `identify`.
    """
    drive = simulator.setup.drive
    places = {"input_map": np.asarray(drive.input_map)} if isinstance(drive, Force) else {}
    try:
        found = identify(records, **(options | places))
    except (ComputationError, ValueError):
        return None
    entries = simulator.setup.entries_of(found.mass, found.damping, found.stiffness)
    x0 = tuple(initial_state(found.model, r.u, r.y, r.sampling_time, hold=r.hold)[0] for r in records)
    candidate = Candidate(entries, x0)
    e = np.where(data[0].kept, data[0].y - simulator.run(candidate, data[0]), 0.0)
    chain = white_chain(e, data[0].kept, sampled_plant(simulator.plant(candidate), data[0], simulator.setup.dofs))
    made = Equations(simulator, data, chain, Layout(simulator.setup, candidate))(candidate)
    if made is None:
        return None
    H, n = made[0], len(entries)
    across = H[:n, n:] @ pseudo_inverse(H[n:, n:])
    return Identified(entries, H[:n, :n] - across @ H[n:, :n])


def wrong_entries(bench: Bench, stage: Stage, screening: Screening, *, least: float = 0.0) -> list[Score]:
    """Scores of the entries that the identified model says are wrong, with the sizes to begin from, best first; those
    alone that would lower the sum of squares by at least so much, in units of the noise variance."""
    found = bench.identified
    if found is None:
        return []
    setup, plant = bench.simulator.setup, bench.simulator.plant(stage.candidate)
    matrices = tuple(np.asarray(X) for X in (plant.mass, plant.damping, plant.stiffness))
    here = setup.entries_of(*matrices)
    ranked = []
    for score in screening.best_by_place().values():
        effect, place = score.shape.effect, score.shape.place
        if not isinstance(effect, AbstractMatrixEffect) or effect.extra:
            continue
        first, second = np.eye(setup.dofs)[place.first], np.zeros(setup.dofs)
        if place.second >= 0:
            second[place.second] = 1.0
        moved = effect.matrices(np.ones(1), *matrices, first, second)
        along = setup.entries_of(*moved) - here
        curvature = float(along @ found.information @ along)
        if curvature > 0.0:
            size = float(along @ found.information @ (found.entries - here)) / curvature
            ranked.append((size**2 * curvature, dataclasses.replace(score, weights=np.array([size]))))
    ranked.sort(key=lambda pair: -pair[0])
    return [score for worth, score in ranked[:COUNT] if worth > least]
