"""Units of the parameters of every law, by dimensional analysis of their texts."""

import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis.conclusions.assembly import estimates_of
from jaxgray.mechanics.effects.base import AbstractInputEffect, AbstractOutputEffect, Term, places_of
from jaxgray.mechanics.systems.units import composed_unit

SENSORS = {"displacement": "mm", "velocity": "mm/s", "acceleration": "mm/s^2"}
DIMENSIONS = {"N": (1, 0, 0), "mm": (0, 1, 0), "s": (0, 0, 1), "1": (0, 0, 0)}


def powers(text):
    """Powers of force, length and time that a unit's text stands for."""
    total = np.zeros(3)
    for part, sign in zip(text.split("/"), (1, -1)):
        for factor in part.strip("()").split():
            name, _, power = factor.partition("^")
            total += sign * float(power or 1) * np.array(DIMENSIONS[name])
    return total


def terms(record):
    for effect in jaxgray.CATALOGUE:
        for place in places_of(effect, record.input_names, record.output_names)[:1]:
            yield effect, Term(effect, place, effect.bounded(np.zeros(len(effect.parameters))))


@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("measured", SENSORS)
def test_laws_are_told_in_displacement_and_force_whatever_the_sensor(measured, base):
    u = np.sin(np.arange(40.0))[:, None] * [1.0, 2.0]
    sensor, drive = SENSORS[measured], "mm/s^2" if base else "N"
    units = {"input_units": [drive] * 2, "output_units": [sensor] * 2}
    record = jaxgray.Record(u, u, 0.01, measured=measured, **units)
    seen = 0
    for effect, term in terms(record):
        told = estimates_of(term, {}, record, per_mass=base)
        for parameter in effect.parameters:
            if parameter.choices:
                continue
            text, (force, length, time) = told[parameter.name].unit, parameter.unit
            if isinstance(effect, AbstractOutputEffect):
                assert text == composed_unit(parameter.unit, drive, sensor)
            elif not base:
                np.testing.assert_array_equal(powers(text), parameter.unit, err_msg=f"{effect.id}: {text}")
            elif not isinstance(effect, AbstractInputEffect) and effect.places != "input":
                expected = (0, length + force, time - 2 * force)
                np.testing.assert_array_equal(powers(text), expected, err_msg=f"{effect.id}: {text}")
            seen += 1
    assert seen > 60


def test_what_acts_at_an_input_is_told_in_its_unit_under_a_moving_base_too():
    u = np.sin(np.arange(40.0))[:, None]
    for unit in ("mm", "mm/s^2"):
        record = jaxgray.Record(u, u, 0.01, input_units=[unit], output_units=["mm"])
        (limit,) = (t for e, t in terms(record) if e.id == "input_saturation")
        assert estimates_of(limit, {}, record, per_mass=True)["limit"].unit == unit


def test_a_gap_seen_by_accelerometers_is_a_length():
    u = np.sin(np.arange(40.0))[:, None]
    record = jaxgray.Record(u, u, 0.01, measured="acceleration", input_units=["m/s^2"], output_units=["m/s^2"])
    (stop,) = (t for e, t in terms(record) if e.id == "end_stop")
    told = estimates_of(stop, {}, record, per_mass=True)
    assert (told["gap"].unit, told["ks"].unit) == ("m", "1/s^2")


@pytest.mark.parametrize("unit, expected", [((1, -2, 2), "N s^2/m^2"), ((0, 0, 1), "s"), ((0, -1, 0), "1/m")])
def test_units_are_composed_of_those_of_the_channels(unit, expected):
    assert composed_unit(unit, "N", "m") == expected
    assert composed_unit((1, 0, 0), "", "m") == ""
