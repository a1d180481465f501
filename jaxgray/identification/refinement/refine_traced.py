"""A fixed number of Gauss-Newton steps over the cones, in traced code.

The steps are those of `conic`, without its test of convergence. From a subspace start two or three are enough, and what
is fixed can be differentiated. A step that makes the model less likely is taken back and damped.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...numerics.matrices.positive import PositiveLeastSquares, ProjectedGradientSolver
from ..setup.prediction import Batch, Nuisance, Setting
from ..setup.structure import MASS_FLOOR, Structure
from .normal_equations import Criterion, join, part
from .refine import begin_nuisance

RIDGE = 1e-12
"""Relative damping that keeps directions without information where they are."""

DAMPED = 1.0
"""Relative damping of the step after one that was taken back."""

ROUNDING = 1e-9
"""Rise of minus the logarithm of the likelihood per sample that does not count."""


class _Place(eqx.Module):
    """Joined entries of M, D, K; first states and offsets."""

    entries: Array
    nuisance: Nuisance


class _Point(eqx.Module):
    """The normal equations at a place, and minus the logarithm of its likelihood per sample, but for a constant."""

    place: _Place
    gradient: Array
    information: Array
    cost: Array


def gauss_newton(
    matrices: tuple[Array, Array, Array],
    batch: Batch,
    setting: Setting,
    steps: int,
    structure: Structure | None = None,
) -> tuple[Array, Array, Array]:
    """M, D, K after `steps` Gauss-Newton steps on the free run, M ≻ 0, D ⪰ 0, K ⪰ 0, first states and offsets free.

    **Arguments:** `matrices`: scaled M, D, K to start from; `batch`; `setting`; `steps`: how many. The weights of the
    outputs are renewed before every step. `structure`: what is free, default all entries.

    **Returns:** scaled M, D, K, never less likely than the start with its best first states and offsets.
    Differentiable by the start and the data.

    **Reference:** Ljung, *System Identification*, §10.2.
    """
    criterion = Criterion(batch, setting, Structure() if structure is None else structure)
    sizes = criterion.sizes
    blocks = list(matrices) if structure is None else structure.blocks(*matrices, lift=0.0)
    entries = sum(n * (n + 1) // 2 for n in sizes)
    unit = jnp.concatenate([jnp.full(n * (n + 1) // 2, jnp.trace(X) / n) for n, X in zip(sizes, blocks)])
    unit = jnp.where(unit > 0, unit, 1.0)
    floors = jnp.array([MASS_FLOOR, 0.0, 0.0] if structure is None else criterion.structure.floors(setting.dofs))
    solver = ProjectedGradientSolver()
    identity = jnp.eye(batch.y.shape[2])
    quiet = begin_nuisance(batch, setting, offset=True, innovations=False)

    def evaluated(place, first):
        found = criterion.products(part(place.entries, sizes), place.nuisance)
        lower = jnp.linalg.cholesky(found.covariance(True))
        renewed = jax.scipy.linalg.solve_triangular(lower, identity, lower=True)
        normal = found.normal(jnp.where(first, identity, renewed))
        return _Point(place, normal.gradient, normal.information, jnp.sum(jnp.log(jnp.diag(lower))))

    def step(carry, index):
        place, best, damping = carry
        first = index == 0
        point = evaluated(place, first)
        # First states and offsets enter linearly: their best values come before the first weights and the first cost.
        taken = (index <= 1) | (point.cost <= best.cost + ROUNDING)
        best = jax.tree_util.tree_map(lambda new, old: jnp.where(taken, new, old), point, best)
        damping = jnp.where(taken, 0.0, jnp.maximum(10 * damping, DAMPED))
        z, nuisance, g = best.place.entries, best.place.nuisance, best.gradient
        H = best.information + damping * jnp.diag(
            jnp.where(jnp.arange(len(g)) < entries, jnp.diag(best.information), 0)
        )
        inner = _ridged(H[entries:, entries:])
        across = jnp.linalg.solve(inner, H[entries:, :entries]).T
        reduced = (H[:entries, :entries] - across @ H[entries:, :entries]) * unit[:, None] * unit[None, :]
        slope = (g[:entries] - across @ g[entries:]) * unit
        reduced, here = _ridged((reduced + reduced.T) / 2), z / unit
        nearest = solver(PositiveLeastSquares(reduced, slope - reduced @ here, floors, sizes))
        dz = jnp.where(first, 0.0, (nearest - here) * unit)
        dn = -jnp.linalg.solve(inner, g[entries:] + H[entries:, :entries] @ dz)
        states = quiet.x0.size
        x0 = nuisance.x0 + dn[:states].reshape(quiet.x0.shape)
        offset = nuisance.offset + dn[states:].reshape(quiet.offset.shape)
        return (_Place(z + dz, Nuisance(x0, offset, None)), best, damping), None

    start = _Place(join(blocks), jax.tree_util.tree_map(jnp.asarray, quiet))
    size = entries + quiet.x0.size + quiet.offset.size
    unknown = _Point(start, jnp.zeros(size), jnp.zeros((size, size)), jnp.asarray(jnp.inf))
    (last, best, _), _ = jax.lax.scan(step, (start, unknown, jnp.asarray(0.0)), jnp.arange(steps + 1))
    better = evaluated(last, False).cost <= best.cost + ROUNDING
    found = part(jnp.where(better, last.entries, best.place.entries), sizes)
    return tuple(found) if structure is None else criterion.matrices(found)


def _ridged(H: Array) -> Array:
    return H + RIDGE * jnp.diag(jnp.diag(H))
