"""What the loop of a diagnosis works with."""

import dataclasses
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import AbstractEffect
from ...numerics.progress import AbstractProgress
from ..model.candidate import Candidate, Data
from ..model.simulator import Simulator
from ..noise.whitening import NoiseModel, estimate_noise_model
from ..screening.linearization import Stage, sampled_plant, stage_of
from .gauss_newton import Refit

if TYPE_CHECKING:
    from ..equation_error.search import Search, Trial


@dataclass(frozen=True)
class SearchContext:
    """What the loop works with.

    `simulator`; `data` of estimation and of validation; `catalogue`; `names` of inputs and outputs; `held`: entries
    that do not move; `floor`: independent noise floor per output, or None; `separate`: whether validation has a clock
    of its own; `rng`; `progress`; `identified`: the model that the records give, where a user's own is judged;
    `forces`: gives what the force equation finds (None where it has no solution), where it may be asked: of all laws,
    or of the first alone;
    `first_trials`: gives its trials of the first law, where they only start refits; `trials_at_once`: whether those are
    refitted with the first candidates, not only where these leave more than noise; `out_of_phase`: whether the free run
    is of no use unless laws of the force equation bring it into phase; `others`: gives linear models other than the
    best one, where there may be some.
    """

    simulator: Simulator
    data: list[Data]
    validation: list[Data]
    catalogue: tuple[AbstractEffect, ...]
    names: tuple[tuple[str, ...], tuple[str, ...]]
    held: np.ndarray
    floor: np.ndarray | None
    separate: bool
    rng: np.random.Generator
    progress: AbstractProgress
    identified: "Identified | None" = None
    forces: "Callable[[bool], Search | None] | None" = None
    first_trials: "Callable[[], list[Trial]] | None" = None
    trials_at_once: bool = False
    out_of_phase: bool = False
    others: "Callable[[], tuple[Candidate, ...]] | None" = None


def stage_of_candidate(context: SearchContext, candidate: Candidate) -> Stage:
    """The model on the first record, without the columns of what is held."""
    stage = stage_of(context.simulator, candidate, context.data[0])
    entries = len(candidate.entries)
    kept = np.concatenate([~context.held, np.ones(stage.J.shape[2] - entries, bool)])
    return dataclasses.replace(stage, J=stage.J[:, :, kept])


_noise_models: "weakref.WeakKeyDictionary[Refit, tuple[Data, NoiseModel]]" = weakref.WeakKeyDictionary()


def noise_model_of(context: SearchContext, fit: Refit) -> NoiseModel:
    """The noise model of what a refit leaves of the first record; estimated once, however often it is asked for."""
    data, known = context.data[0], _noise_models.get(fit)
    if known is None or known[0] is not data:
        _noise_models[fit] = known = data, _estimated(context, fit, data)
    return known[1]


def _estimated(context: SearchContext, fit: Refit, data: Data) -> NoiseModel:
    plant = context.simulator.plant(fit.candidate)
    system = sampled_plant(plant, data, context.simulator.setup.outputs)
    force = context.simulator.input_power(data)
    return estimate_noise_model(fit.residual[0], data.kept, system, force)


@dataclasses.dataclass(frozen=True)
class Identified:
    """`entries`: joined blocks θ̂ of the identified M, D, K; `x0`: first states; `information`: H of the entries, first
    states and laws taken out."""

    entries: Float[np.ndarray, " entries"]
    x0: tuple[Float[np.ndarray, " states"], ...]
    information: Float[np.ndarray, "entries entries"]
