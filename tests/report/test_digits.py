"""No number is shown with more digits than its standard error warrants, on any output, whatever the errors are."""

import dataclasses
import io
import re

import numpy as np
import pytest
from made_diagnosis import diagnosis, equivalent, nothing, wrong_numbers
from rich.console import Console

from jaxgray.diagnosis.findings import Estimate
from jaxgray.report.diagnosis_terminal import show_diagnosis
from jaxgray.report.documents.diagnosis import diagnosis_document
from jaxgray.report.documents.export import plain
from jaxgray.report.documents.identification import identification_document
from jaxgray.report.notebook import html
from jaxgray.report.page.whole import html_of
from jaxgray.report.terminal import show_identification

NUMBER = r"[-−+]?\d[\d ]*\.?\d*"
PAIR = re.compile(rf"({NUMBER}) ± ({NUMBER})")
LONE = re.compile(r"(?<![\w.±])\d+\.\d+(?![\w.])")
HOSTILE = (1.0, 1e-3, 1e-9, 1e-24, 0.0, np.nan, np.inf)
"""Factors of the standard errors."""


def figures(text):
    """How many significant digits a number has."""
    return len(text.replace(".", "").replace(" ", "").lstrip("-−+0"))


def decimals(text):
    return len(text.partition(".")[2])


def check(text):
    """What is wrong with the numbers of a text."""
    found = []
    for value, error in PAIR.findall(text):
        if figures(error) > 2 and decimals(error):
            found.append(f"{value} ± {error}: the error has more than two digits")
        if decimals(value) != decimals(error):
            found.append(f"{value} ± {error}: value and error end at different places")
    plain_text = PAIR.sub("", text)
    found += [f"{number}: more than six digits" for number in LONE.findall(plain_text) if figures(number) > 6]
    return found


def visible(page):
    """What a reader sees of a page, without its scripts."""
    page = re.sub(r"<(script|style).*?</\1>", " ", page, flags=re.S)
    return re.sub(r"<[^>]*>", " ", page)


def on_terminal(show, document):
    out = Console(file=io.StringIO(), width=400)
    show(out, document)
    return out.file.getvalue()


def scaled(finding, factor):
    """A finding whose parameters have other standard errors."""
    parameters = {}
    for name, one in finding.parameters.items():
        if isinstance(one.standard_error, tuple):
            error = tuple(factor * e for e in one.standard_error)
        else:
            error = None if one.standard_error is None else factor * one.standard_error
        value = one.value * 1.0000123456789 if isinstance(one.value, float) else one.value
        parameters[name] = Estimate(value, error, one.unit)
    members = tuple(dataclasses.replace(member, parameters=parameters) for member in finding.members)
    return dataclasses.replace(finding, parameters=parameters, members=members)


@pytest.mark.parametrize("factor", HOSTILE)
@pytest.mark.parametrize("make", [diagnosis, equivalent, nothing, wrong_numbers])
def test_a_diagnosis_shows_no_needless_digits(make, factor):
    made = make()
    made = dataclasses.replace(made, findings=tuple(scaled(finding, factor) for finding in made.findings))
    document = plain(diagnosis_document(made))
    for text in (repr(made), on_terminal(show_diagnosis, document), visible(html_of(made)), visible(html(made))):
        assert "±" in text or not made.findings or factor != 1.0
        assert not check(text)


@pytest.mark.parametrize("factor", [f for f in HOSTILE if np.isfinite(f)])
def test_an_identification_shows_no_needless_digits(identification, factor):
    uncertainty = dataclasses.replace(identification.uncertainty, covariance=identification.covariance * factor**2)
    made = dataclasses.replace(identification, uncertainty=uncertainty)
    document = plain(identification_document(made))
    for text in (repr(made), on_terminal(show_identification, document), visible(html_of(made)), visible(html(made))):
        assert not check(text)


def test_needless_digits_are_seen():
    assert check("k = 2.748360970411279691205664 ± 0.0")
    assert check("k = 2.7483 ± 0.01")
    assert check("k = 2.74 ± 0.00123")
    assert check("a share of 12.3456789")
    assert not check("k = 2.748 ± 0.012 N/m, 0.5 ± 0.1, (1.20 ± 0.03)e+06, 12.34 %")
