"""The blocks of the README and the manual: what stands in them, how they are run, and how outputs are compared."""

import contextlib
import io
import re
import shlex
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax
from documents import WRITTEN
from shown import ROOT

from jaxgray.cli import main
from jaxgray.manual.effect_pages import _alone, _errors, _overview
from jaxgray.manual.gallery import ORDER, _command
from jaxgray.mechanics.effects import CATALOGUE
from jaxgray.report.documents.catalogue import catalogue_document

PAGES = ROOT / "jaxgray" / "manual" / "pages"
README = ROOT / "README.md"
DOUBLE = 'jax.config.update("jax_enable_x64", True)'


TEXTS = {path.name: path.read_text(encoding="utf-8") for path in (README, *sorted(PAGES.glob("*.md")))}
MADE = {f"effects/{effect.id}.md": _alone(effect) for effect in CATALOGUE}
MADE |= {
    "effects/index.md": _overview(catalogue_document()),
    "effects/model_errors.md": _errors(catalogue_document(), {}),
}
MADE["gallery.md"] = "\n\n".join(_command(name) for name in ORDER)
"""Every page as it is written, and those that are made, as far as they have commands."""


@dataclass(frozen=True)
class Block:
    """One fenced block: its page, its place among those of its page, language, and text."""

    page: str
    number: int
    language: str
    text: str

    def __str__(self):
        return f"{self.page}: {self.number} {self.language}"

    @property
    def commands(self) -> list[str]:
        """One by one."""
        joined = self.text.replace("\\\n", "")
        return [" ".join(part.split()) for line in joined.splitlines() for part in line.split("&&") if part.strip()]


def blocks(page: str) -> list[Block]:
    """Every fenced block of a page, in order."""
    text = (TEXTS | MADE)[page] + "\n"
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return [Block(page, k, language, inside) for k, (language, inside) in enumerate(found)]


def run_command(line: str, folder: Path) -> str:
    """What a `jaxgray …` prints, run as a shell in some folder would; the documents that it leaves are checked."""
    name, *arguments = shlex.split(line, comments=True)
    assert Path(name).name == "jaxgray", line
    file = None
    if ">" in arguments:
        *arguments, _, file = arguments
    said, told = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
        code = main(arguments)
    assert code == 0, f"{line}: {told.getvalue()}"
    assert said.getvalue(), f"{line} says nothing"
    if file is not None:
        (folder / file).write_text(said.getvalue(), encoding="utf-8")
    WRITTEN.check_folder(folder)
    return said.getvalue() + told.getvalue()


def run_program(code: str, names: dict, folder: Path, title: str) -> str:
    """What a program prints and warns of; `names` are there before, and hold what it has made afterwards."""
    said = io.StringIO()
    # A program that turns on 64-bit floats begins without them.
    jax.config.update("jax_enable_x64", DOUBLE not in code)
    try:
        with contextlib.chdir(folder), contextlib.redirect_stdout(said), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            exec(compile(code, title, "exec"), names)
    finally:
        jax.config.update("jax_enable_x64", True)
    WRITTEN.check_folder(folder)
    return said.getvalue() + "".join(f"warning: {one.message}\n" for one in told)


# Digits of names, such as y1 and mass[0,1], are no numbers.
NUMBER = re.compile(r"(?<![\w\[.,])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
LAST_DIGITS = 2
"""Units of the last digit shown in which a number may differ."""
SHARE = 1e-3
"""Share of itself in which a number of many digits may differ."""


def words(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """Every word with # in the place of its numbers, and these; however it is wrapped, and without rules."""
    plain = text.replace("─", "").split()
    return [(NUMBER.sub("#", word), tuple(NUMBER.findall(word))) for word in plain]


def follows(part: str, whole: str) -> bool:
    """Whether the words of a text follow one another in another, with the same numbers but for their last digits."""
    part, whole = words(part), words(whole)
    found = range(len(whole) - len(part) + 1)
    return any(all(map(agree, part, whole[k : k + len(part)])) for k in found)


def agree(shown, printed) -> bool:
    return shown[0] == printed[0] and all(map(near, shown[1], printed[1]))


def near(shown: str, printed: str) -> bool:
    digits, _, power = shown.partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return abs(float(shown) - float(printed)) <= max(LAST_DIGITS * last, SHARE * abs(float(shown))) * (1 + 1e-9)
