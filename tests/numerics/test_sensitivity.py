"""Derivatives by blocks, against automatic differentiation of the response sample by sample."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgray.numerics.lifting import LiftedSystem, respond
from jaxgray.numerics.sensitivity import (
    by_blocks,
    from_blocks,
    lift_by_channel,
    respond_in_blocks,
    response_products,
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
        assert isinstance(slopes, LiftedSystem)
        y, starts = respond_in_blocks(system, by_blocks(u), x0)
        J = sensitivities_in_blocks(system, slopes, by_blocks(u), starts)
        return from_blocks(y, SAMPLES), jax.vmap(lambda column: from_blocks(column, SAMPLES))(J)

    p = rng.standard_normal(PARAMETERS)
    y, J = in_blocks(p, x0)
    np.testing.assert_allclose(y, by_sample(p, x0), rtol=1e-12, atol=1e-12)
    expected = jnp.concatenate(jax.jacfwd(by_sample, argnums=(0, 1))(p, x0), axis=2)
    np.testing.assert_allclose(jnp.moveaxis(J, 0, -1), expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(from_blocks(by_blocks(u), SAMPLES), u)

    # Inner products of all that, with and without an offset, where some samples do not count.
    offset, measured = rng.standard_normal(OUTPUTS), rng.standard_normal((SAMPLES, OUTPUTS))
    kept = (rng.random((SAMPLES, OUTPUTS)) < 0.9) * 1.0
    constants = np.broadcast_to(np.eye(OUTPUTS), (SAMPLES, OUTPUTS, OUTPUTS))
    laid = [by_blocks(signal) for signal in (u, measured, kept)]
    for level, columns in ((offset, [expected, constants]), (None, [expected])):
        error = by_sample(p, x0) + (0.0 if level is None else level) - measured
        rows = np.concatenate([*columns, error[:, :, None]], axis=2) * kept[:, :, None]
        products = response_products(lambda p: lift_by_channel(*matrices(p)), p, x0, level, *laid)
        np.testing.assert_allclose(products, np.einsum("toc,tpd->codp", rows, rows), rtol=1e-8, atol=1e-8)
