"""Derivatives by blocks, against automatic differentiation of the response sample by sample."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxgray.numerics.responses.lifting import respond
from jaxgray.numerics.responses.response_products import response_products
from jaxgray.numerics.responses.sensitivity import (
    ChannelBlocks,
    by_blocks,
    from_blocks,
    heads_along,
    lift_by_channel,
    respond_in_blocks,
    sensitivities_in_blocks,
)

SAMPLES, INPUTS, OUTPUTS, STATES, PARAMETERS = 333, 2, 3, 4, 5


def test_responses_and_derivatives_by_blocks_are_those_sample_by_sample():
    rng = np.random.default_rng(4)
    A = np.linalg.qr(rng.standard_normal((STATES, STATES)))[0] * 0.97
    shapes = ((STATES, STATES), (STATES, INPUTS), (OUTPUTS, STATES), (OUTPUTS, INPUTS))
    middle = [A, *(rng.standard_normal(shape) for shape in shapes[1:])]
    along = [0.01 * rng.standard_normal((*shape, PARAMETERS)) for shape in shapes]
    u, x0 = rng.standard_normal((SAMPLES, INPUTS)), rng.standard_normal(STATES)

    def matrices(p):
        return [X + dX @ p for X, dX in zip(middle, along)]

    @jax.jit
    def by_sample(p, x0):
        return respond(*matrices(p), u, x0)

    @jax.jit
    def in_blocks(p, x0):
        system, slopes = lift_by_channel(*matrices(p)), jax.jacfwd(lambda p: lift_by_channel(*matrices(p)))(p)
        slopes = jax.tree_util.tree_map(lambda X: jnp.moveaxis(X, -1, 0), slopes)
        assert isinstance(slopes, ChannelBlocks)
        y, starts = respond_in_blocks(system, by_blocks(u), x0)
        J = sensitivities_in_blocks(
            system, slopes, by_blocks(u), starts, heads_along(system, slopes, by_blocks(u), starts)
        )
        return from_blocks(y, SAMPLES), jax.vmap(lambda column: from_blocks(column, SAMPLES))(J)

    p = rng.standard_normal(PARAMETERS)
    y, J = in_blocks(p, x0)
    np.testing.assert_allclose(y, by_sample(p, x0), rtol=1e-12, atol=1e-12)
    expected = jnp.concatenate(jax.jacfwd(by_sample, argnums=(0, 1))(p, x0), axis=2)
    np.testing.assert_allclose(jnp.moveaxis(J, 0, -1), expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(from_blocks(by_blocks(u), SAMPLES), u)

    # Inner products of all that, with and without an offset, where single samples do not count or the last ones.
    offset, measured = rng.standard_normal(OUTPUTS), rng.standard_normal((SAMPLES, OUTPUTS))
    constants = np.broadcast_to(np.eye(OUTPUTS), (SAMPLES, OUTPUTS, OUTPUTS))
    counting = [((rng.random((SAMPLES, OUTPUTS)) < 0.9) * 1.0, True)]
    for samples in (SAMPLES, SAMPLES - 1, 320, 301, 7):
        counting.append((np.repeat(np.arange(SAMPLES)[:, None] < samples, OUTPUTS, axis=1) * 1.0, False))

    @functools.partial(jax.jit, static_argnames="gaps")
    def products(level, kept, gaps):
        laid = [by_blocks(signal) for signal in (u, measured, kept)]
        return response_products(lambda p: lift_by_channel(*matrices(p)), p, x0, level, *laid, gaps=gaps)

    for level, columns in ((offset, [expected, constants]), (None, [expected])):
        error = by_sample(p, x0) + (0.0 if level is None else level) - measured
        for kept, gaps in counting:
            rows = np.concatenate([*columns, error[:, :, None]], axis=2) * kept[:, :, None]
            found = products(level, kept, gaps)
            np.testing.assert_allclose(found, np.einsum("toc,tpd->codp", rows, rows), rtol=1e-8, atol=1e-8)
