"""Information in a record about M, D, K where noise at the forces is estimated beside them."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from ...numerics.programs.stored_programs import ONCE, stored
from ...numerics.responses.lifting import respond
from ..setup.prediction import free_run, noise_model
from .conic import pseudo_inverse
from .normal_equations import Criterion, Iterate, join, part, sensitivities


@stored(level=ONCE)
def _derivatives(at: Iterate, criterion: Criterion) -> tuple[Array, Array, Array]:
    """Covariance of the innovations, its derivatives by blocks and noise, and those of the whitened innovations."""
    batch, nuisance = criterion.batch, at.nuisance
    outputs, inputs = batch.y.shape[2], batch.u.shape[2]

    def innovations(vector, noise):
        system = criterion.setting.system(*criterion.matrices(part(vector, criterion.sizes)))
        gain, covariance = noise_model(system, noise, inputs)
        residual = (batch.y - free_run(system, batch, nuisance)) * batch.kept
        through = jax.vmap(lambda e: respond(system.A - gain @ system.C, gain, -system.C, jnp.eye(outputs), e))
        return covariance, through(residual) * batch.kept

    here = join(at.blocks), nuisance.noise
    S, _ = innovations(*here)
    moved, rows = (jnp.concatenate(pair, axis=-1) for pair in jax.jacfwd(innovations, argnums=(0, 1))(*here))
    whitening = jsl.solve_triangular(jnp.linalg.cholesky(S), jnp.eye(outputs), lower=True)
    return S, moved, jnp.einsum("op,rnpk->rnok", whitening, rows)


def information_beside_noise(
    at: Iterate, criterion: Criterion, variance: float
) -> tuple[Float[np.ndarray, "parameters parameters"], Float[np.ndarray, " ratios"]]:
    """Information about blocks, first states and offsets, times the noise `variance`, the noise parameters eliminated.

    With innovations ε of covariance S it is Σ ψᵀS⁻¹ψ + N/2 tr(S⁻¹S_i S⁻¹S_j), ψ_i = ∂ε/∂θ_i, S_i = ∂S/∂θ_i.

    **Arguments:** `at`: where the refinement ended, in the innovations form; `criterion`; `variance`: of innovations
    whitened by S of unit determinant.

    **Returns:** the information, and the standard errors of the noise parameters.

    **Reference:** Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory* (1993), §3.9.
    """
    S, moved, rows = (np.asarray(X) for X in _derivatives(at, criterion))
    entries, noise = len(join(at.blocks)), len(np.asarray(at.nuisance.noise))
    own = np.asarray(sensitivities(at, criterion)[1])[..., entries:]
    J = np.concatenate([rows[..., :entries], own, rows[..., entries:]], axis=-1)
    J = J.reshape(-1, J.shape[-1])
    information = J.T @ J
    slopes = np.linalg.solve(S, np.moveaxis(moved, -1, 0))
    places = np.r_[:entries, len(information) - noise : len(information)]
    traces = np.einsum("iab,jba->ij", slopes, slopes)
    information[np.ix_(places, places)] += variance * criterion.count / len(S) / 2 * traces
    kept, out = slice(0, -noise), slice(-noise, None)
    across = information[kept, out]
    errors = np.sqrt(variance * np.diag(pseudo_inverse(information))[out])
    return information[kept, kept] - across @ pseudo_inverse(information[out, out]) @ across.T, errors
