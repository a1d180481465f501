"""The rooms of the package and the floors they stand on."""

import pathlib
import subprocess
import sys

import pytest

import jaxgray

ROOT = pathlib.Path(__file__).resolve().parents[1]


def test_imports_go_down_the_floors():
    command = pathlib.Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_rooms_stay_small():
    large = {p.name: n for p in ROOT.glob("jaxgray/**/*.py") if (n := len(p.read_text().splitlines())) > 400}
    assert not large


@pytest.mark.parametrize(
    "name",
    [
        "compress",
        "identify",
        "identify_many",
        "sweep",
        "read_record",
        "diagnose",
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
