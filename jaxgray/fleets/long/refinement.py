"""Refinement of a long record's model: normal equations of its segments, summed over workers.

Every segment has a first state of its own, which is eliminated from its normal equations before they are summed; a
worker returns tables of inner products, whose size does not depend on the samples. The free entries are those of M, D,
K, and offsets; outputs are weighed by the covariance of their errors, renewed at every step.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...identification.setup.options import drive_of
from ...identification.setup.prediction import Setting
from ...mechanics.model import MechanicalModel
from ...numerics.matrices.linear_algebra import from_triangle, triangle
from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.progress import AbstractProgress, Silent
from ...numerics.responses.response_products import response_products
from ...numerics.responses.sensitivity import by_blocks, lift_by_channel
from ..runner import carry_out, engines, refuse
from .compressed import LongRecord
from .source import Source

SEGMENT = 2**16
"""Samples with a first state of their own."""

TOGETHER = 8
"""Segments that a worker takes at a time."""

MOST_STEPS = 20

SETTLED = 0.01
"""Decrease of twice the negative log-likelihood that a step must promise to be taken."""

FIRST_DAMPING = 1e-6


@dataclass(frozen=True)
class Refined:
    """`model` in the record's units; `covariance` of the stacked upper triangles (by columns) of mass, damping,
    stiffness, for white noise; `noise`: standard deviation of the error per output; `steps` taken."""

    model: MechanicalModel
    covariance: Float[np.ndarray, "entries entries"]
    noise: Float[np.ndarray, " outputs"]
    steps: int

    @property
    def standard_errors(self) -> dict[str, Float[np.ndarray, "dofs dofs"]]:
        """Standard error of every entry."""
        parts = np.split(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), 3)
        return {name: np.asarray(from_triangle(x)) for name, x in zip(("mass", "damping", "stiffness"), parts)}


@dataclass(frozen=True)
class Stretch:
    """What a worker multiplies out: segments of `source` from `first` on; `entries`: scaled triangles; `states`: first
    state of each; `offset`; `setting`; `level`, `sizes` of the signals; `index` of the first segment."""

    source: Source
    first: int
    entries: np.ndarray
    states: np.ndarray
    offset: np.ndarray
    setting: Setting
    level: np.ndarray
    sizes: np.ndarray
    segment: int
    index: int


def multiplied(stretch: Stretch) -> tuple[int, list[np.ndarray]]:
    """Tables of inner products of the segments; runs on a worker."""
    jax.config.update("jax_enable_x64", True)
    tables, inputs = [], stretch.source.inputs
    for k, x0 in enumerate(stretch.states):
        rows = stretch.source.read(stretch.first + k * stretch.segment, stretch.segment)
        signals = (rows - stretch.level) / stretch.sizes
        lacking = ((0, stretch.segment - len(signals)), (0, 0))
        kept = np.pad(np.ones((len(signals), signals.shape[1] - inputs)), lacking)
        u, y = np.pad(signals[:, :inputs], lacking), np.pad(signals[:, inputs:], lacking)
        tables.append(np.asarray(_products(stretch.setting, stretch.entries, x0, stretch.offset, u, y, kept)))
    return stretch.index, tables


@jax.jit
def _products(setting: Setting, entries, x0, offset, u, y, kept):
    def lifted(vector):
        system = setting.system(*(from_triangle(part) for part in jnp.split(vector, 3)))
        return lift_by_channel(system.A, system.B, system.C, system.D)

    laid = (by_blocks(signal) for signal in (u, y, kept))
    return response_products(lifted, entries, x0, offset, *laid, gaps=False)


@dataclass(frozen=True)
class _Point:
    """Entries, offsets and first states, and the tables there."""

    entries: np.ndarray
    offset: np.ndarray
    states: np.ndarray
    tables: list[np.ndarray]
    samples: int

    @property
    def covariance(self) -> np.ndarray:
        return sum(table[-1, :, -1, :] for table in self.tables) / self.samples

    @property
    def cost(self) -> float:
        sign, value = np.linalg.slogdet(self.covariance)
        return self.samples * value if sign > 0 and np.isfinite(value) else np.inf

    def reduced(self):
        """Normal equations of entries and offsets, and of every segment what gives its first state back."""
        weights = np.linalg.inv(self.covariance)
        p, s = len(self.entries), self.states.shape[1]
        total, back = 0.0, []
        for table in self.tables:
            T = np.einsum("op,codp->cd", weights, table)
            x = np.arange(p, p + s)
            rest = np.setdiff1d(np.arange(len(T)), x)
            ridge = 1e-12 * np.trace(T[np.ix_(x, x)]) / s
            gain = np.linalg.solve(T[np.ix_(x, x)] + ridge * np.eye(s), T[np.ix_(x, rest)])
            total = total + T[np.ix_(rest, rest)] - T[np.ix_(rest, x)] @ gain
            back.append(gain)
        return total[:-1, :-1], total[:-1, -1], back


def refine_on_workers(
    record: LongRecord,
    model: MechanicalModel | None = None,
    *,
    client=None,
    scheduler: str | None = None,
    workers: int | None = None,
    segment_samples: int = SEGMENT,
    progress: AbstractProgress | None = None,
) -> Refined:
    """Refine mass, damping and stiffness of a long record by prediction error, every pass shared by all workers.

    **Arguments:**

    - `record`: by `compress_on_workers`.
    - `model`: where to start; default the record's own.
    - `client`, `scheduler`, `workers`: as for `fleet`.
    - `segment_samples`: samples with a first state of their own; default 65 536.
    - `progress`: told of every stretch; silent by default.

    **Returns:** a `Refined`.

    **Raises:** `ComputationError` where it does not settle; `Lost` where the workers are gone.
    """
    progress = Silent() if progress is None else progress
    model = record.model() if model is None else model
    scaling, pattern, source = record.scaling, record.pattern, record.source
    r, c = triangle(model.dofs)
    drive = drive_of(pattern, "force", None, False) if model.drive is None else model.drive
    setting = Setting(
        drive.scaled(scaling.coordinates, scaling.inputs, scaling.sampling_time), pattern.measured, pattern.hold
    )
    scaled = scaling.matrices_in(*(np.asarray(X) for X in (model.mass, model.damping, model.stiffness)))
    entries = np.concatenate([np.asarray(X)[r, c] for X in scaled])
    segments = -(-source.samples // segment_samples)
    level = np.concatenate([np.zeros(pattern.inputs), record.level])
    sizes = np.concatenate([np.asarray(scaling.inputs), np.asarray(scaling.outputs)])

    with engines(client, scheduler, workers) as engine:

        def at(entries, offset, states) -> _Point:
            stretches = [
                Stretch(
                    source,
                    k * segment_samples,
                    entries,
                    states[k : k + TOGETHER],
                    offset,
                    setting,
                    level,
                    sizes,
                    segment_samples,
                    k,
                )
                for k in range(0, segments, TOGETHER)
            ]
            tables: dict[int, list] = {}
            counts = [len(one.states) for one in stretches]
            carry_out(
                engine(),
                multiplied,
                stretches,
                counts,
                refuse,
                progress,
                found=lambda value: tables.update([value]),
                what="segments",
            )
            return _Point(entries, offset, states, [t for k in sorted(tables) for t in tables[k]], source.samples)

        point = at(entries, np.zeros(model.outputs), np.zeros((segments, 2 * model.dofs)))
        damping, steps, settled = FIRST_DAMPING, 0, False
        while steps < MOST_STEPS and not settled:
            H, g, back = point.reduced()
            size = np.sqrt(np.diag(H))
            scaled_H, scaled_g = H / size[:, None] / size, g / size
            step = -np.linalg.solve(scaled_H + damping * np.eye(len(g)), scaled_g) / size
            states = np.array([x - gain @ np.append(step, 1.0) for x, gain in zip(point.states, back)])
            p = len(entries)
            trial = at(point.entries + step[:p], point.offset + step[p:], states)
            steps += 1
            promised = -step @ g
            if trial.cost <= point.cost + SETTLED:
                settled = promised < SETTLED and point.cost - trial.cost < 1.0
                point, damping = trial, damping / 10
            else:
                damping = max(100 * damping, 1e-4)
    if not settled:
        raise ComputationError(RESULTS.refinement_diverged, stage="refinement", detail=f"after {steps} steps")
    H, _, _ = point.reduced()
    size = np.sqrt(np.diag(H))
    covariance = (np.linalg.inv(H / size[:, None] / size) / size[:, None] / size)[: len(entries), : len(entries)]
    n = model.dofs
    units = np.concatenate([np.asarray(X)[r, c] for X in scaling.matrices_out(*[np.ones((n, n))] * 3)])
    M, D, K = (np.asarray(from_triangle(part)) for part in np.split(point.entries * units, 3))
    return Refined(
        model.with_matrices(M, D, K),
        covariance * units[:, None] * units,
        np.sqrt(np.diag(point.covariance)) * np.asarray(scaling.outputs),
        steps,
    )
