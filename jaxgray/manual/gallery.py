"""The gallery: what the examples found, as a page of tables and pictures.

An example writes its table and curves with `--gallery FILE`, where FILE is in the folder `gallery` beside this module;
the tests run the examples and hold the files against what comes out.
"""

import json
from pathlib import Path

import numpy as np

from .effect_curves import Curve, Panel
from .effect_pictures import drawn

FILES = Path(__file__).parent / "gallery"

ORDER = ("paper_simulation", "micro_manipulator", "drive", "building", "learned_force", "fleet_of_drives")

DIGITS = 5
"""Of the numbers of a curve."""

OPTIONS = {"micro_manipulator": " --piezo"}
"""Of the commands, beside the defaults."""

INTRODUCTION = """# Gallery

Simulated machines in which something is hidden that a linear model lacks, by programs that share nothing with
jaxgray, and what it makes of their records. Each is a program in the folder `examples` of the sources, run by the
tests; tables and curves are what came out.
"""


def write_gallery(folder: Path) -> None:
    """Write `gallery.md` and its pictures.

    **Arguments:** `folder`: of all pages.
    """
    pictures = folder / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    parts = [INTRODUCTION]
    for name in ORDER:
        shown = json.loads((FILES / f"{name}.json").read_text(encoding="utf-8"))
        panels = tuple(_panel(one) for one in shown["panels"])
        (pictures / f"{name}.svg").write_bytes(drawn(panels))
        words = f"Left: {panels[0].title}. Right: {panels[1].title}."
        picture = f'<div class="picture" markdown>\n\n![{words}](gallery/{name}.svg)\n\n</div>'
        parts += [f"## {shown['title']}", shown["text"], picture, _table(shown["table"])]
        parts.append(_command(name))
    (folder / "gallery.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _command(name: str) -> str:
    return f"```sh\npython examples/{name}.py{OPTIONS.get(name, '')}\n```"


def keep(shown: dict, path: Path) -> None:
    """Write what an example shows.

    **Arguments:** `shown`: its `title`, `text`, `table` (rows of texts, the head first) and two `panels` with their
    `curves`; `path`: of the file.
    """

    def rounded(values) -> list[float]:
        return [float(f"{value:.{DIGITS}g}") for value in values]

    panels = [
        panel | {"curves": [one | {"x": rounded(one["x"]), "y": rounded(one["y"])} for one in panel["curves"]]}
        for panel in shown["panels"]
    ]
    Path(path).write_text(json.dumps(shown | {"panels": panels}, ensure_ascii=False) + "\n", encoding="utf-8")


def _panel(one: dict) -> Panel:
    curves = tuple(Curve(c["label"], np.array(c["x"]), np.array(c["y"]), c["role"]) for c in one["curves"])
    return Panel(one["title"], one["x_label"], one["y_label"], curves)


def _table(rows: list[list[str]]) -> str:
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
