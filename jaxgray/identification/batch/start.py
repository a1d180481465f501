"""The subspace start of one record as one traced function, to be vmapped over many."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.systems.drives import Force
from ...numerics.matrices.positive import NearestSolver
from ..setup.prediction import Setting
from ..setup.preparation import Signals
from ..subspace.compression import RANK_TOLERANCE, factors
from ..subspace.grid import candidate, score
from ..subspace.physical import from_inverse_mass, input_matrix, jointly
from ..subspace.projection import AbstractWeight
from ..subspace.realization import ExactMap
from .steps import One


def start_one(
    one: One,
    setting: Setting,
    poles: Float[Array, " time_constants"],
    block_rows: tuple[int, ...],
    weight: AbstractWeight,
    *,
    every_coordinate: bool,
) -> tuple[tuple[Array, Array, Array], Float[Array, ""]]:
    """The best subspace model over time constants and block rows, in closed form.

    Positive semidefinite by projection, which serves as a start; not finite where the record's filtered columns are
    dependent or no choice gives a stable model.

    **Arguments:** `one`: the record; `setting`, its drive a `Force`; `poles`: a = exp(−h/τ) of each τ to try;
    `block_rows` to try; `weight`; `every_coordinate`: whether forces act on every coordinate.

    **Returns:** scaled M, D, K, and the place of the choice in the grid τ × i.
    """
    assert isinstance(setting.drive, Force)
    E = setting.drive.input_map
    padded = max(block_rows)
    stacked = jnp.concatenate([one.u, one.y], axis=1)
    inputs = one.u.shape[1]
    grid, pivots = factors(poles, stacked, one.inside, inputs=inputs, block_rows=padded, householder=False)
    signals = Signals(one.u, one.y, one.kept, one.u.shape[0])
    cells = np.array([(k, i) for k in range(len(poles)) for i in block_rows], dtype=float).reshape(-1, 2)

    def cell(where):
        k = where[0].astype(int)
        found = candidate(
            grid[k],
            poles[k],
            where[1],
            signals,
            inputs=inputs,
            padded=padded,
            weight=weight,
            map=ExactMap(),
            measured=setting.measured,
            hold=setting.hold,
            householder=False,
        )
        return found, jnp.where(pivots[k] > RANK_TOLERANCE, score(found.deviation), -jnp.inf)

    found, scores = jax.vmap(cell)(jnp.asarray(cells))
    best = jnp.argmax(scores)
    chosen = jax.tree_util.tree_map(lambda leaf: leaf[best], found)
    solver = NearestSolver()
    if every_coordinate:
        matrices = from_inverse_mass(chosen.realization, chosen.fit, E, solver)
    else:
        B2 = input_matrix(chosen.fit).reshape(E.shape)
        matrices = jointly(chosen.realization, (B2, E), solver)[0]
    usable = jnp.isfinite(scores[best])
    return tuple(jnp.where(usable, (X + X.T) / 2, jnp.nan) for X in matrices), best
