"""One page for each effect, made from the catalogue, and an overview of all."""

import inspect
import json
from collections.abc import Iterator
from pathlib import Path

from ..demonstration_effects import DEMONSTRATED
from ..diagnosis.model.own_laws import ParameterError
from ..diagnosis.words.titles import name_of
from ..mechanics.effects import CATALOGUE, MODEL_ERRORS, AbstractEffect
from ..report.documents.catalogue import UNITS, catalogue_document, unit_pattern
from .effect_pictures import picture
from .look_alikes import TOLD_APART

SIZES = Path(__file__).parent / "smallest_sizes.json"

CHANNELS = "--inputs u1,u2 --outputs y1,y2"

ONLY = "coulomb_friction,stribeck_friction"

OVERVIEW, ERRORS, FINDINGS = "index.md", "model_errors.md", "record_findings.md"


def write_effect_pages(folder: Path) -> None:
    """Write the pages and their pictures.

    **Arguments:** `folder`: where to; made if it is not there.
    """
    document = catalogue_document()
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    shown = {}
    for effect in CATALOGUE + MODEL_ERRORS:
        made = picture(effect)
        (folder / "pictures" / f"{effect.id}.svg").write_bytes(made.svg)
        shown[effect.id] = _framed(f"![{made.words}](pictures/{effect.id}.svg)", "picture")
    pages = {OVERVIEW: _overview(document), ERRORS: _errors(document, shown), FINDINGS: _findings(document)}
    sizes = smallest_sizes()
    for effect, described in zip(CATALOGUE, document["effects"], strict=True):
        pages[f"{effect.id}.md"] = _page(effect, described, shown[effect.id], sizes.get(effect.id))
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")


def navigation() -> list:
    """The pages as entries of a menu, by family, paths from the folder of all pages."""
    families: dict[str, list[str]] = {}
    for effect in CATALOGUE:
        families.setdefault(effect.family, []).append(f"effects/{effect.id}.md")
    grouped = [{family.capitalize(): pages} for family, pages in families.items()]
    return [f"effects/{OVERVIEW}", *grouped, f"effects/{ERRORS}", f"effects/{FINDINGS}"]


def smallest_sizes() -> dict[str, dict]:
    """What the demonstration would have shown, by id: `location` and `sizes` of the parameters; empty where unknown."""
    return json.loads(SIZES.read_text(encoding="utf-8"))["effects"] if SIZES.exists() else {}


def look_alikes(effect: AbstractEffect) -> dict[str, str]:
    """Ids of effects that may be taken for this one, with the reason in a few words."""
    found: dict[str, list[str]] = {}
    for other in CATALOGUE:
        if other.id != effect.id:
            for why in _relations(effect, other):
                found.setdefault(other.id, []).append(why)
    return {id: "; ".join(reasons) for id, reasons in found.items()}


def _relations(effect: AbstractEffect, other: AbstractEffect) -> Iterator[str]:
    if other.id in effect.contains:
        yield "the simpler law that is left where the further parameters vanish"
    if other.id in effect.renamed:
        yield "a simpler law that this one contains, with other names of the parameters"
    if other.id in effect.becomes:
        yield "what this law looks like where its own features are too small to be seen"
    if effect.id in other.contains:
        yield "a wider law, which is this one where its further parameters vanish"
    if effect.id in other.renamed:
        yield "a wider law, which contains this one with other names of the parameters"
    if effect.id in other.becomes:
        yield "a law that looks like this one where its own features are too small to be seen"
    if effect.resembles and effect.resembles == other.resembles:
        yield f"both appear as {_counted(effect.resembles)}"


def _counted(word: str) -> str:
    return {"offset": "an offset", "change of a parameter": "a change of a parameter"}.get(word, word)


def _page(effect: AbstractEffect, described: dict, shown: str, size: dict | None) -> str:
    parts = [
        f"# {_title(effect.id)}",
        f"`{effect.id}`, of the family {effect.family}. {_summary(effect)}",
        _law(effect.law),
        shown,
        "## Parameters",
        _parameters(described),
        "## Where it can act",
        f"{_capital(described['places_text'])}.",
        "## What gives it away",
        f"{_capital(effect.signature)}.",
        *_alike(effect),
        *_smallest(effect, size),
        "## Look for it alone",
        _alone(effect),
        "## Reference",
        f"{effect.reference}.",
    ]
    return "\n\n".join(parts) + "\n"


def _title(id: str) -> str:
    return _capital(name_of(id))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _summary(effect: AbstractEffect) -> str:
    return " ".join(inspect.getdoc(type(effect)).split("\n\n")[0].split())


def _law(law: str) -> str:
    return _framed(f"```text\n{law}\n```", "law")


def _framed(text: str, name: str) -> str:
    """Markdown in an element with a class of its own."""
    return f'<div class="{name}" markdown>\n\n{text}\n\n</div>'


def _parameters(described: dict) -> str:
    rows = ["| parameter | unit | range | estimated |", "|---|---|---|---|"]
    for one in described["parameters"]:
        name = f"`{one['name']}`" + (f", {one['count']} of them" if one["count"] > 1 else "")
        choices = " or ".join(one["choices"])
        estimated = f"no, {choices}" if choices else "yes" if one["estimated"] else "no, set by the record"
        unit = "none" if one["unit"] == "1" else one["unit"]
        rows.append(f"| {name} | {unit} | {'' if choices else _range(one)} | {estimated} |")
    note = f"\n\n{UNITS}" if described["family"] in ("actuator", "sensor") else ""
    return "\n".join(rows) + note


def _range(parameter: dict) -> str:
    lower, upper = parameter["lower"], parameter["upper"]
    if lower is None and upper is None:
        return "any"
    if upper is None:
        return f"from {lower:g}"
    return f"up to {upper:g}" if lower is None else f"{lower:g} to {upper:g}"


def _alike(effect: AbstractEffect) -> list[str]:
    found, hint = look_alikes(effect), TOLD_APART.get(effect.id)
    if not found and hint is None:
        return []
    parts = ["## What looks like it"]
    if found:
        rows = [f"| [{_title(id)}]({id}.md) | {why} |" for id, why in found.items()]
        parts.append("\n".join(["| effect | why |", "|---|---|", *rows]))
    if hint is not None:
        parts.append(f"**An experiment that tells them apart.** {hint}" if found else f"**An experiment.** {hint}")
    return parts


def _smallest(effect: AbstractEffect, size: dict | None) -> list[str]:
    if size is None:
        return []
    powers = {parameter.name: parameter.unit for parameter in effect.parameters}
    units = {name: _in_newtons(unit_pattern(powers[name])) for name in size["sizes"]}
    rows = [f"| `{name}` | {value:.2g} {units[name]} |" for name, value in size["sizes"].items()]
    return [
        "## Smallest size that is seen",
        f"In the records of `jaxgray demo`, at `{size['location']}`, a diagnosis would have shown this effect from "
        "about this size. A record of your own has its own smallest sizes, and every diagnosis says them.",
        "\n".join(["| parameter | size |", "|---|---|", *rows]),
    ]


def _in_newtons(unit: str) -> str:
    return "" if unit == "1" else unit.replace("force", "N").replace("length", "m")


def _alone(effect: AbstractEffect) -> str:
    options = f"`--scheduling p --only {effect.id}`" if effect.scheduled else f"`--only {effect.id}`"
    text = f"A diagnosis looks for it alone with {options}."
    if effect.id not in DEMONSTRATED:
        return text
    demo = f"```sh\njaxgray demo --effect {effect.id}\n```"
    return f"{text} This command hides it in a simulated record and finds it:\n\n{demo}"


def _overview(document: dict) -> str:
    families: dict[str, list[dict]] = {}
    for effect in document["effects"]:
        families.setdefault(effect["family"], []).append(effect)
    parts = [
        "# The effects",
        f"What a diagnosis can name: {len(document['effects'])} laws that a linear model may lack, by family. Each has "
        "a page with a picture, its parameters and what looks like it. "
        f"[Wrong numbers of a given model]({ERRORS}) and [findings on the record itself]({FINDINGS}) have pages too.",
        "`jaxgray effects` prints the same list. A diagnosis looks for all of them, or for those that `--only` names:",
        f"```sh\njaxgray effects --json effects.json\n"
        f"jaxgray diagnose record.csv {CHANNELS} \\\n    --only {ONLY}\n```",
    ]
    for family, effects in families.items():
        rows = [f"| [{_title(one['id'])}]({one['id']}.md) | `{one['law']}` | {one['signature']} |" for one in effects]
        parts += [f"## {family.capitalize()}", "\n".join(["| effect | law | told by |", "|---|---|---|", *rows])]
    return "\n\n".join(parts) + "\n"


def _errors(document: dict, shown: dict[str, str]) -> str:
    described = document["model_errors"]
    parts = [
        "# Errors of a given model",
        "Where you bring your own model, single entries of its matrices may be wrong, and numbers of the effects that "
        "it has. A diagnosis tests that before any law, and only there.",
        f"```sh\njaxgray diagnose record.csv {CHANNELS} --model model.json\n```",
    ]
    for effect, one in zip((*MODEL_ERRORS, ParameterError()), described, strict=True):
        parts += [
            f"## {_title(effect.id)}",
            f"`{effect.id}`. {_summary(effect)} It acts at {one['places_text']}. Told by: {effect.signature}.",
            _law(effect.law),
            *([shown[effect.id]] if effect.id in shown else []),
            _parameters(one),
            f"Reference: {effect.reference}.",
        ]
    return "\n\n".join(parts) + "\n"


def _findings(document: dict) -> str:
    rows = [f"| {_capital(one['name'])} | `{one['id']}` | {one['signature']} |" for one in document["record_findings"]]
    parts = [
        "# Findings on the record",
        "What a diagnosis says of the record itself. These are not laws: nothing is added to the model for them, and "
        "the verdict stays as it is.",
        "\n".join(["| finding | id | told by |", "|---|---|---|", *rows]),
        "Every diagnosis looks for all of them; there is no option to choose.",
    ]
    return "\n\n".join(parts) + "\n"
