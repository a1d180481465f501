"""Along which curve a refit moves the parameters of a law."""

import numpy as np
import pytest

from jaxgray.mechanics.effects import CATALOGUE
from jaxgray.mechanics.effects.hysteresis import MaxwellSlipHysteresis


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)
def test_a_curve_begins_along_the_step(effect):
    rng = np.random.default_rng(3)
    upper = [1.0 if parameter.upper > 1 else parameter.upper for parameter in effect.parameters]
    p = effect.bounded(rng.uniform(0.3, 0.7, len(effect.parameters)) * upper)
    change = 0.05 * rng.standard_normal(len(p)) * p
    for share in (1e-3, 1e-4):
        off = effect.moved(p, share * change) - p - share * change
        assert np.max(np.abs(off)) <= 2 * share**2 * np.max(np.abs(p))


def test_sliders_keep_their_force_while_their_deflection_shrinks():
    effect = MaxwellSlipHysteresis()
    p, change = np.array([30.0, 5.0, 0.02, 0.2]), np.array([30.0, 0.0, -0.01, 0.0])
    # By first order k·d rises by 30·0.02 − 30·0.01, and straight on it would have stayed as it was.
    moved = effect.moved(p, change)
    np.testing.assert_allclose(moved * [0.01, 1, 1, 1], [0.9, 5.0, 0.01, 0.2])
    assert np.all(effect.moved(p, -change) >= [0.0, 5.0, 0.03, 0.2])
