"""Past, future and the oblique projection between them, in the coordinates of the compressed factor.

The factor's columns stand for the filtered rows: inner products are preserved, so that rows of thousands
of samples become vectors of some eighty entries. Every number of block rows up to the factor's own is
served by masks; nothing here changes shape with it. The factor's first rows span the inputs, one order after the
other, so that projections on inputs, or off them, are choices of rows.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Bool, Float

from ...numerics.matrices.linear_algebra import dominant_subspace, inverse_root, orthonormal_basis
from .filter_bank import lambda_powers, lambda_shift, past_rows


class Data(eqx.Module):
    """Future and past of one (time constant, block rows) choice, as columns over the factor's rows.

    `family`: the factor's columns by order and channel (u, then y); `past`: past outputs, orthonormal
    combinations of the family, zero beyond `block_rows`; `enlarged_past`: one order earlier, one row more.
    """

    a: Float[Array, ""]
    block_rows: Float[Array, ""]
    family: Float[Array, "rows orders channels"]
    past: Float[Array, "rows padded outputs"]
    enlarged_past: Float[Array, "rows padded_plus_one outputs"]
    inputs: int = eqx.field(static=True)
    padded: int = eqx.field(static=True)

    @property
    def outputs(self) -> int:
        return self.family.shape[2] - self.inputs

    def of_inputs(self, orders: Array | float) -> Bool[Array, " rows"]:
        """Which rows span the inputs of the first orders."""
        return jnp.arange(self.family.shape[0]) < orders * self.inputs

    def live(self, fewer: int = 0) -> Bool[Array, " padded"]:
        """Which of the padded orders 0 … i−1 exist, with `fewer` taken off the end."""
        return jnp.arange(self.padded) < self.block_rows - fewer

    def future(self, fewer: int = 0) -> tuple[Array, Array]:
        """Future inputs and outputs, rows × (orders · channels)."""
        rows = self.family.shape[0]
        kept = jnp.where(self.live(fewer)[:, None], self.family[:, : self.padded], 0.0)
        return kept[:, :, : self.inputs].reshape(rows, -1), kept[:, :, self.inputs :].reshape(rows, -1)


def arrange(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    block_rows: Float[Array, ""],
    inputs: int,
    padded: int,
) -> Data:
    """Future and past from the factor.

    **Arguments:** `factor`: of `compression`, columns ordered by filter, then by channel (u, y); `a`: filter
    pole; `block_rows`: i ≤ `padded`, may be traced; `inputs`: how many channels are inputs.

    **Returns:** `Data`.
    """
    channels = factor.shape[1] // (2 * padded)
    family = factor.reshape(factor.shape[0], 2 * padded, channels)
    past = past_rows(a, block_rows, block_rows, padded, 2 * padded)
    enlarged = past_rows(a, block_rows + 1, block_rows - 1, padded + 1, 2 * padded)
    return Data(
        a,
        block_rows,
        family,
        jnp.einsum("rj,qjc->qrc", past, family[:, :, inputs:]),
        jnp.einsum("rj,qjc->qrc", enlarged, family[:, :, inputs:]),
        inputs,
        padded,
    )


class AbstractWeight(eqx.Module):
    """The weighting W1 of the oblique projection, and what serves as instruments."""

    @property
    def input_instruments_only(self) -> bool:
        """Whether the past outputs are left out of the instruments."""
        return False

    @abc.abstractmethod
    def apply(self, data: Data, future: Float[Array, "rows outputs"], projected: Array) -> Array:
        """W1 times the projection; `future` is the future output off the future inputs."""


class MOESP(AbstractWeight):
    """W1 = I in the Laguerre family: every filtered output counts alike. The default."""

    def apply(self, data, future, projected):
        return projected


class N4SID(AbstractWeight):
    """W1 = I in the coordinates of the λ-powers, the rows of the paper."""

    def apply(self, data, future, projected):
        powers = jnp.where(data.live()[:, None], lambda_powers(data.a, data.padded), 0.0)
        blocks = projected.reshape(data.padded, data.outputs, -1)
        return jnp.einsum("kj,jpc->kpc", powers, blocks).reshape(projected.shape)


class CVA(AbstractWeight):
    """W1 = (Y_f Π Y_fᵀ)^(−1/2): canonical correlations; directions without variance are left out."""

    truncation: float = 1e-10

    def apply(self, data, future, projected):
        return inverse_root(future.T @ future, self.truncation) @ projected


class PastInputs(AbstractWeight):
    """Only past inputs as instruments: consistent for any output noise, at about twice the error."""

    @property
    def input_instruments_only(self) -> bool:
        return True

    def apply(self, data, future, projected):
        return projected


WEIGHTS = {"moesp": MOESP(), "n4sid": N4SID(), "cva": CVA(), "past-inputs": PastInputs()}
"""Weights by the name that the command uses."""


class Projections(eqx.Module):
    """What the realisation needs of the data.

    `observability`: Γ, a basis of the dominant left subspace of W1 O_i Π, back in the Laguerre family;
    `regressor`, `target_states`, `target_outputs`: the two sides of the robust least squares, as columns
    off the future inputs; `singular_values` of W1 O_i Π.
    """

    observability: Float[Array, "outputs states"]
    regressor: Float[Array, "rows states"]
    target_states: Float[Array, "rows states"]
    target_outputs: Float[Array, "rows channels"]
    singular_values: Float[Array, " values"]


class Spans(eqx.Module):
    """Future inputs, and past: rows that span the inputs, and an orthonormal basis of past outputs off all inputs.

    Future and past inputs together span f_0 u … f_{2i−1} u. Taken as these, in this order, they are well
    conditioned at every τ; the past λ-powers beside the future are not (condition 1e8 at τ = 30 h, i = 10).
    """

    ahead: Bool[Array, " rows"]
    behind: Bool[Array, " rows"]
    past_outputs: Float[Array, "rows columns"] | None

    def off_future(self, X: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
        """X off the future inputs."""
        return jnp.where(self.ahead[:, None], 0.0, X)

    def on_past(self, X: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
        """X on the past, off the future inputs."""
        own = jnp.where(self.behind[:, None], X, 0.0)
        return own if self.past_outputs is None else own + self.past_outputs @ (self.past_outputs.T @ X)

    def on_all(self, X: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
        """X on future inputs and past together."""
        return self.on_past(X) + jnp.where(self.ahead[:, None], X, 0.0)

    def coefficients(self, X: Float[Array, "rows columns"]) -> Float[Array, "columns directions"]:
        """Coefficients of X along orthonormal directions of the past."""
        own = jnp.where(self.behind[:, None], X, 0.0).T
        if self.past_outputs is None:
            return own
        return jnp.concatenate([own, X.T @ self.past_outputs], axis=1)


def _spans(data: Data, weight: AbstractWeight, fewer: int, past: Array, householder: bool) -> Spans:
    """Future and past with the future `fewer` orders shorter."""
    inputs = data.of_inputs(2 * data.block_rows)
    ahead = data.of_inputs(data.block_rows - fewer)
    if weight.input_instruments_only:
        return Spans(ahead, inputs & ~ahead, None)
    columns = jnp.where(inputs[:, None], 0.0, past.reshape(past.shape[0], -1))
    live = jnp.repeat(jnp.arange(past.shape[1]) < data.block_rows + fewer, data.outputs)
    # No row of the inputs' is touched, also where dependent columns are filled with other directions.
    basis = orthonormal_basis(columns, live, householder=householder)
    return Spans(ahead, inputs & ~ahead, jnp.where(inputs[:, None], 0.0, basis))


def left_inverse(X: Float[Array, "rows states"]) -> Float[Array, "states rows"]:
    """(XᵀX)⁻¹Xᵀ by QR, for full column rank."""
    Q, R = jnp.linalg.qr(X)
    return jsl.solve_triangular(R, Q.T)


def project(data: Data, weight: AbstractWeight, order: int, *, householder: bool) -> Projections:
    """The oblique projection of the future outputs along the future inputs on the past, and its shift.

    **Arguments:** `data`; `weight`; `order`: number of states; `householder`: orthonormalise by QR (for
    dependent rows, as without noise) instead of CholeskyQR2.

    **Returns:** `Projections`.

    **Reference:** Van Overschee & De Moor, algorithm 4.8, steps 1 to 4.
    """
    _, Yf = data.future()
    _, Yf_shift = data.future(1)
    spans = _spans(data, weight, 0, data.past, householder)
    spans_shift = _spans(data, weight, 1, data.enlarged_past, householder)
    coefficients = spans.coefficients(Yf)
    weighted = weight.apply(data, spans.off_future(Yf), coefficients)
    basis, singular_values = dominant_subspace(weighted, order)
    observability = coefficients @ basis
    observability = observability / jnp.linalg.norm(observability, axis=0)

    outputs = data.outputs
    shift = jnp.where(data.live(1)[:, None], lambda_shift(data.a, data.padded)[:, : data.padded], 0.0)
    blocks = observability.reshape(data.padded, outputs, order)
    shifted = jnp.einsum("kj,jpn->kpn", shift, blocks).reshape(observability.shape)

    inverse = left_inverse(observability)
    inverse_shifted = left_inverse(shifted)
    last_power = lambda_powers(data.a, data.padded)[jnp.asarray(data.block_rows, int) - 1]
    current = jnp.einsum("j,qjc->qc", last_power, data.family[:, : data.padded, data.inputs :])
    return Projections(
        observability,
        spans.on_past(Yf @ inverse.T),
        spans.off_future(spans_shift.on_all(Yf_shift @ inverse_shifted.T)),
        spans.off_future(current),
        singular_values,
    )
