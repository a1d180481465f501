"""Every command and program of the README and the manual: none is left out, each can be run, and what is cheap is run.

`test_readme.py` runs those whose output is shown.
"""

import json
import re
import shlex
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import simulate
from shown import ROOT
from test_readme import PAGES, README, blocks, command
from typer.main import get_command

import jaxgray
from jaxgray.cli import main
from jaxgray.cli.commands import app
from jaxgray.manual.effect_pages import _commands
from jaxgray.mechanics.effects import CATALOGUE

SHOWN = {"README.md": {"sh": 4, "text": 2, "python": 1, "bibtex": 1}, "verdicts.md": {"sh": 3, "text": 5, "py": 1}}
"""What `test_readme.py` runs and compares, and commands on files of the reader's, which are parsed here."""

RUN_HERE = {
    "start.md": {"sh": 2, "py": 1},
    "files.md": {"sh": 2, "py": 2},
    "diagnosis.md": {"sh": 3, "py": 1},
    "hidden.md": {"sh": 1},
    "many.md": {"sh": 1},
    "learning.md": {"py": 1},
    "own_effect.md": {"py": 1},
}

TEXTS = {path.name: path.read_text(encoding="utf-8") for path in (README, *sorted(PAGES.glob("*.md")))}


def languages(text):
    opened = re.findall(r"^ *```(.*)$", text, flags=re.MULTILINE)
    return Counter(opened[::2])


def test_no_block_is_left_out():
    found = {name: dict(languages(text)) for name, text in TEXTS.items() if "```" in text}
    assert found == SHOWN | RUN_HERE
    # What is indented by four is code to Markdown, too, except below the items of a list.
    for name, text in TEXTS.items():
        plain = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
        assert not re.search(r"\n\n {4}\S", plain), name


def commands():
    """Every `jaxgray …` of the pages, those that are generated for the effects among them."""
    pages = {name: "\n".join(blocks_of(text, "sh")) for name, text in TEXTS.items()}
    pages |= {effect.id: "\n".join(blocks_of(_commands(effect) + "\n", "sh")) for effect in CATALOGUE}
    for name, text in pages.items():
        for line in text.replace("\\\n", "").splitlines():
            for part in line.split("&&"):
                words = shlex.split(part, comments=True)
                if words and words[0].rsplit("/")[-1] == "jaxgray":
                    yield pytest.param(words[1:], id=f"{name}: {' '.join(words[1:3])}")


def blocks_of(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("words", list(commands()))
def test_every_command_is_understood(words):
    words = words[: words.index(">")] if ">" in words else words
    group = get_command(app)
    name, chosen, rest = group.resolve_command(group.make_context("jaxgray", list(words)), list(words))
    assert chosen is not None and chosen.make_context(name, list(rest)).params is not None


def test_a_command_with_a_wrong_option_is_not():
    with pytest.raises(Exception, match="No such option"):
        test_every_command_is_understood(["diagnose", "a.csv", "--inputs", "u", "--outputs", "y", "--only-one", "x"])


def run(name, number, **names):
    """What a program of a page leaves behind."""
    (code,) = blocks_of(TEXTS[name], "py")[number : number + 1]
    exec(compile(code, f"{name}, program {number + 1}", "exec"), names)
    return names


def steps(rng, samples, size=1.0):
    return size * np.repeat(rng.uniform(-1, 1, samples // 20), 20)


@pytest.fixture
def two_files(tmp_path):
    """An encoder's rows, and those of the force at times of their own, of a mass on a spring."""
    rng = np.random.default_rng(5)
    u = steps(rng, 1000)
    y = simulate(np.eye(1), np.eye(1), 60.0 * np.eye(1), u[:, None], 0.01)[:, 0] + 1e-4 * rng.standard_normal(1000)
    t = 0.01 * np.arange(1000)
    # The force is sampled between the angles, and holds until its next row.
    for name, column, times, values in (("encoder", "angle", t, y), ("force", "F", t - 0.004, u)):
        rows = [f"{a!r},{b!r}" for a, b in zip(times.tolist(), values.tolist())]
        (tmp_path / f"{name}.csv").write_text(f"t,{column}\n" + "\n".join(rows) + "\n")
    return tmp_path, t, u, y


def test_programs_on_files_run(two_files, monkeypatch):
    folder, t, u, y = two_files
    monkeypatch.chdir(folder)
    with pytest.warns(jaxgray.RecordWarning, match="times of their own"):
        record = run("files.md", 0, jaxgray=jaxgray, time=t, u=u, y=y)["record"]
    assert record.has_own_times and record.output_names == ("angle",)
    run("files.md", 1)


def test_commands_on_files_run(two_files, monkeypatch, capsys):
    monkeypatch.chdir(two_files[0])
    identify, schemas = blocks_of(TEXTS["files.md"], "sh")
    listed, written = schemas.splitlines()

    def printed(line):
        assert main(shlex.split(line)[1:]) == 0
        return capsys.readouterr().out

    assert "angle" in printed(identify)
    assert "jaxgray/diagnosis/1" in printed(listed).split()
    written, _, file = written.partition(" > ")
    assert file == "diagnosis.json" and json.loads(printed(written))["title"] == "jaxgray/diagnosis/1"


def test_the_program_of_learning_differentiates():
    rng = np.random.default_rng(2)
    u = np.stack([steps(rng, 400)[:, None] for _ in range(2)])
    M, D, K = np.eye(1), np.eye(1), 60.0 * np.eye(1)
    y = np.stack([simulate(M, D, K, one, 0.01) for one in u]) + 1e-4 * rng.standard_normal(u.shape)
    wanted = jaxgray.MechanicalModel(M, D, K).state_space(0.01).A
    names = run("learning.md", 0, jax=jax, jnp=jnp, jaxgray=jaxgray, wanted=wanted)
    by_tau, by_weights = names["slope"](0.05, jnp.ones(400), u, y)
    assert by_tau.shape == (2,) and by_weights.shape == (2, 400)
    assert np.all(np.isfinite(by_tau)) and np.any(by_weights != 0)


@pytest.mark.slow
def test_the_law_of_ones_own_is_found():
    rng = np.random.default_rng(3)
    u, h = steps(rng, 2000, 30.0), 0.01
    q, v, y = 0.0, 0.0, np.empty(2000)
    for k in range(2000):
        y[k] = q
        for _ in range(50):
            v += h / 50 * (u[k] - 2.0 * v - 100.0 * q - 3e3 * q**5)
            q += h / 50 * v
    record = jaxgray.Record(u, y + 1e-3 * y.std() * rng.standard_normal(2000), h)
    found = run("own_effect.md", 0, record=record)["found"]
    assert found.findings[0].effect == "fifth_order_spring", str(found)


@pytest.mark.slow
def test_ones_own_simulator_is_judged():
    names = run_simulator(np.random.default_rng(4))
    numbers = {name: one for finding in names["found"].findings for name, one in finding.parameters.items()}
    said = str(names["found"])
    # The program says 0.1 and 0.15, the machine has 0.11 and 0.15.
    assert "inertia" in said and names["found"].verdict == "named" and numbers, said


def run_simulator(rng):
    """The program of the page on a record that its own simulator has made with another inertia."""
    (code,) = blocks_of(TEXTS["diagnosis.md"], "py")
    define, call = code.split("found = ")
    names = {"np": np, "jaxgray": jaxgray}
    exec(define, names)
    u = steps(rng, 1500, 2.0)[:, None]
    y = names["simulate"](u, np.zeros_like(u), {"inertia": 0.11, "friction": 0.15})
    names["record"] = jaxgray.Record(u, y + 1e-3 * y.std() * rng.standard_normal(y.shape), 0.01)
    exec("found = " + call, names)
    return names


@pytest.mark.slow
def test_the_first_program_runs_on_the_demonstration(tmp_path, monkeypatch):
    command("jaxgray demo --out demo --quiet", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run("start.md", 0)["result"].verdict == "named" and (tmp_path / "out.html").exists()


def test_the_citation_is_of_this_version():
    (entry,) = blocks(README, "bibtex")
    fields = dict(re.findall(r"^ *(\w+) = \{(.*)\},?$", entry, flags=re.MULTILINE))
    assert entry.startswith("@software{") and entry.rstrip().endswith("}")
    assert fields["version"] == jaxgray.__version__ and fields["year"].isdigit() and fields["title"]
    assert (ROOT / "README.md").read_text(encoding="utf-8").count("```bibtex") == 1
