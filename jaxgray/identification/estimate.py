"""Record to mass, damping and stiffness as one pure function, for programs that differentiate through it.

`identify` is the way for a person: it searches, refines, warns and judges, on the host. `estimate` is the subspace
start alone, for given τ and block rows, with the semidefinite problems solved by their traceable twin; nothing in it
leaves the device or depends on values, so that it may stand under `jit`, `vmap`, `grad`, `jacfwd` and `jacrev`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.systems.drives import ORDER, AbstractDrive, Force
from ..mechanics.systems.statespace import check_hold
from ..numerics.matrices.positive import ProjectedGradientSolver
from ..numerics.programs.runtime import ready
from ..numerics.programs.stored_programs import stored
from ..numerics.responses.lifting import respond_many
from .hidden import canonical_structure, fitted_input, input_basis, realized_order, traced_canonical
from .refinement.refine_traced import gauss_newton
from .setup.options import pick
from .setup.prediction import Batch, Setting
from .setup.preparation import Signals
from .setup.units import Scaling
from .subspace.compression import factor_of_gram, factor_of_rows
from .subspace.filter_bank import cascade, pole
from .subspace.input_matrix import fit_to_factor, fit_to_record, unit_drives
from .subspace.physical import from_inverse_mass, input_matrix, jointly
from .subspace.projection import WEIGHTS, AbstractWeight, arrange, project
from .subspace.realization import MAPS, AbstractMap, realize


class Estimate(eqx.Module):
    """Mass, damping and stiffness in the record's units, and the singular values that the order was taken from.

    Not a number where the data, τ or the weights give no model.
    """

    mass: Float[Array, "dofs dofs"]
    damping: Float[Array, "dofs dofs"]
    stiffness: Float[Array, "dofs dofs"]
    singular_values: Float[Array, " values"]


class Options(eqx.Module):
    """What is static in `estimate`."""

    measured: tuple[str, ...] = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    block_rows: int = eqx.field(static=True)
    map: AbstractMap
    input_matrix_from: str = eqx.field(static=True)
    reaches_all: bool = eqx.field(static=True)
    exact_data: bool = eqx.field(static=True)
    refinement_steps: int = eqx.field(static=True)
    hidden: int = eqx.field(static=True, default=0)


def estimate(
    u,
    y,
    sampling_time,
    time_constant,
    *,
    block_rows: int = 6,
    weight="moesp",
    sample_weights=None,
    map="exact",
    input_matrix_from: str = "factor",
    input_map=None,
    drive: AbstractDrive | None = None,
    measured="displacement",
    hold: str = "zero",
    exact_data: bool = False,
    refinement_steps: int = 0,
    hidden: int = 0,
) -> Estimate:
    """Mass, damping and stiffness of M q̈ + D q̇ + K q = E u as a pure function of arrays.

    Filtered by λ-filters, compressed to one triangular factor, projected, realised, then M ≻ 0, D ⪰ 0, K ⪰ 0 by
    semidefinite least squares differentiated at their fixed point. Derivatives are those of subspaces and of least
    squares, never of singular vectors: they stay correct where singular values coincide and where a matrix is on the
    boundary of its cone.

    **Arguments:**

    - `u`, `y`: inputs and outputs (samples × channels), finite, one coordinate per output; differentiable.
    - `sampling_time` [s].
    - `time_constant` (τ) [s], differentiable.
    - `block_rows` (i): default 6.
    - `weight`: "moesp" (default), "n4sid", "cva", "past-inputs", or a weight object such as
        `RowWeights(array)`, differentiable by its arrays.
    - `sample_weights`: weight of every sample (samples), default ones; differentiable. Zero leaves a sample out of the
        least squares, not out of the filters.
    - `map`: "exact" (default) or "paper", from the λ-operator to continuous time.
    - `input_matrix_from`: "factor" (default), or "record", by regression on simulated responses over another pass.
    - `input_map` (E, outputs × inputs): default input j on the coordinate of output j.
    - `drive`: in place of `input_map`, such as `BaseAcceleration(direction)`; the mass then has trace `dofs`.
    - `measured`: "displacement" (default), "velocity" or "acceleration", one for all outputs or one per output.
    - `hold`: "zero" (default) or "linear".
    - `exact_data`: the record has hardly any noise, so that its filtered rows are dependent: orthonormalise by
        Householder QR. Default False.
    - `refinement_steps`: how many Gauss-Newton steps on the free run follow, over the same cones; default 0. Two
        or three reach the maximum likelihood of white output noise.
    - `hidden`: how many coordinates no output measures, default 0. The matrices are then those of the canonical form
        (every hidden coordinate a unit mass of its own), for forces on every measured coordinate, oscillating hidden
        modes and more block rows than 2 (outputs + hidden)/outputs.

    **Returns:** an `Estimate`.

    **Raises:** `ValueError` for shapes or options that cannot serve.

    **Reference:** Olofsson et al., steps 1 to 6 and equations (22) to (24); Blondel et al., *Efficient and modular
    implicit differentiation*.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.estimate(record.u, record.y, 0.01, 0.05, refinement_steps=3)
        >>> round(float(found.mass[0, 0]), 1), round(float(found.stiffness[0, 0]))
        (2.0, 80)
    """
    ready()
    u, y = _channels("u", u), _channels("y", y)
    if len(u) != len(y):
        raise ValueError(f"u has {len(u)} samples, y has {len(y)}; give as many of both.")
    outputs, inputs = y.shape[1], u.shape[1]
    measured = (measured,) * outputs if isinstance(measured, str) else tuple(measured)
    if len(measured) != outputs or any(kind not in ORDER for kind in measured):
        raise ValueError(
            f"measured={measured} does not say displacement, velocity or acceleration for each of {outputs} outputs."
        )
    if not isinstance(block_rows, int | np.integer) or block_rows < 3:
        raise ValueError(f"block_rows={block_rows} must be a whole number of at least 3.")
    if len(u) <= 2 * block_rows * (inputs + outputs + 1):
        raise ValueError(
            f"u has {len(u)} samples, {block_rows} block rows need more than "
            f"{2 * block_rows * (inputs + outputs + 1)}; give a longer record or fewer block rows."
        )
    if input_matrix_from not in ("factor", "record"):
        raise ValueError(f"input_matrix_from={input_matrix_from!r} is not known; choose 'factor' or 'record'.")
    if drive is None:
        drive = Force(jnp.eye(outputs, inputs) if input_map is None else jnp.asarray(input_map))
    elif input_map is not None:
        raise ValueError("input_map and drive are both given; give the input map to the drive.")
    hidden = int(hidden)
    if hidden:
        drive = with_hidden(drive, outputs, hidden, int(block_rows))
    drive.check(outputs + hidden, measured)
    if drive.inputs != inputs:
        raise ValueError(f"u has {inputs} channels, the input map {drive.inputs}; give one column per input.")
    weights = jnp.ones(len(u)) if sample_weights is None else jnp.asarray(sample_weights)
    if weights.shape != (len(u),):
        raise ValueError(f"sample_weights has shape {weights.shape}; give one weight for each of {len(u)} samples.")
    weight = pick("weight", weight, WEIGHTS)
    if isinstance(weight, RowWeights) and weight.rows.shape != (block_rows, outputs):
        raise ValueError(f"weight has shape {weight.rows.shape}; give {block_rows} block rows × {outputs} outputs.")
    options = Options(
        measured,
        check_hold(hold),
        int(block_rows),
        pick("map", map, MAPS),
        input_matrix_from,
        isinstance(drive, Force) and _full_rank(drive.input_map[:outputs]),
        bool(exact_data),
        int(refinement_steps),
        hidden,
    )
    if hidden and not options.reaches_all:
        raise ValueError(f"hidden={hidden} needs a force on every measured coordinate; give more inputs, or identify.")
    return _estimate(u, y, weights, jnp.asarray(sampling_time), jnp.asarray(time_constant), weight, drive, options)


@stored
def _estimate(u, y, weights, sampling_time, time_constant, weight, drive, options: Options) -> Estimate:
    y = y - jnp.mean(y, axis=0)
    scaling = Scaling.of(jnp.std(u, axis=0), jnp.std(y, axis=0), sampling_time, options.measured)
    u, y = u / scaling.inputs, y / scaling.outputs
    a = pole(time_constant, sampling_time)
    signals = jnp.concatenate([u, y], axis=1)
    factor = weighted_factor(a, signals, weights, u.shape[1], options.block_rows, householder=options.exact_data)
    if options.hidden:
        return canonical_estimate(factor, a, scaling, weight, drive, options, (u, y, weights))
    pass_again = (u, y, weights) if options.input_matrix_from == "record" else None
    found = from_factor(factor, a, scaling, weight, drive, options, pass_again)
    if not options.refinement_steps:
        return found
    setting = Setting(scaled_drive(drive, scaling), options.measured, options.hold)
    batch = Batch(u[None], y[None], jnp.broadcast_to(weights[:, None], y.shape)[None])
    scaled = scaling.matrices_in(found.mass, found.damping, found.stiffness)
    refined = gauss_newton(scaled, batch, setting, options.refinement_steps)
    return Estimate(*scaling.matrices_out(*refined), found.singular_values)


def weighted_factor(
    a: Float[Array, ""],
    signals: Float[Array, "samples signals"],
    weights: Float[Array, " samples"],
    inputs: int,
    block_rows: int,
    *,
    householder: bool,
) -> Float[Array, "columns columns"]:
    """The compressed factor of `compression`, every row (sample) of the filtered record times a weight.

    **Arguments:** `a`: filter pole; `signals`: scaled u and y; `weights` of the samples; `inputs`: how many
    signals are inputs; `block_rows`; `householder`: as in `compression`.

    **Returns:** the factor after initial state and offset are projected out.
    """
    samples, channels = signals.shape
    A, b = cascade(a, 2 * block_rows - 1)
    orders = len(b)
    # One sample earlier: there an impulse stands for the state of the filters at the first sample.
    driven = jnp.concatenate([jnp.pad(signals, ((1, 0), (0, 0))), jnp.eye(samples + 1, 1)], axis=1)
    filtered = respond_many(A, b[:, None], jnp.eye(orders), jnp.zeros((orders, 1)), driven.T[:, :, None])[:, 1:]
    filtered = filtered.transpose(1, 2, 0)
    ahead = [filtered[:, :, channels], jnp.ones((samples, 1)), signals]
    rows = jnp.concatenate([*ahead, filtered[:, :, :channels].reshape(samples, -1)], axis=1) * weights[:, None]
    if householder:
        return factor_of_rows(jnp.linalg.qr(rows, mode="r"), inputs, block_rows)[0]
    return factor_of_gram(rows.T @ rows, inputs, block_rows)[0]


def scaled_drive(drive: AbstractDrive, scaling: Scaling) -> AbstractDrive:
    """The drive in scaled coordinates."""
    return drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time)


@stored
def from_factor(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    scaling: Scaling,
    weight: AbstractWeight,
    drive: AbstractDrive,
    options: Options,
    record: tuple[Array, Array, Array] | None = None,
) -> Estimate:
    """Mass, damping and stiffness from the compressed factor alone: one program without a call back to the host.

    **Arguments:** `factor` (`weighted_factor`) of signals in units of `scaling`; `a`: filter pole; `weight`;
    `drive`; `options`; `record`: scaled u and y and the weights of their samples, where the input matrix is to be
    found from them.

    **Returns:** an `Estimate`.
    """
    inputs, outputs = drive.inputs, len(options.measured)
    data = arrange(factor, a, options.block_rows, inputs, options.block_rows)
    projections = project(data, weight, 2 * outputs, householder=options.exact_data)
    realization = realize(projections, a, options.measured, options.map)
    if record is None:
        fit = fit_to_factor(unit_drives(realization, options.measured, options.hold), data)
    else:
        u, y, weights = record
        kept = jnp.broadcast_to(weights[:, None], y.shape)
        fit = fit_to_record(realization, u, y, kept, measured=options.measured, hold=options.hold)
    drive, solver = scaled_drive(drive, scaling), ProjectedGradientSolver()
    if options.reaches_all:
        matrices = from_inverse_mass(realization, fit, drive.input_map, solver)
    elif isinstance(drive, Force):
        B2 = input_matrix(fit).reshape(drive.input_map.shape)
        matrices = jointly(realization, (B2, drive.input_map), solver)[0]
    else:
        matrices = jointly(realization, None, solver)[0]
    M, D, K = scaling.matrices_out(*matrices)
    if not isinstance(drive, Force):
        share = outputs / jnp.trace(M)
        M, D, K = M * share, D * share, K * share
    return Estimate(M, D, K, projections.singular_values)


def with_hidden(drive: AbstractDrive, outputs: int, hidden: int, block_rows: int) -> AbstractDrive:
    """The drive with no force on hidden coordinates.

    **Raises:** `ValueError` where the number, the drive or the block rows cannot serve.
    """
    if hidden < 0:
        raise ValueError(f"hidden={hidden} is not understood; give how many coordinates no output measures.")
    if not isinstance(drive, Force) or drive.input_map.shape[0] != outputs:
        raise ValueError(f"hidden={hidden} needs forces on the {outputs} measured coordinates alone; identify others.")
    if (block_rows - 1) * outputs < 2 * (outputs + hidden):
        raise ValueError(
            f"block_rows={block_rows} are too few for {2 * (outputs + hidden)} states; give at least "
            f"{-(-2 * (outputs + hidden) // outputs) + 1}."
        )
    return Force(jnp.concatenate([drive.input_map, jnp.zeros((hidden, drive.inputs))]))


def canonical_estimate(
    factor: Float[Array, "columns columns"],
    a: Float[Array, ""],
    scaling: Scaling,
    weight: AbstractWeight,
    drive: AbstractDrive,
    options: Options,
    record: tuple[Array, Array, Array],
) -> Estimate:
    """The canonical form from the compressed factor and the record, in traced code.

    **Arguments:** as of `from_factor`; `record`: scaled u and y, and the weights of their samples.

    **Returns:** an `Estimate`.
    """
    u, y, weights = record
    n, p = options.hidden, len(options.measured)
    A, Cy, values = realized_order(
        factor,
        a,
        options.block_rows,
        inputs=drive.inputs,
        padded=options.block_rows,
        weight=weight,
        order=2 * (p + n),
        map=options.map,
        householder=options.exact_data,
    )
    basis = input_basis(A, Cy, options.measured, drive)
    signals = Signals(u, y, jnp.broadcast_to(weights[:, None], y.shape), len(u))
    B, _ = fitted_input(A, basis, signals, None, options.hold)
    E = scaling.coordinates[:, None] * drive.input_map[:p] * scaling.inputs
    M, D, K = traced_canonical(A, B @ jnp.linalg.pinv(E), basis[2], n).matrices
    # A unit mass counted as the measured ones are.
    size = jnp.sqrt(jnp.trace(M[:p, :p]) / p)
    units = jnp.concatenate([jnp.ones(p), jnp.ones(n) * size])
    M, D, K = (X * units[:, None] * units[None, :] for X in (M, D, K))
    own = jnp.concatenate([scaling.coordinates, jnp.ones(n) * size * scaling.sampling_time])
    scaling = eqx.tree_at(lambda s: s.coordinates, scaling, own)
    # What the form is counted from is no part of it.
    form = canonical_structure(*(jax.lax.stop_gradient(X) for X in (M, D, K)), n, unit=M[-1, -1])
    found = form.matrices(form.blocks(M, D, K, lift=0.0), p + n)
    if options.refinement_steps:
        setting = Setting(scaled_drive(drive, scaling), options.measured, options.hold, n)
        batch = Batch(u[None], y[None], signals.kept[None])
        found = gauss_newton(found, batch, setting, options.refinement_steps, form)
    return Estimate(*scaling.matrices_out(*found), values)


class RowWeights(AbstractWeight):
    """W1 = diag(rows) in the Laguerre family: a weight for every filtered output, to be learned.

    **Arguments:** `rows` (block rows × outputs); ones are MOESP. Only their ratios matter.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> weight = jaxgray.RowWeights(np.linspace(1.0, 0.5, 6)[:, None])
        >>> found = jaxgray.estimate(record.u, record.y, 0.01, 0.05, weight=weight)
        >>> round(float(found.mass[0, 0]), 1)
        2.0
    """

    rows: Float[Array, "block_rows outputs"]

    def apply(self, data, future, projected):
        return self.rows.reshape(-1, 1) * projected


def _channels(name: str, values) -> Float[Array, "samples channels"]:
    values = jnp.asarray(values, dtype=float)
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2:
        raise ValueError(f"{name} has shape {values.shape}; give samples × channels.")
    return values


def _full_rank(input_map) -> bool:
    dofs, inputs = input_map.shape
    if isinstance(input_map, jax.core.Tracer):
        return inputs >= dofs
    return bool(np.linalg.matrix_rank(np.asarray(input_map)) == dofs)
