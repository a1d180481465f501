"""Numbers, units and sentences as a person reads them."""

import numpy as np
import pytest

from jaxgray import BaseAcceleration, Force, MechanicalModel
from jaxgray.mechanics.matrix_units import matrix_units
from jaxgray.mechanics.systems.units import displacement_unit
from jaxgray.numerics.text import plus_minus
from jaxgray.report.identification_rows import verdict
from jaxgray.report.terminal import progress


@pytest.mark.parametrize(
    "value, error, text",
    [
        (4.998734, 0.00123, "4.9987 ± 0.0012"),
        (99.9, 12.3, "100 ± 12"),
        (-1.2345e-6, 2.3e-9, "(-1.2345 ± 0.0023)e-06"),
        (1.23456789e8, 2.1e5, "(1.2346 ± 0.0021)e+08"),
        (0.0, 0.5, "0.00 ± 0.50"),
        (3.0, 0.0, "3 (fixed)"),
        (2.748360970411279691, 1e-14, "2.74836"),
        (0.02020388819, 2e-11, "0.0202039"),
        (53.9, 1.2e-5, "53.900000 ± 0.000012"),
        (3.14159265, None, "3.1416"),
        (float("nan"), 1.0, "–"),
        (None, None, "–"),
    ],
)
def test_plus_minus(value, error, text):
    assert plus_minus(value, error) == text


@pytest.mark.parametrize(
    "unit, measured, expected",
    [
        ("mm", "displacement", "mm"),
        ("m/s", "velocity", "m"),
        ("m/s^2", "acceleration", "m"),
        ("g", "acceleration", "g s^2"),
        ("mm/min", "velocity", "(mm/min) s"),
        ("", "velocity", ""),
    ],
)
def test_displacement_unit(unit, measured, expected):
    assert displacement_unit(unit, measured) == expected


def test_units_are_composed():
    eye = np.eye(2)
    model = MechanicalModel(eye, eye, eye, input_units=("N", "N"), output_units=("m", "m"))
    assert matrix_units(model) == {
        "mass": [["N s^2/m"] * 2] * 2,
        "damping": [["N s/m"] * 2] * 2,
        "stiffness": [["N/m"] * 2] * 2,
    }


def test_mixed_units_make_the_same_work():
    eye = np.eye(2)
    one = MechanicalModel(eye, eye, eye, drive=Force(eye[:, :1]), input_units=("N",), output_units=("m", "rad"))
    assert matrix_units(one)["stiffness"] == [["N/m", "N/rad"], ["N/rad", "N m/(rad rad)"]]


def test_no_units_no_guess():
    eye = np.eye(2)
    assert matrix_units(MechanicalModel(eye, eye, eye)) is None
    base = BaseAcceleration(np.ones((2, 1)), True)
    driven = MechanicalModel(eye, eye, eye, drive=base, input_units=("m/s^2",), output_units=("m", "m"))
    assert matrix_units(driven) is None


def test_verdict_without_held_out_data():
    document = {
        "model": {"mass": [[1.0]], "input_map": [[1.0]]},
        "fit_percent": {"estimation": {"y1": 71.26}},
        "residual_test": {"white": False},
        "refined": False,
    }
    assert verdict(document) == (
        "1 coordinate, 1 input, starting model without refinement: fit 71.3 % on the data of the fit; "
        "residual not white."
    )


def test_progress_is_silent_when_piped_and_speaks_when_asked(capsys):
    with progress() as silent:
        silent.stage("reading")
    assert capsys.readouterr().err == ""
    with progress(verbose=True) as spoken:
        spoken.stage("reading")
        spoken.stage("simulating", fraction=0.1)
        spoken.stage("simulating", fraction=0.2)
    assert capsys.readouterr().err == "reading …\nsimulating …\n"
    with progress(quiet=True, verbose=True) as silent:
        silent.stage("reading")
    assert capsys.readouterr().err == ""
