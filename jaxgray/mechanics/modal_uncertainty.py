"""How well modes, zeros and frequency-response functions are known, by the delta method."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..numerics.matrices.linear_algebra import from_triangle, triangle_vector
from ..numerics.programs.runtime import ready
from ..numerics.programs.stored_programs import stored
from .model import MechanicalModel
from .systems.modal import (
    check_mass,
    check_omega,
    frequency_response,
    natural_frequencies_hz_and_damping,
    rate_factor,
    response,
    undamped_modes,
)
from .systems.zeros import first_order, zeros_of_pairs


@dataclass(frozen=True, eq=False)
class ModalUncertainty:
    """Standard errors of what `modes` and `zeros` return, in the same order and units.

    `natural_frequency_hz`, `damping_ratio`: per mode, NaN where the mode is a rigid body's; `mode_shapes`
    (dofs × modes); `antiresonance_hz`: per (input name, output name), one for each antiresonance of that
    pair.
    """

    natural_frequency_hz: Float[np.ndarray, " modes"]
    damping_ratio: Float[np.ndarray, " modes"]
    mode_shapes: Float[np.ndarray, "dofs modes"]
    antiresonance_hz: dict[tuple[str, str], Float[np.ndarray, " antiresonances"]]

    def __repr__(self) -> str:
        lines = ["Standard errors", "mode  frequency [Hz]  damping ratio"]
        for k, (f, z) in enumerate(zip(self.natural_frequency_hz, self.damping_ratio)):
            lines.append(f"{k + 1:>4}  {f:>14.3g}  {z:>13.3g}")
        for (source, place), errors in self.antiresonance_hz.items():
            if len(errors):
                lines.append(f"antiresonances [Hz] {source} to {place}: {', '.join(f'{e:.3g}' for e in errors)}")
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class ResponseBand:
    """A frequency-response function with standard errors, each frequencies × outputs × inputs.

    `response`: complex; `magnitude`: standard error of |H|, in the units of H; `phase` [rad]: standard error
    of the phase, infinite where H is zero.
    """

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    magnitude: Float[np.ndarray, "frequencies outputs inputs"]
    phase: Float[np.ndarray, "frequencies outputs inputs"]


def stacked_entries(model: MechanicalModel) -> Float[Array, " entries"]:
    """Upper triangles by columns of mass, then damping, then stiffness: the order of every covariance."""
    return jnp.concatenate([triangle_vector(X) for X in (model.mass, model.damping, model.stiffness)])


def with_entries(model: MechanicalModel, entries: Float[Array, " entries"]) -> MechanicalModel:
    """The model with the matrices of these `stacked_entries`."""
    return model.with_matrices(*(from_triangle(part) for part in jnp.split(entries, 3)))


def _shapes(model):
    return undamped_modes(model.mass, model.stiffness)[1]


@stored
def _modal_jacobians(model, entries):
    def quantities(theta):
        at = with_entries(model, theta)
        found = *natural_frequencies_hz_and_damping(at.mass, at.damping, at.stiffness), _shapes(at)
        return found, found

    return jax.jacfwd(quantities, has_aux=True)(entries)


@stored
def _zero_jacobian(model, entries, z, left, right, inputs, outputs, T):
    """Derivative of each zero z: −wᴴ dP v / wᴴ(∂P/∂z)v with the null vectors of its pencil P."""
    states = 2 * model.dofs
    w, w_out = left[:, :states].conj(), left[:, states].conj()
    v, v_in = right[:, :states], right[:, states]

    def balance(theta):
        S = with_entries(model, theta).state_space(T)
        moved = v @ S.A.T - z[:, None] * v + S.B[:, inputs].T * v_in[:, None]
        seen = jnp.sum(S.C[outputs] * v, axis=1) + S.D[outputs, inputs] * v_in
        total = jnp.sum(w * moved, axis=1) + w_out * seen
        return jnp.stack([total.real, total.imag])

    real, imaginary = jax.jacfwd(balance)(entries)
    return (real + 1j * imaginary) / jnp.sum(w * v, axis=1)[:, None]


def modal_uncertainty(model: MechanicalModel, covariance) -> ModalUncertainty:
    """Standard errors of natural frequencies, damping ratios, mode shapes and antiresonances.

    Delta method: J Σ Jᵀ with the exact derivatives of eigenvalues, shapes and zeros, by forward
    differentiation of perturbation formulas rather than finite differences, so that no step must be chosen
    and no modes matched. At repeated frequencies it is finite: a frequency's error is then that along the
    shape chosen, a shape's leaves out its turning within the repeated frequency. Where two poles meet the
    linearisation is too small.

    **Arguments:** `model`; `covariance`: of the upper triangles by columns of mass, then damping, then
    stiffness.

    **Returns:** a `ModalUncertainty`.

    **Raises:** `ValueError` when the covariance does not fit or the mass is not positive definite.

    **Reference:** Fox & Kapoor (1968), *Rates of change of eigenvalues and eigenvectors* (shapes).
    """
    return ModalUncertainty(*mode_errors(model, covariance), antiresonance_errors(model, covariance))


def mode_errors(
    model: MechanicalModel, covariance
) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, " modes"], Float[np.ndarray, "dofs modes"]]:
    """Standard errors of natural frequencies [Hz], damping ratios and mode shapes; all else as `modal_uncertainty`."""
    ready()
    check_mass(model)
    covariance = _check_covariance(model, covariance)
    jacobians, (f, ratio, _) = _modal_jacobians(model, stacked_entries(model))
    f_error, ratio_error, shape_error = (_deviation(np.asarray(J), covariance) for J in jacobians)
    return (
        np.where(np.asarray(f) == 0, np.nan, f_error),
        np.where(np.isnan(np.asarray(ratio)), np.nan, ratio_error),
        shape_error,
    )


def antiresonance_errors(
    model: MechanicalModel, covariance
) -> dict[tuple[str, str], Float[np.ndarray, " antiresonances"]]:
    """Standard errors of antiresonances [Hz] by input and output; all else as `modal_uncertainty`."""
    covariance = _check_covariance(model, covariance)
    pairs = zeros_of_pairs(model)
    T, A, B, C, D = first_order(model)
    found, pencils = {}, []
    for (source, place), pair in pairs.items():
        i, o = model.input_names.index(source), model.output_names.index(place)
        z = pair.antiresonances
        found[source, place] = np.zeros(len(z))
        for k, value in enumerate(z * T):
            P = np.block([[A - value * np.eye(len(A)), B[:, [i]]], [C[[o]], D[[o]][:, [i]]]])
            pencils.append((source, place, k, i, o, value, *_null_vectors(P)))
    if not pencils:
        return found
    sources, places, numbers, inputs, outputs, values, left, right = zip(*pencils)
    arrays = (np.array(x) for x in (values, left, right, inputs, outputs, T))
    J = np.asarray(_zero_jacobian(model, stacked_entries(model), *arrays))
    values = np.array(values)[:, None]
    along = (values.conj() * J).real / np.abs(values)
    for source, place, k, error in zip(sources, places, numbers, _deviation(along, covariance)):
        found[source, place][k] = error / (2 * np.pi * T)
    return found


def _null_vectors(P: Complex[np.ndarray, "n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Left and right null vectors of a singular matrix whose rows and columns may have any units."""
    row = 1 / np.maximum(np.max(np.abs(P), axis=1), 1e-300)
    column = 1 / np.maximum(np.max(np.abs(P) * row[:, None], axis=0), 1e-300)
    U, _, Vh = np.linalg.svd(P * row[:, None] * column)
    return U[:, -1] * row, Vh[-1].conj() * column


@stored
def _response_jacobian(model, entries, omega):
    def parts(theta):
        H = response(with_entries(model, theta), omega)
        return H.real, H.imag

    return jax.jacfwd(parts)(entries)


def frequency_response_band(model: MechanicalModel, omega, covariance, kind: str = "receptance") -> ResponseBand:
    """Standard errors of magnitude and phase of a frequency-response function, by the delta method.

    **Arguments:** `model`; `omega`: frequencies [rad/s]; `covariance`: of the upper triangles by columns of
    mass, then damping, then stiffness; `kind`: "receptance" (default), "mobility" or "accelerance".

    **Returns:** a `ResponseBand`.

    **Raises:** `ValueError` when an argument does not fit.
    """
    covariance = _check_covariance(model, covariance)
    H = frequency_response(model, omega, kind=kind)
    omega = check_omega(omega)
    real, imaginary = _response_jacobian(model, stacked_entries(model), omega)
    J = (np.asarray(real) + 1j * np.asarray(imaginary)) * rate_factor(model, omega, kind)[..., None]
    size = np.abs(H)
    # Along H is magnitude, across it is phase; where H vanishes any direction is along.
    turn = np.where(size > 0, H / np.where(size > 0, size, 1.0), 1.0)[..., None].conj()
    across = _deviation((turn * J).imag, covariance)
    phase = np.where(size > 0, across / np.where(size > 0, size, 1.0), np.inf)
    return ResponseBand(H, _deviation((turn * J).real, covariance), phase)


def _deviation(J: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", J, covariance, J), 0.0))


def _check_covariance(model: MechanicalModel, covariance) -> Float[np.ndarray, "entries entries"]:
    covariance = np.asarray(covariance, dtype=float)
    size = 3 * model.dofs * (model.dofs + 1) // 2
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise ValueError(
            f"covariance has shape {covariance.shape} or is not finite; give {size} × {size} over the upper "
            "triangles by columns of mass, then damping, then stiffness."
        )
    return covariance
