"""Names and units out of files stay text wherever they are written: page, JSON, C, MJCF, CSV."""

import csv
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as xml
from html.parser import HTMLParser

import numpy as np
import pytest
from independent import random_steps, simulate

from jaxgray.cli import main
from jaxgray.mechanics.model import MechanicalModel
from jaxgray.records import Record, read_record
from jaxgray.report.documents.columns import columns_text, record_columns
from jaxgray.report.exports import export

SCRIPT = "</script><script>alert(1)</script>"
QUICK = ["--no-refine", "--time-constant", "0.05", "--block-rows", "6"]

HOSTILE = (
    SCRIPT,
    "*/ int evil; /*",
    "*\\ int evil; /*",
    "a\\",
    "??/",
    '"><worldbody/>',
    "--><evil/><!--",
    "a----b",
    "<![CDATA[x",
    "&lt;",
    'q"uo,te',
    "# y",
    "% y",
    "a\x01b\x1b[31m",
    "two\nlines",
    "ü\u202eb",
)


def named(name, unit):
    return MechanicalModel(
        np.eye(2), np.eye(2), 9.0 * np.eye(2), input_names=("u", name), output_names=("y", name + " "),
        input_units=("N", unit), output_units=("m", unit), measured=("displacement", "acceleration"),
    )  # fmt: skip


def without_comments(text):
    return re.sub(r"/\*.*?\*/", "", text, flags=re.S)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_header_of_c_has_them_in_comments_alone(tmp_path, name):
    plain, hostile = tmp_path / "m.h", tmp_path / "n.h"
    export(named("v", "V"), plain, sampling_time=0.1)
    export(named(name, name), hostile, sampling_time=0.1)
    expected = without_comments(plain.read_text()).replace("m_", "n_").replace("M_", "N_")
    assert without_comments(hostile.read_text()) == expected and "//" not in hostile.read_text().replace("http://", "")


def test_a_header_of_c_takes_the_name_of_its_file(tmp_path):
    path = tmp_path / "*\\ int evil; .h"
    export(named("v", "V"), path, sampling_time=0.1)
    assert "int evil;" not in without_comments(path.read_text())
    if shutil.which("cc"):
        subprocess.run(["cc", "-std=c99", "-Wall", "-fsyntax-only", "-x", "c", str(path)], check=True)


@pytest.mark.parametrize("name", HOSTILE)
def test_mjcf_has_them_in_attributes_and_comments_alone(tmp_path, name):
    export(named("v", "V"), tmp_path / "m.xml")
    export(named(name, name), tmp_path / f"{name.replace('/', '')}.xml")
    (hostile,) = [path for path in tmp_path.iterdir() if path.name != "m.xml"]
    tags = [[one.tag for one in xml.parse(path).iter()] for path in (tmp_path / "m.xml", hostile)]
    assert tags[0] == tags[1]
    wanted = "".join(c if c.isprintable() else "?" for c in name)
    assert {one.get("name") for one in xml.parse(hostile).iter("motor")} == {"u", wanted}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_table_has_them_in_one_cell(tmp_path, name):
    record = Record(np.arange(5.0), np.ones(5), 0.1, input_names=[name], output_names=["y"], input_units=[name])
    text = columns_text(record_columns(record))
    rows = list(csv.reader(text.splitlines()))
    assert len(rows) == 6 and {len(row) for row in rows} == {3}
    assert rows[0][1] == " ".join(f"{name} [{name}]".split())
    only = columns_text({name: np.arange(3.0), "y": np.arange(3.0)})
    (tmp_path / "a.csv").write_text(only)
    found = read_record(tmp_path / "a.csv", inputs="y", outputs=" ".join(name.split()), sampling_time=1.0)
    np.testing.assert_array_equal(found.y[:, 0], np.arange(3.0))


class Scripts(HTMLParser):
    """What a browser would run or load."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.inside, self.tags = [], False, []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.inside = tag == "script"
        if self.inside:
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = self.inside and tag != "script"

    def handle_data(self, data):
        if self.inside:
            self.scripts[-1] += data


def test_a_column_called_a_script_stays_text_from_the_record_to_every_result(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    u = random_steps(np.random.default_rng(3), 1500, 1, 0.01, hold_times=(0.05, 0.3))
    y = simulate([[1.0]], [[0.8]], [[40.0]], u, 0.01)
    y = y + 1e-4 * np.random.default_rng(4).standard_normal(y.shape)
    for name, column in (("hostile", SCRIPT), ("plain", "y")):
        record = Record(u, y, 0.01, input_names=["u"], output_names=[column])
        (tmp_path / f"{name}.csv").write_text(columns_text(record_columns(record)))
        units = ["--input-units", SCRIPT, "--output-units", SCRIPT] if name == "hostile" else []
        made = ["--json", f"{name}.json", "--report", f"{name}.html", *QUICK]
        assert main(["identify", f"{name}.csv", "--inputs", "u", "--outputs", column, *units, *made, "--quiet"]) == 0
        for ending in ("h", "xml", "mat", "npz"):
            assert main(["export", f"{name}.json", f"{name}.{ending}", "--quiet"]) == 0
        run = ["--out", f"{name}-run.csv", "--quiet"]
        assert main(["simulate", f"{name}.json", f"{name}.csv", *run, *units]) == 0
    assert json.loads((tmp_path / "hostile.json").read_text())["model"]["output_names"] == [SCRIPT]
    hostile, plain = (Scripts((tmp_path / f"{name}.html").read_text()) for name in ("hostile", "plain"))
    assert hostile.tags == plain.tags and len(hostile.scripts) == len(plain.scripts)
    assert all("<script" not in one or one.lstrip().startswith("{") for one in hostile.scripts)
    widths = [
        {len(row) for row in csv.reader((tmp_path / f"{name}-run.csv").read_text().splitlines())}
        for name in ("hostile", "plain")
    ]
    assert widths[0] == widths[1] and len(widths[0]) == 1
    assert "alert" not in without_comments((tmp_path / "hostile.h").read_text())
    # No name of a column makes a place of a file.
    assert {path.suffix for path in tmp_path.rglob("*")} == {".csv", ".json", ".html", ".h", ".xml", ".mat", ".npz"}
