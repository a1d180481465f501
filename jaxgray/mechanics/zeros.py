"""Transmission zeros of a model, and the antiresonances of one input and output."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..numerics.runtime import ready
from .modal import check_mass, time_scale, undamped_modes
from .model import MechanicalModel

RANK_TOLERANCE = 1e-10
"""Singular value, relative to matrices of unit size, below which a direction is taken to be blocked."""

ORIGIN = 1e-6
"""Magnitude, relative to the fastest motion, below which a zero counts as one at the origin (a measured velocity
has one, an acceleration two), where rounding parts a double one."""


@dataclass(frozen=True, eq=False)
class Zeros:
    """Where an input leaves no trace in the outputs.

    `values` [rad/s]: the finite zeros, complex, by ascending magnitude; `names`: of the inputs and outputs.
    """

    values: Complex[np.ndarray, " zeros"]
    names: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def antiresonance_hz(self) -> Float[np.ndarray, " antiresonances"]:
        """|z|/2π [Hz] of the zeros that come as complex pairs, one per pair."""
        return np.abs(self._pairs) / (2 * np.pi)

    @property
    def damping_ratio(self) -> Float[np.ndarray, " antiresonances"]:
        """−Re z/|z| of each antiresonance; negative where the zero lies in the right half plane."""
        return -self._pairs.real / np.abs(self._pairs)

    @property
    def _pairs(self):
        return self.values[self.values.imag > 1e-9 * np.abs(self.values)]

    def __repr__(self) -> str:
        lines = [f"Zeros from {', '.join(self.names[0])} to {', '.join(self.names[1])}: {len(self.values)}"]
        pairs = iter(zip(self.antiresonance_hz, self.damping_ratio))
        for z in self.values:
            if z.imag > 1e-9 * abs(z):
                f, ratio = next(pairs)
                lines.append(f"  {z.real:.4g} ± {z.imag:.5g}j rad/s  antiresonance {f:.5g} Hz, ratio {ratio:.3g}")
            elif abs(z.imag) <= 1e-9 * abs(z):
                lines.append(f"  {z.real:.4g} rad/s")
        return "\n".join(lines)


def model_time_scale(model: MechanicalModel) -> float:
    """Time [s] in which the fastest motion of the model is of unit rate."""
    squared, V = undamped_modes(model.mass, model.stiffness)
    return float(time_scale(squared, V.T @ model.damping @ V))


def transmission_zeros(model: MechanicalModel) -> Zeros:
    """Invariant zeros of a model: where [A − zI, B; C, D] loses rank, with as many outputs as inputs or not.

    Collocated forces and displacements on every coordinate have none; measured velocities have one and
    accelerations two at the origin for every input.

    **Arguments:** `model`.

    **Returns:** `Zeros`.

    **Raises:** `ValueError` when the mass is not positive definite, or when some combination of inputs never
    shows, so that every number would be a zero.
    """
    return _zeros(model, np.arange(model.inputs), np.arange(model.dofs))


def zeros(model: MechanicalModel, *, input, output) -> Zeros:
    """Zeros of the transfer function from one input to one output, with its antiresonances in Hz.

    **Arguments:** `model`; `input`, `output`: name or position.

    **Returns:** `Zeros`.

    **Raises:** `ValueError` for an unknown name, when the mass is not positive definite, or when the input does
    not reach the output.
    """
    i = _position("input", input, model.input_names)
    o = _position("output", output, model.output_names)
    return _zeros(model, np.array([i]), np.array([o]))


def _position(argument: str, given, names: tuple[str, ...]) -> int:
    if given in names:
        return names.index(given)
    if isinstance(given, int | np.integer) and 0 <= given < len(names):
        return int(given)
    raise ValueError(f"{argument}={given!r} is not known; give one of {', '.join(names)} or its position from 0.")


def _zeros(model: MechanicalModel, inputs, outputs) -> Zeros:
    ready()
    check_mass(model)
    T = model_time_scale(model)
    lower = jnp.linalg.cholesky(model.mass)
    none = jnp.zeros_like(lower)
    system = model.state_space(T).transformed(jnp.block([[lower.T, none], [none, lower.T]]))
    A, B, C, D = (np.asarray(X) for X in (system.A, system.B[:, inputs], system.C[outputs], system.D[np.ix_(outputs, inputs)]))
    # Units of inputs and outputs must not decide what counts as blocked.
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
    its output through r integrations come in chains of r + 1 and are found at ε^(−1/(r+1)), among the finite.

    **Reference:** Emami-Naeini & Van Dooren (1982), *Computation of zeros of linear multivariable systems*.
    """
    A, B, C, D = _output_zeroing(A, B, C, D)
    A, C, B, D = (X.T for X in _output_zeroing(A.T, C.T, B.T, D.T))
    A, B, C, D = _output_zeroing(A, B, C, D)
    if B.shape[1] > D.shape[0]:
        raise ValueError(
            f"inputs {', '.join(names[0])} do not show separately in outputs {', '.join(names[1])}: every number "
            "would be a zero; choose fewer inputs, or an output that they reach."
        )
    return np.linalg.eigvals(A - B @ np.linalg.solve(D, C)) if len(A) else np.zeros(0, complex)
