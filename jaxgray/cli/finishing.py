"""What all commands share: the options of the start in the library's words, and the way out of a command."""

import importlib
import io
import json
import sys
from pathlib import Path

from .arguments import Excitation, Talk, numbers


def subspace_options(excitation: Excitation) -> dict:
    """Keywords of `identify`, `sweep` and `diagnose` for the drive and the subspace start."""
    return {
        "excitation": excitation.excitation,
        "relative": excitation.relative,
        "input_map": excitation.input_map,
        "time_constants": numbers("--time-constant", excitation.time_constant),
        "block_rows": numbers("--block-rows", excitation.block_rows, int),
        "weight": excitation.weight,
        "map": excitation.map,
    }


def finish(document: dict, show, talk: Talk, target: str | None, files: dict[Path, bytes], notes: list[str]) -> None:
    """Write everything that was asked for, then say it; the reader's notes go to the error stream."""
    from ..numerics.whole_files import write_together
    from ..report import terminal
    from ..report.documents import export

    wanted = {target: export.json_text(document).encode()} if target not in (None, "-") else {}
    write_together(files | wanted)
    if target == "-":
        sys.stdout.write(json.dumps(export.plain(document), allow_nan=False, indent=1) + "\n")
        notes = document["warnings"]
    elif not talk.quiet:
        own = [text for text in document["warnings"] if text not in notes]
        show(terminal.console(), document | {"warnings": own})
    if not talk.quiet:
        for text in notes:
            print(f"warning: {' '.join(text.split())}", file=sys.stderr)


def page(path: Path | None, result, notes: list[str]) -> dict[Path, bytes]:
    """A result as a page, by the file it goes to; none without one; `notes`: from reading, put before its warnings."""
    if path is None:
        return {}
    from ..report.page.whole import html_of

    return {path: html_of(result, tuple(notes)).encode()}


def drawn(folder: Path | None, module: str, names: tuple[str, ...], result) -> dict[Path, bytes]:
    """Figures as PNG, by the files they go to; none without a folder.

    **Arguments:** `folder`: made if it is not there; `module` of `report.figures`; `names` of its functions,
    which are those of the files; `result`: what is drawn.
    """
    if folder is None:
        return {}
    home = importlib.import_module(f"jaxgray.report.figures.{module}")
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name in names:
        buffer = io.BytesIO()
        getattr(home, name)(result).savefig(buffer, format="png", dpi=150)
        files[folder / f"{name}.png"] = buffer.getvalue()
    return files
