"""The diagnosis as one immutable result."""

from dataclasses import dataclass

from ..numerics.notebook import Shown
from .findings import DiagnosisFields
from .words.sentences import describe, verdict_sentence


@dataclass(frozen=True, repr=False)
class Diagnosis(DiagnosisFields, Shown):
    """What the simulation gets wrong, why, and what mending it buys.

    `verdict`: the worst over the findings; `baseline`: the linear model (or the user's own); `noise_floor` per output
    and where it comes from; `findings` in order of acceptance; `extended`: the model with all terms, None where
    nothing was found; `gain`: of all findings together; `excess`: RMSE over noise floor of what is left; `white`:
    whether what is left is white; `explainable`: share of the baseline's excess that a flexible competitor could
    explain on held-out data; `depends_on`: variables on which an unexplained rest depends; `rejected`; `not_found`;
    `shifts` of M, D, K; `budget`: share of every term, noise and the unexplained in the baseline's mean square error,
    in percent; `next_experiment`; `warnings`; `curves` for the figures; `identification`: the linear fit, None with
    the user's own model; `terms` accepted; `beside`: forces at the coordinates of the first record that act on the
    linear model beside its inputs, where that stands for the user's own simulator, else None; `simulated`: what
    stands in for a simulation of which only the outputs were given, else None; `energy`: where the work of the inputs
    goes in the model with its laws, None where it has none.
    """

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return verdict_sentence(self)

    def __repr__(self) -> str:
        return describe(self)
