"""Shell completion: what bash makes of the script that the command prints, and where it is put."""

import os
import shutil
import subprocess
import sys

import pytest

import jaxgray
from jaxgray.cli import main

BASH = shutil.which("bash")
pytestmark = pytest.mark.skipif(BASH is None, reason="needs bash")


@pytest.fixture
def bash(tmp_path):
    """Runs a script in bash, which finds the command `jaxgray`, in a home of its own."""
    command = tmp_path / "bin" / "jaxgray"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -W error -m jaxgray "$@"\n')
    command.chmod(0o755)
    package = os.path.dirname(os.path.dirname(jaxgray.__file__))
    surroundings = os.environ | {
        "HOME": str(tmp_path),
        "PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH")))),
    }

    def run(script):
        # A shell that could, would turn into its last command, which then finds no shell above it.
        done = subprocess.run(
            [BASH, "--norc", "-c", f"{script}\ntrue"], env=surroundings, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.stderr == ""
        return done.stdout

    return run


COMPLETE = """
eval "$(jaxgray --show-completion)"
complete_words() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _jaxgray_completion jaxgray; echo "${COMPREPLY[@]}"; }
complete_words jaxgray di
complete_words jaxgray diagnose --sim
complete_words jaxgray identify record.
complete -p jaxgray
"""


def test_bash_completes_commands_and_options_and_leaves_files_to_itself(bash):
    command, options, files, set_up = bash(COMPLETE).splitlines()
    assert command == "diagnose" and sorted(options.split()) == ["--simulated", "--simulator"] and files == ""
    assert "-o default" in set_up


def test_it_is_installed_for_later_shells(bash, tmp_path):
    assert "bash completion installed" in bash("jaxgray --install-completion")
    (script,) = (tmp_path / ".bash_completions").iterdir()
    assert str(script) in (tmp_path / ".bashrc").read_text()
    assert bash(f"source {script}; complete -p jaxgray").startswith("complete -o default")


def test_what_it_is_asked_wrongly_is_an_exit_code(capsys, monkeypatch):
    monkeypatch.setenv("_JAXGRAY_COMPLETE", "nonsense")
    assert main([]) == 1
    assert "Invalid completion instruction" in capsys.readouterr().err
