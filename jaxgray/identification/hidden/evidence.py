"""What is known of the coordinates that no output measures, beside the model itself."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ...mechanics.model import MechanicalModel


@dataclass(frozen=True)
class Element:
    """A mass, damper or spring of a structure: `name`, such as stiffness[y1-h1]; `value` and `standard_error`, None
    where inputs and outputs do not determine it; `known`: whether it was given."""

    name: str
    value: float | None
    standard_error: float | None
    known: bool


@dataclass(frozen=True)
class OrderStep:
    """One number of hidden coordinates weighed by `--hidden auto`.

    `hidden`: how many; `delta_bic`: BIC minus that of one fewer, the colour of the residual allowed for; `gain_percent`
    and `gain_error`: mean fall of the squared error on held-out data, and its standard error, in percent; `accepted`;
    `failure`: why there is no model, None where there is one.
    """

    hidden: int
    delta_bic: float | None
    gain_percent: float | None
    gain_error: float | None
    accepted: bool
    failure: str | None = None


@dataclass(frozen=True)
class OrderEvidence:
    """How many hidden coordinates, and why: `steps`, and `singular_values` of the largest model's projection."""

    steps: tuple[OrderStep, ...]
    singular_values: Float[np.ndarray, " values"] | None


@dataclass(frozen=True)
class HiddenEvidence:
    """What is known of coordinates that no output measures.

    `names`; `canonical`: whether the model is the canonical form (every hidden coordinate a unit mass), a
    representative and no physical structure; `set_entries`: entries of each matrix that the form sets; `undetermined`:
    entries that inputs and outputs leave open; `combinations`: what they determine instead, in words; `rank` and
    `parameters` of the structure; `elements`: masses, dampers and springs of a structure; `alternatives`: other models
    of the same structure, as likely as the model; `order`: how the number was found, None where it was given.
    """

    names: tuple[str, ...]
    canonical: bool
    set_entries: dict[str, Bool[np.ndarray, "dofs dofs"]]
    undetermined: dict[str, Bool[np.ndarray, "dofs dofs"]]
    combinations: tuple[str, ...]
    rank: int
    parameters: int
    elements: tuple[Element, ...]
    alternatives: tuple[MechanicalModel, ...]
    order: OrderEvidence | None = None

    def kind(self, matrix: str, row: int, column: int) -> str:
        """Of an entry: "set" by the canonical form, "canonical" (it belongs to the representative), "open" (inputs and
        outputs do not determine it), or "physical"."""
        if self.set_entries[matrix][row, column]:
            return "set"
        if self.undetermined[matrix][row, column]:
            return "open"
        measured = len(self.set_entries[matrix]) - len(self.names)
        return "canonical" if self.canonical and max(row, column) >= measured else "physical"

    def sentences(self) -> list[str]:
        """What to keep in mind with the numbers."""
        lines = []
        if self.canonical and self.names:
            lines.append(
                f"Canonical form: {_listed(self.names)} of its own; entries marked * belong to this representative, "
                "their diagonal being the modes with the measured coordinates held still. Entries between measured "
                "coordinates are physical where hidden masses are coupled by springs and dampers alone; named "
                "connections (structure) make all of them so."
            )
        if not self.canonical and self.rank < self.parameters:
            what = f"only {', '.join(self.combinations)}" if self.combinations else "no combination of them"
            open_ones = ", ".join(e.name for e in self.elements if e.value is None and not e.known)
            lines.append(
                f"Inputs and outputs determine {self.rank} of {self.parameters} parameters of this structure: "
                f"{open_ones} stay open, {what} {'is' if len(self.combinations) <= 1 else 'are'} determined."
            )
        if self.alternatives:
            lines.append(
                f"{len(self.alternatives) + 1} sets of this structure's parameters give the same inputs and outputs; "
                "the one shown is no better than the others. Measure one more coordinate, or fix an entry that you "
                "know."
            )
        if self.order is not None:
            lines.append(order_sentence(self.order))
        return lines


def _listed(names: tuple[str, ...]) -> str:
    return f"{names[0]} is a unit mass" if len(names) == 1 else f"each of {', '.join(names)} is a unit mass"


def order_sentence(order: OrderEvidence) -> str:
    """How the number of hidden coordinates was found."""
    parts = []
    for step in order.steps[1:]:
        if step.failure is not None:
            parts.append(f"{step.hidden}: no model ({step.failure})")
        else:
            gain = ""
            if step.gain_percent is not None:
                gain = f", held-out error {-step.gain_percent:+.2g} ± {step.gain_error:.1g} %"
            verdict = "accepted" if step.accepted else "not accepted"
            parts.append(f"{step.hidden}: ΔBIC {step.delta_bic:+.3g}{gain}, {verdict}")
    return "Hidden coordinates weighed: " + "; ".join(parts) + "."
