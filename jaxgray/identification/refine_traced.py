"""A fixed number of Gauss-Newton steps over the cones, in traced code.

The steps are those of `conic`, without its decisions: no damping that reacts, no test of convergence. From a
subspace start two or three are enough, and what is fixed can be differentiated.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.positive import PositiveLeastSquares, ProjectedGradientSolver
from .normal import Criterion, join, part
from .prediction import Batch, Nuisance, Setting
from .refine import begin_nuisance
from .structure import MASS_FLOOR, Structure

RIDGE = 1e-12
"""Relative damping that keeps directions without information where they are."""


def gauss_newton(
    matrices: tuple[Array, Array, Array], batch: Batch, setting: Setting, steps: int
) -> tuple[Array, Array, Array]:
    """M, D, K after `steps` Gauss-Newton steps on the free run, M ≻ 0, D ⪰ 0, K ⪰ 0, first states and offsets free.

    **Arguments:** `matrices`: scaled M, D, K to start from; `batch`; `setting`; `steps`: how many. The weights of the
    outputs are renewed before every step.

    **Returns:** scaled M, D, K. Differentiable by the start and the data.

    **Reference:** Ljung, *System Identification*, §10.2.
    """
    criterion = Criterion(batch, setting, Structure())
    sizes = criterion.sizes
    entries = sum(n * (n + 1) // 2 for n in sizes)
    unit = jnp.concatenate([jnp.full(n * (n + 1) // 2, jnp.trace(X) / n) for n, X in zip(sizes, matrices)])
    unit = jnp.where(unit > 0, unit, 1.0)
    floors = jnp.array([MASS_FLOOR, 0.0, 0.0])
    solver = ProjectedGradientSolver()
    identity = jnp.eye(batch.y.shape[2])
    quiet = begin_nuisance(batch, setting, offset=True, innovations=False)

    def step(carry, first):
        z, nuisance = carry
        blocks = part(z, sizes)
        found = criterion.products(blocks, nuisance)
        lower = jnp.linalg.cholesky(found.covariance(True))
        renewed = jax.scipy.linalg.solve_triangular(lower, identity, lower=True)
        normal = found.normal(jnp.where(first, identity, renewed))
        H, g = normal.information, normal.gradient
        inner = _ridged(H[entries:, entries:])
        across = jnp.linalg.solve(inner, H[entries:, :entries]).T
        reduced = (H[:entries, :entries] - across @ H[entries:, :entries]) * unit[:, None] * unit[None, :]
        slope = (g[:entries] - across @ g[entries:]) * unit
        reduced, here = _ridged((reduced + reduced.T) / 2), z / unit
        best = solver(PositiveLeastSquares(reduced, slope - reduced @ here, floors, sizes))
        # First states and offsets enter linearly: their best values come before the first weights.
        dz = jnp.where(first, 0.0, (best - here) * unit)
        dn = -jnp.linalg.solve(inner, g[entries:] + H[entries:, :entries] @ dz)
        states = quiet.x0.size
        x0 = nuisance.x0 + dn[:states].reshape(quiet.x0.shape)
        return (z + dz, Nuisance(x0, nuisance.offset + dn[states:].reshape(quiet.offset.shape), None)), None

    (z, _), _ = jax.lax.scan(step, (join(list(matrices)), quiet), jnp.arange(steps + 1) == 0)
    return tuple(part(z, sizes))


def _ridged(H: Array) -> Array:
    return H + RIDGE * jnp.diag(jnp.diag(H))
