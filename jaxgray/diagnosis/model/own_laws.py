"""Laws that a given model has already: they act in every run of the search, and each of their numbers may be wrong.

They are no findings: a candidate holds what the search adds, and is completed with them where it is simulated. A wrong
number is an effect like others, whose one parameter is what has to be added.
"""

import dataclasses
import functools
from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from ...mechanics.effects import MODEL_ERRORS
from ...mechanics.effects.base import AbstractEffect, Parameter, Term, places_of
from .candidate import Candidate, estimated


class ParameterError(AbstractEffect):
    """Wrong number of an effect that a model has which was given.

    `owner`: the law whose number it is; `at`: which law of the model, and which of its parameters; `value`: as given.
    """

    id = "parameter_error"
    family = "model errors"
    law = "number += delta, in the unit of the number"
    parameters = (Parameter("delta", amplitude=True),)
    signature = "residual like the derivative of the outputs by the number"
    reference = "Ljung, System Identification, Prentice Hall 1999, §7.2"
    places = "law"
    owner: ClassVar[AbstractEffect]
    at: ClassVar[tuple[int, int]]
    value: ClassVar[float]

    def shapes(self, scales):
        return [np.ones(1)]

    def __reduce__(self):
        return _parameter_error, (self.owner, self.at, self.value)


@functools.lru_cache(maxsize=1024)
def _parameter_error(owner: AbstractEffect, at: tuple[int, int], value: float) -> ParameterError:
    parameter = owner.parameters[at[1]]
    delta = Parameter("delta", parameter.unit, parameter.lower - value, parameter.upper - value, amplitude=True)
    known = {"parameters": (delta,), "owner": owner, "at": at, "value": value}
    return type("WrongNumber", (ParameterError,), known)()


def told_apart(name: tuple[str, str]) -> str | tuple[str, str]:
    """What candidates of one kind share, by effect and place: the effect; every wrong number is a kind of its own."""
    return name if name[0] == ParameterError.id else name[0]


def parameter_errors(own: tuple[Term, ...]) -> tuple[ParameterError, ...]:
    """Effects that say which number of the laws of a model is wrong, one for every number that a fit could move."""
    return tuple(
        _parameter_error(term.effect, (k, j), float(term.values[j]))
        for k, term in enumerate(own)
        for j in estimated(term)
    )


def wrong_number(effect: AbstractEffect, own: tuple[Term, ...]) -> str:
    """The name of the place of a wrong number: "Fc of coulomb_friction at y1"; with its position in a list."""
    k, j = effect.at
    term = own[k]
    names = [parameter.name for parameter in term.effect.parameters]
    which = f"[{names[:j].count(names[j])}]" if names.count(names[j]) > 1 else ""
    return f"{names[j]}{which} of {term.effect.id} at {term.place.name}"


def owner_of(effect: AbstractEffect) -> AbstractEffect:
    """The law that an effect says something of: of a wrong number the law that has it, else the effect itself."""
    return effect.owner if isinstance(effect, ParameterError) else effect


def corrected_laws(own: tuple[Term, ...], terms: Iterable[Term]) -> tuple[Term, ...]:
    """All terms that act: corrections of entries, which a model that is saved has in its matrices; the laws of the
    model, with the numbers that some terms correct; the other terms."""
    values, entries, others = [np.array(term.values, dtype=float) for term in own], [], []
    for term in terms:
        if isinstance(term.effect, ParameterError):
            k, j = term.effect.at
            values[k][j] += float(term.values[0])
        else:
            (entries if term.effect in MODEL_ERRORS else others).append(term)
    return (*entries, *(Term(t.effect, t.place, t.effect.bounded(v)) for t, v in zip(own, values)), *others)


def completed(candidate: Candidate, own: tuple[Term, ...]) -> Candidate:
    """A candidate with the laws of the given model among its terms."""
    return candidate.with_terms(corrected_laws(own, candidate.terms)) if own else candidate


def columns_of(candidate: Candidate, own: tuple[Term, ...]) -> tuple[list[int], list[int]]:
    """Where the values of a candidate's terms, and those of the model's own laws, stand among the values of the
    completed candidate's terms."""
    corrections = sum(len(estimated(term)) for term in candidate.terms if term.effect in MODEL_ERRORS)
    counts = [len(estimated(term)) for term in own]
    starts = corrections + np.concatenate([[0], np.cumsum(counts)]).astype(int)
    mine, entry, other = [], 0, int(starts[-1])
    for term in candidate.terms:
        count = len(estimated(term))
        if isinstance(term.effect, ParameterError):
            k, j = term.effect.at
            mine.append(int(starts[k]) + estimated(own[k]).index(j))
        elif term.effect in MODEL_ERRORS:
            mine += range(entry, entry + count)
            entry += count
        else:
            mine += range(other, other + count)
            other += count
    return mine, list(range(corrections, int(starts[-1])))


def laws_of(model, record) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """The laws of a given model as the search takes them, at places that are called as in the record, and why some are
    left out: what belongs to the clock of one record says nothing of another.

    **Raises:** `ValueError` for a law at a place that the record does not have.
    """
    own, left_out = [], []
    for term in model.effects:
        effect = term.effect
        if effect.tied_to_clock or effect.own_phase:
            left_out.append(
                f"{effect.id} at {term.place.name} of the model is left out: it belongs to the clock of one record."
            )
            continue
        places = places_of(effect, record.input_names, record.output_names)
        spot = term.place.first, term.place.second
        place = next((p for p in places if (p.first, p.second) == spot), None)
        if place is None:
            raise ValueError(
                f"model has {effect.id} at {term.place.name!r}, where the record has no channel; give the model that "
                "belongs to the record."
            )
        own.append(dataclasses.replace(term, place=place, values=np.asarray(term.values, dtype=float)))
    return tuple(own), tuple(left_out)
