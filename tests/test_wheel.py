"""What is handed out: it has all that is needed, is small, and works where there is no checkout."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import jaxgray

pytest.importorskip("hatchling", reason="building needs hatchling, which the extra test has")

ROOT = Path(__file__).resolve().parents[1]
PICTURES = (".png", ".svg", ".jpg")
LARGEST = 3_000_000
"""Bytes of a wheel without its pictures, at most."""


def build(folder, target):
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", target], cwd=folder, check=True)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel, and the archive of sources."""
    target = tmp_path_factory.mktemp("dist")
    build(ROOT, target)
    (wheel,), (sources,) = target.glob("*.whl"), target.glob("*.tar.gz")
    return wheel, sources


def contents(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return {one.filename: one.compress_size for one in archive.infolist()}


def test_the_wheel_is_small_and_whole(built):
    files = contents(built[0])
    assert sum(size for name, size in files.items() if not name.endswith(PICTURES)) <= LARGEST
    assert {name.split("/")[0] for name in files} == {"jaxgray", f"jaxgray-{jaxgray.__version__}.dist-info"}
    kept = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "jaxgray").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in files if name.startswith("jaxgray/")} == kept
    assert any(name.endswith("licenses/LICENSE") for name in files)


def test_the_sources_make_the_same_wheel(built, tmp_path):
    wheel, sources = built
    with tarfile.open(sources) as archive:
        archive.extractall(tmp_path, filter="data")
    (folder,) = tmp_path.iterdir()
    top = {path.name for path in folder.iterdir()} - {".gitignore", "PKG-INFO"}
    assert top == {"pyproject.toml", "README.md", "LICENSE", "jaxgray", "tests", "benchmarks", "examples"}
    build(folder, tmp_path / "again")
    (again,) = (tmp_path / "again").glob("*.whl")
    assert contents(again) == contents(wheel)


def clean(folder):
    """An environment of its own, which knows nothing of this one."""
    venv.create(folder, with_pip=False)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    surroundings = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return scripts, surroundings | {"XDG_CACHE_HOME": str(folder / "cache")}


def run(command, folder, surroundings):
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


def install(scripts, surroundings, *what):
    """By this environment's pip, into another."""
    run(
        [sys.executable, "-m", "pip", "-q", "--python", scripts / "python", "install", "--no-compile", *what],
        scripts,
        surroundings,
    )


def test_it_works_without_the_checkout(built, tmp_path):
    scripts, surroundings = clean(tmp_path / "environment")
    install(scripts, surroundings, "--no-deps", "--no-index", built[0])
    # Its dependencies are those of this environment, whose own .pth files are not followed.
    place = "import sysconfig; print(sysconfig.get_path('purelib'))"
    own = Path(run([scripts / "python", "-c", place], tmp_path, surroundings))
    (own / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = "import jaxgray; print(jaxgray.__file__)"
    assert Path(run([scripts / "python", "-c", where], tmp_path, surroundings)).is_relative_to(own)
    jaxgray_there = scripts / "jaxgray"
    assert run([jaxgray_there, "--version"], tmp_path, surroundings) == jaxgray.__version__
    assert "jaxgray/diagnosis/1" in run([jaxgray_there, "schema"], tmp_path, surroundings).split()
    assert "coulomb_friction" in run([jaxgray_there, "effects"], tmp_path, surroundings)


@pytest.mark.slow
def test_it_installs_with_what_it_declares_and_finds_friction(built, tmp_path):
    scripts, surroundings = clean(tmp_path / "environment")
    install(scripts, surroundings, built[0])
    said = run([scripts / "jaxgray", "demo"], tmp_path, surroundings)
    assert "Cause: Coulomb friction at y1" in said
