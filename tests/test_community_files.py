"""What stands in .github: issue forms that a host can show, and a guide whose links and commands hold."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.name != "config.yml")
FIELDS = {"textarea", "input", "dropdown", "checkboxes"}


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_every_issue_form_can_be_shown(path):
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert set(form) == {"name", "description", "title", "labels", "body"}
    fields = [one for one in form["body"] if one["type"] != "markdown"]
    assert {one["type"] for one in fields} <= FIELDS and all(one["attributes"]["label"] for one in fields)
    ids = [one["id"] for one in fields]
    assert len(set(ids)) == len(ids) and all(re.fullmatch(r"[a-z_-]+", id) for id in ids)
    assert any(one.get("validations", {}).get("required") for one in fields)


def test_what_the_guide_links_to_is_there():
    guide = ROOT / ".github" / "CONTRIBUTING.md"
    text = guide.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) >= 3 and all((guide.parent / link).is_file() for link in links)
    named = re.findall(r"`((?:jaxgray|tests)/[\w./]+)`", text)
    assert named and all((ROOT / one).exists() for one in named)
    assert len(FORMS) == 3
