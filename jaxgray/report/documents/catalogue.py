"""The catalogue of effects as a list for people and for programs."""

import textwrap

import numpy as np
from rich.console import Console

from ...diagnosis.model.own_laws import ParameterError
from ...diagnosis.words.titles import name_of
from ...mechanics.effects import CATALOGUE, MODEL_ERRORS, RECORD_FINDINGS, AbstractEffect, Parameter

EFFECTS = "jaxgray/effects/1"

PLACES = {
    "coordinate": "a coordinate, y1",
    "spring": "a coordinate y1, or between two y1-y2",
    "pair": "between two coordinates, y1-y2",
    "input": "an input, u1",
    "output": "an output, y1",
    "record": "the whole record",
    "cross": "from a channel to an output, u1->y1",
    "law": "a number of an effect, Fc of coulomb_friction at y1",
}
UNITS = "Of effects at an input, force stands for the unit of the input; of sensors, length for that of the output."
ENTRIES = "an entry: diagonal y1, off-diagonal y1-y2"


def unit_pattern(powers: tuple[int, int, int]) -> str:
    """A unit in the words force, length and s, such as `force s^2/length`; "1" where there is none.

    **Arguments:** `powers` of force, length and time.
    """

    def product(signed) -> list[str]:
        return [name if power == 1 else f"{name}^{power}" for name, power in signed if power > 0]

    names = list(zip(("force", "length", "s"), powers))
    over, under = product(names), product([(name, -power) for name, power in names])
    text = " ".join(over) or "1"
    if not under:
        return text
    return f"{text}/{under[0]}" if len(under) == 1 else f"{text}/({' '.join(under)})"


def catalogue_document() -> dict:
    """The catalogue as the JSON schema `jaxgray/effects/1`: effects, errors of a given model, findings on records."""
    return {
        "schema": EFFECTS,
        "effects": [_effect(effect) for effect in CATALOGUE],
        "model_errors": [
            *(_effect(effect) | {"places_text": ENTRIES} for effect in MODEL_ERRORS),
            _effect(ParameterError()),
        ],
        "record_findings": [
            {"id": id, "name": name_of(id), "signature": signature} for id, signature in RECORD_FINDINGS.items()
        ],
        "warnings": [],
    }


def _effect(effect: AbstractEffect) -> dict:
    parameters: dict[str, dict] = {}
    for parameter in effect.parameters:
        one = parameters.setdefault(parameter.name, _parameter(parameter))
        one["count"] += 1
    return {
        "id": effect.id,
        "name": name_of(effect.id),
        "family": effect.family,
        "law": effect.law,
        "parameters": list(parameters.values()),
        "places": effect.places,
        "places_text": PLACES[effect.places],
        "parity": effect.parity,
        "signature": effect.signature,
        "reference": effect.reference,
    }


def _parameter(parameter: Parameter) -> dict:
    return {
        "name": parameter.name,
        "unit": unit_pattern(parameter.unit),
        "estimated": parameter.counts,
        "lower": parameter.lower if np.isfinite(parameter.lower) else None,
        "upper": parameter.upper if np.isfinite(parameter.upper) else None,
        "choices": list(parameter.choices),
        "count": 0,
    }


def show_catalogue(out: Console, document: dict) -> None:
    """Every effect in a few lines, by family.

    **Arguments:** `out`: where to; `document`: by `catalogue_document`.
    """
    family = ""
    for effect in document["effects"]:
        if effect["family"] != family:
            family = effect["family"]
            out.print(f"\n{family}" if effect is not document["effects"][0] else family, style="bold")
        _show(out, effect)
    out.print("\nerrors of a model that is given (--model)", style="bold")
    for effect in document["model_errors"]:
        _show(out, effect)
    out.print("\nfindings on the record itself, not simulated", style="bold")
    for finding in document["record_findings"]:
        _print(out, f"  {finding['id']}: {finding['signature']}")
    out.print()
    _print(out, UNITS)


def _show(out: Console, effect: dict) -> None:
    _print(out, f"  {effect['id']}: {effect['law']}")
    parameters = ", ".join(
        f"{one['name']} [{one['unit']}]"
        + (f" × {one['count']}" if one["count"] > 1 else "")
        + (f" = {'|'.join(one['choices'])}" if one["choices"] else "" if one["estimated"] else " fixed")
        for one in effect["parameters"]
    )
    _print(out, f"      parameters: {parameters}")
    _print(out, f"      at {effect['places_text']}; told by: {effect['signature']}")


def _print(out: Console, text: str) -> None:
    indent = " " * (len(text) - len(text.lstrip()) + 4)
    out.print(textwrap.fill(text, out.width, subsequent_indent=indent, break_on_hyphens=False), soft_wrap=True)
