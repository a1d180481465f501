"""Which machine a record is of, and when it was made."""

from pathlib import Path

import pytest

from jaxgray.fleets.drift.series import Naming


@pytest.mark.parametrize(
    "pattern, file, machine, number",
    [
        ("{machine}_{when}.csv", "a/robot_7_012.csv", "robot_7", 12.0),
        ("{machine}-{when}.csv", "a/robot_7-012.csv", "robot_7", 12.0),
        ("{machine}_{when}.csv", "press_2026-03-01.csv", "press", 20513.0),
        ("{machine}_{when}.csv", "press_20260301T120000.csv", "press", 20513.5),
        ("*/{machine}/{when}_*.csv", "data/m1/3.5_x.csv", "m1", 3.5),
        ("{machine}.csv", "m1.csv", "m1", None),
    ],
)
def test_file_names(pattern, file, machine, number):
    naming = Naming.of(pattern, None, ())
    naming.check([Path(file)])
    found, _, when = naming.machine_and_when(file, {})
    assert (found, when) == (machine, number)


def test_a_column_says_when():
    assert Naming.of("{machine}.csv", "hours", ()).machine_and_when("m.csv", {"hours": 7.0}) == ("m", "7", 7.0)


@pytest.mark.parametrize("pattern", ["x.csv", "{machine}_{day}.csv", "{machine}{machine}.csv"])
def test_patterns_that_say_no_machine(pattern):
    with pytest.raises(ValueError, match="machine is .*give a pattern"):
        Naming.of(pattern, None, ())


def test_a_name_that_does_not_fit_is_said():
    with pytest.raises(ValueError, match="does not fit other.csv"):
        Naming.of("m{machine}.csv", None, ()).check([Path("m1.csv"), Path("other.csv")])
