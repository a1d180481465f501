"""The README is short, and what it names is there."""

import os
import re

from pages import DOUBLE, README, blocks
from shown import ROOT

import jaxgray


def of(language):
    """The texts of its blocks in one language."""
    return [block.text for block in blocks("README.md") if block.language == language]


def test_the_readme_is_read_in_five_minutes():
    assert len(README.read_text(encoding="utf-8")) <= 9000
    (code,) = of("python")
    assert len(code.strip().splitlines()) <= 20 and DOUBLE in code


def test_the_readme_has_one_command_to_set_up_and_one_for_the_tests_which_the_script_runs():
    demo, *_, test = (text.strip() for text in of("sh"))
    assert demo.startswith("python3 -m venv .venv && ") and demo.endswith("jaxgray demo")
    assert test.startswith("python3 -m venv .venv && ") and test.endswith("-m pytest")
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    lines = script.read_text(encoding="utf-8").strip().splitlines()
    assert lines[-1] == test and "set -euo pipefail" in lines


def test_what_the_readme_links_to_is_there():
    links = re.findall(r"\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    assert len(links) > 10 and all((ROOT / link).is_file() for link in links)


def test_the_citation_is_of_this_version():
    (entry,) = of("bibtex")
    fields = dict(re.findall(r"^ *(\w+) = \{(.*)\},?$", entry, flags=re.MULTILINE))
    assert entry.startswith("@software{") and entry.rstrip().endswith("}")
    assert fields["version"] == jaxgray.__version__ and fields["year"].isdigit() and fields["title"]
