"""The gate and the short list: which effects would explain something of what is left.

Score test of every candidate, off the span of the model's own sensitivities:

    r0 = ‖P W e‖²,  r1 = ‖P_{J,S} W e‖²,  LR = m ln(r0/r1),  ΔBIC = LR − k ln m − 2 ln(shapes·places).

**Reference:** Rao's score test; Schwarz (1978) for the criterion; Holm (1979) for many families at once.
"""

from dataclasses import dataclass

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from ..identification.conic import pseudo_inverse
from .features import Features, Shape
from .problem import Data
from .residual import Chain, counted, estimate_chain

GATE = 10.0
"""ΔBIC from which a candidate counts."""

SIGNIFICANCE = 0.01
"""Family-wise probability of a false alarm (Holm)."""

_DEPENDENT = 1e-9
"""Share of a response's power off the model's sensitivities below which the record cannot show it."""


@dataclass(frozen=True)
class Score:
    """How much one shape explains.

    `shape`; `weights` of its basis; `ratio`: LR; `delta_bic`; `p_value` before Holm's correction; `smallest`: weight
    factor by which the shape would just be seen; `column`: its first column in the features.
    """

    shape: Shape
    weights: Float[np.ndarray, " basis"]
    ratio: float
    delta_bic: float
    p_value: float
    smallest: float
    column: int


@dataclass(frozen=True)
class Screening:
    """Scores of all shapes, best first, under one chain, and what did not give a finite response.

    `rows`: whitened samples that count (m); `chain`; `clean`: residual without model and what was picked;
    `threshold`: ΔBIC from which the gate opens; `overflowed`: shapes whose response was not finite; `first`: scores
    under the chain to begin with.
    """

    scores: tuple[Score, ...]
    chain: Chain
    rows: int
    clean: Float[np.ndarray, "samples outputs"]
    threshold: float
    overflowed: int
    first: tuple[Score, ...] = ()

    def best_by_effect(self) -> dict[str, Score]:
        """The best score of every effect."""
        best = {}
        for score in self.scores:
            best.setdefault(score.shape.effect.id, score)
        return best

    def best_by_place(self) -> dict[tuple[str, str], Score]:
        """The best score of every effect at every place."""
        best = {}
        for score in self.scores:
            best.setdefault((score.shape.effect.id, score.shape.place.name), score)
        return best

    @property
    def shows(self) -> bool:
        """Whether any candidate is worth a refit."""
        return bool(self.scores) and self.scores[0].delta_bic >= GATE

    @property
    def fires(self) -> bool:
        """Whether any candidate passes the gate: ΔBIC above the threshold, and significant among all by Holm."""
        best = list(self.best_by_place().values())
        if not best or best[0].delta_bic < self.threshold:
            return False
        return min(score.p_value for score in best) * len(best) < SIGNIFICANCE


class Products:
    """Inner products of sensitivities, residual and responses through one chain, sensitivities taken out.

    `matrix` of the responses and `target` with the residual, both off the span of the sensitivities; `power` of the
    residual there (r0); `before`: power of the responses as they were; `rows` (m).
    """

    def __init__(self, chain: Chain, e, J, features: Features, kept):
        used = counted(kept)
        X = features.responses
        self.finite = np.all(np.isfinite(X), axis=(0, 1))
        table = np.concatenate([J, e[:, :, None], np.where(self.finite, X, 0.0)], axis=2)
        white = chain.whiten(np.where(kept[:, :, None], table, 0.0))
        white = white.reshape(-1, table.shape[2])[used.reshape(-1)]
        self.finite &= np.all(np.isfinite(white[:, J.shape[2] + 1 :]), axis=0)
        white[:, J.shape[2] + 1 :][:, ~self.finite] = 0.0
        G = white.T @ white
        inside = np.arange(J.shape[2])
        self.inverse = pseudo_inverse(G[np.ix_(inside, inside)]) if len(inside) else np.zeros((0, 0))
        self.across = G[len(inside) :, : len(inside)] @ self.inverse
        rest = G[len(inside) :, len(inside) :] - self.across @ G[: len(inside), len(inside) :]
        self.power, self.target, self.matrix = float(rest[0, 0]), rest[1:, 0], (rest[1:, 1:] + rest[1:, 1:].T) / 2
        self.before = np.diag(G)[len(inside) + 1 :]
        self.rows = int(used.sum())

    def visible(self, columns) -> np.ndarray:
        """Which of some responses the record can show."""
        power = np.diag(self.matrix)[columns]
        return power > _DEPENDENT * np.maximum(self.before[columns], 1e-300)

    def without_columns(self, columns) -> "Products":
        """The same with some responses taken out as well."""
        rest = object.__new__(Products)
        inverse = pseudo_inverse(self.matrix[np.ix_(columns, columns)])
        across = self.matrix[:, columns] @ inverse
        rest.matrix = self.matrix - across @ self.matrix[columns]
        rest.target = self.target - across @ self.target[columns]
        rest.power = self.power - float(self.target[columns] @ inverse @ self.target[columns])
        rest.before, rest.rows, rest.finite = self.before, self.rows, self.finite
        return rest


def score_all(products: Products, features: Features) -> tuple[tuple[Score, ...], int]:
    """Scores of all shapes, best first, and how many had no finite response."""
    m, scores, overflowed, at = products.rows, [], 0, 0
    for shape in features.shapes:
        columns = np.arange(at, at + len(shape.basis))
        at += len(shape.basis)
        if not np.all(products.finite[columns]):
            overflowed += 1
            continue
        seen = products.visible(columns)
        if not seen.any():
            continue
        chosen = columns[seen]
        target = products.target[chosen]
        inverse = pseudo_inverse(products.matrix[np.ix_(chosen, chosen)], 1e-10)
        weights = np.zeros(len(columns))
        weights[seen] = inverse @ target
        share = min(max(float(target @ weights[seen]) / products.power, 0.0), 1 - 1e-12)
        ratio = -m * np.log1p(-share)
        penalty = _penalty(shape, m)
        worth = ratio - penalty > 0
        if worth and not allowed(shape, weights):
            continue
        p = float(scipy.stats.chi2.sf(ratio, len(chosen))) * shape.tried if worth else 1.0
        variance = products.power * (1 - share) / m
        size = np.sqrt(np.max(np.diag(products.matrix)[chosen]))
        smallest = float(np.sqrt((penalty + GATE) * variance) / size)
        scores.append(Score(shape, weights, float(ratio), float(ratio - penalty), p, smallest, int(columns[0])))
    scores.sort(key=lambda s: -s.delta_bic)
    return tuple(scores), overflowed


def _penalty(shape: Shape, rows: int) -> float:
    return shape.free * np.log(rows) + 2 * np.log(shape.tried)


def allowed(shape: Shape, weights: np.ndarray) -> bool:
    """Whether the effect can be of this sign: some amplitude is left inside its physical bounds."""
    effect = shape.effect
    values = effect.bounded(effect.combine(shape.values, weights))
    amplitudes = [(v, p) for v, p in zip(values, effect.parameters) if p.amplitude]
    return not amplitudes or any(p.lower < v < p.upper for v, p in amplitudes)


def screen(
    e: Float[np.ndarray, "samples outputs"],
    J: Float[np.ndarray, "samples outputs parameters"],
    data: Data,
    features: Features,
    system,
    force: Float[np.ndarray, " inputs"],
    chain: Chain,
    *,
    rounds: int = 3,
    picked: int = 3,
    surrogates: int = 0,
    rng: np.random.Generator | None = None,
) -> Screening:
    """Score every candidate, the chain estimated on what is left once the best are removed.

    An effect must not be part of what the chain is fitted to: it would be whitened away. So the chain is estimated
    in turn with the scores, each time on the residual without sensitivities and without the best few responses.

    **Arguments:** `e`, `J`: free-run residual and its sensitivities; `data`; `features`; `system`, `force`: for
    `estimate_chain`; `chain` to begin with; `rounds`; `picked`: how many are removed at most; `surrogates`: noise
    residuals that calibrate the gate; `rng` for them.

    **Returns:** a `Screening`.
    """
    first = None
    for turn in range(rounds + 1):
        products = Products(chain, e, J, features, data.kept)
        scores, overflowed = score_all(products, features)
        first = scores if first is None else first
        if turn == rounds:
            break
        clean = without(e, J, features, products, scores, chain, data.kept, picked)
        renewed = estimate_chain(clean, data.kept, system, force)
        if turn and renewed.ratio == chain.ratio and np.allclose(renewed.coefficients, chain.coefficients, atol=0.01):
            break
        chain = renewed
    threshold = GATE
    if surrogates and scores and GATE < scores[0].delta_bic < 100.0:
        threshold = max(GATE, _calibrated(products, scores, surrogates, rng))
    return Screening(scores, chain, products.rows, clean, threshold, overflowed, first)


def without(
    e,
    J,
    features: Features,
    products: Products,
    scores,
    chain: Chain,
    kept: Bool[np.ndarray, "samples outputs"],
    picked,
) -> Float[np.ndarray, "samples outputs"]:
    """The residual without sensitivities and without the best responses, chosen one after the other."""
    pool = [s for s in scores if s.delta_bic > GATE][:60]
    chosen, names, here = [], set(), products
    while len(chosen) < picked:
        best = None
        for s in pool:
            if (s.shape.effect.id, s.shape.place.name) in names:
                continue
            columns = np.arange(s.column, s.column + len(s.shape.basis))
            columns = columns[here.visible(columns)]
            if not len(columns):
                continue
            inverse = pseudo_inverse(here.matrix[np.ix_(columns, columns)], 1e-10)
            taken = float(here.target[columns] @ inverse @ here.target[columns])
            share = min(max(taken / here.power, 0.0), 1 - 1e-12)
            gain = -here.rows * np.log1p(-share) - _penalty(s.shape, here.rows)
            if gain > GATE and (best is None or gain > best[0]):
                best = gain, s, columns
        if best is None:
            break
        names.add((best[1].shape.effect.id, best[1].shape.place.name))
        chosen.append(best[2])
        here = here.without_columns(best[2])
    columns = np.concatenate(chosen).astype(int) if chosen else np.zeros(0, int)
    table = np.concatenate([J, features.responses[:, :, columns]], axis=2)
    used = counted(kept).reshape(-1)
    both = np.concatenate([table, e[:, :, None]], axis=2)
    white = chain.whiten(np.where(kept[:, :, None], both, 0.0)).reshape(-1, both.shape[2])[used]
    scale = np.linalg.norm(white[:, :-1], axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    gram = (white[:, :-1] / scale).T @ (white / np.append(scale, 1.0))
    weights = pseudo_inverse(gram[:, :-1]) @ gram[:, -1] / scale
    return np.where(kept, e - table @ weights, 0.0)


def _calibrated(products: Products, scores, surrogates: int, rng) -> float:
    """99 % quantile of the best ΔBIC over residuals of nothing but noise."""
    rng = np.random.default_rng(0) if rng is None else rng
    scale = np.sqrt(np.maximum(np.diag(products.matrix), 1e-300))
    values, vectors = np.linalg.eigh(products.matrix / scale[:, None] / scale[None, :])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    target = root @ rng.standard_normal((len(scale), surrogates)) * scale[:, None]
    best = np.full(surrogates, -np.inf)
    for s in scores:
        columns = np.arange(s.column, s.column + len(s.shape.basis))
        inverse = pseudo_inverse(products.matrix[np.ix_(columns, columns)], 1e-10)
        taken = np.einsum("is,ij,js->s", target[columns], inverse, target[columns])
        share = np.minimum(taken / products.rows, 1 - 1e-12)
        best = np.maximum(best, -products.rows * np.log1p(-share) - _penalty(s.shape, products.rows))
    return float(np.quantile(best, 0.99))
