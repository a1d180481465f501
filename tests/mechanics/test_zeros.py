"""Zeros, checked by the frequency-response function vanishing there and by closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.systems.drives import BaseDisplacement, Force
from jaxgray.mechanics.systems.zeros import transmission_zeros, zeros

N = 4
M = np.diag([1.0, 2.0, 1.5, 0.7])
K = 300.0 * (2 * np.eye(N) - np.eye(N, k=1) - np.eye(N, k=-1))
D = 1e-3 * K + np.diag([0.3, 0.1, 0.5, 0.2])


def receptance(s):
    return np.linalg.inv(s * s * M + s * D + K)


@pytest.mark.parametrize("output", range(N))
def test_zeros_of_a_chain(output):
    # Through p springs with damping: 2(n − 1 − p) zeros of the rest of the chain, one of each spring passed.
    found = zeros(MechanicalModel(M, D, K), input=0, output=output).values
    assert len(found) == 2 * (N - 1 - output) + output
    for z in found:
        H = receptance(z)
        assert np.abs(H[output, 0]) < 1e-7 * np.max(np.abs(H))
    springs = np.sort_complex(found)[:output]
    np.testing.assert_allclose(springs, -1e3, rtol=1e-3)


def test_collocated_antiresonances_are_the_modes_of_what_is_left():
    found = zeros(MechanicalModel(M, 0 * D, K), input=0, output=0)
    left = np.sqrt(np.linalg.eigvals(np.linalg.solve(M[1:, 1:], K[1:, 1:])).real)
    np.testing.assert_allclose(found.antiresonance_hz, np.sort(left) / (2 * np.pi), rtol=1e-10)
    np.testing.assert_allclose(found.damping_ratio, 0.0, atol=1e-9)


def test_without_damping_nothing_is_left_at_the_far_end():
    found = zeros(MechanicalModel(M, 0 * D, K), input="u1", output="y4")
    assert len(found.values) == 0 and found.antiresonance_hz.size == 0


def test_pairs_of_the_reference_system(model, matrices):
    M, D, K = matrices
    for i in range(2):
        for o in range(2):
            entry = (1 - o, 1 - i)
            expected = np.roots([M[entry], D[entry], K[entry]])
            found = model.zeros(input=f"u{i + 1}", output=o).values
            np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-9)
    assert len(transmission_zeros(model).values) == 0


@pytest.mark.parametrize(("measured", "count"), [("velocity", 2), ("acceleration", 4)])
def test_rates_have_zeros_at_the_origin(matrices, measured, count):
    found = transmission_zeros(MechanicalModel(*matrices, measured=measured)).values
    np.testing.assert_array_equal(found, np.zeros(count))


def test_more_outputs_than_inputs(matrices):
    M, _, K = matrices
    # A force (sD + K) r of an excited base vanishes in all outputs together only if D = K/100.
    base = MechanicalModel(M, K / 100, K, drive=BaseDisplacement(jnp.ones((2, 1))))
    np.testing.assert_allclose(transmission_zeros(base).values, [-100.0], rtol=1e-9)
    one = MechanicalModel(*matrices, drive=Force(jnp.asarray([[1.0], [0.0]])), measured="velocity")
    np.testing.assert_array_equal(transmission_zeros(one).values, [0.0])


def test_more_inputs_than_outputs(matrices):
    E = jnp.asarray([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    found = transmission_zeros(MechanicalModel(*matrices, drive=Force(E), measured="velocity")).values
    np.testing.assert_array_equal(found, [0.0, 0.0])


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("rate", [1e-2, 1e4])
def test_units_do_not_matter(size, rate):
    # Coordinate k counted in another unit, time in another.
    units = np.diag(size ** np.array([0.0, 1.0, -0.5, 0.5]))
    scaled = (units @ X @ units * rate**p for X, p in ((M, 0), (D, 1), (K, 2)))
    found = zeros(MechanicalModel(*scaled), input=1, output=2).values
    np.testing.assert_allclose(found / rate, zeros(MechanicalModel(M, D, K), input=1, output=2).values, rtol=1e-6)


def test_named_failures(model):
    apart = MechanicalModel(np.eye(2), np.eye(2), np.eye(2))
    with pytest.raises(ValueError, match="inputs u1 do not show separately in outputs y2"):
        zeros(apart, input=0, output=1)
    with pytest.raises(ValueError, match="output='q1' is not known; give one of y1, y2"):
        zeros(model, input=0, output="q1")
    with pytest.raises(ValueError, match="input=None"):
        model.zeros(output=0)


def test_one_screen():
    text = repr(zeros(MechanicalModel(M, D, K), input=0, output=1))
    assert "from u1 to y2: 5" in text and text.count("antiresonance") == 2
