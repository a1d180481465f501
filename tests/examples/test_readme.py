"""What the README and the manual say runs as it stands."""

import os
import re
import subprocess
import sys

import pytest
from shown import ROOT

from jaxgray.demonstration import SAMPLES
from jaxgray.demonstration_effects import simulated
from jaxgray.report.columns import columns_text, record_columns

PAGES = ROOT / "jaxgray" / "manual" / "pages"
README = ROOT / "README.md"


def blocks(path, language):
    """The code blocks of a page in one language."""
    text = path.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def words(text):
    """What is printed without numbers, which differ in their last digits, without rules, and however it is wrapped."""
    return re.sub(r"[-+]?\d[\d.,]*(?:e[-+]?\d+)?|─", "", text).split()


def follows(part, whole):
    """Whether some words follow one another in a text."""
    part, whole = words(part), words(whole)
    return any(whole[k : k + len(part)] == part for k in range(len(whole) - len(part) + 1))


def python(code, timeout=600, folder=ROOT):
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"PYTHONPATH": path}
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        timeout=timeout,
        cwd=folder,
        env=environment,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def command(line, folder):
    """What a command of a page prints in some folder."""
    line = line.replace("\\\n", "").replace(".venv/bin/jaxgray", "jaxgray").strip()
    line = line.replace("jaxgray", f"{sys.executable} -m jaxgray", 1)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    run = subprocess.run(
        line, shell=True, capture_output=True, text=True, timeout=600, cwd=folder, env=environment, encoding="utf-8"
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_the_readme_is_read_in_five_minutes():
    assert len(README.read_text(encoding="utf-8")) <= 9000


def test_the_readmes_python_runs_as_it_stands(tmp_path):
    (code,) = blocks(README, "python")
    assert len(code.strip().splitlines()) <= 20
    # As `jaxgray demo --out demo` writes them.
    (tmp_path / "demo").mkdir()
    for name, record in zip(("estimation", "validation"), simulated("coulomb_friction", 1, SAMPLES)):
        (tmp_path / "demo" / f"{name}.csv").write_text(columns_text(record_columns(record)), encoding="utf-8")
    printed = python(code, folder=tmp_path)
    number = float(re.search(r"Fc = ([\d.]+) ±", printed)[1])
    assert printed.startswith("[[ 5.0") and abs(number - 0.2) < 0.003
    assert follows(blocks(README, "text")[1], printed), printed


def test_the_readme_has_one_command_to_set_up_and_one_for_the_tests_which_the_script_runs():
    demo, *_, test = (block.strip() for block in blocks(README, "sh"))
    assert demo.startswith("python3 -m venv .venv && ") and demo.endswith("jaxgray demo")
    assert test.startswith("python3 -m venv .venv && ") and test.endswith("-m pytest")
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    lines = script.read_text(encoding="utf-8").strip().splitlines()
    assert lines[-1] == test and "set -euo pipefail" in lines


def test_what_the_readme_links_to_is_there():
    links = re.findall(r"\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    assert len(links) > 10 and all((ROOT / link).is_file() for link in links)


def test_words_are_compared_and_not_their_digits():
    assert follows("Fc = 0.2 ± 0.1 N", "at y1, Fc = 0.1996 ± 0.0006 N as fitted")
    assert not follows("Fs = 0.2 ± 0.1 N", "at y1, Fc = 0.1996 ± 0.0006 N as fitted")


@pytest.mark.slow
def test_commands_print_what_the_readme_and_the_manual_show(tmp_path):
    command("jaxgray demo --out demo --quiet", tmp_path)
    assert follows(blocks(README, "text")[0], command(blocks(README, "sh")[1], tmp_path))
    verdicts = PAGES / "verdicts.md"
    none, named, _, _, unexplained = blocks(verdicts, "text")
    commands = blocks(verdicts, "sh")
    assert follows(none, command(commands[0], tmp_path))
    assert follows(named, command(commands[1], tmp_path))
    *_, last = commands[2].partition("\n")
    assert follows(unexplained, command(last, tmp_path))


@pytest.mark.slow
def test_the_program_of_the_manual_ends_as_shown():
    verdicts = PAGES / "verdicts.md"
    printed = python(blocks(verdicts, "py")[0], timeout=600)
    for text in blocks(verdicts, "text")[2:4]:
        assert follows(text, printed), printed
