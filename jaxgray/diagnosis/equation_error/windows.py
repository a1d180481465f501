"""Free runs over short windows, each with a first state of its own: for bodies that drift over the whole record."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ...mechanics.model import MechanicalModel
from ...mechanics.runs.extended import Plant, plant_run, slots_of
from ...numerics.matrices.bounded import LARGEST
from ...numerics.programs.stored_programs import stored
from ...records import Record
from ..model.free_run import FreeRun
from .rows import Series, at_rest_of

WINDOW = 1.0
"""Length of a window [s]; less where the record is short or has few samples a second."""

SHORTEST, LONGEST = 50, 2000
"""Samples a window may have."""

FEWEST = 2
"""Windows in motion from which those at rest do not count."""

STEPS, PATIENCE = 30, 6
"""Steps for the first states, and how many may bring nothing before they end: where friction holds a body for a while,
the error has steps of its own."""

LEAST_DAMPING = 1e-12
"""Of the steps for the first states, relative to the size of their slopes: some may do what others do."""

PAYS = 1e-3
"""Relative fall of a window's error that is worth a step."""


def window_samples(records: list[Record]) -> int:
    """Samples of one window: about a second, at most the shortest record."""
    shortest = min(r.samples for r in records)
    wanted = int(round(WINDOW / records[0].sampling_time))
    return min(max(min(wanted, LONGEST), SHORTEST), shortest)


@stored
def _windows(plant, x0, start, end, scheduling, slots, time, laws):
    def run(x0, start, end, p):
        return plant_run(plant, x0, start, end, slots, time, laws=laws, scheduling=p)

    # Derivatives by the first state are differences of runs: compiling them costs more than all that is computed.
    return jax.vmap(jax.vmap(run, in_axes=(0, None, None, None)))(x0, start, end, scheduling)


class Windows:
    """Free runs of models on the windows of some records, all of one length and run together.

    **Arguments:** `records`; `series`: the same in the band of the regression, for first guesses; `samples` of a
    window; `left_out`: samples of every record on which no window counts that has any of them.
    """

    def __init__(self, records: list[Record], series: list[Series], samples: int, left_out: list[np.ndarray]):
        self.samples, self.series = samples, series
        self.counts = [r.samples // samples for r in records]
        self.time = records[0].sampling_time
        self.y = self.cut([r.y for r in records])
        self.first = self.cut([np.concatenate([s.q, s.v], axis=1) for s in series])[:, 0]
        usable = ~self.cut(left_out).any(axis=1)
        # What rests on dry friction does so whatever else the model has, and creeps as no law says.
        moving = usable & (self.cut([at_rest_of(s.v) for s in series]).mean(axis=1) < 0.5)
        ends = np.cumsum(self.counts)
        counted = [m if m.sum() >= FEWEST else u for m, u in zip(np.split(moving, ends), np.split(usable, ends))]
        self.known = np.isfinite(self.y) & np.concatenate(counted)[:, None, None]

    def cut(self, X: list[np.ndarray]) -> np.ndarray:
        """Series of all records as windows × samples × channels."""
        return np.concatenate(
            [
                np.asarray(x)[: count * self.samples].reshape(count, self.samples, *x.shape[1:])
                for x, count in zip(X, self.counts)
            ]
        )

    def run(self, model: MechanicalModel) -> list[FreeRun]:
        """Outputs of a model on the windows of every record, the first state of each window estimated on it.

        **Returns:** a `FreeRun` per record, its windows one after the other; infinite where it overflows.
        """
        plant = Plant(model.mass, model.damping, model.stiffness, model.drive, model.measured)
        laws = tuple(dict.fromkeys(term.effect for term in model.effects))
        slots = slots_of(model.effects, plant, laws)
        inputs = (self.cut([getattr(s, name) for s in self.series]) for name in ("start", "end", "scheduling"))
        series = (*map(jnp.asarray, inputs), slots, jnp.asarray(self.time), laws)
        return self.fitted(lambda states: np.asarray(_windows(plant, jnp.asarray(states), *series)))

    def fitted(self, runs: Callable[[np.ndarray], np.ndarray]) -> list[FreeRun]:
        """The same of anything that runs from given states: `runs`, from several states of every window (windows × runs
        × states) to outputs (windows × runs × samples × outputs)."""
        known = self.known
        target = np.where(known, self.y, 0.0)
        size = np.sqrt(np.sum(target**2, axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)), 1))
        weight = known / np.where(size > 0, size, 1.0)
        x0, best = self.first.copy(), np.full(len(target), np.inf)
        kept, y = x0.copy(), np.zeros_like(target)
        damping = np.full(len(target), 1e-9)
        idle = 0
        for _ in range(STEPS + 1):
            made, J, sound = self._run_and_slopes(runs, x0)
            e = (target - made) * weight
            cost = np.where(sound[:, 0], np.sum(e**2, axis=(1, 2)), np.inf)
            better = cost < best
            idle = 0 if np.any(better & ~(cost > (1 - PAYS) * best)) else idle + 1
            y, kept, best = (np.where(_wide(better, x), x, old) for x, old in ((made, y), (x0, kept), (cost, best)))
            if idle > PATIENCE:
                break
            damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 100)
            table = (J * weight[..., None]).reshape(len(target), -1, J.shape[-1])
            for k in range(len(target)):
                x0[k] = (kept[k] + x0[k]) / 2
                if better[k] and np.all(sound[k]):
                    scale = np.linalg.norm(table[k], axis=0)
                    scale = np.where(scale > 0, scale, 1.0)
                    normal = (table[k] / scale).T @ (table[k] / scale) + damping[k] * np.eye(len(scale))
                    x0[k] = kept[k] + np.linalg.solve(normal, (table[k] / scale).T @ e[k].ravel()) / scale
        y = np.where(np.isfinite(best)[:, None, None], y, np.inf)
        found, at = [], 0
        for count in self.counts:
            part = slice(at, at + count)
            at += count
            simulated, measured, there = (x[part].reshape(-1, y.shape[2]) for x in (y, target, known))
            found.append(FreeRun(simulated, np.where(there, measured - simulated, 0.0), there))
        return found

    def _run_and_slopes(self, runs, x0):
        """Outputs of all windows, their slopes by the first states, by differences of one part in 10⁵, and which runs
        of every window (the first is that of the outputs) did not overflow; zero where they did."""
        states = x0.shape[1]
        steps = 1e-5 * np.maximum(np.sqrt(np.mean(self.first**2, axis=0)), 1e-300)
        all_states = np.concatenate([x0[:, None], x0[:, None] + np.diag(steps)[None]], axis=1)
        made = runs(all_states)
        sound = np.all(np.abs(made) <= LARGEST, axis=(2, 3))
        made = np.where(sound[:, :, None, None], made, 0.0)
        J = (made[:, 1 : states + 1] - made[:, :1]) / steps[None, :, None, None]
        return made[:, 0], np.moveaxis(J, 1, -1), sound


def _wide(flags, like):
    return flags.reshape(-1, *(1,) * (like.ndim - 1))
