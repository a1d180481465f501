"""Least squares on the force equation: M, D, K and the parameters of terms, residuals correlated from row to row."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...mechanics.effects.base import Term
from ...numerics.matrices.bounded import bounded, column_sizes
from ...numerics.matrices.linear_algebra import duplication, from_symmetric_vector
from ...numerics.matrices.positive import ClarabelSolver, PositiveLeastSquares
from .. import settings
from ..model.candidate import estimated
from ..noise.effective_samples import independent_share
from .rows import Series, contribution, scales_of

REMEMBERED = 500
STEPS = 20
_DEPENDENT = 1e-6
TOLERANCE = 1e-6
FLOOR = 1e-9
"""Least mass, relative to what the regression finds."""


@dataclass(frozen=True)
class Weight:
    """How the rows count: `size` of the residual per coordinate, by which they are divided; `share` of them that is
    independent.

    The residual of a force equation is no noise alone but what the model leaves out at low frequency: whitening would
    move the weight to where derivatives are worst. Plain least squares, and fewer rows that count, is sounder.
    """

    size: Float[np.ndarray, " dofs"]
    share: float = 1.0


@dataclass(frozen=True)
class ForceFit:
    """A fit of the force equation.

    `matrices`: M, D, K; `errors`: standard errors of their entries; `terms`; `covariance` of the estimated values of
    all terms in order; `cost`: weighted sum of squares; `count` of independent rows; `free` parameters;
    `residual`: per record, rows × dofs, in units of force; `blocks`: which of M, D, K are in; `moving`: positions of
    the values that were estimated, per term: not those that do what an earlier term does already.
    """

    matrices: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    terms: tuple[Term, ...]
    covariance: Float[np.ndarray, "values values"]
    cost: float
    count: float
    free: int
    residual: tuple[np.ndarray, ...]
    blocks: tuple[bool, ...]
    moving: tuple[tuple[int, ...], ...] = ()

    @property
    def criterion(self) -> float:
        """N ln(cost/N) + k ln N."""
        return self.count * float(np.log(self.cost / self.count)) + self.free * float(np.log(self.count))

    def term_errors(self, index: int) -> dict[int, float]:
        """Standard errors of one term's parameters, by position."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        before = sum(map(len, self.moving[:index]))
        return {j: float(spread[before + k]) for k, j in enumerate(self.moving[index])}

    def significance(self, index: int) -> float:
        """The largest |β|/se among the amplitudes of a term; without an amplitude there is none to test."""
        term, spread = self.terms[index], self.term_errors(index)
        ratios = [
            abs(float(term.values[j])) / spread[j] if spread[j] > 0 else 0.0
            for j in spread
            if term.effect.parameters[j].amplitude
        ]
        return max(ratios, default=np.inf)


class Equation:
    """The rows of some records: E u on the left, M q̈ + D q̇ + K q on the right.

    **Arguments:** `series`: the records in the band; `input_map` (E); `mass` where it is known: M q̈ stands on the left
    then.
    """

    def __init__(
        self,
        series: list[Series],
        input_map: Float[np.ndarray, "dofs inputs"],
        mass: Float[np.ndarray, "dofs dofs"] | None = None,
    ):
        self.series, self.input_map = series, np.asarray(input_map, float)
        self.dofs, self.mass = len(self.input_map), mass
        self._known: dict = {}
        self.entries = self.dofs * (self.dofs + 1) // 2
        basis = np.asarray(duplication(self.dofs)).reshape(self.dofs, self.dofs, -1)
        self.force = [s.input_rows @ self.input_map.T for s in series]
        # The motion goes through the filter once more only as part of a law; M, D, K take what is filtered already.
        self.table = [
            np.concatenate([np.einsum("ijb,nj->nib", basis, X[s.rows]) for X in (s.a, s.v, s.q)], axis=2)
            for s in series
        ]
        if mass is not None:
            self.force = [force - s.a[s.rows] @ mass.T for force, s in zip(self.force, series)]
            for table in self.table:
                table[:, :, : self.entries] = 0.0
        self.size = np.sqrt(np.mean(np.concatenate(self.force) ** 2, axis=0))
        self.size = np.where(self.size > 0, self.size, max(float(self.size.max()), 1e-300))

    def plain(self) -> Weight:
        """Rows in units of the force, all of them independent."""
        return Weight(self.size)

    def weight_of(self, residual: list[Float[np.ndarray, "rows dofs"]]) -> Weight:
        """The weight of a residual."""
        size = np.sqrt(np.mean(np.concatenate(residual) ** 2, axis=0))
        share = independent_share(max(residual, key=len))
        return Weight(np.maximum(size, 1e-12 * self.size), share)

    def weighted(self, X: list[np.ndarray], weight: Weight) -> np.ndarray:
        """Rows × dofs (× columns) of all records, stacked, in units of the residual."""
        size = weight.size[None, :]
        return np.concatenate(
            [(x / size.reshape(*size.shape, *(1,) * (x.ndim - 2))).reshape(len(x) * self.dofs, *x.shape[2:]) for x in X]
        )

    def added(self, term: Term, *, slopes: bool = False) -> list[np.ndarray]:
        """What a term adds to the rows of every record; the latest are remembered."""
        key = term.effect, term.place.name, np.asarray(term.values, float).tobytes(), slopes
        made = self._known.get(key)
        if made is None:
            made = [
                contribution(term.effect, term.place, term.values, s, self.input_map, slopes=slopes)
                for s in self.series
            ]
            if len(self._known) > REMEMBERED:
                self._known.clear()
            self._known[key] = made
        return made

    def scales(self, effect, place):
        """Sizes in the first record at a place."""
        return scales_of(effect, place, self.series[0], self.input_map, float(self.size.max()))

    def fit(self, terms: tuple[Term, ...], weight: Weight, *, whole: bool = False) -> ForceFit | None:
        """M, D, K and all estimated values of the terms.

        Damping or stiffness that is not significant, or not physical, is left out.

        **Arguments:** `terms` to start from; `weight`; `whole`: keep all of M, D, K whatever it is worth.

        **Returns:** a `ForceFit`; None where nothing finite or no positive mass is found.
        """
        best = self._fit(terms, weight, (self.mass is None, True, True))
        if whole or best is None:
            return best
        for block in (2, 1):
            less = tuple(here and k != block for k, here in enumerate(best.blocks))
            without = self._fit(best.terms, weight, less)
            if without is None:
                continue
            hopeless = self.dofs == 1 and np.linalg.eigvalsh(best.matrices[block])[0] <= 0
            if hopeless or without.criterion - best.criterion < settings.MIN_DELTA_BIC:
                best = without
        # A shape found beside stiffness need not be the one without.
        if not all(best.blocks[1:]) and any(not p.amplitude and p.counts for t in terms for p in t.effect.parameters):
            again = self._fit(terms, weight, best.blocks)
            best = again if again is not None and again.cost < best.cost else best
        lowest = [np.linalg.eigvalsh(X)[[0, -1]] for X in best.matrices]
        valid = lowest[0][0] > 0 and all(low >= -1e-9 * abs(high) for low, high in lowest[1:])
        return best if valid else self._physical(best, weight)

    def _fit(self, terms, weight, blocks) -> ForceFit | None:
        inside = np.repeat(blocks, self.entries)
        tables = [t[:, :, inside] for t in self.table]
        L, F = self.weighted(tables, weight), self.weighted(self.force, weight)
        scale = np.linalg.norm(L, axis=0)
        Q, R = np.linalg.qr(L / np.where(scale > 0, scale, 1.0))
        now = self._state(terms, weight, Q, F, tuple(tuple(estimated(t)) for t in terms))
        if now is None:
            return None
        moving = _independent(terms, now[1] - Q @ (Q.T @ now[1]), now[1])
        now = self._state(terms, weight, Q, F, moving)
        damping = 0.0
        for _ in range(STEPS if terms else 0):
            e, slopes, _ = now
            J = slopes - Q @ (Q.T @ slopes)
            size = column_sizes(J)
            normal = (J / size).T @ (J / size) + damping * np.eye(J.shape[1])
            step = np.linalg.lstsq(normal, (J / size).T @ e, rcond=1e-12)[0] / size
            trial_terms = _moved(terms, step, moving)
            trial = self._state(trial_terms, weight, Q, F, moving)
            if trial is None or not trial[0] @ trial[0] < e @ e:
                damping = max(10 * damping, 1e-3)
                if damping > 1e6:
                    break
                continue
            settled = e @ e - trial[0] @ trial[0] < TOLERANCE * (e @ e)
            terms, now, damping = trial_terms, trial, damping / 10 if damping > 1e-5 else 0.0
            if settled:
                break
        e, slopes, plain = now
        rest = F - plain
        entries = np.linalg.lstsq(R, Q.T @ rest, rcond=1e-12)[0] / np.where(scale > 0, scale, 1.0)
        table = np.concatenate([L, slopes], axis=1)
        size = column_sizes(table)
        cost, count = float(e @ e), len(e) * weight.share
        inverse = np.linalg.pinv((table / size).T @ (table / size), rcond=1e-12, hermitian=True)
        covariance = inverse / np.outer(size, size) * cost / max(count - table.shape[1], 1)
        split = L.shape[1]
        full, spread = np.zeros((2, len(inside)))
        full[inside], spread[inside] = entries, np.sqrt(np.maximum(np.diag(covariance)[:split], 0.0))
        made = ForceFit(
            self._matrices(full),
            self._errors(spread),
            tuple(terms),
            covariance[split:, split:],
            cost,
            count,
            table.shape[1],
            (),
            tuple(bool(b) for b in blocks),
            moving,
        )
        return dataclasses.replace(made, residual=tuple(self.residual(made)))

    def _matrices(self, entries) -> tuple[np.ndarray, ...]:
        """M, D, K of their entries."""
        M, D, K = map(from_symmetric_vector, np.split(entries, 3))
        return (M if self.mass is None else self.mass), D, K

    def _errors(self, spread) -> tuple[np.ndarray, ...]:
        """Standard errors of M, D, K, of those of their entries."""
        basis = np.asarray(duplication(self.dofs))
        return tuple(np.sqrt((basis**2) @ s**2).reshape(self.dofs, self.dofs) for s in np.split(spread, 3))

    def _state(self, terms, weight, Q, F, moving):
        """Residual with M, D, K taken out, slopes, and what the terms add; None where it overflows."""
        plain, columns = np.zeros(len(F)), [np.zeros((len(F), 0))]
        for term, where in zip(terms, moving):
            slopes = [s[:, :, list(where)] for s in self.added(term, slopes=True)]
            if not bounded(*self.added(term), *slopes):
                return None
            value = self.weighted(self.added(term), weight)
            table = self.weighted(slopes, weight)
            plain = plain + value
            columns.append(table)
        rest = F - plain
        return rest - Q @ (Q.T @ rest), np.concatenate(columns, axis=1), plain

    def model_force(self, fit: ForceFit) -> list[np.ndarray]:
        """The right side of the equation."""
        entries = self._entries(fit.matrices)
        made = [t @ entries for t in self.table]
        for term in fit.terms:
            made = [m + x for m, x in zip(made, self.added(term))]
        return made

    def _entries(self, matrices):
        basis = np.asarray(duplication(self.dofs))
        return np.concatenate([np.linalg.lstsq(basis, X.ravel(), rcond=None)[0] for X in matrices])

    def residual(self, fit: ForceFit) -> list[np.ndarray]:
        """What is left of the force, per record."""
        return [f - m for f, m in zip(self.force, self.model_force(fit))]

    def relative_error(self, fit: ForceFit) -> float:
        """‖residual‖/‖force‖ over all rows and coordinates, every coordinate in units of its force."""
        left = np.concatenate(self.residual(fit)) / self.size
        whole = np.concatenate(self.force) / self.size
        return float(np.linalg.norm(left) / max(np.linalg.norm(whole), 1e-300))

    def _physical(self, fit: ForceFit, weight: Weight) -> ForceFit | None:
        """The nearest fit with M positive definite, D and K positive semidefinite, the terms as they are."""
        F = [f - sum((self.added(t)[k] for t in fit.terms), np.zeros_like(f)) for k, f in enumerate(self.force)]
        table, target = self.weighted(self.table, weight), self.weighted(F, weight)
        size = np.linalg.norm(table.reshape(len(table), 3, -1), axis=(0, 2)).repeat(self.entries)
        size = np.where(size > 0, size, 1.0)
        problem = PositiveLeastSquares.from_residual(table / size, target, (self.dofs,) * 3, (0.0, 0.0, 0.0))
        least = FLOOR * float(np.abs(np.trace(fit.matrices[0]))) * size[0]
        problem = PositiveLeastSquares.from_residual(table / size, target, (self.dofs,) * 3, (least, 0.0, 0.0))
        found = np.asarray(ClarabelSolver()(problem)) / size
        matrices = self._matrices(found)
        if not np.linalg.eigvalsh(matrices[0])[0] > 0:
            return None
        made = dataclasses.replace(fit, matrices=matrices)
        left = self.residual(made)
        e = self.weighted(left, weight)
        return dataclasses.replace(made, residual=tuple(left), cost=float(e @ e))


def _independent(terms: tuple[Term, ...], slopes: np.ndarray, before: np.ndarray) -> tuple[tuple[int, ...], ...]:
    """Positions of the values of every term that do something no earlier amplitude does: two laws may share a part."""
    result, at = [], 0
    basis = np.zeros((len(slopes), 0))
    for term in terms:
        moving = []
        for j in estimated(term):
            x, size = slopes[:, at], float(np.linalg.norm(before[:, at]))
            at += 1
            left = x - basis @ (basis.T @ x)
            amplitude = term.effect.parameters[j].amplitude
            if amplitude and np.linalg.norm(left) <= _DEPENDENT * max(size, 1e-300):
                continue
            moving.append(j)
            if amplitude:
                basis = np.concatenate([basis, left[:, None] / np.linalg.norm(left)], axis=1)
        result.append(tuple(moving))
    return tuple(result)


def _moved(terms: tuple[Term, ...], step: np.ndarray, moving) -> tuple[Term, ...]:
    """Terms with their estimated values moved, inside their bounds."""
    result, at = [], 0
    for term, where in zip(terms, moving):
        values = np.array(term.values, float)
        values[list(where)] += step[at : at + len(where)]
        at += len(where)
        result.append(Term(term.effect, term.place, term.effect.bounded(values)))
    return tuple(result)
