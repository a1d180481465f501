"""Residuals made by hand: noise that a controller feeds back to the inputs is seen there."""

import numpy as np
import pytest

from jaxgray.identification.validation.residuals import residual_test

SAMPLES = 4000


def signals(seed):
    """Noise, and an input that has nothing to do with it."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((SAMPLES, 1)), np.repeat(rng.uniform(-1, 1, (SAMPLES // 8, 1)), 8, axis=0)


@pytest.mark.parametrize("seed", range(3))
def test_noise_in_the_inputs_is_followed_by_them(seed):
    e, u = signals(seed)
    before = np.concatenate([np.zeros((1, 1)), e[:-1]])
    # A tenth of the input answers the noise, now and one sample later.
    found = residual_test(e, u - 0.03 * e - 0.06 * before)
    assert found.feedback and found.followed


@pytest.mark.parametrize("seed", range(3))
def test_inputs_that_know_nothing_of_the_noise_do_not_follow_it(seed):
    found = residual_test(*signals(seed))
    assert found.white and not (found.feedback or found.followed or found.input_explained)
