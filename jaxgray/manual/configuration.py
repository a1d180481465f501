"""How MkDocs is to build the manual: menu, theme, plug-ins, and links that must lead somewhere."""

from pathlib import Path

from .effect_pages import navigation

GROUPS = {
    "First steps": ("start.md", "gallery.md", "choosing.md", "files.md", "commands.md"),
    "Reading an answer": ("verdicts.md", "results.md", "diagnosis.md", "accuracy.md", "limits.md"),
    "Going further": ("hidden.md", "many.md", "learning.md", "own_effect.md"),
    "Looking up": ("reference.md", "method.md", "glossary.md", "changes.md"),
}
"""The written pages, and the page of the public names, as the menu shows them; the effects come before the last."""


def configuration(package: Path) -> dict:
    """The configuration, as MkDocs reads it from a file; all paths beside that file.

    **Arguments:** `package`: folder that holds the package `jaxgray`, from which signatures and docstrings are read.
    """
    return {
        "site_name": "jaxgray",
        "docs_dir": "pages",
        "site_dir": "site",
        "use_directory_urls": False,
        "nav": _menu(),
        "theme": _theme(),
        "extra": {"generator": False, "polyfills": ["assets/iframe-worker.js"]},
        "extra_css": ["assets/manual.css"],
        "plugins": ["search", "offline", {"mkdocstrings": _names(package)}],
        "markdown_extensions": [
            "admonition",
            "attr_list",
            "def_list",
            "footnotes",
            "md_in_html",
            "tables",
            {"toc": {"permalink": True, "title": "On this page"}},
            "pymdownx.details",
            "pymdownx.highlight",
            "pymdownx.superfences",
        ],
        "validation": {
            "nav": {"omitted_files": "warn", "not_found": "warn", "absolute_links": "warn"},
            "links": {
                "not_found": "warn",
                "anchors": "warn",
                "absolute_links": "warn",
                "unrecognized_links": "warn",
            },
        },
    }


def _menu() -> list:
    groups = [{title: list(pages)} for title, pages in GROUPS.items()]
    return [{"Home": "index.md"}, *groups[:-1], {"Effects": navigation()}, groups[-1]]


def _theme() -> dict:
    def scheme(media: str, icon: str, following: str, **more) -> dict:
        toggle = {"icon": f"material/{icon}", "name": f"Switch to {following}"}
        return {"media": f"(prefers-color-scheme{media})", "toggle": toggle, "primary": "blue grey", **more}

    return {
        "name": "material",
        "font": False,
        "features": ["navigation.indexes", "navigation.top", "search.highlight", "content.code.copy", "toc.follow"],
        "icon": {"logo": "material/sine-wave"},
        "palette": [
            scheme("", "brightness-auto", "light colours"),
            scheme(": light", "brightness-7", "dark colours", scheme="default"),
            scheme(": dark", "brightness-4", "the colours of the system", scheme="slate"),
        ],
    }


def _names(package: Path) -> dict:
    options = {
        # Docstrings are markdown already.
        "docstring_style": None,
        "allow_inspection": False,
        "heading_level": 3,
        "members_order": "source",
        "separate_signature": True,
        "show_attribute_values": False,
        "show_bases": False,
        "show_if_no_docstring": False,
        "show_root_heading": True,
        "show_signature_annotations": True,
        "show_source": False,
        "show_symbol_type_heading": True,
    }
    return {"default_handler": "python", "handlers": {"python": {"paths": [str(package)], "options": options}}}
