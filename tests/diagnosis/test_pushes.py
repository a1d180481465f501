"""Stretches of what the force equation leaves, as pushes."""

from types import SimpleNamespace

import numpy as np

from jaxgray.diagnosis.equation_error.unmeasured_forces import _brief


def stretches(rows, size):
    """First and last sample of every push seen in one record of 2000 samples."""
    one = SimpleNamespace(rows=rows, q=np.zeros((2000, size.shape[1])))
    dofs = size.shape[1]
    return [(p.first, p.last) for p in _brief([size], np.full(dofs, 0.2), np.full(dofs, 5.0), [one], [size], 1.0)]


def test_a_push_beside_missing_rows_does_not_reach_across_them():
    rows = np.arange(0, 2000, 2)
    rows = rows[(rows < 600) | (rows >= 700)]
    size = np.where((rows >= 700) & (rows < 712) | (rows >= 1500) & (rows < 1510), 20.0, 0.1)[:, None]
    assert stretches(rows, size) == [(698, 712), (1498, 1510)]
    around = np.where((rows >= 590) & (rows < 710), 20.0, 0.1)[:, None]
    assert stretches(rows, around) == [(588, 600), (698, 710)]


def test_a_push_that_moves_all_coordinates_counts_once():
    rows = np.arange(0, 2000, 2)
    size = np.where((rows >= 1000) & (rows < 1060), 20.0, 0.1)[:, None] * np.ones(3)
    assert stretches(rows, size) == [(998, 1060)] * 3
    assert stretches(rows, np.where(rows < 120, 20.0, 0.1)[:, None]) == []
