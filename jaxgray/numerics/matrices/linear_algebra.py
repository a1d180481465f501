"""Matrices as the other floors need them: symmetric vectors, orthonormal bases, dominant subspaces.

Everything here can be traced, vmapped and differentiated; what has no derivative (singular vectors
where singular values meet) is replaced by what has one (the subspace they span).
"""

import functools

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Bool, Float

from .namespace import namespace


def symmetric_size(length: int) -> int:
    """Rows n of the symmetric matrix whose triangle has `length` = n(n+1)/2 entries."""
    return int((np.sqrt(8 * length + 1) - 1) / 2)


@functools.cache
def triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column indices of the upper triangle by columns, the order that Clarabel uses."""
    columns = np.concatenate([np.full(c + 1, c) for c in range(n)])
    rows = np.concatenate([np.arange(c + 1) for c in range(n)])
    return rows, columns


def triangle_vector(X: Float[Array, "n n"]) -> Float[Array, " entries"]:
    """Entries of the upper triangle by columns, unscaled."""
    return _taken(X, _triangle_of) if isinstance(X, jax.Array) else _triangle_of(X)


def _triangle_of(X):
    return X[triangle(X.shape[-1])]


@functools.partial(jax.jit, static_argnums=1, inline=True)
def _taken(x, pick):
    # Called from the host as often as from within: one program in place of eight.
    return pick(x)


@functools.cache
def _places(n: int) -> np.ndarray:
    """Where each entry of a symmetric matrix stands in its triangle vector."""
    rows, columns = triangle(n)
    places = np.zeros((n, n), int)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return places


def from_triangle(x: Float[Array, " entries"]) -> Float[Array, "n n"]:
    """Symmetric matrix with these upper-triangle entries (by columns, unscaled)."""
    return _taken(x, _matrix_of) if isinstance(x, jax.Array) else _matrix_of(x)


def _matrix_of(x):
    return x[_places(symmetric_size(x.shape[-1]))]


def _weights(n: int) -> np.ndarray:
    rows, columns = triangle(n)
    return np.where(rows == columns, 1.0, np.sqrt(2.0))


def symmetric_vector(X: Float[Array, "n n"]) -> Float[Array, " entries"]:
    """Isometric vector of a symmetric matrix: upper triangle by columns, off-diagonals × √2."""
    return triangle_vector(X) * _weights(X.shape[-1])


def from_symmetric_vector(x: Float[Array, " entries"]) -> Float[Array, "n n"]:
    """Inverse of `symmetric_vector`."""
    return from_triangle(x / _weights(symmetric_size(x.shape[-1])))


@functools.cache
def duplication(n: int) -> np.ndarray:
    """Matrix that turns the isometric vector of a symmetric n × n matrix into its entries, row by row."""
    rows, columns = triangle(n)
    table = np.zeros((n, n, len(rows)))
    table[rows, columns, np.arange(len(rows))] = 1 / _weights(n)
    table[columns, rows, np.arange(len(rows))] = 1 / _weights(n)
    return table.reshape(n * n, -1)


def orthonormal_basis(
    X: Float[Array, "rows columns"], kept: Bool[Array, " columns"], *, householder: bool, passes: int = 2
) -> Float[Array, "rows columns"]:
    """Orthonormal basis of the kept columns; zero where a column is not kept.

    CholeskyQR2 where the columns are well conditioned (two Gram matrices and two triangular solves,
    accurate to rounding up to a condition number of about 1e7), or Householder QR where they may be
    dependent. A column that is not kept is given a dimension of its own, so that padding never touches
    the rest.

    **Arguments:** `X`: columns; `kept`: which of them count; `householder`: take the slower way;
    `passes`: of Cholesky, default 2; one is orthonormal only to the square of the condition number.

    **Returns:** a matrix of the shape of `X`.
    """
    X = jnp.where(kept, X, 0.0)
    if householder:
        extended = jnp.concatenate([X, jnp.diag(jnp.where(kept, 0.0, 1.0))], axis=0)
        return jnp.where(kept, jnp.linalg.qr(extended)[0][: X.shape[0]], 0.0)
    for _ in range(passes):
        gram = X.T @ X + jnp.diag(jnp.where(kept, 0.0, 1.0))
        X = jsl.solve_triangular(jnp.linalg.cholesky(gram), X.T, lower=True).T
    return X


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def dominant_subspace(
    X: Float[Array, "rows columns"], rank: int
) -> tuple[Float[Array, "columns rank"], Float[Array, " values"]]:
    """Orthonormal basis of the dominant right singular subspace of `X`, and all singular values.

    The derivative of the basis is that of the subspace alone: the part that would turn the basis within the
    subspace is left out, so that it stays finite where kept singular values meet. Use it only for what does not
    depend on the choice of basis.

    **Arguments:** `X`: any matrix; `rank`: dimension of the subspace.

    **Returns:** one basis vector a column, and the singular values, descending.
    """
    _, s, Vt = jnp.linalg.svd(X, full_matrices=False)
    return Vt[:rank].T, s


@dominant_subspace.defjvp
def _dominant_subspace_jvp(rank, primals, tangents):
    (X,), (dX,) = primals, tangents
    U, s, Vt = jnp.linalg.svd(X, full_matrices=False)
    V1 = Vt[:rank].T
    full = s.shape[0]
    gap = s[None, :rank] ** 2 - s[rank:, None] ** 2
    gap = jnp.where(gap > 0, gap, jnp.inf)
    left = U[:, rank:full].T @ dX @ V1
    right = Vt[rank:full] @ dX.T @ U[:, :rank]
    within = (s[rank:, None] * left + right * s[None, :rank]) / gap
    dV = Vt[rank:full].T @ within
    row_space = Vt.T
    outside = dX.T @ U[:, :rank]
    outside = (outside - row_space @ (row_space.T @ outside)) / jnp.where(s[:rank] > 0, s[:rank], jnp.inf)
    return (V1, s), (dV + outside, jnp.sum(U * (dX @ Vt.T), axis=0))


def _clipped(X):
    xp = namespace(X)
    values, vectors = xp.linalg.eigh((X + X.T) / 2)
    return (vectors * xp.maximum(values, 0.0)) @ vectors.T


def project_positive(X: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Nearest positive semidefinite matrix (Frobenius norm) to a symmetric one.

    The derivative is the Daleckii-Krein formula with divided differences, finite also where eigenvalues
    repeat, where differentiating the eigenvectors is not.
    """
    return _projected(X) if isinstance(X, jax.Array) else _clipped(X)


_projected = jax.custom_jvp(_clipped)


@_projected.defjvp
def _project_positive_jvp(primals, tangents):
    (X,), (dX,) = primals, tangents
    values, vectors = jnp.linalg.eigh((X + X.T) / 2)
    clipped = jnp.maximum(values, 0.0)
    difference = values[:, None] - values[None, :]
    apart = jnp.abs(difference) > 1e-12 * jnp.max(jnp.abs(values))
    slope = jnp.where(
        apart,
        (clipped[:, None] - clipped[None, :]) / jnp.where(apart, difference, 1.0),
        ((values[:, None] + values[None, :]) > 0).astype(X.dtype),
    )
    rotated = vectors.T @ ((dX + dX.T) / 2) @ vectors
    return (vectors * clipped) @ vectors.T, vectors @ (slope * rotated) @ vectors.T


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def inverse_root(X: Float[Array, "n n"], truncation: float) -> Float[Array, "n n"]:
    """X^(−1/2) of a positive semidefinite matrix, directions below `truncation` (relative) left out.

    The derivative is by divided differences, as that of `project_positive`.
    """
    roots, vectors = _inverse_roots(X, truncation)[1:]
    return (vectors * roots) @ vectors.T


def _inverse_roots(X, truncation):
    values, vectors = jnp.linalg.eigh((X + X.T) / 2)
    large = values > truncation * values[-1]
    return values, jnp.where(large, 1.0 / jnp.sqrt(jnp.where(large, values, 1.0)), 0.0), vectors


@inverse_root.defjvp
def _inverse_root_jvp(truncation, primals, tangents):
    (X,), (dX,) = primals, tangents
    values, roots, vectors = _inverse_roots(X, truncation)
    r, s = roots[:, None], roots[None, :]
    # (r − s)/(a − b) = −r²s²/(r + s) for a = r⁻², b = s⁻², and r/(a − b) where s is left out.
    both = (r > 0) & (s > 0)
    difference = values[:, None] - values[None, :]
    one = ((r > 0) ^ (s > 0)) & (difference != 0)
    slope = jnp.where(both, -((r * s) ** 2) / jnp.where(both, r + s, 1.0), 0.0)
    slope = jnp.where(one, (r - s) / jnp.where(one, difference, 1.0), slope)
    rotated = vectors.T @ ((dX + dX.T) / 2) @ vectors
    return (vectors * roots) @ vectors.T, vectors @ (slope * rotated) @ vectors.T


BLOCK = 16
"""Rows of a block over its columns: few enough for a block to stay in the cache."""


def triangular_factor(X: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """R of the QR decomposition of a tall matrix, up to signs of its rows, from those of blocks that fit the cache.

    **Reference:** Demmel, Grigori, Hoemmen & Langou, SIAM J. Sci. Comput. 34 (2012) A206-A239 (TSQR).
    """
    rows, columns = X.shape
    size = BLOCK * columns
    count = -(-rows // size)
    if count > 1:
        padded = jnp.pad(X, ((0, count * size - rows), (0, 0))).reshape(count, size, columns)
        X = jnp.linalg.qr(padded, mode="r").reshape(-1, columns)
    return jnp.linalg.qr(X, mode="r")


def least_squares(X: Float[Array, "rows columns"], Y: Float[Array, "rows targets"]) -> Float[Array, "columns targets"]:
    """Solution of min ‖X Z − Y‖ for full column rank, by QR with scaled columns."""
    scale = jnp.linalg.norm(X, axis=0)
    scale = jnp.where(scale > 0, scale, 1.0)
    Q, R = jnp.linalg.qr(X / scale)
    return jsl.solve_triangular(R, Q.T @ Y) / scale[:, None]


def null_basis(X: Float[Array, "rows columns"]) -> Float[Array, "columns directions"]:
    """A basis of what a matrix of full row rank takes to zero, orthonormal at hand; traceable and differentiable.

    Which basis does not matter to what is made of it, so that the choice is taken as constant.
    """
    first = jax.lax.stop_gradient(jnp.linalg.qr(jax.lax.stop_gradient(X).T, mode="complete")[0][:, X.shape[0] :])
    return first - X.T @ jnp.linalg.solve(X @ X.T, X @ first)
