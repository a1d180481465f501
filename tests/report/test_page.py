"""The page without a browser: what it says, how it is written, that it stands alone."""

import dataclasses
import html.parser
import json
import re

import numpy as np
import pytest
from made_diagnosis import diagnosis, equivalent, model, nothing, wrong_numbers

import jaxgray
from jaxgray.diagnosis.findings import Gain
from jaxgray.report.diagnosis_rows import candidate_rows, candidates, in_words
from jaxgray.report.documents.diagnosis import diagnosis_document
from jaxgray.report.page import parts as page_parts
from jaxgray.report.page import whole as page
from jaxgray.report.page.time_plots import stretches

PARTS = ["findings", "time", "spectra", "missing", "ranking", "shift", "budget", "not-found", "experiment", "data"]


class Outline(html.parser.HTMLParser):
    """Headings, tables and references of a page, and whether every element is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.headings, self.ids, self.loads, self.tables, self._text = [], [], [], [], [], None
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag not in ("meta", "link", "br", "line", "polyline", "circle"):
            self.open.append(tag)
        if "id" in attrs:
            self.ids.append(attrs["id"])
        self.loads += [value for key, value in attrs.items() if key in ("src", "href") and not value.startswith("#")]
        if tag in ("h1", "h2"):
            self._text = ""

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag in ("h1", "h2"):
            self.headings.append((tag, self._text))
            self._text = None

    def handle_data(self, data):
        if self._text is not None:
            self._text += data


def embedded(text):
    """The document that the page carries."""
    return json.loads(re.search(r'<script type="application/json" id="document">(.*?)</script>', text, re.S)[1])


def test_the_verdict_comes_first_and_nine_parts_follow():
    text = page.html_of(diagnosis())
    outline = Outline(text)
    assert outline.headings[0] == ("h1", diagnosis().sentence)
    assert [tag for tag, _ in outline.headings[1:]] == ["h2"] * (len(outline.headings) - 1)
    assert [one for one in outline.ids if one in PARTS] == PARTS
    assert len(outline.ids) == len(set(outline.ids))
    assert outline.loads == ["data:,"]
    assert len(text.encode()) < page.LARGEST


def test_the_first_screen_tells_cause_place_size_and_gain():
    made = page.page_of(diagnosis())
    cause, place, size, gain = made.cards[0]
    assert (cause.value, place.value, size.value) == ("Coulomb friction", "y1", "Fc = 0.2412 ± 0.0023 N")
    assert (gain.value, gain.remark) == ("64.2 % (61.1 to 66.8)", "on held-out data")
    # Root mean square of 2.8 and 1.05 before, of 1 and 1 after.
    assert [fact.value for fact in made.cards[1]] == ["2.1×", "1.00×", "noise alone"]


def test_every_table_is_that_of_the_document():
    made = diagnosis()
    document = diagnosis_document(made)
    assert embedded(page.html_of(made)) == json.loads(json.dumps(document))
    tables = {
        block.caption: block.rows.body
        for section in page.page_of(made).sections
        for block in section.blocks
        if block.kind == "table"
    }
    shift = document["shifts"][1]
    row = next(row for row in tables["Before and after, in percent and in standard errors"] if row[0] == shift["name"])
    assert row[1:5] == ("3.39", "3.000 ± 0.010", f"{shift['percent']:+.1f} %", "-39.0")
    assert tables["Shares of the mean square error"][0] == ("Coulomb friction at y1", "87.0 %")
    assert len(tables["Smallest visible sizes"]) == len(document["not_found"])


@pytest.mark.parametrize(
    "made, words",
    [
        (nothing(), ("nothing is missing",)),
        (nothing("unexplained", 2.8, depends_on=("velocity (y1)",)), ("something is missing that has no name",)),
        (equivalent(), ("causes this record cannot tell apart", "or sensor offset at y1", "d²/σ²: 250 with it")),
        (wrong_numbers(), ("Your model misses", "Wrong stiffness")),
    ],
    ids=["noise", "unexplained", "equivalent", "own model"],
)
def test_pages_of_other_verdicts(made, words):
    text = page.html_of(made)
    Outline(text)
    for word in words:
        assert word in text


def test_the_ranking_holds_everything_by_its_evidence():
    document = diagnosis_document(equivalent())
    document["gate"] = [
        {"effect": "constant_force", "location": "y1", "delta_bic": 70.0},
        {"effect": "end_stop", "location": "y2", "delta_bic": 12.0},
        {"effect": "cubic_stiffness", "location": "y2", "delta_bic": 3.0},
    ]
    rows = candidates(document)
    found = [(row["effect"], row["refit"], row["gate"], row["status"]) for row in rows]
    assert found == [
        ("stribeck_friction", 2481.0, None, "rejected"),
        ("constant_force", 80.0, 70.0, "equivalent"),
        ("sensor_offset", 77.5, None, "in the class"),
        ("end_stop", None, 12.0, "not refitted"),
        ("dahl_friction", None, None, "rejected"),
    ]
    assert "ΔBIC gate" in candidate_rows(document).head
    assert "ΔBIC gate" not in candidate_rows(diagnosis_document(equivalent())).head
    assert in_words("explained better by coulomb_friction at y1_a") == "explained better by Coulomb friction at y1_a"


def test_one_finding_has_one_gain_and_several_have_the_sum():
    both = wrong_numbers(gain=Gain({}, 80.0, (70.0, 90.0), 60.0, True))
    first, second, all_of_it = page.page_of(both).cards
    assert first[3].value == second[3].value == "64.2 % (61.1 to 66.8)"
    assert "80.0 % (70.0 to 90.0)" in [fact.value for fact in all_of_it]


def test_names_from_files_cannot_break_the_page():
    bad = '</script><img src=x onerror="alert(1)">&y'
    made = diagnosis()
    named = dataclasses.replace(
        made,
        baseline=dataclasses.replace(made.baseline, model=dataclasses.replace(model(3.0), output_names=(bad, "y2"))),
    )
    named = dataclasses.replace(named, noise_floor={bad: 1e-3, "y2": 2e-3}, warnings=(bad,))
    text = page.html_of(named)
    assert "<img" not in text and Outline(text).loads == ["data:,"]
    assert embedded(text)["warnings"] == [bad]


def test_a_page_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "out.html"
    jaxgray.write_report(diagnosis(), path, notes=("A note from the file.",))
    assert (
        path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>") and "A note from the file." in path.read_text()
    )
    assert [one.name for one in tmp_path.iterdir()] == ["out.html"]
    with pytest.raises(ValueError, match="the folder .* is not there"):
        jaxgray.write_report(diagnosis(), tmp_path / "no" / "out.html")
    with pytest.raises(ValueError, match="result is a MechanicalModel; give what identify or diagnose returned"):
        jaxgray.write_report(model(1.0), tmp_path / "model.html")


def test_series_survive_and_long_ones_keep_their_extremes():
    x = np.array([1.5, np.nan, -2.25])
    np.testing.assert_array_equal(page_parts.unpacked(page_parts.packed(x)), x.astype("f4"))
    long = np.zeros(100_001)
    long[70_001], long[5] = 9.0, np.nan
    stretch = page_parts.stretch_for(len(long), 40)
    assert stretch > 1 and page_parts.stretch_for(100, 4) == 1
    drawn = page_parts.over_time(0.01 * np.arange(len(long)), long, stretch)
    y = page_parts.unpacked(drawn["y"])
    assert drawn["x"]["count"] == len(y) <= page_parts.MOST_VALUES // 40 + 2 and np.nanmax(y) == 9.0
    assert abs(drawn["x"]["first"] + drawn["x"]["step"] * np.nanargmax(y) - 700.01) < 0.01 * stretch
    assert f"Of every {stretch} of the 100001 samples" in page_parts.drawn_from(100_001, stretch)


def test_stretches_are_where_the_error_is_worst_and_typical():
    error = np.ones(2000)
    error[1200:1300], error[:500] = 5.0, 0.1
    worst, typical = stretches(error)
    assert worst == slice(1200, 1300)
    assert np.all(error[typical] == 1.0)
    assert stretches(np.ones(30)) == (slice(0, 30), slice(0, 30))


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_stands_out_from_what_it_is_on(theme):
    """WCAG 2: text at least 4.5, lines of plots at least 3."""
    css = (page.environment().loader.get_source(page.environment(), "page.css"))[0]
    block = re.search(
        r':root(\[data-theme="dark"\])? \{([^}]*--page: #' + ("fff" if theme == "light" else "0f1") + "[^}]*)", css
    )
    colours = dict(re.findall(r"--(\w+): (#\w{6})", block[2]))

    def luminance(colour):
        parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    def contrast(a, b):
        high, low = sorted((luminance(colours[a]), luminance(colours[b])), reverse=True)
        return (high + 0.05) / (low + 0.05)

    for ground in ("page", "soft"):
        assert min(contrast(name, ground) for name in ("text", "muted", "link")) >= 4.5
    assert min(contrast(name, "page") for name in ("measured", "before", "after", "second", "third", "fourth")) >= 3.0


def test_identification_page(identification):
    text = page.html_of(identification)
    outline = Outline(text)
    order = ["model", "fit", "bode", "modes", "residual", "start", "data"]
    assert [one for one in outline.ids if one in order] == order
    document = embedded(text)
    assert document["schema"] == "jaxgray/identification/1"
    fit = document["fit_percent"]["validation"]["y1"]
    assert f"{fit:.2f} %" in text and outline.headings[0][1].endswith(".")
    assert "plot-start-map" in outline.ids and "plot-bode-1-1" in outline.ids
    assert len(text.encode()) < page.LARGEST


def test_notebooks_show_results(identification):
    shown = diagnosis()._repr_html_()
    assert diagnosis().sentence in shown and "0.2412 ± 0.0023 N" in shown and "<script" not in shown
    assert "natural frequency [Hz]" in identification._repr_html_()
    fits = np.array([[[90.0, 80.0], [np.nan, np.nan]]])
    matrices = np.zeros((1, 2, 2, 2))
    sweep = jaxgray.Sweep(np.array([0.1]), np.array([4, 6]), fits, None, *[matrices] * 3, 1, 0, ("y1", "y2"))
    assert "80.00" in sweep._repr_html_() and "–" in sweep._repr_html_()
