"""Mass, damping and stiffness of a whole grid of realisations at once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ...mechanics.systems.drives import Force
from ...numerics.matrices.positive import FreeSolver
from ...numerics.outcomes import ComputationError
from ..setup.prediction import Setting
from ..subspace.grid import Candidate, drives_every_coordinate
from ..subspace.input_matrix import InputFit
from ..subspace.physical import FLOOR, from_inverse_mass, input_matrix, jointly
from ..subspace.realization import Realization
from .start import REACH_LIMIT, physical_model


@functools.partial(jax.jit, static_argnames="every_coordinate")
def _closed_form(
    realization: Realization, fit: InputFit, setting: Setting, every_coordinate: bool
) -> tuple[tuple[Array, Array, Array], Array, Array]:
    """Minimisers without the cone, the margin by which they lie inside it, and how far the inputs reach."""

    def one(realization, fit):
        E = setting.drive.input_map
        if every_coordinate:
            matrices = from_inverse_mass(realization, fit, E, FreeSolver())
            bounded, reach = jnp.linalg.inv(matrices[0]), jnp.ones(())
        else:
            B2 = input_matrix(fit).reshape(E.shape)
            matrices, reach = jointly(realization, (B2, E), FreeSolver())
            bounded = matrices[0]
        least = [jnp.linalg.eigvalsh((X + X.T) / 2)[0] for X in (bounded, *matrices[1:])]
        size = jnp.abs(jnp.trace(bounded)) / len(bounded)
        return matrices, jnp.min(jnp.stack([least[0] - 10 * FLOOR * size, *least[1:]])), reach

    return jax.vmap(jax.vmap(one))(realization, fit)


def physical_grid(
    found: Candidate, setting: Setting
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], Bool[np.ndarray, "*grid"], Bool[np.ndarray, "*grid"]]:
    """M, D, K (scaled) of every choice, those of `physical_model`.

    Where the minimiser without the cone lies inside it, as nearly everywhere, it is the answer, and all of them are
    computed together; the rest go to the exact solver one by one.

    **Arguments:** `found`: realisations and input fits, leading axes τ × i; `setting`.

    **Returns:** matrices, not a number where there is none; where there is a model; where the exact solver gave it.
    """
    shape = found.realization.A21.shape[:2]
    parts = (found.realization.A21, found.realization.A22, found.fit.factor, found.fit.target)
    finite = np.all([np.all(np.isfinite(np.asarray(p).reshape(*shape, -1)), axis=2) for p in parts], axis=0)
    if isinstance(setting.drive, Force):
        every = drives_every_coordinate(setting.drive)
        matrices, margin, reach = _closed_form(found.realization, found.fit, setting, every)
        matrices = [np.array(X) for X in matrices]
        usable = finite & (np.asarray(reach) > REACH_LIMIT)
        inside = usable & (np.asarray(margin) > 0) & np.all([np.isfinite(X).all((2, 3)) for X in matrices], axis=0)
    else:
        matrices = [np.full((*shape, *found.realization.A21.shape[2:]), np.nan) for _ in range(3)]
        usable, inside = finite, np.zeros(shape, bool)
    exact = usable & ~inside
    for k in zip(*np.nonzero(exact)):
        choice = jax.tree_util.tree_map(lambda leaf, k=k: leaf[k], (found.realization, found.fit))
        try:
            here = physical_model(*choice, setting, None)
        except ComputationError:
            usable[k] = False
            continue
        for table, X in zip(matrices, here):
            table[k] = np.asarray(X)
    for table in matrices:
        table[~usable] = np.nan
    return tuple(matrices), usable, exact & usable
