"""Effects of a model in files: id, place, and parameters by symbol; those of one symbol make a list."""

import math
import reprlib

import numpy as np

from ...mechanics.effects import by_id
from ...mechanics.effects.base import Term, places_of


def term_document(term: Term) -> dict:
    """A law at its place with its values, in plain words and numbers."""
    values: dict[str, list] = {}
    for parameter, value in zip(term.effect.parameters, np.asarray(term.values).tolist()):
        values.setdefault(parameter.name, []).append(parameter.choices[round(value)] if parameter.choices else value)
    parameters = {name: one[0] if len(one) == 1 else one for name, one in values.items()}
    return {"effect": term.effect.id, "location": term.place.name, "parameters": parameters}


def term_of(document, input_names, output_names, hidden=()) -> Term:
    """The law that `term_document` wrote.

    **Arguments:** `document`; `input_names`, `output_names`, `hidden` coordinates of the model.

    **Raises:** `ValueError` for an effect, a place or parameters that are not known.
    """
    if not isinstance(document, dict) or not {"effect", "location", "parameters"} <= set(document):
        raise ValueError(
            f"effects: {reprlib.repr(document)} is no effect; give an object with effect, location and parameters."
        )
    id, location, parameters = document["effect"], document["location"], document["parameters"]
    if not (isinstance(id, str) and isinstance(location, str) and isinstance(parameters, dict)):
        raise ValueError(
            f"effects: effect, location and parameters are {reprlib.repr([id, location, parameters])}; give two texts "
            "and an object."
        )
    effect = by_id(id)
    places = {place.name: place for place in places_of(effect, input_names, output_names, hidden)}
    if location not in places:
        raise ValueError(
            f"effects: {effect.id} cannot act at {reprlib.repr(location)}; give one of {', '.join(places) or 'none'}."
        )
    given = {name: list(value) if isinstance(value, list) else [value] for name, value in parameters.items()}
    values = []
    for parameter in effect.parameters:
        rest = given.get(parameter.name)
        if not rest:
            raise ValueError(f"effects: {effect.id} at {location} lacks the parameter {parameter.name}.")
        value = rest.pop(0)
        shown = f"effects: {effect.id} has {parameter.name} = {reprlib.repr(value)}"
        if parameter.choices:
            if value not in parameter.choices:
                raise ValueError(f"{shown}; give one of {', '.join(parameter.choices)}.")
            value = parameter.choices.index(value)
        values.append(_number(value, shown))
    return Term(effect, places[location], np.array(values))


def _number(value, shown: str) -> float:
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{shown}; give a finite number.")
    return number
