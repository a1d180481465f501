"""The manual as a folder of pages, which MkDocs makes from those that are written here and those that are generated."""

import hashlib
import importlib
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SCHEMA = "jaxgray/manual/1"
MARK = "manual.json"
"""File by which a folder is known to hold a manual."""

HOME = Path(__file__).parent
PAGES, ASSETS = HOME / "pages", HOME / "assets"

TOOLS = "mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers.python"
NEEDED = "the manual needs mkdocs-material and mkdocstrings: pip install 'jaxgray[docs]'."

SUFFIXES = ".py", ".md", ".json", ".js", ".css"
"""Of the files that the manual is made from."""

UNUSED = "404.html", "sitemap.xml", "sitemap.xml.gz"
"""What only a server has a use for."""


def build(folder: Path) -> Path:
    """Write the manual to a folder, whole or not at all.

    **Arguments:** `folder`: made if it is not there; an earlier manual in it is replaced.

    **Returns:** the path of its first page.

    **Raises:** `ValueError` for a folder that holds anything else, `ImportError` naming the extra to install,
    `RuntimeError` where a page has a fault, such as a link that leads nowhere.
    """
    folder = Path(folder).resolve()
    _check_place(folder)
    _check_tools()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as name:
        work = Path(name)
        _write_sources(work)
        _run_mkdocs(work)
        site = work / "site"
        for unused in UNUSED:
            (site / unused).unlink(missing_ok=True)
        mark = {"schema": SCHEMA, "version": importlib.metadata.version("jaxgray")}
        (site / MARK).write_text(json.dumps(mark) + "\n")
        _put(site, folder, work / "before")
    return folder / "index.html"


def key() -> str:
    """Sixteen hex digits that change with the release and with the files that the manual is made from."""
    digest = hashlib.sha256(importlib.metadata.version("jaxgray").encode())
    package = HOME.parent
    for path in sorted(path for path in package.rglob("*") if path.suffix in SUFFIXES):
        digest.update(f"\n{path.relative_to(package).as_posix()}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _check_place(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ValueError(f"{folder} is a file; give a folder for the manual.")
    if any(folder.iterdir()) and not (folder / MARK).exists():
        raise ValueError(f"{folder} holds other files; give a new folder, an empty one, or one with an earlier manual.")


def _check_tools() -> None:
    for name in TOOLS:
        try:
            importlib.import_module(name)
        except ImportError:
            raise ImportError(NEEDED) from None


def _write_sources(work: Path) -> None:
    """The pages and the configuration, side by side."""
    from .configuration import configuration
    from .effect_pages import write_effect_pages
    from .gallery import write_gallery
    from .reference import reference_page

    pages = work / "pages"
    shutil.copytree(PAGES, pages)
    shutil.copytree(ASSETS, pages / "assets")
    write_effect_pages(pages / "effects")
    write_gallery(pages)
    (pages / "reference.md").write_text(reference_page(), encoding="utf-8")
    # JSON is YAML too.
    (work / "mkdocs.yml").write_text(json.dumps(configuration(HOME.parents[1])), encoding="utf-8")


def _run_mkdocs(work: Path) -> None:
    # In a process of its own: its messages, and what its plug-ins change, stay there.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict"]
    surroundings = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(command, cwd=work, env=surroundings, capture_output=True, text=True)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith(("WARNING", "ERROR"))]
        raise RuntimeError("; ".join(said) or done.stderr.strip() or "MkDocs failed without a word")


def _put(site: Path, folder: Path, before: Path) -> None:
    """Move the new manual to its place, where another may stand, which comes back if that fails."""
    if not folder.exists():
        os.replace(site, folder)
        return
    os.replace(folder, before)
    try:
        os.replace(site, folder)
    except BaseException:
        os.replace(before, folder)
        raise
