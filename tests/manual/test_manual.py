"""The manual: built by the command, whole, without a dead link, and without anything from the network."""

import html.parser
import importlib.metadata
import json
import re
import subprocess
import sys
import urllib.parse

import pytest
from documents import validator

import jaxgray
from jaxgray.cli import main
from jaxgray.manual import site
from jaxgray.manual.effect_pages import look_alikes
from jaxgray.manual.effect_pictures import picture
from jaxgray.mechanics.effects import CATALOGUE, MODEL_ERRORS, RECORD_FINDINGS, by_id

LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "object": "data"}


class Page(html.parser.HTMLParser):
    """Anchors of a page, its links, and what it loads."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links, self.loads = set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.anchors.update(attrs[name] for name in ("id", "name") if attrs.get(name))
        if tag == "a" and attrs.get("href"):
            self.links.append(attrs["href"])
        elif attrs.get(LOADED.get(tag)):
            self.loads.append(attrs[LOADED[tag]])


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder that the command writes, and what it prints."""
    folder = tmp_path_factory.mktemp("docs") / "new" / "manual"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        assert main(["docs", "--out", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture(scope="module")
def pages(built):
    """Every page, by its path."""
    return {path: Page(path.read_text(encoding="utf-8")) for path in built.rglob("*.html")}


def test_the_folder_holds_the_manual_alone(built):
    assert (built / "index.html").exists()
    validator(site.SCHEMA).validate(json.loads((built / site.MARK).read_text()))
    assert [path.name for path in built.parent.iterdir()] == ["manual"]


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)
def test_every_effect_has_a_page_with_its_picture(built, pages, effect):
    path = built / "effects" / f"{effect.id}.html"
    assert f"pictures/{effect.id}.svg" in pages[path].loads
    text = path.read_text(encoding="utf-8")
    assert effect.reference.split(",")[0].replace("&", "&amp;") in text and f"--only {effect.id}" in _plain(text)
    assert f"{effect.id}.html" in pages[built / "effects" / "index.html"].links
    for other in look_alikes(effect):
        assert f"{other}.html" in pages[path].links and effect.id in look_alikes(by_id(other))


def _plain(text):
    return re.sub(r"<[^>]+>", "", text)


def test_errors_and_findings_have_a_page(built, pages):
    loads = pages[built / "effects" / "model_errors.html"].loads
    assert all(f"pictures/{effect.id}.svg" in loads for effect in MODEL_ERRORS)
    text = (built / "effects" / "record_findings.html").read_text(encoding="utf-8")
    assert all(finding in text for finding in RECORD_FINDINGS)


def test_every_public_name_is_in_the_reference(built):
    text = (built / "reference.html").read_text(encoding="utf-8")
    assert [name for name in jaxgray.__all__ if f"jaxgray.{name}" not in text] == []
    assert "Others" not in _plain(text)


def test_every_link_and_every_picture_is_there(pages):
    lost = []
    for path, page in pages.items():
        for link in page.links + page.loads:
            address = urllib.parse.urlsplit(link)
            if address.scheme or address.netloc:
                continue
            target = (path.parent / urllib.parse.unquote(address.path)).resolve() if address.path else path
            anchor = urllib.parse.unquote(address.fragment)
            if not target.exists() or anchor and target in pages and anchor not in pages[target].anchors | {"__top"}:
                lost.append((path.name, link))
    assert len(pages) > len(CATALOGUE) and lost == []


def test_nothing_comes_from_the_network(built, pages):
    loads = {load for page in pages.values() for load in page.loads}
    assert loads and [load for load in loads if "//" in load] == []
    for path in [*built.rglob("*.css"), *built.rglob("*.svg")]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"(@import|url\(|href=)\W*(https?:)?//", text), path.name


@pytest.mark.parametrize("name", ["coulomb_friction", "dahl_friction", "input_delay", "unmodelled_mode"])
def test_pictures_are_the_same_every_time(built, name):
    assert picture(by_id(name)).svg == (built / "effects" / "pictures" / f"{name}.svg").read_bytes()


def _says(capsys, argv):
    assert main([str(one) for one in argv]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1
    return said.err


def test_a_folder_with_other_files_is_left_as_it_is(capsys, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    assert "holds other files" in _says(capsys, ["docs", "--out", tmp_path])
    assert "is a file" in _says(capsys, ["docs", "--out", tmp_path / "thesis.txt"])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("missing", ["mkdocs", "material", "mkdocstrings_handlers.python"])
def test_without_the_extra_one_line_says_how_to_get_it(capsys, monkeypatch, tmp_path, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    assert "pip install 'jaxgray[docs]'" in _says(capsys, ["docs", "--out", tmp_path / "manual"])
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def scant(monkeypatch, tmp_path):
    """Sources of one page in place of the manual's; `tmp_path` has them in `pages`."""

    def write(work):
        (work / "pages").mkdir()
        (work / "pages" / "index.md").write_text((tmp_path / "index.md").read_text())
        (work / "mkdocs.yml").write_text("{site_name: x, docs_dir: pages, validation: {links: {not_found: warn}}}")

    monkeypatch.setattr(site, "_write_sources", write)
    (tmp_path / "index.md").write_text("# Found\n")
    return tmp_path


def test_an_earlier_manual_is_replaced_only_by_a_whole_one(scant):
    folder = scant / "manual"
    assert site.build(folder) == folder / "index.html"
    (scant / "index.md").write_text("# Changed\n\n[Lost](lost.md)\n")
    with pytest.raises(RuntimeError, match="lost.md"):
        site.build(folder)
    assert "Found" in (folder / "index.html").read_text()
    (scant / "index.md").write_text("# Changed\n")
    site.build(folder)
    assert "Changed" in (folder / "index.html").read_text()
    assert {path.name for path in scant.iterdir()} == {"index.md", "manual"}


def test_without_a_folder_it_is_built_once_and_opened(capsys, monkeypatch, tmp_path):
    import webbrowser

    made, opened = [], []

    def build(folder):
        made.append(folder)
        folder.mkdir()
        (folder / "index.html").touch()
        return folder / "index.html"

    monkeypatch.setattr("jaxgray.manual.build", build)
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        assert main(["docs"]) == 0
        first = capsys.readouterr().out.strip()
    assert made == [tmp_path / "jaxgray" / "manual" / site.key()]
    assert first == str(made[0] / "index.html") and opened == [(made[0] / "index.html").as_uri()] * 2


def test_the_version_is_that_of_the_package():
    assert jaxgray.__version__ == importlib.metadata.version("jaxgray")
    assert "__version__" in dir(jaxgray) and "identify" in dir(jaxgray)


def test_help_of_the_command_needs_no_jax():
    code = (
        "import sys\nfrom jaxgray.cli import main\nassert main(['docs', '--help']) == 0\nsys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True).returncode == 0
