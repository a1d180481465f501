"""The rooms of the package and the floors they stand on."""

import ast
import graphlib
import pathlib
import re
import subprocess
import sys

import grimp
import pytest

import jaxgray

ROOT = pathlib.Path(__file__).resolve().parents[1]
FLOORS = sorted(path for path in (ROOT / "jaxgray").iterdir() if path.is_dir() and any(path.glob("*.py")))
"""Their folders hold ten modules at most, and name all of them."""


def test_imports_go_down_the_floors():
    command = pathlib.Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_module_imports_itself_by_way_of_others():
    graph = grimp.build_graph("jaxgray")
    below = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()
    graphlib.TopologicalSorter(below).prepare()


@pytest.mark.parametrize("floor", FLOORS, ids=lambda path: path.name)
def test_rooms_of_a_floor_hold_few_modules(floor):
    folders = [floor, *(p for p in floor.rglob("*") if p.is_dir() and any(p.glob("*.py")))]
    held = {str(p.relative_to(ROOT)): sum(q.name != "__init__.py" for q in p.glob("*.py")) for p in folders}
    assert max(held.values()) <= 10, held
    for folder in folders:
        face = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
        inside = {q.stem for q in folder.iterdir() if q.suffix == ".py" or (q / "__init__.py").exists()}
        assert inside - {"__init__"} <= set(re.findall(r"\w+", face)), folder


@pytest.mark.parametrize(
    "name",
    [
        "compress",
        "identify",
        "identify_many",
        "sweep",
        "read_record",
        "diagnose",
        "fleet",
        "stabilisation",
        "write_report",
        "write_simulation",
        "export",
        "to_scipy",
        "to_control",
    ],
)
def test_every_public_argument_is_documented(name):
    import inspect

    function = getattr(jaxgray, name)
    missing = [p for p in inspect.signature(function).parameters if f"`{p}`" not in function.__doc__]
    assert not missing


def test_the_readme_counts_the_effects_of_the_catalogue():
    assert f"{len(jaxgray.CATALOGUE)} effects in all" in " ".join((ROOT / "README.md").read_text().split())
