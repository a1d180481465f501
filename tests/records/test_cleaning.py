"""Spoilt samples become missing, and nothing else."""

import numpy as np

from jaxgray.records import Record
from jaxgray.records.cleaning import without_defects

T = 0.01 * np.arange(2000)
RNG = np.random.default_rng(5)
Y = np.stack([np.sin(3.0 * T) + 0.5 * np.sin(7.3 * T), np.cos(5.1 * T)], axis=1) + 1e-3 * RNG.standard_normal((2000, 2))


def record(y):
    return Record(np.sign(np.sin(2.0 * T))[:, None], y, 0.01)


def test_a_clean_record_stays_the_same_object():
    clean = record(Y)
    assert without_defects(clean) is clean


def test_outliers_and_cut_off_samples_are_missing():
    y = Y.copy()
    spikes = [300, 800, 801, 1500]
    y[spikes, 1] += 5.0
    limit = 1.2
    cut = np.flatnonzero(Y[:, 0] > limit)
    y[:, 0] = np.minimum(y[:, 0], limit)
    cleaned = without_defects(record(y))
    assert set(np.flatnonzero(cleaned.missing[:, 1])) == set(spikes)
    lost = np.flatnonzero(cleaned.missing[:, 0])
    assert set(cut) <= set(lost)
    assert len(lost) <= len(cut) + 4 * np.sum(np.diff(cut) > 1) + 4
    kept = ~cleaned.missing
    np.testing.assert_array_equal(cleaned.y[kept], y[kept])


def test_a_channel_that_is_cut_off_in_most_of_its_samples_keeps_the_rest():
    y = np.minimum(Y, -0.4)
    cleaned = without_defects(record(y))
    assert np.all(cleaned.missing[Y > -0.4]) and np.all(cleaned.missing.mean(axis=0) < 0.75)
    np.testing.assert_array_equal(cleaned.y[~cleaned.missing], Y[~cleaned.missing])


def test_a_channel_that_is_hardly_anything_else_is_left_alone():
    y = np.minimum(Y, np.quantile(Y, 0.1, axis=0))
    assert without_defects(record(y)).missing.sum() == 0
