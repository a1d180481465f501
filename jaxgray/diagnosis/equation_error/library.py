"""Which laws would explain something of what is left of the force equation: scores of the whole catalogue."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects.base import AbstractEffect, AbstractForceEffect, Place, places_of
from .. import settings
from ..model.candidate import estimated
from ..screening.features import Shape
from ..screening.score_test import Score, allowed, best_by_place
from .regression import Equation, ForceFit, Weight
from .rows import contributions

WIDER = (0.25, 4.0)
"""Lengths of a shape are tried at these multiples as well: a rigid body has no natural amplitude."""


ROUNDS = 2
PICKED = 3
_DEPENDENT = 1e-9

MOST_RADIANS = 120
"""Way of a place, in lengths of a law that repeats itself over displacement, up to which such laws are looked for."""

FINE = 1.04
"""Ratio of neighbouring lengths where a law has one."""


@dataclass(frozen=True)
class Scores:
    """Scores of all shapes, best first, under the weight of what is left once the best few are taken out."""

    scores: tuple[Score, ...]
    weight: Weight
    rows: float

    def best_by_place(self) -> dict[tuple[str, str], Score]:
        """The best score of every effect at every place."""
        return best_by_place(self.scores)

    @property
    def fires(self) -> bool:
        """Whether any candidate passes the gate."""
        return bool(self.scores) and self.scores[0].delta_bic >= settings.MIN_DELTA_BIC


@dataclass
class Library:
    """Contributions of all shapes of a catalogue to the rows of an equation, computed once."""

    equation: Equation
    shapes: list[Shape] = field(default_factory=list)
    columns: list[list[np.ndarray]] = field(default_factory=list)

    @classmethod
    def of(cls, equation: Equation, catalogue: tuple[AbstractEffect, ...], names) -> "Library":
        """Every force law that is not tied to the clock of one record, at every place.

        An input effect may cancel the input itself, which leaves nothing to explain: it is not tried.
        """
        library = cls(equation)
        for effect in catalogue:
            if not isinstance(effect, AbstractForceEffect) or effect.tied_to_clock:
                continue
            if effect.scheduled and not any(np.any(s.scheduling) for s in equation.series):
                continue
            places = places_of(effect, *names)
            for place in places:
                library._add(effect, place, len(places))
        return library

    def _add(self, effect: AbstractEffect, place: Place, places: int) -> None:
        scales = self.equation.scales(effect, place)
        grid = [np.asarray(values, float) for values in effect.shapes(scales)]
        lengths = [j for j, p in enumerate(effect.parameters) if p.unit == (0, 1, 0) and p.counts and not p.amplitude]
        if len(lengths) == 1:
            # A force that nearly balances inertia shows only where the length is right.
            known = [values[lengths[0]] for values in grid]
            low, high = WIDER[0] * min(known), WIDER[1] * max(known)
            fine = np.geomspace(low, high, int(np.ceil(np.log(high / low) / np.log(FINE))) + 1)
            if effect.repeats:
                # Beyond these, so near to one another that their phases part by no more than a radian on the way.
                turns = np.arange(np.ceil(scales.q_peak / low), MOST_RADIANS)
                fine = np.concatenate([scales.q_peak / turns[::-1], fine])
            grid = [_with(grid[0], lengths, length) for length in fine]
        elif lengths:
            grid += [_with(values, lengths, values[lengths] * factor) for factor in WIDER for values in list(grid)]
        bases = [tuple(effect.basis(values)) for values in grid]
        table = np.array([values for basis in bases for values in basis], float)
        if not len(table):
            return
        equation, looks = self.equation, effect.looks(scales, grid) * places
        # records → rows × dofs × terms
        made = [contributions(effect, place, table, one, equation.input_map) for one in equation.series]
        ends = np.cumsum([len(basis) for basis in bases])
        for values, basis, end in zip(grid, bases, ends):
            columns = [one[:, :, end - len(basis) : end] for one in made]
            if all(np.all(np.isfinite(one)) for one in columns):
                self.shapes.append(Shape(effect, place, values, basis, scales, looks))
                self.columns.append(columns)


def _with(values: np.ndarray, where, new) -> np.ndarray:
    other = np.array(values, float)
    other[where] = new
    return other


def score(library: Library, fit: ForceFit, taken: frozenset) -> Scores:
    """Score every shape against what a fit leaves, the weight estimated in turn without the best few.

    **Arguments:** `library`; `fit`; `taken`: (id, place) that are in the model.

    **Returns:** `Scores`.
    """
    equation = library.equation
    tangent = list(equation.table)
    for term in fit.terms:
        slopes = equation.added(term, slopes=True)
        tangent = [np.concatenate([t, s[:, :, estimated(term)]], axis=2) for t, s in zip(tangent, slopes)]
    free = [k for k, shape in enumerate(library.shapes) if (shape.effect.id, shape.place.name) not in taken]
    left = list(fit.residual)
    weight = equation.plain()
    for turn in range(ROUNDS + 1):
        base = equation.weighted(tangent, weight)
        base = base / np.maximum(np.linalg.norm(base, axis=0), 1e-300)
        U, s, _ = np.linalg.svd(base, full_matrices=False)
        U = U[:, s > 1e-9 * s[0]]
        e = equation.weighted(left, weight)
        e = e - U @ (U.T @ e)
        rows = len(e) * weight.share
        ready = {k: equation.weighted(library.columns[k], weight) for k in free}
        found = [one for k in free if (one := _scored(library.shapes[k], ready[k], U, e, k, rows)) is not None]
        found.sort(key=lambda one: -one.delta_bic)
        if turn == ROUNDS:
            break
        weight = equation.weight_of(_cleaned(equation, tangent, left, library, found, ready, U, e, weight, rows))
    return Scores(tuple(found), weight, rows)


def _penalty(shape: Shape, rows: int) -> float:
    return shape.free * np.log(rows) + 2 * np.log(shape.tried)


def _scored(shape: Shape, X: Float[np.ndarray, "rows basis"], U, e, column: int, rows: float) -> Score | None:
    rest = X - U @ (U.T @ X)
    power, before = np.sum(rest**2, axis=0), np.sum(X**2, axis=0)
    seen = power > _DEPENDENT * np.maximum(before, 1e-300)
    if not seen.any():
        return None
    table = rest[:, seen]
    weights = np.zeros(X.shape[1])
    weights[seen] = pseudo_inverse(table.T @ table, 1e-10) @ (table.T @ e)
    share = min(max(float(e @ table @ weights[seen]) / float(e @ e), 0.0), 1 - 1e-12)
    ratio, penalty = -rows * np.log1p(-share), _penalty(shape, rows)
    if ratio > penalty and not allowed(shape, weights):
        return None
    smallest = np.sqrt((penalty + settings.MIN_DELTA_BIC) * float(e @ e) * (1 - share) / rows / power[seen].max())
    return Score(shape, weights, float(ratio), float(ratio - penalty), 0.0, float(smallest), column)


def _cleaned(equation: Equation, tangent, left, library: Library, found, ready, U, e, weight: Weight, rows: float):
    """What is left without M, D, K, terms and the best few candidates, chosen one after the other."""
    chosen, names = [], set()
    pool = [one for one in found if one.delta_bic > settings.MIN_DELTA_BIC][:40]
    while len(chosen) < PICKED:
        best = None
        for one in pool:
            if (one.shape.effect.id, one.shape.place.name) in names:
                continue
            again = _scored(one.shape, ready[one.column], U, e, one.column, rows)
            if (
                again is not None
                and again.delta_bic > settings.MIN_DELTA_BIC
                and (best is None or again.delta_bic > best.delta_bic)
            ):
                best = again
        if best is None:
            break
        names.add((best.shape.effect.id, best.shape.place.name))
        chosen.append(best.column)
        X = ready[best.column]
        U = np.linalg.svd(np.concatenate([U, X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)], axis=1), False)[0]
        e = e - U @ (U.T @ e)
    table = [np.concatenate([t, *(library.columns[k][r] for k in chosen)], axis=2) for r, t in enumerate(tangent)]
    both = equation.weighted(table, weight)
    scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
    weights = np.linalg.lstsq(both / scale, equation.weighted(left, weight), rcond=1e-9)[0] / scale
    return [l - t @ weights for l, t in zip(left, table)]
