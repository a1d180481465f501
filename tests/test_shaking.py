"""The tool that shakes the suite shakes what it should, and nothing else."""

import sys
from types import ModuleType

import numpy as np
import pytest
import shaking

import jaxgray


def test_values_move_by_their_last_digits_and_equal_ones_alike():
    x = np.random.default_rng(0).standard_normal((500, 2))
    x[::7] = x[3]
    x[1], x[2], x[4] = 0.0, np.nan, np.inf
    moved = shaking.shaken_values(x, 1e-13)
    finite = np.isfinite(x)
    np.testing.assert_array_equal(moved[~finite], x[~finite])
    moving = finite & (x != 0)
    relative = moved[moving] / x[moving] - 1
    assert 0.9e-13 < np.max(np.abs(relative)) < 1.1e-13 and np.std(relative) > 3e-14
    assert abs(np.mean(relative)) < 2e-14
    assert np.all(moved[::7] == moved[3]) and np.all(moved[1] == 0)
    other = shaking.shaken_values(x, 1e-13, seed=1)
    assert np.mean(other[finite] != moved[finite]) > 0.9


def test_what_is_called_with_records_sees_them_shaken_once(monkeypatch):
    seen = []

    def identify(record, *, validation=None):
        seen.append((record, validation))
        return jaxgray.identify_many([record]) if len(seen) == 1 else None

    # Stand-ins for all three, so that nothing stays shaken after this test.
    monkeypatch.setattr(jaxgray, "identify", identify)
    monkeypatch.setattr(jaxgray, "identify_many", lambda records: seen.append((records[0], None)))
    monkeypatch.setattr(jaxgray, "diagnose", lambda record: None)
    elsewhere = ModuleType("jaxgray.elsewhere")
    elsewhere.found = identify
    monkeypatch.setitem(sys.modules, "jaxgray.elsewhere", elsewhere)
    shaking.shake_everything(1e-13)
    assert elsewhere.found is jaxgray.identify is not identify
    u, y = np.random.default_rng(1).standard_normal((2, 30, 1))
    record = jaxgray.Record(u, y, 0.1, output_units=("m",))
    elsewhere.found(record, validation=[record])
    first, validation = seen[0]
    assert not np.array_equal(first.y, y) and first.y == pytest.approx(y, rel=2e-13)
    np.testing.assert_array_equal(validation[0].y, first.y)
    assert first.output_units == ("m",)
    # What calls another on the way does not shake again.
    np.testing.assert_array_equal(seen[1][0].y, first.y)
