"""Every command and every program of the README and the manual runs as it stands, and prints what is shown below it.

`page_files.py` has the files that they work on. A block is run here, or `NOT_RUN` and `IN_WHOLE_CAMPAIGNS` say why not.
"""

import concurrent.futures
import json
import re
import shlex
from collections import Counter

import jax.numpy as jnp
import numpy as np
import pytest
from page_files import FILES, of_effects
from pages import MADE, TEXTS, blocks, follows, run_command, run_program
from typer.main import get_command

from jaxgray.cli.commands import app
from jaxgray.demonstration_effects import DEMONSTRATED
from jaxgray.diagnosis.words.titles import title_of
from jaxgray.fleets import runner

NOT_RUN = {
    "python3 -m venv .venv": "`.ci/run` and test_wheel.py set up an environment",
    ".venv/bin/pip install": "needs the network; test_wheel.py installs the wheel",
    ".venv/bin/python -m pytest": "these tests; `.ci/run` has the same line, which test_readme.py compares",
    "python examples/": "test_gallery.py runs the examples of the gallery",
}
"""Commands by how they begin."""

IN_WHOLE_CAMPAIGNS = {
    f"jaxgray demo --effect {id}": "a whole diagnosis for every page of an effect; `jaxgray demo` runs here"
    for id in DEMONSTRATED
} | dict.fromkeys(
    (
        "jaxgray diagnose quake.csv",
        "jaxgray diagnose drive.csv --inputs torque --outputs motor --hidden load",
        "jaxgray diagnose axis.csv --inputs force --outputs position --simulated",
        "jaxgray diagnose demo/estimation.csv --inputs u1,u2 --outputs y1,y2 --validation demo/validation.csv --only",
        "jaxgray fleet 'data/*.parquet' --inputs u1,u2 --outputs y1,y2 --out fleet --task diagnose",
    ),
    "a whole diagnosis of a kind of its own; tests/diagnosis has one of each",
)
"""Commands that only `-m slow` runs, by how they begin."""


def found_as(hidden):
    """The row of truth beside finding."""
    return f"{title_of(hidden.effect, hidden.location, ('y1', 'y2'))}: "


NOTHING = "nothing is missing that this record could show"

SAYS = {
    **{f"jaxgray demo --effect {id}": found_as(hidden) for id, hidden in DEMONSTRATED.items()},
    "jaxgray demo": "Cause: Coulomb friction at y1",
    "jaxgray diagnose demo/": "Cause: Coulomb friction at y1",
    "jaxgray diagnose quake.csv": NOTHING,
    "jaxgray diagnose arm.csv": "elbow.damping is",
    "jaxgray diagnose axis.csv --inputs torque --outputs angle --simulator axis.py": "inertia is",
    "jaxgray diagnose axis.csv --inputs torque --outputs angle --simulator axis.fmu": "friction is",
    "jaxgray diagnose axis.csv --inputs force": "It moves as M, D, K",
    "jaxgray export OUT.json model.xml": "model.xml: 2 coordinates",
    "jaxgray identify encoder.csv": "angle",
    "jaxgray schema": "jaxgray/diagnosis/1",
    "jaxgray diagnose drive.csv": NOTHING,
    "jaxgray fleet": "Fleet of 3 records",
    "jaxgray diagnose record.csv --inputs u1,u2 --outputs y1,y2 --model": "the stiffness at y1 should be lower by 5.0",
    "jaxgray diagnose record.csv": NOTHING,
    "jaxgray effects --json effects.json": "coulomb_friction",
    "jaxgray demo --effect none": NOTHING,
}
"""What a command says that stands above no output, by how it begins."""

BLOCKS = [block for page in TEXTS | MADE for block in blocks(page)]
PROGRAMS = [block for block in BLOCKS if block.language in ("py", "python")]
OUTPUTS = [block for block in BLOCKS if block.language == "text" and block.page in TEXTS]


def begins(line, table):
    """The entry of a table for a command; the longest beginning counts."""
    return max((one for one in table if line.startswith(one)), key=len, default=None)


def above(block):
    return next(one for one in BLOCKS if (one.page, one.number) == (block.page, block.number - 1))


def command_of(line):
    return line.removeprefix(".venv/bin/") if "bin/jaxgray" in line else line


def maker_of(block):
    return of_effects if block.page.startswith("effects/") else FILES[block.page]


def commands():
    """Those to be run, each once for the same files."""
    found = {}
    for block in BLOCKS:
        for line in map(command_of, block.commands if block.language == "sh" else ()):
            if begins(line, NOT_RUN) is None:
                found.setdefault((maker_of(block), line), block)
    for (_, line), block in found.items():
        slow = [pytest.mark.slow] if begins(line, IN_WHOLE_CAMPAIGNS) else []
        yield pytest.param(block, line, id=f"{block.page}: {line}", marks=slow)


class Run:
    """What commands and programs have printed, each run once for the same files, in their folder below `base`."""

    def __init__(self, base):
        self._base, self._places, self._said = base, {}, {}

    def place(self, block):
        """Folder of a page and what its programs know, made when first asked for."""
        maker = maker_of(block)
        if maker not in self._places:
            folder = self._base / maker.__name__
            folder.mkdir()
            self._places[maker] = folder, maker(folder)
        return self._places[maker]

    def command(self, block, line):
        folder, _ = self.place(block)
        return self._once((folder, line), run_command, line, folder)

    def program(self, block):
        folder, names = self.place(block)
        return self._once((folder, block.text), run_program, block.text, names, folder, str(block))

    def _once(self, key, function, *arguments):
        if key not in self._said:
            self._said[key] = function(*arguments)
        return self._said[key]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("COLUMNS", "200")
        yield Run(tmp_path_factory.mktemp("pages"))


@pytest.fixture(autouse=True)
def one_worker_of_this_process(monkeypatch):
    """A fleet is carried out in a thread, which shares what is compiled."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        monkeypatch.setattr(runner, "engine_of", lambda *_: runner.ExecutorEngine(pool))
        yield


def mended(folder):
    (damping,) = re.findall(r'name="elbow"[^>]*damping="([\d.]+)"', (folder / "mended.xml").read_text())
    assert float(damping) == pytest.approx(0.5, rel=0.05)


def fleet_is_written(folder):
    assert (folder / "fleet" / "index.html").exists() and (folder / "fleet" / "drift.json").exists()


def schema_is_written(folder):
    assert json.loads((folder / "diagnosis.json").read_text())["title"] == "jaxgray/diagnosis/1"


LEAVES = {
    "jaxgray diagnose arm.csv --inputs motor --outputs elbow --simulator arm.xml --parameters": mended,
    "jaxgray fleet": fleet_is_written,
    "jaxgray schema diagnosis >": schema_is_written,
}
"""What a command leaves in its folder, by how it begins."""


@pytest.mark.parametrize(("block", "line"), list(commands()))
def test_a_command_runs_and_says_what_it_found(run, block, line):
    said = run.command(block, line)
    if ">" not in line and block not in map(above, OUTPUTS):
        assert SAYS[begins(line, SAYS)] in " ".join(said.split()), said
    if line.startswith("jaxgray demo"):
        assert "not found" not in said and "found without being there" not in said, said
    if begins(line, LEAVES) is not None:
        LEAVES[begins(line, LEAVES)](run.place(block)[0])


def readme(said, names):
    number = float(re.search(r"Fc = ([\d.]+) ±", said)[1])
    assert said.startswith("[[ 5.0") and abs(number - 0.2) < 0.003


def rows(said, names):
    assert names["record"].has_own_times and names["record"].output_names == ("angle",)
    assert "warning: " in said and "times of their own" in said


def schema(said, names):
    assert names["jaxgray"].schema("jaxgray/diagnosis/1")["title"] == "jaxgray/diagnosis/1"


def own_simulator(said, names):
    found = names["found"]
    # The program says 0.1, the machine has 0.11.
    inertia = float(re.search(r"inertia is ([\d.]+) ±", str(found).replace("\n", " "))[1])
    assert found.verdict == "named" and inertia == pytest.approx(0.11, rel=0.01)


def slopes(said, names):
    by_tau, by_weights = names["slope"](0.05, jnp.ones(400), names["u"], names["y"])
    assert by_tau.shape == (2,) and by_weights.shape == (2, 400)
    assert np.all(np.isfinite(by_tau)) and np.any(by_weights != 0)


def own_law(said, names):
    found = names["found"]
    looked_for = {(one.effect, one.location) for one in found.not_found}
    assert found.verdict == "noise" and ("fifth_order_spring", "y1") in looked_for, found


def two_verdicts(said, names):
    assert said.count("Diagnosis: ") == 2


MAKES = {
    "README.md": [readme],
    "start.md": [readme],
    "files.md": [rows, schema],
    "diagnosis.md": [own_simulator],
    "learning.md": [slopes],
    "own_effect.md": [own_law],
    "verdicts.md": [two_verdicts],
}
"""What the programs of a page print and make, in their order."""


def whole_diagnoses(block):
    """Whether a program, or what an output is of, is for `-m slow` alone."""
    if block.language in ("py", "python"):
        return block.page == "verdicts.md"
    before = above(block)
    if before.language == "sh":
        return begins(command_of(before.commands[-1]), IN_WHOLE_CAMPAIGNS) is not None
    return any(whole_diagnoses(one) for one in PROGRAMS if one.page == block.page)


def cases(blocks):
    return [
        pytest.param(block, id=str(block), marks=[pytest.mark.slow] if whole_diagnoses(block) else [])
        for block in blocks
    ]


@pytest.mark.parametrize("block", cases(PROGRAMS))
def test_a_program_runs_and_makes_what_it_says(run, block):
    said = run.program(block)
    of_page = [one for one in PROGRAMS if one.page == block.page]
    MAKES[block.page][of_page.index(block)](said, run.place(block)[1])


@pytest.mark.parametrize("block", cases(OUTPUTS))
def test_what_is_printed_is_what_is_shown(run, block):
    """Below a command its output; elsewhere that of a program of the page."""
    before = above(block)
    if before.language == "sh":
        said = [run.command(before, command_of(before.commands[-1]))]
    else:
        said = [run.program(one) for one in PROGRAMS if one.page == block.page]
    assert any(follows(block.text, one) for one in said), "\n".join(said)


def test_every_block_is_of_a_kind_that_is_run():
    """Outputs are compared where they are shown; of laws of an effect nothing can be run."""
    assert {block.language for block in BLOCKS} == {"sh", "py", "python", "text", "bibtex"}
    assert [block.page for block in BLOCKS if block.language == "bibtex"] == ["README.md"]
    # What is indented by four is code to Markdown, too, except below the items of a list.
    for page, text in TEXTS.items():
        plain = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
        assert "```" not in plain and not re.search(r"\n\n {4}\S", plain), page


def test_no_entry_of_the_tables_is_left_over():
    lines = [command_of(line) for block in BLOCKS if block.language == "sh" for line in block.commands]
    for table in (NOT_RUN, IN_WHOLE_CAMPAIGNS, LEAVES, SAYS):
        assert {begins(line, table) for line in lines} - {None} == set(table)
    pages = {block.page for block in BLOCKS if block.language != "bibtex"} - set(MADE)
    assert pages == set(FILES)
    assert {page: len(made) for page, made in MAKES.items()} == Counter(block.page for block in PROGRAMS)


def mentioned():
    """Every `jaxgray …` in running text, save those with a part to choose."""
    for page, text in (TEXTS | MADE).items():
        plain = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
        for line in re.findall(r"`(?:\.venv/bin/)?(jaxgray [^`]+)`", plain):
            if not re.search(r"COMMAND|\[|…$", line):
                yield pytest.param(line, id=f"{page}: {line}")


def understood(line):
    words = shlex.split(line)[1:]
    group = get_command(app)
    if words[0].startswith("--"):
        assert words[0] in [option for one in group.params for option in one.opts]
        return
    if len(words) == 1:
        assert words[0] in group.commands
        return
    name, chosen, rest = group.resolve_command(group.make_context("jaxgray", list(words)), list(words))
    assert chosen is not None and chosen.make_context(name, list(rest)).params is not None


@pytest.mark.parametrize("line", list(mentioned()))
def test_a_command_in_running_text_is_understood(line):
    understood(line)


def test_a_command_with_a_wrong_option_is_not():
    with pytest.raises(Exception, match="No such option"):
        understood("jaxgray diagnose a.csv --inputs u --outputs y --only-one x")


def test_words_are_the_same_and_numbers_nearly_so():
    assert follows("Fc = 0.2 ± 0.1 N", "at y1, Fc = 0.1996 ± 0.0006 N as fitted")
    assert follows("y1 25570 (61.6 to 81.8)", "y1   25571 (61.7 to\n81.8)")
    for other in ("Fs = 0.1995 ± 0.0006 N", "Fc = 0.1998 ± 0.0006 N", "Fc = 0.1995 ± 0.0006"):
        assert not follows("Fc = 0.1995 ± 0.0006 N", other)
    assert not follows("friction at y1, 3", "friction at y2, 3") and not follows("mass[0,1] 2", "mass[1,1] 2")
