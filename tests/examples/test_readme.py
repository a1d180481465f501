"""What the README says runs as it stands."""

import os
import re
import subprocess
import sys

from shown import ROOT


def blocks(language):
    """The README's code blocks of one language."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def test_the_readmes_python_runs_as_it_stands():
    (code,) = blocks("python")
    assert len(code.strip().splitlines()) <= 20
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=300, cwd=ROOT
    )
    assert run.returncode == 0, run.stderr
    mass = re.search(r"mass +([\d.]+) ± ([\d.e-]+)", run.stdout)
    assert abs(float(mass[1]) - 2.0) < 4.5 * float(mass[2]) < 0.1
    assert "fit on validation" in run.stdout and "Modes" in run.stdout


def test_the_readme_has_two_commands_to_set_up_and_the_script_runs_the_second():
    demo, test, *_ = (block.strip() for block in blocks("sh"))
    assert demo.startswith("python3 -m venv .venv && ") and demo.endswith("jaxgray demo")
    assert test.startswith("python3 -m venv .venv && ") and test.endswith("-m pytest")
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    lines = script.read_text(encoding="utf-8").strip().splitlines()
    assert lines[-1] == test and "set -euo pipefail" in lines
