"""The one rule by which a candidate becomes a finding, whatever likelihood it was refitted under.

It must be significant (ΔBIC, and an amplitude of some standard errors), sound (at no physical bound, and no other law
under this name), explain at least a tenth of what the model without it leaves above the noise, and its gain on held-out
data must be sure (99 %).
"""

import abc

import numpy as np

from ..mechanics.effects.base import Parameter, Term
from . import settings
from .findings import Gain, Reason, Refusal


class AbstractEvidence(abc.ABC):
    """What the data of the fit say of a refitted candidate; every likelihood has its own."""

    delta_bic: float

    @abc.abstractmethod
    def bound(self) -> str | None:
        """The parameter that ran to its physical bound, None where none did."""

    @abc.abstractmethod
    def other_law(self) -> str | None:
        """Why the law is another one at these values, None where it is not."""

    @abc.abstractmethod
    def size(self) -> float:
        """Its amplitude in standard errors."""

    @abc.abstractmethod
    def explained(self) -> float:
        """Share that it takes off what the model without it leaves above the noise."""

    def follows_inputs(self) -> bool:
        """Whether what it leaves comes back in the inputs, as a closed loop makes it."""
        return False


def unsound(evidence: AbstractEvidence) -> Refusal | None:
    """What speaks against a candidate whatever it gains, None for nothing."""
    if evidence.delta_bic < settings.MIN_DELTA_BIC:
        return Refusal(Reason.NO_EVIDENCE, f"the refit explains too little (ΔBIC {evidence.delta_bic:.0f})")
    if evidence.follows_inputs():
        return Refusal(Reason.FEEDBACK, "the inputs follow what it leaves: a closed loop looks the same")
    if (bound := evidence.bound()) is not None:
        return at_its_bound(bound)
    if (law := evidence.other_law()) is not None:
        return Refusal(Reason.OTHER_LAW, law)
    # An amplitude that a shape moves along with has a wide error, though nothing explains the record without it.
    least = (
        settings.MIN_STANDARD_ERRORS
        if evidence.delta_bic < settings.CLEAR_DELTA_BIC
        else settings.MIN_STANDARD_ERRORS_IF_CLEAR
    )
    if (size := evidence.size()) < least:
        return Refusal(Reason.UNCERTAIN, f"only {size:.1f} standard errors from nothing")
    return None


def negligible(evidence: AbstractEvidence, of: str) -> Refusal | None:
    """Whether it explains too little `of` what is left to be of interest."""
    share = evidence.explained()
    return (
        None
        if share >= settings.MIN_EXPLAINED_SHARE
        else Refusal(Reason.NEGLIGIBLE, f"explains only {100 * share:.0f} % of {of}")
    )


def unproven(gain: Gain, on: str = "held-out data") -> Refusal | None:
    """Whether its gain is not sure on these data, or may be a large loss on others of the kind."""
    if gain.ci99_lower > 0 and gain.ci95[0] < -settings.MAX_LOSS:
        words = f"may as well be a large loss on other records ({gain.percent:.1f} %, from {gain.ci95[0]:.0f} %)"
        return Refusal(Reason.NO_SURE_GAIN, words)
    if gain.ci99_lower > 0:
        return None
    return Refusal(Reason.NO_SURE_GAIN, f"no sure gain on {on} ({gain.percent:.1f} %, from {gain.ci99_lower:.1f} %)")


def at_its_bound(parameter: str) -> Refusal:
    """The refusal of a law with a parameter at a physical bound."""
    return Refusal(Reason.AT_BOUND, f"{parameter} ran to its physical bound")


def bound_of(term: Term, estimated: list[int]) -> str | None:
    """The first of the estimated parameters of a term that lies on a physical bound, None for none. Of a list, with all
    of it: with some of it the list is shorter."""
    names = [term.effect.parameters[j].name for j in estimated]
    bound = [_on_bound(term.effect.parameters[j], float(term.values[j])) for j in estimated]
    for name in names:
        if all(on for other, on in zip(names, bound) if other == name):
            return name
    return None


def _on_bound(parameter: Parameter, value: float) -> bool:
    sides = (bound for bound in (parameter.lower, parameter.upper) if np.isfinite(bound))
    return any(abs(value - bound) <= 1e-9 * max(abs(bound), abs(value), 1e-300) for bound in sides)
