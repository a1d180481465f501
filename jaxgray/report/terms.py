"""Effects of a model in files: id, place, and parameters by symbol; those of one symbol make a list."""

import numpy as np

from ..mechanics.effects import by_id
from ..mechanics.effects.base import Term, places_of


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
        raise ValueError(f"effects: {document!r} is no effect; give an object with effect, location and parameters.")
    effect = by_id(document["effect"])
    places = {place.name: place for place in places_of(effect, input_names, output_names, hidden)}
    if document["location"] not in places:
        raise ValueError(
            f"effects: {effect.id} cannot act at {document['location']!r}; give one of {', '.join(places) or 'none'}."
        )
    given = {k: list(v) if isinstance(v, list) else [v] for k, v in dict(document["parameters"]).items()}
    values = []
    for parameter in effect.parameters:
        rest = given.get(parameter.name)
        if not rest:
            raise ValueError(f"effects: {effect.id} at {document['location']} lacks the parameter {parameter.name}.")
        value = rest.pop(0)
        if parameter.choices:
            if value not in parameter.choices:
                choices = ", ".join(parameter.choices)
                raise ValueError(f"effects: {effect.id} has {parameter.name} = {value!r}; give one of {choices}.")
            value = parameter.choices.index(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise ValueError(f"effects: {effect.id} has {parameter.name} = {value!r}; give a finite number.")
        values.append(float(value))
    return Term(effect, places[document["location"]], np.array(values))
