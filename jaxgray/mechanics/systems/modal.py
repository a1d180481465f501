"""What a mechanical engineer reads off a model: modes and frequency-response functions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ...numerics.programs.runtime import ready
from ...numerics.programs.stored_programs import stored
from .abstract_model import AbstractMechanicalModel
from .drives import ORDER

KINDS = {"receptance": 0, "mobility": 1, "accelerance": 2}
"""Time derivatives between a frequency-response function of this kind and the receptance."""

RIGID = 1e-12
"""Squared natural frequency, relative to the largest, below which a mode counts as rigid-body motion."""


class Modes(eqx.Module):
    """The modes of a model, in ascending order of natural frequency.

    `natural_frequency_hz` [Hz]: undamped, 0 for rigid-body modes (and for those with negative stiffness);
    `damping_ratio`: a fraction, NaN where the natural frequency is 0; `mode_shapes` (dofs × modes): undamped,
    real, VᵀMV = I, largest entry positive; `poles` [rad/s]: damped, by ascending magnitude, both of each
    pair; `complex_mode_shapes` (dofs × poles): (s²M + sD + K)φ = 0, largest entry 1; `names` of the
    coordinates; `hidden`: those of them that no output measures.
    """

    natural_frequency_hz: Float[np.ndarray, " modes"]
    damping_ratio: Float[np.ndarray, " modes"]
    mode_shapes: Float[np.ndarray, "dofs modes"]
    poles: Complex[np.ndarray, " states"]
    complex_mode_shapes: Complex[np.ndarray, "dofs states"]
    names: tuple[str, ...] = eqx.field(static=True)
    hidden: tuple[str, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        names = (f"({name})" if name in self.hidden else name for name in self.names)
        rows = [("mode", "frequency [Hz]", "damping ratio", *names)]
        for k, (f, z) in enumerate(zip(self.natural_frequency_hz, self.damping_ratio)):
            shape = self.mode_shapes[:, k] / np.max(np.abs(self.mode_shapes[:, k]))
            rows.append((str(k + 1), f"{f:.6g}", f"{z:.4g}", *(f"{entry:+.3f}" for entry in shape)))
        width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(text.rjust(w) for text, w in zip(row, width)) for row in rows]
        poles = ", ".join(f"{s.real:.4g}" + (f" ± {s.imag:.5g}j" if s.imag else "") for s in self.poles if s.imag >= 0)
        marked = "; in brackets: not measured" if self.hidden else ""
        return "\n".join([f"Modes (shapes scaled to largest entry 1{marked})", *lines, f"poles [rad/s]: {poles}"])


@jax.custom_jvp
def undamped_modes(
    mass: Float[Array, "dofs dofs"], stiffness: Float[Array, "dofs dofs"]
) -> tuple[Float[Array, " modes"], Float[Array, "dofs modes"]]:
    """Squared natural frequencies and mass-normalised mode shapes of K v = ω² M v.

    By the Cholesky factor of M, so that real shapes come out orthogonal also at repeated frequencies.

    The derivative of the shapes leaves out the part that would turn them within one repeated frequency, so
    that it is finite there too; everything that does not depend on the choice of shapes is right.

    **Arguments:** `mass` (M), symmetric positive definite; `stiffness` (K), symmetric.

    **Returns:** ω² [rad²/s²] in ascending order, and V with VᵀMV = I, the largest entry of a shape positive.
    """
    lower = jnp.linalg.cholesky(mass)
    half = jax.scipy.linalg.solve_triangular(lower, (stiffness + stiffness.T) / 2, lower=True)
    normalised = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    squared, U = jnp.linalg.eigh((normalised + normalised.T) / 2)
    V = jax.scipy.linalg.solve_triangular(lower, U, lower=True, trans=1)
    largest = jnp.take_along_axis(V, jnp.argmax(jnp.abs(V), axis=0)[None], axis=0)
    return squared, V * jnp.where(largest < 0, -1.0, 1.0)


@undamped_modes.defjvp
def _undamped_modes_jvp(primals, tangents):
    squared, V = undamped_modes(*primals)
    dM, dK = tangents
    from_mass = V.T @ (dM + dM.T) @ V / 2
    from_stiffness = V.T @ (dK + dK.T) @ V / 2
    gap = squared[None, :] - squared[:, None]
    apart = jnp.abs(gap) > 1e-10 * jnp.max(jnp.abs(squared))
    within = (from_stiffness - squared[None, :] * from_mass) / jnp.where(apart, gap, 1.0)
    change = jnp.where(apart, within, -from_mass / 2)
    return (squared, V), (jnp.diag(from_stiffness) - squared * jnp.diag(from_mass), V @ change)


def time_scale(squared: Float[Array, " modes"], modal_damping: Float[Array, "modes modes"]) -> Float[Array, ""]:
    """Time [s] in which the fastest motion is of unit rate, from ω² and VᵀDV; 1 where nothing moves."""
    rate = jnp.maximum(jnp.sqrt(jnp.max(jnp.abs(squared))), jnp.max(jnp.abs(modal_damping)))
    return 1.0 / jnp.where(rate > 0, rate, 1.0)


def damped_poles(
    mass: Float[Array, "dofs dofs"], damping: Float[Array, "dofs dofs"], stiffness: Float[Array, "dofs dofs"]
) -> tuple[Complex[Array, " states"], Complex[Array, "dofs states"]]:
    """Poles s and complex mode shapes of (s²M + sD + K)φ = 0, in no particular order.

    The derivative of the poles is that of simple ones, −φᵀ(s²dM + s dD + dK)φ / φᵀ(2sM + D)φ, and zero where
    the denominator vanishes (a double pole has none); the shapes are taken as constant.

    **Arguments:** `mass`, `damping`, `stiffness`: symmetric.

    **Returns:** s [rad/s], and φ, one column a pole.
    """
    stop = jax.lax.stop_gradient
    squared, V = undamped_modes(stop(mass), stop(stiffness))
    modal_damping = V.T @ stop(damping) @ V
    T = time_scale(squared, modal_damping)
    squared = jnp.where(jnp.abs(squared) > RIGID * jnp.max(jnp.abs(squared)), squared, 0.0)
    n = V.shape[0]
    A = jnp.block([[jnp.zeros((n, n)), jnp.eye(n)], [-jnp.diag(squared) * T**2, -modal_damping * T]])
    s, X = jax.lax.stop_gradient(jnp.linalg.eig(A))
    s, phi = s / T, V @ X[:n]

    def form(S):
        return jnp.einsum("ik,ij,jk->k", phi, S, phi)

    balance = s**2 * form(mass) + s * form(damping) + form(stiffness)
    slope = stop(2 * s * form(mass) + form(damping))
    weight = stop(jnp.einsum("ik,ij,jk->k", phi.conj(), mass, phi).real)
    simple = jnp.abs(slope) * T > 1e-9 * weight
    return s - jnp.where(simple, (balance - stop(balance)) / jnp.where(simple, slope, 1.0), 0.0), phi


def natural_frequencies_hz_and_damping(
    mass: Float[Array, "dofs dofs"], damping: Float[Array, "dofs dofs"], stiffness: Float[Array, "dofs dofs"]
) -> tuple[Float[Array, " modes"], Float[Array, " modes"]]:
    """Undamped natural frequencies, and damping ratios ζ = −Re s/|s| of the poles that belong to them.

    Each pole goes with the mode of which its complex shape holds most, the clearest first. A mode for which
    no oscillating pole is left (overdamped) has ζ = vᵀDv/2ω. Traceable and differentiable where poles are
    simple.

    **Arguments:** `mass`, `damping`, `stiffness`: symmetric, mass positive definite.

    **Returns:** natural frequencies [Hz], 0 for rigid-body modes, and damping ratios, NaN there.
    """
    squared, V = undamped_modes(mass, stiffness)
    s, phi = damped_poles(mass, damping, stiffness)
    n = V.shape[0]
    upper = jnp.argsort(-s.imag)[:n]
    s = s[upper]
    oscillates = s.imag > 1e-9 * jnp.abs(s)
    parts = jnp.abs(V.T @ mass @ phi[:, upper]).T ** 2
    share = jnp.where(oscillates[:, None], parts / jnp.sum(parts, axis=1, keepdims=True), -1.0)
    share = jax.lax.stop_gradient(share)
    pole_of = jnp.full(n, -1)
    for _ in range(n):
        pole, mode = jnp.divmod(jnp.argmax(share), n)
        pole_of = pole_of.at[mode].set(jnp.where(share[pole, mode] >= 0, pole, pole_of[mode]))
        share = share.at[pole, :].set(-1.0).at[:, mode].set(-1.0)
    moving = squared > RIGID * jnp.max(jnp.abs(squared))
    omega = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)
    size = jnp.where(oscillates, jnp.sqrt(jnp.where(oscillates, s.real**2 + s.imag**2, 1.0)), 1.0)
    modal = jnp.diag(V.T @ damping @ V) / (2 * jnp.where(moving, omega, 1.0))
    ratio = jnp.where(pole_of >= 0, (0.0 - s.real / size)[pole_of], modal)
    return omega / (2 * jnp.pi), jnp.where(moving, ratio, jnp.nan)


@stored
def _modes(mass, damping, stiffness):
    f, ratio = natural_frequencies_hz_and_damping(mass, damping, stiffness)
    return f, ratio, undamped_modes(mass, stiffness)[1], *damped_poles(mass, damping, stiffness)


def modes(model: AbstractMechanicalModel) -> Modes:
    """Natural frequencies, damping ratios, mode shapes and poles of a model's mass, damping and stiffness.

    **Arguments:** `model`.

    **Returns:** `Modes`.

    **Raises:** `ValueError` when the mass is not positive definite.
    """
    ready()
    check_mass(model)
    f, ratio, V, s, phi = (np.asarray(part) for part in _modes(model.mass, model.damping, model.stiffness))
    # Magnitudes of a pair may differ in the last digit, which must not part it.
    magnitude = np.round(np.log(np.maximum(np.abs(s), 1e-300)), 9)
    order = np.lexsort((-s.imag, np.abs(s.imag) == 0, magnitude))
    s, phi = s[order], phi[:, order]
    phi = phi / phi[np.argmax(np.abs(phi), axis=0), np.arange(len(s))]
    return Modes(f, ratio, V, s, phi, model.coordinates, model.hidden)


def check_mass(model: AbstractMechanicalModel) -> None:
    """Raise `ValueError` where the mass is not positive definite."""
    values = np.linalg.eigvalsh(np.asarray(model.mass))
    if not values[0] > 0:
        raise ValueError(
            f"mass has the eigenvalue {values[0]:.3g}; give a positive definite matrix, since there is "
            "inertia in every direction."
        )


def mac(shapes_a, shapes_b) -> Float[np.ndarray, "modes_a modes_b"]:
    """Modal assurance criterion |aᴴb|² / (aᴴa · bᴴb): 1 where two shapes are alike, whatever their scale.

    **Arguments:** `shapes_a`, `shapes_b`: one shape a column, real or complex, over the same coordinates;
    those should be of one unit.

    **Returns:** one row for each shape of `shapes_a`, one column for each of `shapes_b`.

    **Raises:** `ValueError` when the numbers of coordinates differ.
    """
    a, b = (np.asarray(X).reshape(np.shape(X)[0], -1) for X in (shapes_a, shapes_b))
    if a.shape[0] != b.shape[0]:
        raise ValueError(f"shapes_a has {a.shape[0]} rows, shapes_b has {b.shape[0]}; give the same coordinates.")
    size = np.sum(np.abs(a) ** 2, axis=0)[:, None] * np.sum(np.abs(b) ** 2, axis=0)[None, :]
    return np.abs(a.conj().T @ b) ** 2 / np.where(size > 0, size, 1.0)


def check_kind(kind: str) -> str:
    """The kind itself, or a `ValueError` that names the choices."""
    if kind not in KINDS:
        raise ValueError(f"kind={kind!r} is not known; choose one of {', '.join(KINDS)}.")
    return kind


def known_rate(model: AbstractMechanicalModel) -> str:
    """What is known of the coordinates from the input alone, "displacement" or "acceleration".

    With the base acceleration as input their absolute motion is only known as acceleration.
    """
    try:
        model.drive.check(model.dofs, ("displacement",) * model.outputs)
    except ValueError:
        return "acceleration"
    return "displacement"


def response(
    model: AbstractMechanicalModel, omega: Float[Array, " frequencies"]
) -> Complex[Array, "frequencies outputs inputs"]:
    """Frequency-response function of the `known_rate` of the measured coordinates, whatever is measured; traceable."""
    squared, V = undamped_modes(model.mass, model.stiffness)
    T = jax.lax.stop_gradient(time_scale(squared, V.T @ model.damping @ V))
    rates = (known_rate(model),) * model.outputs
    return model.drive.state_space(model.mass, model.damping, model.stiffness, rates, T).transfer(omega * T)


_response = stored(response)


def rate_factor(model: AbstractMechanicalModel, omega, kind: str) -> Complex[np.ndarray, "frequencies 1 1"]:
    """(jω)^k, which leads from `response` to the kind asked for."""
    return (1j * np.asarray(omega)[:, None, None]) ** (KINDS[check_kind(kind)] - ORDER[known_rate(model)])


def check_omega(omega) -> Float[Array, " frequencies"]:
    """Frequencies as an array, or a `ValueError`."""
    given = np.atleast_1d(np.asarray(omega, dtype=float))
    if given.ndim != 1 or not np.isfinite(given).all():
        raise ValueError(f"omega has shape {given.shape} or is not finite; give frequencies in rad/s, one dimension.")
    return jnp.asarray(given)


def frequency_response(
    model: AbstractMechanicalModel, omega, *, kind: str = "receptance"
) -> Complex[np.ndarray, "frequencies outputs inputs"]:
    """Frequency-response function of the measured coordinates, for forces (K + jωD − ω²M)⁻¹E (jω)^k.

    With a base displacement or acceleration as input it is the motion (absolute or relative, as measured) per
    unit of that input.

    **Arguments:** `model`; `omega`: frequencies [rad/s]; `kind`: "receptance" (displacement, k = 0, default),
    "mobility" (velocity, k = 1) or "accelerance" (acceleration, k = 2) per unit input.

    **Returns:** complex, frequencies × outputs × inputs, in the coordinates' units; not finite at a pole on
    the imaginary axis.

    **Raises:** `ValueError` for another kind or bad frequencies.
    """
    ready()
    omega = check_omega(omega)
    return np.asarray(_response(model, omega)) * rate_factor(model, omega, kind)
