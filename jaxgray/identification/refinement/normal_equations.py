"""Normal equations of the prediction error in the entries of the blocks, first states and offsets.

One compiled function of the record serves every host-side optimiser: it returns inner products of errors and
sensitivities for every pair of outputs, from which the normal equations follow for any weights.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg as sl
from jaxtyping import Array, Float

from ...mechanics.systems.statespace import StateSpace
from ...numerics.matrices.linear_algebra import duplication, symmetric_vector
from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.lifting import free_response
from ...numerics.responses.response_products import response_products
from ...numerics.responses.sensitivity import by_blocks, lift_by_channel
from ..setup.prediction import Batch, Nuisance, Setting, prediction_errors, weighed
from ..setup.structure import Structure

FLOOR = 1e-12
"""Smallest residual, relative to the outputs, that the weights resolve: below it is rounding."""

LARGEST = 1e100
"""Inner product from which a trial counts as overflowing: its square is still a number."""

SHRINKAGE = 1e-3
"""Taken off the correlation of two outputs' errors: what a wrong model leaves may be collinear, noise is not."""


class Normal(eqx.Module):
    """Normal equations at a point, in the scaled block vectors followed by the nuisance parameters.

    `cost`: sum of squared whitened errors; `gradient` = Jᵀe; `information` = JᵀJ.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " parameters"]
    information: Float[Array, "parameters parameters"]


class Products(eqx.Module):
    """Inner products over the samples, output by output: sensitivities first, the error last.

    `table[o, p]`: products of the rows of outputs o and p; `counts`: samples kept of each output.
    """

    table: Float[Array, "outputs outputs columns columns"]
    counts: Float[Array, " outputs"]

    @property
    def finite(self) -> bool:
        """Whether nothing overflowed, nor would if multiplied; in traced code, where nobody can ask, taken to be so."""
        return not isinstance(self.table, np.ndarray) or bool(np.max(np.abs(self.table)) <= LARGEST)

    def normal(self, whitening: Float[Array, "outputs outputs"]) -> Normal:
        """Normal equations with the errors whitened; on the host infinitely costly where anything overflowed."""
        if not self.finite or not np.all(np.isfinite(whitening) if isinstance(whitening, np.ndarray) else True):
            columns = self.table.shape[-1] - 1
            return Normal(np.array(np.inf), np.full(columns, np.nan), np.full((columns, columns), np.nan))
        weights = whitening.T @ whitening
        table = (weights[:, :, None, None] * self.table).sum((0, 1))
        return Normal(table[-1, -1], table[:-1, -1], table[:-1, :-1])

    def covariance(self, correlated: bool) -> Float[Array, "outputs outputs"]:
        """Mean products of the errors; `correlated`: also of different outputs."""
        table = self.table[:, :, -1, -1] / (self.counts[:, None] * self.counts[None, :]) ** 0.5
        eye = np.eye(len(self.counts))
        if not self.finite:
            return np.full_like(table, np.nan)
        return (table if correlated else table * eye) * (1 - SHRINKAGE * (1 - eye)) + FLOOR**2 * eye

    @property
    def exact(self) -> bool:
        """Whether what is left of every output is rounding (on the host)."""
        return bool(np.all(np.diagonal(self.covariance(False)) < 2 * FLOOR**2))

    def whitening(self, correlated: bool) -> np.ndarray:
        """Lower triangular W with W Σ Wᵀ = I for the covariance Σ of the errors, on the host.

        Reweighting with it until it rests minimises the determinant of Σ, the maximum likelihood for Gaussian
        output noise. With missing samples the outputs are weighted one by one. Not a number where Σ is.
        """
        covariance = np.asarray(self.covariance(correlated))
        if not np.all(np.isfinite(covariance)):
            return np.full_like(covariance, np.nan)
        lower = np.linalg.cholesky(covariance)
        return sl.solve_triangular(lower, np.eye(len(lower)), lower=True)


def join(blocks: list[Array]) -> Float[Array, " entries"]:
    """Blocks as one vector of isometric triangle vectors; NumPy stays NumPy."""
    vectors = [symmetric_vector(block) for block in blocks]
    return (np if all(isinstance(v, np.ndarray) for v in vectors) else jnp).concatenate(vectors)


def part(vector: Float[Array, " entries"], sizes: tuple[int, ...]) -> list[Array]:
    """Inverse of `join`."""
    ends = np.cumsum([n * (n + 1) // 2 for n in sizes])
    pieces = [vector[end - n * (n + 1) // 2 : end] for n, end in zip(sizes, ends)]
    return [(duplication(n) @ piece).reshape(n, n) for n, piece in zip(sizes, pieces)]


def without_noise(nuisance: Nuisance) -> Nuisance:
    """First states and offsets alone."""
    return Nuisance(nuisance.x0, nuisance.offset, None)


def moved(nuisance: Nuisance, step: Float[np.ndarray, " parameters"]) -> Nuisance:
    """First states and offsets after a step, on the host."""
    x0 = np.asarray(nuisance.x0)
    offset = nuisance.offset
    if offset is not None:
        offset = np.asarray(offset) + step[x0.size :].reshape(offset.shape)
    return Nuisance(x0 + step[: x0.size].reshape(x0.shape), offset, nuisance.noise)


class Iterate(eqx.Module):
    """Where an iteration stands: blocks of M, D, K, nuisance, and the whitening of the output noise."""

    blocks: list[Array]
    nuisance: Nuisance
    whitening: Float[Array, "outputs outputs"]


class Prior(eqx.Module):
    """What is assumed of entries that an experiment may leave open: their sizes, and how sure that is.

    `centre`: of the joined block vectors; `precision`: 1/variance of every entry, 0 where nothing is assumed. In units
    of whitened errors: one unit is as much evidence as one sample that is off by one standard deviation.
    """

    centre: Float[Array, " entries"]
    precision: Float[Array, " entries"]

    def added(self, normal: Normal, vector: Float[Array, " entries"]) -> Normal:
        """Normal equations with the prior's share, at these entries."""
        off, n = vector - self.centre, len(self.centre)
        gradient, information = np.array(normal.gradient), np.array(normal.information)
        gradient[:n] += self.precision * off
        information[np.arange(n), np.arange(n)] += self.precision
        return Normal(normal.cost + self.precision @ off**2, gradient, information)


class Criterion(eqx.Module):
    """What the refinement makes small: prediction errors of the records, under what is free in M, D, K, and the
    distance from a `prior` where there is one."""

    batch: Batch
    setting: Setting
    structure: Structure
    prior: Prior | None = None

    @property
    def sizes(self) -> tuple[int, ...]:
        """Rows of each block."""
        return self.structure.sizes(self.setting.dofs)

    @property
    def owners(self) -> tuple[str, ...]:
        """The matrix to which each block belongs."""
        return self.structure.owners(self.setting.dofs)

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Whether each block's factor has a logarithmic diagonal."""
        return self.structure.logarithmic(self.setting.dofs)

    @property
    def count(self) -> float:
        """Number of output samples (on the host)."""
        return float(np.sum(np.asarray(self.batch.kept)))

    @property
    def correlated(self) -> bool:
        """Whether the noise of different outputs may be (on the host): not where samples of single ones are missing."""
        kept = np.asarray(self.batch.kept)
        return bool(np.all(np.sum(kept, axis=2) % kept.shape[2] == 0))

    def matrices(self, blocks: list[Array]) -> tuple[Array, Array, Array]:
        """M, D, K from the blocks."""
        return self.structure.matrices(blocks, self.setting.dofs)

    def errors(self, at: Iterate) -> tuple[Float[Array, "records samples outputs"], StateSpace]:
        """Whitened prediction errors, and the sampled system that makes them."""
        system = self.setting.system(*self.matrices(at.blocks))
        return prediction_errors(system, self.batch, at.nuisance, at.whitening), system

    def products(self, blocks: list[Array], nuisance: Nuisance) -> Products:
        """Inner products of errors and sensitivities; in the innovations form the errors are white already."""
        if self.prior is not None:
            # No part of the errors: with it or without, one compiled program.
            return dataclasses.replace(self, prior=None).products(blocks, nuisance)
        if nuisance.noise is None and len(self.batch.y) == 1:
            return _of_one_record(blocks, nuisance, self)
        plain = Iterate(blocks, nuisance, np.eye(self.batch.y.shape[2]))
        return _gram(*sensitivities(plain, self), self.batch.kept)

    def evaluate(self, blocks: list[Array], nuisance: Nuisance) -> Products:
        """`products`, fetched to the host."""
        return jax.device_get(self.products(blocks, nuisance))

    def normal(self, products: Products, whitening: Float[Array, "outputs outputs"], blocks: list[Array]) -> Normal:
        """Normal equations on the host at these blocks, the prior's share included."""
        plain = products.normal(whitening)
        return plain if self.prior is None else self.prior.added(plain, join(blocks))


@stored(level=ONCE)
def sensitivities(
    at: Iterate, criterion: Criterion
) -> tuple[Float[Array, "records samples outputs"], Float[Array, "records samples outputs parameters"]]:
    """Whitened prediction errors, and their Jacobian by the entries of the blocks, first states and offsets.

    The noise parameters stay as they are: their information is, to first order, apart from that of the model.
    """
    batch, nuisance = criterion.batch, at.nuisance

    def errors(vector):
        e, system = criterion.errors(Iterate(part(vector, criterion.sizes), nuisance, at.whitening))
        return e, (e, system)

    J, (e, system) = jax.jacfwd(errors, has_aux=True)(join(at.blocks))
    # First states and offsets enter linearly, every record's own.
    records, samples, outputs = e.shape
    own = [free_response(system.A, system.C, samples)]
    if nuisance.offset is not None:
        own.append(jnp.broadcast_to(jnp.eye(outputs), (samples, outputs, outputs)))
    eye = jnp.eye(records)
    for columns in own:
        rows = -columns * batch.kept[..., None]
        rows = jax.vmap(lambda r: weighed(r, system, batch, nuisance, at.whitening), -1, -1)(rows)
        rows = rows[..., None, :] * eye[:, None, None, :, None]
        J = jnp.concatenate([J, rows.reshape(*e.shape, -1)], axis=3)
    return e, J


@stored(level=ONCE)
def _of_one_record(blocks: list[Array], nuisance: Nuisance, criterion: Criterion) -> Products:
    """`Criterion.products` where there is one record and noise at the outputs alone."""
    batch = criterion.batch
    u, y, kept = (by_blocks(signal[0]) for signal in (batch.u, batch.y, batch.kept))
    offset = None if nuisance.offset is None else nuisance.offset[0]

    def lifted(vector):
        system = criterion.setting.system(*criterion.matrices(part(vector, criterion.sizes)))
        return lift_by_channel(system.A, system.B, system.C, system.D)

    table = response_products(lifted, join(blocks), nuisance.x0[0], offset, u, y, kept, gaps=batch.gaps)
    return Products(table.transpose(1, 3, 0, 2), _counts(batch.kept))


def _counts(kept):
    return jnp.maximum(jnp.sum(kept, axis=(0, 1)), 1.0)


@jax.jit
def _gram(e, J, kept):
    rows = jnp.concatenate([J, e[..., None]], axis=3)
    outputs, columns = rows.shape[2:]
    flat = rows.reshape(-1, outputs * columns)
    table = (flat.T @ flat).reshape(outputs, columns, outputs, columns).transpose(0, 2, 1, 3)
    return Products(table, _counts(kept))
