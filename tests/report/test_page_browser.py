"""The page in a headless Chromium: nothing on the console, every plot drawn, readable on a phone, zoom and print."""

import json
import re

import pytest
from made_diagnosis import diagnosis, equivalent, nothing

import jaxgray
from jaxgray.report.documents.diagnosis import diagnosis_document
from jaxgray.report.page.whole import page_of

WIDE = "[...document.querySelectorAll('.drawing')].filter((one) => one.offsetWidth > 390).length"

PAGES = ("named", "equivalent", "noise", "identification")


@pytest.fixture(scope="module")
def written(tmp_path_factory, identification):
    """Pages as files, by name, with their results."""
    folder = tmp_path_factory.mktemp("pages")
    results = dict(zip(PAGES, (diagnosis(), equivalent(), nothing(), identification)))
    for name, result in results.items():
        jaxgray.write_report(result, folder / f"{name}.html")
    return {name: (folder / f"{name}.html", result) for name, result in results.items()}


@pytest.mark.parametrize("name", PAGES)
def test_every_plot_is_drawn_and_nothing_is_said(written, opened, name):
    path, result = written[name]
    shown = opened(path)
    plots = [block for section in page_of(result).sections for block in section.blocks if block.kind == "plot"]
    found = shown.evaluate(
        """() => [...document.querySelectorAll('.drawing')].map((one) => [
            one.id, one.querySelectorAll('.main-svg').length, one.getAttribute('aria-label'),
            one._fullData.length, one.querySelectorAll('.trace, .bars, .hm, .point, .js-line').length])"""
    )
    assert [one[0] for one in found] == [f"plot-{plot.name}" for plot in plots] and plots
    for (_, layers, label, traces, marks), plot in zip(found, plots):
        assert layers and label == plot.alt and traces == len(plot.traces) and marks
    assert shown.said == [] and not [url for url in shown.asked if not url.startswith(("file:", "data:", "blob:"))]
    assert shown.locator("#trouble").is_hidden()
    tools = set(shown.evaluate("[...document.querySelectorAll('.modebar-btn')].map((one) => one.dataset.title)"))
    assert tools == {"Download plot as a PNG", "Zoom", "Pan", "Reset axes"}
    # The same page on a phone turned upright.
    shown.set_viewport_size({"width": 390, "height": 844})
    shown.wait_for_function("document.documentElement.scrollWidth <= 390", timeout=5000)
    assert shown.evaluate(WIDE) == 0 and shown.said == []


def test_a_phone_shows_it_without_scrolling_sideways(written, opened):
    shown = opened(written["named"][0], width=390, height=844, dark=True)
    assert shown.evaluate("document.documentElement.scrollWidth") <= 390
    assert shown.evaluate(WIDE) == 0 and shown.said == []


def test_the_numbers_are_those_of_the_document(written, opened):
    path, result = written["named"]
    shown = opened(path)
    document = diagnosis_document(result)
    assert shown.evaluate("JSON.parse(document.getElementById('document').textContent)") == json.loads(
        json.dumps(document)
    )
    assert shown.locator("h1").inner_text() == document["sentence"]
    card = " ".join(shown.locator(".card").first.inner_text().split())
    gain, force = document["findings"][0]["gain"], document["findings"][0]["parameters"]["Fc"]
    numbers = [float(text) for text in re.findall(r"\d+\.\d+", card)]
    assert numbers == pytest.approx([force["value"], force["standard_error"], gain["percent"], *gain["ci95"]], rel=1e-3)
    table = shown.locator("#time ~ section table, #findings table").nth(1).inner_text()
    assert f"{document['baseline']['fit_percent']['validation']['y1']:.2f} %" in table
    drawn = shown.evaluate("[...document.getElementById('plot-time-0').data[0].y].slice(0, 5)")
    assert drawn == pytest.approx(result.curves[0].measured[:5, 0].tolist(), rel=1e-6)


def test_zoom_is_shared_between_linked_plots_and_can_be_undone(written, opened):
    shown = opened(written["named"][0])
    ranges = "['plot-time-0', 'plot-time-1'].map((one) => document.getElementById(one)._fullLayout.xaxis.range)"
    home = shown.evaluate(ranges)
    shown.evaluate("Plotly.relayout('plot-time-0', {'xaxis.range[0]': 1.0, 'xaxis.range[1]': 2.0})")
    shown.wait_for_function(f"{ranges}.every((one) => one[0] === 1 && one[1] === 2)", timeout=5000)
    shown.evaluate("Plotly.relayout('plot-time-1', {'xaxis.autorange': true})")
    shown.wait_for_function(f"JSON.stringify({ranges}) === '{json.dumps(home, separators=(',', ':'))}'", timeout=5000)


def test_long_series_are_thinned_by_their_extremes_and_not_when_zoomed(written, opened):
    shown = opened(written["named"][0])
    made = """(range) => {
        const y = new Float32Array(100000).fill(0); y[70001] = 9; y[70002] = -7; y[50] = NaN;
        const even = { first: 0, step: 0.01, count: y.length };
        const points = shown({ even, y, x: series(even) }, range, 1000);
        const k = points.y.indexOf(9);
        return [points.y.length, points.x[k], Math.min(...points.y.filter(Number.isFinite))];
    }"""
    count, time, least = shown.evaluate(made, None)
    assert count <= 2000 and time == pytest.approx(700.01) and least == -7
    count, time, least = shown.evaluate(made, [700.0, 700.1])
    assert count >= 30 and time == pytest.approx(700.01) and least == -7


def test_theme_follows_the_system_and_the_button(written, opened):
    ground = "getComputedStyle(document.body).backgroundColor"
    line = "document.getElementById('plot-time-0').data[1].line.color"
    shown = opened(written["named"][0], dark=True)
    dark, shade = shown.evaluate(ground), shown.evaluate(line)
    assert dark == "rgb(15, 20, 25)" and shown.locator("#theme").inner_text() == "Light"
    ranges = "[...document.querySelectorAll('.drawing')].map((one) => one._fullLayout.yaxis.range)"
    before = shown.evaluate(ranges)
    shown.locator("#theme").click()
    assert shown.evaluate(ground) == "rgb(255, 255, 255)" and shown.locator("#theme").inner_text() == "Dark"
    shown.wait_for_function(f"{line} !== '{shade}'", timeout=5000)
    shown.evaluate("redraw()")
    shown.wait_for_timeout(500)
    assert shown.evaluate(ranges) == before


def test_keyboard_and_clipboard(written, opened):
    shown = opened(written["named"][0])
    shown.context.grant_permissions(["clipboard-read", "clipboard-write"])
    order = []
    for _ in range(6):
        shown.keyboard.press("Tab")
        order.append(shown.evaluate("document.activeElement.id || document.activeElement.textContent"))
    assert order == [
        "Skip to the result",
        "download",
        "print",
        "theme",
        "What was found",
        "Measured, simulated, extended",
    ]
    assert shown.evaluate("document.querySelectorAll('[tabindex]:not([tabindex=\"0\"])').length") == 0
    shown.locator("#budget .copy").click()
    shown.wait_for_function("document.querySelector('#budget .copy').textContent === 'Copied'")
    lines = shown.evaluate("navigator.clipboard.readText()").splitlines()
    assert lines[:2] == ["error budget\tshare of the mean square error", "Coulomb friction at y1\t87.0 %"]


def test_it_prints_in_light_colours_and_everything_unfolded(written, opened):
    shown = opened(written["named"][0], dark=True)
    assert shown.pdf(prefer_css_page_size=True).startswith(b"%PDF")
    shown.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert shown.evaluate("document.querySelectorAll('details:not([open])').length") == 0
    assert shown.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    widths = shown.evaluate("[...document.querySelectorAll('.drawing')].map((one) => one.offsetWidth)")
    assert max(widths) <= 690
    shown.evaluate("dispatchEvent(new Event('afterprint'))")
    assert shown.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 20, 25)"
    assert shown.said == []
