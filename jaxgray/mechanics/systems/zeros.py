"""Transmission zeros of a model, and the antiresonances of one input and output."""

import contextlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from ...numerics.programs.runtime import ready
from ...numerics.programs.stored_programs import stored
from .abstract_model import AbstractMechanicalModel
from .modal import check_mass, time_scale, undamped_modes

RANK_TOLERANCE = 1e-10
"""Singular value, relative to matrices of unit size, below which a direction is taken to be blocked."""

ORIGIN = 1e-6
"""Magnitude, relative to the fastest motion, below which a zero counts as one at the origin (a measured
velocity has one, an acceleration two), where rounding parts a double one."""


@dataclass(frozen=True, eq=False)
class Zeros:
    """Where an input leaves no trace in the outputs.

    `values` [rad/s]: the finite zeros, complex, by ascending magnitude; `names`: of the inputs and outputs.
    """

    values: Complex[np.ndarray, " zeros"]
    names: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def antiresonance_hz(self) -> Float[np.ndarray, " antiresonances"]:
        """|z|/2π [Hz] of the pairs of zeros that make a dip in the frequency response, one per pair."""
        return np.abs(self.antiresonances) / (2 * np.pi)

    @property
    def damping_ratio(self) -> Float[np.ndarray, " antiresonances"]:
        """−Re z/|z| of each antiresonance; negative where the zero lies in the right half plane."""
        return -self.antiresonances.real / np.abs(self.antiresonances)

    @property
    def antiresonances(self) -> Complex[np.ndarray, " antiresonances"]:
        """The upper zero [rad/s] of each pair that makes a dip: |jω − z||jω − z̄| has a minimum over ω > 0
        only when |Re z| < |Im z|; others are pairs of real zeros, or what rounding makes of them."""
        return self.values[self.values.imag > np.abs(self.values.real)]

    def __repr__(self) -> str:
        lines = [f"Zeros from {', '.join(self.names[0])} to {', '.join(self.names[1])}: {len(self.values)}"]
        pairs = iter(zip(self.antiresonance_hz, self.damping_ratio))
        for z in self.values:
            if z.imag < 0:
                continue
            line = f"  {z.real:.4g} ± {z.imag:.5g}j rad/s" if z.imag else f"  {z.real:.4g} rad/s"
            if z.imag > abs(z.real):
                f, ratio = next(pairs)
                line += f"  antiresonance {f:.5g} Hz, damping ratio {ratio:.3g}"
            lines.append(line)
        return "\n".join(lines)


@stored
def _first_order(model):
    squared, V = undamped_modes(model.mass, model.stiffness)
    T = time_scale(squared, V.T @ model.damping @ V)
    system = model.state_space(T)
    return T, system.A, system.B, system.C, system.D


def first_order(model: AbstractMechanicalModel) -> tuple[np.ndarray, ...]:
    """T [s], in which the fastest motion is of unit rate, and A, B, C, D with time counted in it."""
    return tuple(np.asarray(part) for part in _first_order(model))


def transmission_zeros(model: AbstractMechanicalModel) -> Zeros:
    """Invariant zeros of a model: where [A − zI, B; C, D] loses rank, with as many outputs as inputs or not.

    Collocated forces and displacements on every coordinate have none; measured velocities have one and
    accelerations two at the origin for every input.

    **Arguments:** `model`.

    **Returns:** `Zeros`.

    **Raises:** `ValueError` when the mass is not positive definite, or when inputs do not show separately.
    """
    return _zeros(model, _in_natural_units(model), np.arange(model.inputs), np.arange(model.outputs))


def zeros(model: AbstractMechanicalModel, *, input, output) -> Zeros:
    """Zeros from one input to one output, with the antiresonances in Hz.

    Poles of modes that the input does not reach or the output does not see are among them.

    **Arguments:** `model`; `input`, `output`: name or position.

    **Returns:** `Zeros`.

    **Raises:** `ValueError` for an unknown name, when the mass is not positive definite, or when the input
    does not reach the output.
    """
    i = _position("input", input, model.input_names)
    o = _position("output", output, model.output_names)
    return _zeros(model, _in_natural_units(model), np.array([i]), np.array([o]))


def zeros_of_pairs(model: AbstractMechanicalModel) -> dict[tuple[str, str], Zeros]:
    """Zeros from every input to every output, by their names; those that the input does not reach are left out.

    **Raises:** `ValueError` when the mass is not positive definite.
    """
    system, found = _in_natural_units(model), {}
    for i, source in enumerate(model.input_names):
        for o, place in enumerate(model.output_names):
            with contextlib.suppress(ValueError):
                found[source, place] = _zeros(model, system, np.array([i]), np.array([o]))
    return found


def _position(argument: str, given, names: tuple[str, ...]) -> int:
    if given in names:
        return names.index(given)
    if isinstance(given, int | np.integer) and 0 <= given < len(names):
        return int(given)
    raise ValueError(f"{argument}={given!r} is not known; give one of {', '.join(names)} or its position from 0.")


def _in_natural_units(model: AbstractMechanicalModel) -> tuple[np.ndarray, ...]:
    """`first_order`, its states scaled by the mass: units of coordinates must not decide what counts as blocked.

    **Raises:** `ValueError` when the mass is not positive definite.
    """
    ready()
    check_mass(model)
    T, A, B, C, D = first_order(model)
    W = np.kron(np.eye(2), np.linalg.cholesky(np.asarray(model.mass)).T)
    return T, np.linalg.solve(W.T, (W @ A).T).T, W @ B, np.linalg.solve(W.T, C.T).T, D


def _zeros(model: AbstractMechanicalModel, system, inputs, outputs) -> Zeros:
    """**Raises:** `ValueError` where the inputs do not show separately in the outputs."""
    T, A, B, C, D = system
    B, C, D = B[:, inputs], C[outputs], D[np.ix_(outputs, inputs)]
    # Nor those of inputs and outputs.
    row = np.linalg.norm(np.hstack([C, D]), axis=1)
    C, D = C / np.where(row > 0, row, 1.0)[:, None], D / np.where(row > 0, row, 1.0)[:, None]
    column = np.linalg.norm(np.vstack([B, D]), axis=0)
    B, D = B / np.where(column > 0, column, 1.0), D / np.where(column > 0, column, 1.0)
    names = tuple(model.input_names[k] for k in inputs), tuple(model.output_names[k] for k in outputs)
    z = _invariant_zeros(A, B, C, D, names)
    z = np.where(np.abs(z) < ORIGIN, 0.0, z) / T
    return Zeros(z[np.lexsort((-z.imag, np.round(np.log(np.maximum(np.abs(z), 1e-300)), 9)))], names)


def _invariant_zeros(A, B, C, D, names) -> Complex[np.ndarray, " zeros"]:
    """Finite zeros, by taking out of the pencil what lies at infinity before its eigenvalues are computed.

    The generalised eigenvalues of the whole pencil will not do: the infinite ones of an input that reaches
    its output through r integrations come in a chain of r + 1, which rounding can break up and bring down
    among the finite.

    **Reference:** Emami-Naeini & Van Dooren (1982), *Computation of zeros of linear multivariable systems*.
    """
    least = min(B.shape[1], C.shape[0])
    A, B, C, D = _output_zeroing(A, B, C, D)
    A, C, B, D = (X.T for X in _output_zeroing(A.T, C.T, B.T, D.T))
    if len(D) < least:
        raise ValueError(
            f"inputs {', '.join(names[0])} do not show separately in outputs {', '.join(names[1])}, so that "
            "every number would be a zero; choose fewer inputs, or outputs that they reach."
        )
    return np.linalg.eigvals(A - B @ np.linalg.solve(D, C)).astype(complex)


def _output_zeroing(A, B, C, D):
    """The motion that leaves no trace: states which the outputs see at once are taken out, with what keeps
    them at zero as new outputs, until no output is free of the inputs (D has full row rank)."""
    while len(D):
        U, s, _ = np.linalg.svd(D)
        rank = np.sum(s > RANK_TOLERANCE)
        if rank == len(D):
            break
        seen, C, D = U[:, rank:].T @ C, U[:, :rank].T @ C, U[:, :rank].T @ D
        _, s, Vt = np.linalg.svd(seen)
        blocked = np.sum(s > RANK_TOLERANCE)
        if not blocked:
            break
        gone, kept = Vt[:blocked], Vt[blocked:].T
        C, D = np.vstack([C @ kept, gone @ A @ kept]), np.vstack([D, gone @ B])
        A, B = kept.T @ A @ kept, kept.T @ B
    return A, B, C, D
