"""A model that follows the data of its fit, and what the verdict takes from held-out data that it does not follow."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis.diagnose import _fails_elsewhere
from jaxgray.diagnosis.model.free_run import FreeRun

FLOOR = np.array([0.1, 0.2])


def records(size=1.0, seed=1):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((400, 1))
    return [jaxgray.Record(u, size * rng.uniform(-1, 1, (400, 2)), 0.01)]


def state(excess, *, ratio=0.0, held_out=True, laws=1):
    e = excess * FLOOR * np.ones((400, 2))
    run = FreeRun(e, e, np.ones((400, 2), bool))
    accepted = [SimpleNamespace(gain=SimpleNamespace(held_out=held_out))] * laws
    screening = SimpleNamespace(noise_model=SimpleNamespace(ratio=ratio))
    return SimpleNamespace(runs=[run], accepted=accepted, screening=screening)


@pytest.mark.parametrize("laws", [0, 1])
def test_more_than_noise_on_all_held_out_data_is_said(laws):
    assert _fails_elsewhere(state(2.0, laws=laws), records(), records(seed=2), FLOOR)
    assert not _fails_elsewhere(state(1.2, laws=laws), records(), records(seed=2), FLOOR)


def test_what_held_out_data_cannot_show_is_not():
    held = records(seed=2)
    assert not _fails_elsewhere(state(2.0, ratio=0.1), records(), held, FLOOR), "noise at the forces drives it away"
    assert not _fails_elsewhere(state(2.0, held_out=False), records(), held, FLOOR), "a law of one record's clock"
    assert not _fails_elsewhere(state(2.0), records(), records(3.0, seed=2), FLOOR), "farther than the fit knows"
    assert _fails_elsewhere(state(2.0, laws=0), records(), records(3.0, seed=2), FLOOR), "no law to be extrapolated"
    assert not _fails_elsewhere(SimpleNamespace(**vars(state(2.0)) | {"runs": []}), records(), [], FLOOR)
