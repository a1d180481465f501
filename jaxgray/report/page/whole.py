"""One HTML file for a result: complete in itself, it loads nothing."""

import base64
import functools
import gzip
import json
from importlib.metadata import PackageNotFoundError, version

import jinja2
from markupsafe import Markup

from ...diagnosis.result import Diagnosis
from ...identification import Identification
from ...numerics.whole_files import write_whole
from ..documents.diagnosis import diagnosis_document
from ..documents.export import plain
from ..documents.identification import identification_document
from .diagnosis import diagnosis_page
from .identification import identification_page
from .parts import Page, Plot

LARGEST = 6_000_000
"""Bytes that a page stays under."""


def write_report(result: Identification | Diagnosis, path, *, notes: tuple[str, ...] = ()) -> None:
    """Write a result as one HTML file to open, print and send: it holds all it needs and works without a network.

    **Arguments:** `result`: of `identify` or `diagnose`; `path`: of the file, which is whole or not there; `notes`:
    from reading the record, put before the warnings of the result; default none.

    **Raises:** `ValueError` for another kind of result, or a folder that is not there.

    **Example:**

        >>> import pathlib
        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> jaxgray.write_report(jaxgray.identify(record), "report.html")
        >>> pathlib.Path("report.html").read_text(encoding="utf-8").lstrip()[:15].lower()
        '<!doctype html>'
    """
    write_whole(html_of(result, notes).encode(), path)


def html_of(result: Identification | Diagnosis, notes: tuple[str, ...] = ()) -> str:
    """The page of a result as text.

    **Arguments:** `result`; `notes`: put before the warnings of the result.

    **Raises:** `ValueError` for another kind of result.
    """
    return rendered(page_of(result, notes))


def page_of(result: Identification | Diagnosis, notes: tuple[str, ...] = ()) -> Page:
    """What a page says, without its markup; arguments as for `html_of`."""
    if isinstance(result, Diagnosis):
        return diagnosis_page(result, diagnosis_document(result, tuple(notes)))
    if isinstance(result, Identification):
        return identification_page(result, plain(identification_document(result, tuple(notes))))
    raise ValueError(f"result is a {type(result).__name__}; give what identify or diagnose returned.")


def rendered(page: Page, *, library_at: str | None = None) -> str:
    """A page as HTML.

    **Arguments:** `page`; `library_at`: name of a file beside the page that holds `library_script`, for folders of many
    pages; default none: the page is complete in itself.
    """
    drawings = [block.drawing() for section in page.sections for block in section.blocks if isinstance(block, Plot)]
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            page=page,
            version=own_version(),
            document=_script(_slim(page.document)),
            drawings=_script(drawings),
            library=Markup(library()) if drawings and library_at is None else "",
            library_at=library_at if drawings else None,
        )
    )


def _slim(document: dict) -> dict:
    """The document without the samples of a proposed input, which the JSON file has."""
    proposed = document.get("next_experiment")
    if proposed is None:
        return document
    return document | {"next_experiment": {key: value for key, value in proposed.items() if key != "input"}}


def _script(data) -> Markup:
    """JSON that can stand inside a script element."""
    text = json.dumps(plain(data), allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


@functools.cache
def environment() -> jinja2.Environment:
    """The templates."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("jaxgray.report"), autoescape=True, undefined=jinja2.StrictUndefined
    )


@functools.cache
def library() -> str:
    """The plotting library, compressed, as text."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode()


def library_script() -> str:
    """The plotting library as a script that pages beside it load: it puts the text where a page would have had it."""
    element = f'{{type: "text/plain", id: "library", textContent: "{library()}"}}'
    return f'document.currentScript.after(Object.assign(document.createElement("script"), {element}));\n'


def own_version() -> str:
    """The version of jaxgray that is installed; empty where it runs from its folder."""
    try:
        return version("jaxgray")
    except PackageNotFoundError:
        return ""
