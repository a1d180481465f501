"""Records that say nothing of inertia as a static gain with effects at the inputs, and springs, by least squares.

    y = offset + G (u + Σ ψ(u)),

The memory of the effects runs through the whole record; what was before it is left out. With springs y stands on the
right side, too (`springs.py`).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import AbstractForceEffect, Place, Scales, Term
from ...mechanics.runs.extended import held_input
from ...numerics.matrices.bounded import bounded, column_sizes
from ...numerics.programs.stored_programs import stored
from ...records import Record
from ..model.candidate import estimated
from ..model.free_run import FreeRun
from .springs import arm_at, curve, force_columns

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
        return count * float(np.log(max(self.cost, 1e-300))) + self.free * float(np.log(max(count, 2.0)))

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
    """Some records as a static gain with effects sees them; `to_inputs`: which inputs are a force at a coordinate, the
    inverse of the input map, None where it has none and springs cannot be told."""

    def __init__(self, records: list[Record], to_inputs: Float[np.ndarray, "inputs outputs"] | None = None):
        self.records = records
        self.to_inputs = to_inputs
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
            if any(_is_spring(term) for term in fit.terms):
                y = self._simulated(fit.offset, fit.gain, fit.terms, record)[0]
            else:
                y = fit.offset + self.inputs(fit.terms, record)[0] @ fit.gain.T
            runs.append(FreeRun(y, np.where(kept, np.nan_to_num(record.y) - y, 0.0), kept))
        return runs

    def fit(self, terms: tuple[Term, ...]) -> StaticFit | None:
        """Gain, offset and the values of all terms by least squares; None where it is not finite."""
        springs = any(_is_spring(term) for term in terms)
        found = self._with_springs(terms) if springs else self._with_inputs(terms)
        if found is None:
            return None
        (offset, gain, terms), e, J, simulated = found
        outputs, inputs = gain.shape
        split, size, cost = outputs * (1 + inputs), column_sizes(J), float(e @ e) / len(e)
        covariance = np.linalg.pinv((J / size).T @ (J / size), rcond=1e-12, hermitian=True) / np.outer(size, size)
        covariance = covariance * cost
        errors = np.sqrt(np.maximum(np.diag(covariance)[outputs:split], 0.0)).reshape(outputs, inputs)
        return StaticFit(
            gain, errors, offset, terms, covariance[split:, split:], cost, len(e), J.shape[1], tuple(simulated)
        )

    def _with_inputs(self, terms: tuple[Term, ...]):
        """Offset, gain and terms, residual, Jacobian and simulated outputs of the best fit; gain and offset follow from
        the values of the terms."""

        def at(terms):
            made = self._linear(terms)
            if made is None:
                return None
            return made[1], np.concatenate([made[0], self._term_columns(made[5], made[2])], axis=1), made

        def moved(terms, step):
            return _moved(terms, step[len(step) - sum(len(estimated(term)) for term in terms) :])

        terms, now = _descended(terms, at, moved, STEPS if terms else 0)
        if now is None:
            return None
        e, J, (_, _, gain, offset, simulated, _) = now
        return (offset, gain, terms), e, J, simulated

    def _with_springs(self, terms: tuple[Term, ...]):
        """The same with springs: all is moved together."""
        begun = self._linear(tuple(term for term in terms if not _is_spring(term)))
        if begun is None:
            return None
        outputs, inputs = begun[2].shape
        split = outputs * (1 + inputs)

        def moved(point, step):
            offset, gain, terms = point
            return offset + step[:outputs], gain + step[outputs:split].reshape(gain.shape), _moved(terms, step[split:])

        point, now = _descended((begun[3], begun[2], terms), self._rows, moved, STEPS)
        if now is None:
            return None
        return point, now[0], now[1], [self._simulated(*point, record)[0] for record in self.records]

    def _simulated(self, offset, gain, terms: tuple[Term, ...], record: Record):
        """Outputs, and their derivatives (samples × outputs × parameters) by the offset, the gain and the estimated
        values of all terms."""
        springs = [term for term in terms if _is_spring(term)]
        u, slopes = self.inputs(tuple(term for term in terms if not _is_spring(term)), record)
        outputs, inputs = gain.shape
        values = tuple(jnp.asarray(term.values, dtype=float) for term in springs)
        laws, arms = tuple(t.effect for t in springs), tuple(jnp.asarray(arm_at(t, outputs)) for t in springs)
        to_inputs = np.zeros((inputs, outputs)) if self.to_inputs is None else self.to_inputs
        y, J, by_input = (np.asarray(X) for X in curve(laws, arms, values, offset, gain, jnp.asarray(to_inputs), u))
        columns, at, slope = [J[:, :, : outputs * (1 + inputs)]], outputs * (1 + inputs), iter(slopes)
        for term in terms:
            if _is_spring(term):
                columns += [J[:, :, [at + k]] for k in estimated(term)]
                at += len(term.effect.parameters)
            else:
                for _ in estimated(term):
                    j, series = next(slope)
                    columns.append((by_input[:, :, j] * series[:, None])[:, :, None])
        return y, np.concatenate(columns, axis=2)

    def _rows(self, point):
        """Residual and Jacobian of all samples that count, in units of the outputs' size; None where not finite."""
        e, J = [], []
        for record, kept in zip(self.records, self.kept):
            y, slopes = self._simulated(*point, record)
            if not bounded(y, slopes):
                return None
            e.append(((np.nan_to_num(record.y) - y) / self.size)[kept])
            J.append((slopes / self.size[:, None])[kept])
        return np.concatenate(e), np.concatenate(J)

    def with_first_sizes(self, before: StaticFit, term: Term) -> Term:
        """A law with the sizes that its forces along the measured motion call for, or a tenth of its shape where it is
        an effect at an input."""
        if not _is_spring(term):
            start = np.array(term.values, float)
            start[[p.amplitude for p in term.effect.parameters]] *= 0.1
            return Term(term.effect, term.place, term.effect.bounded(start))
        e, columns = [], []
        for record, kept, run in zip(self.records, self.kept, self.run(before)):
            y = np.where(np.isfinite(record.y), record.y, run.simulated)
            flat = np.concatenate([np.ones((record.samples, 1)), record.u], axis=1)
            straight = [(flat[:, k, None] * row)[kept] for row in np.eye(y.shape[1]) for k in range(flat.shape[1])]
            made = force_columns(term, before.gain, self.to_inputs, y)
            columns.append(np.stack([*straight, *(column[kept] for column in made)], axis=1))
            e.append(run.e[kept])
        table = np.concatenate(columns)
        size = column_sizes(table)
        count = len(term.effect.basis(np.asarray(term.values)))
        weights = (np.linalg.lstsq(table / size, np.concatenate(e), rcond=1e-12)[0] / size)[-count:]
        return Term(term.effect, term.place, term.effect.bounded(term.effect.combine(np.asarray(term.values), weights)))

    def _linear(self, terms):
        """Columns of offsets and gains, residual, gain, offset, simulated outputs and slopes, for given terms."""
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
            table[at : at + len(b), i] = b[:, 0]
            table[at : at + len(b), outputs + i * (width - 1) : outputs + (i + 1) * (width - 1)] = b[:, 1:]
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

    def displacements(self, place: Place) -> Scales:
        """Sizes of the displacement at a coordinate, or between two."""
        first = [r.y[:, place.first] - (r.y[:, place.second] if place.second >= 0 else 0.0) for r in self.records]
        q = np.abs(np.concatenate(first))
        q = q[np.isfinite(q)]
        size, peak = float(max(np.sqrt(np.mean(q**2)), 1e-300)), float(q.max())
        quantiles, h = tuple(map(float, np.quantile(q, LEVELS))), self.records[0].sampling_time
        longest = max(r.samples for r in self.records)
        return Scales(size, size, peak, peak, quantiles, size, peak, quantiles, size, 1.0, h, longest * h, ())

    def scales(self, place: Place) -> Scales:
        """Sizes of one input about the middle of its range."""
        u = np.concatenate([r.u[:, place.first] for r in self.records])
        centred = np.abs(u - (u.max() + u.min()) / 2)
        h, longest = self.records[0].sampling_time, max(r.samples for r in self.records)
        size = float(max(np.sqrt(np.mean(centred**2)), 1e-300))
        quantiles = tuple(map(float, np.quantile(centred, LEVELS)))
        peak = float(centred.max())
        return Scales(size, size, peak, peak, quantiles, size, peak, quantiles, size, 1.0, h, longest * h, ())


def _descended(point, at, moved, steps: int):
    """Where damped Gauss-Newton steps end, and what `at` gives there: residual, Jacobian and more, None where they are
    not finite; `moved`: the point after a step."""
    now, damping = at(point), 0.0
    for _ in range(steps if now is not None else 0):
        e, J = now[:2]
        size = column_sizes(J)
        normal = (J / size).T @ (J / size) + damping * np.eye(J.shape[1])
        trial = moved(point, np.linalg.lstsq(normal, (J / size).T @ e, rcond=1e-12)[0] / size)
        new = at(trial)
        if new is None or not new[0] @ new[0] < e @ e:
            damping = max(10 * damping, 1e-3)
            if damping > 1e8:
                break
            continue
        done = e @ e - new[0] @ new[0] < 1e-6 * (e @ e)
        point, now, damping = trial, new, damping / 10 if damping > 1e-5 else 0.0
        if done:
            break
    return point, now


def _is_spring(term: Term) -> bool:
    return isinstance(term.effect, AbstractForceEffect)


def _moved(terms, step):
    result, at = [], 0
    for term in terms:
        values = np.array(term.values, float)
        where = estimated(term)
        values[where] += step[at : at + len(where)]
        at += len(where)
        result.append(Term(term.effect, term.place, term.effect.bounded(values)))
    return tuple(result)
