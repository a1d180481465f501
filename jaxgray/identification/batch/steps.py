"""Prediction-error refinement of one record as one traced function, to be vmapped over many.

Damped Gauss-Newton steps on the Cholesky factors of M, D, K, on the first state and on the offsets, judged by the
likelihood with the noise covariance concentrated out, which every step renews. Each record has a damping and an end
of its own. What Cholesky factors cannot tell, whether an end at the edge of the cone is the optimum, is not decided
here: such records are marked.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ...numerics.matrices.linear_algebra import triangle_vector
from ...numerics.responses.lifting import SHORT_BLOCK
from ...numerics.responses.response_products import response_products
from ...numerics.responses.sensitivity import by_blocks, from_blocks, lift_by_channel, respond_in_blocks
from ..refinement.cholesky import pack, unpack
from ..refinement.conic import DECREMENT
from ..refinement.normal_equations import FLOOR
from ..refinement.refine import LIFTS
from ..setup.prediction import Setting
from ..setup.structure import Structure

MAX_STEPS = 40
FIRST_DAMPING = 1e-5
MOST_DAMPING = 1e8
NEARLY_FREE = 1e-3
"""Damping under which what a step promises says how far the optimum is."""
LAGS = 25
"""Lags over which the residual's whiteness is judged."""


class One(eqx.Module):
    """One record, scaled and padded, gaps filled.

    `kept`: 1 for every output sample that was measured; `inside`: 1 for the samples of the record, 0 for padding.
    """

    u: Float[Array, "samples inputs"]
    y: Float[Array, "samples outputs"]
    kept: Float[Array, "samples outputs"]
    inside: Float[Array, " samples"]


class Refined(eqx.Module):
    """Where the steps ended, in scaled coordinates.

    `matrices`: M, D, K; `covariance` of their stacked upper triangles (by columns); `deviation`: mean square
    residual per output; `portmanteau`: Ljung-Box statistic of every output's residual; `least_eigenvalue`:
    smallest over the blocks, relative to each block's largest; `decrement`: what one more step is expected to take off
    the sum of squares, in units of the noise variance; `steps`; `settled`: whether that is nothing.
    """

    matrices: tuple[Float[Array, "dofs dofs"], Float[Array, "dofs dofs"], Float[Array, "dofs dofs"]]
    covariance: Float[Array, "entries entries"]
    deviation: Float[Array, " outputs"]
    portmanteau: Float[Array, " outputs"]
    least_eigenvalue: Float[Array, ""]
    decrement: Float[Array, ""]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]


class _Point(eqx.Module):
    """Parameters, minus twice the log-likelihood there, and the normal equations in units of the noise."""

    place: Float[Array, " parameters"]
    cost: Float[Array, ""]
    gradient: Float[Array, " parameters"]
    information: Float[Array, "parameters parameters"]


class _State(eqx.Module):
    """The best point, the step from there and what it promises, and what share the promises have been falling to."""

    point: _Point
    step: Float[Array, " parameters"]
    decrement: Float[Array, ""]
    rate: Float[Array, ""]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]
    done: Bool[Array, ""]


def _step(point: _Point, damping: Array) -> tuple[Array, Array]:
    """The damped step and the decrement that it promises."""
    scale = jnp.sqrt(jnp.maximum(jnp.diag(point.information), 1e-300))
    H = point.information / scale[:, None] / scale[None, :]
    H = H + (damping + 1e-13) * jnp.eye(len(scale))
    factor = jsl.cho_factor(H, lower=True)
    step = -jsl.cho_solve(factor, point.gradient / scale)
    return step / scale, -step @ (point.gradient / scale)


def refine_one(
    start: tuple[Array, Array, Array],
    one: One,
    setting: Setting,
    structure: Structure,
    *,
    gaps: bool,
    max_steps: int = MAX_STEPS,
) -> Refined:
    """Refine M, D, K of one record by prediction error, maximum likelihood over the outputs.

    **Arguments:** `start`: scaled M, D, K; `one`: the record; `setting`; `structure`: what is free; `gaps`:
    whether samples may be missing inside the record; `max_steps`.

    **Returns:** a `Refined`; not finite where the start is of no use.

    **Reference:** Ljung, *System Identification*, §7.4 (determinant criterion) and §10.2.
    """
    dofs = setting.dofs
    sizes = structure.sizes(dofs)
    logarithmic = structure.logarithmic(dofs)
    samples, outputs = one.y.shape
    blocks = structure.blocks(*start, lift=LIFTS[0])
    scales = [jnp.trace(block) / block.shape[0] for block in blocks]
    first, by_vectors = ravel_pytree(pack(blocks, scales, logarithmic))
    entries = len(first)
    counts = jnp.maximum(jnp.sum(one.kept, axis=0), 1.0)
    # Where samples of single outputs are missing, the outputs are weighed one by one.
    together = jnp.all(one.kept == one.kept[:, :1])

    def matrices(vector):
        return structure.matrices(unpack(by_vectors(vector), scales, logarithmic, sizes), dofs)

    u, measured, kept = (by_blocks(signal) for signal in (one.u, one.y, one.kept))

    def lifted(vector):
        system = setting.system(*matrices(vector))
        return lift_by_channel(system.A, system.B, system.C, system.D)

    def residual(place, system):
        _, x0, offset = jnp.split(place, [entries, entries + 2 * dofs])
        y, _ = respond_in_blocks(system, u, x0)
        return (y + jnp.repeat(offset, SHORT_BLOCK)[:, None] - measured) * kept

    def likelihood(products):
        """Noise covariance from the residual's products, what whitens it, and minus twice the log-likelihood."""
        covariance = products / jnp.sqrt(counts[:, None] * counts[None, :])
        covariance = jnp.where(together | jnp.eye(outputs, dtype=bool), covariance, 0.0)
        lower = jnp.linalg.cholesky(covariance + FLOOR**2 * jnp.eye(outputs))
        return covariance, lower, jnp.sum(2 * counts * jnp.log(jnp.diag(lower)))

    def at(place):
        vector, x0, offset = jnp.split(place, [entries, entries + 2 * dofs])
        products = response_products(lifted, vector, x0, offset, u, measured, kept, gaps=gaps)
        _, lower, cost = likelihood(products[-1, :, -1, :])
        white = jsl.solve_triangular(lower, jnp.eye(outputs), lower=True)
        table = jnp.einsum("op,codp->cd", white.T @ white, products)
        return _Point(place, cost, table[:-1, -1], table[:-1, :-1])

    def advance(state):
        trial = at(state.point.place + state.step)
        better = jnp.isfinite(trial.cost) & (trial.cost <= state.point.cost + DECREMENT)
        # Rounding is all that is left where a step that was hardly damped promised next to nothing.
        rest = ~better & (state.decrement < 100 * DECREMENT) & (state.damping < NEARLY_FREE)
        point = jax.tree_util.tree_map(lambda new, old: jnp.where(better, new, old), trial, state.point)
        lower = jnp.where(state.damping > 1e-7, state.damping / jnp.where(state.steps > 0, 30, 1), 0.0)
        damping = jnp.where(better, lower, jnp.maximum(10 * state.damping, 1e-4))
        step, decrement = _step(point, damping)
        # What would be left after the next step, if that brings as much as the last one did.
        rate = jnp.minimum(decrement / state.decrement, 1.0)
        near = better & (state.steps > 0) & (decrement * rate < DECREMENT) & (damping < NEARLY_FREE)
        lost = ~jnp.isfinite(decrement) | (damping > MOST_DAMPING)
        step = jnp.where(rest | lost, 0.0, step)
        after = _State(point, step, decrement, rate, damping, state.steps + 1, near | rest, near | rest | lost)
        return jax.tree_util.tree_map(lambda new, old: jnp.where(state.done, old, new), after, state)

    # The first step is none: it evaluates the start, so that all of this is compiled once.
    place = jnp.concatenate([first, jnp.zeros(2 * dofs + outputs)])
    infinite, no = jnp.asarray(jnp.inf), jnp.asarray(False)
    begin = _Point(place, infinite, 0 * place, jnp.eye(len(place)))
    unusable = ~jnp.all(jnp.isfinite(first))
    damping = jnp.asarray(FIRST_DAMPING)
    state = _State(begin, 0 * place, infinite, jnp.asarray(1.0), damping, jnp.asarray(0), no, unusable)
    state = jax.lax.while_loop(lambda s: ~s.done & (s.steps < max_steps), advance, state)
    point = state.point
    # The last step is so small that its derivatives need not be renewed.
    place = jnp.where(state.settled, point.place + state.step, point.place)
    vector = place[:entries]
    e = residual(place, lifted(vector))
    products = e.reshape(outputs, -1) @ e.reshape(outputs, -1).T
    covariance, _, cost = likelihood(products)

    def stacked(vector):
        return jnp.concatenate([triangle_vector(X) for X in matrices(vector)])

    T = jax.jacfwd(stacked)(vector)
    scale = jnp.sqrt(jnp.maximum(jnp.diag(point.information), 1e-300))
    inverse = jnp.linalg.inv(point.information / scale[:, None] / scale[None, :] + 1e-14 * jnp.eye(len(scale)))
    inverse = (inverse / scale[:, None] / scale[None, :])[:entries, :entries]
    total = jnp.sum(one.kept)
    found = unpack(by_vectors(vector), scales, logarithmic, sizes)
    values = [jnp.linalg.eigvalsh(block) for block in found]
    least = jnp.min(jnp.stack([value[0] / value[-1] for value in values if len(value) > 1] or [jnp.ones(())]))
    small = [jnp.trace(block) for block, n in zip(found, sizes) if n == 1]
    if small:
        least = jnp.minimum(least, jnp.min(jnp.stack(small) / jnp.stack([s for s, n in zip(scales, sizes) if n == 1])))
    return Refined(
        matrices(vector),
        T @ inverse @ T.T * total / (total - len(scale)),
        jnp.diag(covariance),
        _portmanteau(from_blocks(e, samples), one.kept, counts),
        least,
        state.decrement * state.rate,
        state.steps,
        state.settled & jnp.isfinite(cost) & (cost <= point.cost + DECREMENT),
    )


def _portmanteau(e: Array, kept: Array, counts: Array) -> Float[Array, " outputs"]:
    """n Σ r(lag)² over the first lags, per output; missing samples count as zero."""
    centred = (e - jnp.sum(e, axis=0) / counts) * kept
    power = jnp.abs(jnp.fft.rfft(centred, 2 * len(e), axis=0)) ** 2
    correlation = jnp.fft.irfft(power, 2 * len(e), axis=0)[: LAGS + 1]
    return counts * jnp.sum((correlation[1:] / jnp.maximum(correlation[0], 1e-300)) ** 2, axis=0)
