"""Poles over the model order: what of the motion is there at every order, and what comes and goes with it."""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from ..numerics.matrices.linear_algebra import least_squares
from ..numerics.outcomes import RESULTS, ComputationError
from ..numerics.programs.runtime import ready
from ..numerics.progress import Silent
from ..records import Record, record_of
from .initialization.start import filled
from .setup.options import pick
from .setup.preparation import prepare, scaling_of
from .standing import uniform_records
from .subspace.filter_bank import pole
from .subspace.grid import default_time_constants, record_factors, usable_block_rows
from .subspace.projection import WEIGHTS, AbstractWeight, Data, arrange, project

HIGHEST = 20
"""Highest order by default."""


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """Oscillating poles of subspace models without any physical form, for every order; one entry a pole.

    `order`; `frequency_hz`: natural frequency; `damping_ratio`; `shapes`: at the outputs, largest entry 1; `frequency`,
    `damping`, `shape`: whether the next lower order has a pole within the tolerances of each kind; `time_constant` [s],
    `block_rows` of the filters; `output_names`; `highest_hz`: half the sampling rate.
    """

    order: np.ndarray
    frequency_hz: Float[np.ndarray, " poles"]
    damping_ratio: Float[np.ndarray, " poles"]
    shapes: Complex[np.ndarray, "poles outputs"]
    frequency: Bool[np.ndarray, " poles"]
    damping: Bool[np.ndarray, " poles"]
    shape: Bool[np.ndarray, " poles"]
    time_constant: float
    block_rows: int
    output_names: tuple[str, ...]
    highest_hz: float

    @property
    def stable(self) -> Bool[np.ndarray, " poles"]:
        """Poles that agree with the next lower order in all three."""
        return self.frequency & self.damping & self.shape


def stabilisation(
    record: Record,
    *,
    orders=None,
    time_constant: float | None = None,
    block_rows: int | None = None,
    weight="moesp",
    frequency_tolerance: float = 0.01,
    damping_tolerance: float = 0.05,
    least_mac: float = 0.95,
) -> Stabilisation:
    """Poles of subspace models of every order, to see how many modes a record shows.

    **Arguments:**

    - `record`: the `Record`; rows at times of their own as for `sweep`.
    - `orders`: even numbers of states; default 2, 4, … up to what `block_rows` allows, 20 at most.
    - `time_constant`: of the filters, τ [s]; default the middle of those that `sweep` tries.
    - `block_rows`: i; default the most that `sweep` tries.
    - `weight`: "moesp" (default), "n4sid", "cva", "past-inputs", or a weight object.
    - `frequency_tolerance`, `damping_tolerance`: largest relative change from one order to the next at which a pole
      counts as stable; defaults 0.01 and 0.05.
    - `least_mac`: smallest modal assurance criterion of its shape, likewise; default 0.95.

    **Returns:** a `Stabilisation`.

    **Raises:** `ValueError` for orders that the block rows do not allow; `ComputationError` where the record cannot be
    compressed.

    **Reference:** Peeters & De Roeck, Mechanical Systems and Signal Processing 13 (1999) 855-878.

    **Example:**

        >>> import numpy as np, jaxgray
        >>> rng = np.random.default_rng(1)
        >>> u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        >>> model = jaxgray.MechanicalModel([[2.0]], [[3.0]], [[80.0]])
        >>> y = np.asarray(model.simulate(u[:, None], 0.01)) + 1e-4 * rng.standard_normal((1000, 1))
        >>> record = jaxgray.Record(u, y, 0.01)
        >>> found = jaxgray.stabilisation(record)
        >>> round(float(np.median(found.frequency_hz[found.stable])), 1)
        1.0
    """
    ready()
    (record,), _ = uniform_records([record_of(record, "record")], [], Silent())
    weight = pick("weight", weight, WEIGHTS)
    taus = default_time_constants(record)
    tau = float(taus[len(taus) // 2]) if time_constant is None else float(time_constant)
    i = max(usable_block_rows(record)) if block_rows is None else int(block_rows)
    most = (i - 1) * record.outputs
    orders = list(range(2, min(most, HIGHEST) + 1, 2)) if orders is None else [int(n) for n in orders]
    if not orders or min(orders) < 1 or max(orders) > most:
        raise ValueError(f"orders={orders}: {i} block rows of {record.outputs} outputs allow 1 to {most}; give others.")
    scaling = scaling_of([record])
    signals = filled([record], scaling, None) if record.has_missing else [prepare(record, scaling)]
    poles = pole(jnp.asarray([tau]), scaling.sampling_time)
    factors, householder = record_factors(signals, poles, i)
    if not bool(jnp.all(jnp.isfinite(factors))):
        raise ComputationError(RESULTS.unstable_start, stage="stabilisation")
    data = arrange(factors[0], poles[0], jnp.asarray(float(i)), record.inputs, i)
    found = [_poles(_solution(data, weight, n, householder), float(poles[0]), record) for n in orders]
    limits = frequency_tolerance, damping_tolerance, least_mac
    agreed = [_agreement(now, before, limits) for before, now in zip([None, *found], found)]
    return Stabilisation(
        np.repeat(orders, [len(one[0]) for one in found]),
        *(np.concatenate([one[k] for one in found]) for k in range(3)),
        *(np.concatenate([one[k] for one in agreed]) for k in range(3)),
        tau,
        i,
        record.output_names,
        record.sampling_rate_hz / 2,
    )


@functools.partial(jax.jit, static_argnames=("weight", "order", "householder"))
def _solution(data: Data, weight: AbstractWeight, order: int, householder: bool):
    """A_λ above C."""
    projections = project(data, weight, order, householder=householder)
    targets = jnp.concatenate([projections.target_states, projections.target_outputs], axis=1)
    return least_squares(projections.regressor, targets).T


def _poles(solution, a: float, record: Record):
    """Natural frequency [Hz], damping ratio and shape of the oscillating poles below half the sampling rate."""
    solution = np.asarray(solution)
    order = solution.shape[1]
    values, vectors = np.linalg.eig(solution[:order])
    z = a + (1 - a) * values
    s = np.log(np.where(z == 0, 1e-300, z)) / record.sampling_time
    kept = (s.imag > 0) & (s.imag < np.pi * record.sampling_rate_hz * (1 - 1e-9))
    shapes = (solution[order:] @ vectors[:, kept]).T
    largest = np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=1)[:, None], axis=1)
    size = np.abs(s[kept])
    along = np.argsort(size)
    shapes = shapes / np.where(np.abs(largest) > 0, largest, 1.0)
    return (size / (2 * np.pi))[along], (-s.real[kept] / size)[along], shapes[along]


def _agreement(now, before, limits):
    """Whether every pole has one near it, in each of the three respects, at the order before."""
    count = len(now[0])
    if before is None or len(before[0]) == 0 or count == 0:
        return tuple(np.zeros(count, bool) for _ in range(3))
    frequency, damping, shapes = now
    near = np.argmin(np.abs(before[0][None] - frequency[:, None]), axis=1)
    old_frequency, old_damping, old_shapes = (part[near] for part in before)
    same = np.abs(frequency - old_frequency) < limits[0] * frequency
    calm = np.abs(damping - old_damping) < limits[1] * np.abs(damping)
    across = np.abs(np.sum(shapes.conj() * old_shapes, axis=1)) ** 2
    sizes = np.sum(np.abs(shapes) ** 2, axis=1) * np.sum(np.abs(old_shapes) ** 2, axis=1)
    return same, same & calm, same & (across > limits[2] * sizes)
