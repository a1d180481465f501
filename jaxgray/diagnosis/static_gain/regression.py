"""Records that say nothing of inertia as a static gain with effects at the inputs, by least squares.

    y = offset + G (u + Σ ψ(u)),

The memory of the effects runs through the whole record; what was before it is left out.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import Place, Scales, Term
from ...mechanics.extended import held_input
from ...numerics.stored_programs import stored
from ...records import Record
from ..model.candidate import estimated
from ..model.free_run import FreeRun

EXTREMES = 0.02
"""Memory of what was before the record is over once the input has come so near both its extremes, as a share."""

LONGEST_HEAD = 0.3
STEPS = 30
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)


@dataclass(frozen=True)
class StaticFit:
    """`gain` (outputs × inputs) with `gain_errors`, `offset`, `terms`, `covariance` of their estimated values, mean
    square `cost` in units of the outputs' size, `count` of samples, `free` parameters, `simulated` per record."""

    gain: Float[np.ndarray, "outputs inputs"]
    gain_errors: Float[np.ndarray, "outputs inputs"]
    offset: Float[np.ndarray, " outputs"]
    terms: tuple[Term, ...]
    covariance: np.ndarray
    cost: float
    count: float
    free: int
    simulated: tuple[np.ndarray, ...]

    def criterion(self, share: float) -> float:
        """BIC of this fit with a given share of independent samples."""
        count = self.count * share
        return count * float(np.log(self.cost)) + self.free * float(np.log(max(count, 2.0)))

    def term_errors(self, index: int, share: float) -> dict[int, float]:
        """Standard errors of one term's parameters, by position."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0) / share)
        before = sum(len(estimated(t)) for t in self.terms[:index])
        return {j: float(spread[before + k]) for k, j in enumerate(estimated(self.terms[index]))}


@stored
def _applied(effect, p, start, end, seen, time):
    return *effect.apply(p, start, end, time), effect.at_samples(p, start, end, seen, time)


@stored
def _slopes(effect, p, start, end, seen, time):
    return jax.jacfwd(lambda p: effect.at_samples(p, start, end, seen, time))(p)


def settled(record: Record) -> int:
    """Samples until the input has been near both its extremes: until then its memory is not known."""
    low, high = record.u.min(axis=0), record.u.max(axis=0)
    near = EXTREMES * (high - low)
    first = [
        max(int(np.argmax(u <= a + d)), int(np.argmax(u >= b - d))) for u, a, b, d in zip(record.u.T, low, high, near)
    ]
    return min(max(first) + 1, int(LONGEST_HEAD * record.samples))


class Static:
    """Some records as a static gain with effects sees them."""

    def __init__(self, records: list[Record]):
        self.records = records
        self.kept = [np.isfinite(r.y) & (np.arange(r.samples) >= settled(r))[:, None] for r in records]
        self.size = np.nanstd(np.concatenate([r.y for r in records]), axis=0)
        self.size = np.where(self.size > 0, self.size, 1.0)

    def inputs(self, terms: tuple[Term, ...], record: Record):
        """The input with all effects, and its slopes by every estimated value: which input, and the series."""
        # So slow that between samples it is straight, whatever holds it there.
        held = [*held_input(jnp.asarray(record.u), "linear"), jnp.asarray(record.u)]
        time = jnp.asarray(record.sampling_time)
        slopes = []
        for term in terms:
            j, p = term.place.first, jnp.asarray(term.values, dtype=float)
            one = [x[:, j] for x in held]
            made = np.asarray(_slopes(term.effect, p, *one, time))
            slopes += [(j, made[:, k]) for k in estimated(term)]
            held = [x.at[:, j].set(new) for x, new in zip(held, _applied(term.effect, p, *one, time))]
        return np.asarray(held[2]), slopes

    def run(self, fit: StaticFit) -> list[FreeRun]:
        """What a fit makes of the records."""
        runs = []
        for record, kept in zip(self.records, self.kept):
            y = fit.offset + self.inputs(fit.terms, record)[0] @ fit.gain.T
            runs.append(FreeRun(y, np.where(kept, np.nan_to_num(record.y) - y, 0.0), kept))
        return runs

    def fit(self, terms: tuple[Term, ...]) -> StaticFit | None:
        """Gain, offset and the values of all terms by least squares; None where it is not finite."""
        inputs, outputs = self.records[0].inputs, self.records[0].outputs
        now, damping = self._linear(terms), 0.0
        if now is None:
            return None
        for _ in range(STEPS if terms else 0):
            table, e, gain = now[:3]
            J = np.concatenate([table, self._term_columns(now[5], gain)], axis=1)
            size = _norms(J)
            normal = (J / size).T @ (J / size) + damping * np.eye(J.shape[1])
            step = np.linalg.lstsq(normal, (J / size).T @ e, rcond=1e-12)[0] / size
            trial = _moved(terms, step[table.shape[1] :])
            new = self._linear(trial)
            if new is None or not new[1] @ new[1] < e @ e:
                damping = max(10 * damping, 1e-3)
                if damping > 1e8:
                    break
                continue
            done = e @ e - new[1] @ new[1] < 1e-6 * (e @ e)
            terms, now, damping = trial, new, damping / 10 if damping > 1e-5 else 0.0
            if done:
                break
        table, e, gain, offset, simulated, slopes = now
        J = np.concatenate([table, self._term_columns(slopes, gain)], axis=1)
        size = _norms(J)
        covariance = np.linalg.pinv((J / size).T @ (J / size), rcond=1e-12, hermitian=True) / np.outer(size, size)
        covariance = covariance * float(e @ e) / len(e)
        split = table.shape[1]
        errors = np.sqrt(np.maximum(np.diag(covariance)[:split], 0.0)).reshape(outputs, inputs + 1)[:, 1:]
        cost = float(e @ e) / len(e)
        return StaticFit(
            gain, errors, offset, terms, covariance[split:, split:], cost, len(e), J.shape[1], tuple(simulated)
        )

    def _linear(self, terms):
        """Columns of offset and gain, residual, gain, offset, simulated outputs and slopes, for given terms."""
        made = [self.inputs(terms, r) for r in self.records]
        if not all(np.all(np.isfinite(u)) for u, _ in made):
            return None
        outputs = len(self.size)
        blocks, targets = [], []
        for i in range(outputs):
            rows = [np.column_stack([np.ones(len(u)), u])[k[:, i]] for (u, _), k in zip(made, self.kept)]
            blocks.append(np.concatenate(rows) / self.size[i])
            targets.append(np.concatenate([r.y[k[:, i], i] for r, k in zip(self.records, self.kept)]) / self.size[i])
        weights = [np.linalg.lstsq(b, t, rcond=1e-12)[0] for b, t in zip(blocks, targets)]
        e = np.concatenate([t - b @ w for b, t, w in zip(blocks, targets, weights)])
        width = blocks[0].shape[1]
        table = np.zeros((len(e), outputs * width))
        at = 0
        for i, b in enumerate(blocks):
            table[at : at + len(b), i * width : (i + 1) * width] = b
            at += len(b)
        gain, offset = np.stack([w[1:] for w in weights]), np.array([w[0] for w in weights])
        simulated = [offset + u @ gain.T for u, _ in made]
        return table, e, gain, offset, simulated, [slopes for _, slopes in made]

    def _term_columns(self, slopes, gain):
        columns = []
        for n in range(len(slopes[0])):
            parts = []
            for i in range(len(self.size)):
                for one, kept in zip(slopes, self.kept):
                    j, series = one[n]
                    parts.append(gain[i, j] * series[kept[:, i]] / self.size[i])
            columns.append(np.concatenate(parts))
        return np.stack(columns, axis=1) if columns else np.zeros((sum(int(k.sum()) for k in self.kept), 0))

    def scales(self, place: Place) -> Scales:
        """Sizes of one input about the middle of its range."""
        u = np.concatenate([r.u[:, place.first] for r in self.records])
        centred = np.abs(u - (u.max() + u.min()) / 2)
        h, longest = self.records[0].sampling_time, max(r.samples for r in self.records)
        size = float(max(np.sqrt(np.mean(centred**2)), 1e-300))
        quantiles = tuple(map(float, np.quantile(centred, LEVELS)))
        peak = float(centred.max())
        return Scales(size, size, peak, peak, quantiles, size, peak, quantiles, size, 1.0, h, longest * h, ())


def _norms(J: np.ndarray) -> np.ndarray:
    """Norms of columns, 1 for what this record does not show."""
    size = np.linalg.norm(J, axis=0)
    return np.where(size > 1e-100, size, 1.0)


def _moved(terms, step):
    result, at = [], 0
    for term in terms:
        values = np.array(term.values, float)
        where = estimated(term)
        values[where] += step[at : at + len(where)]
        at += len(where)
        result.append(Term(term.effect, term.place, term.effect.bounded(values)))
    return tuple(result)
