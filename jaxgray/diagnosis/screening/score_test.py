"""The gate and the short list: which effects would explain something of what is left.

Score test of every candidate, off the span of the model's own sensitivities:

    r0 = ‖P W e‖²,  r1 = ‖P_{J,S} W e‖²,  LR = m ln(r0/r1),  ΔBIC = LR − k ln m − 2 ln(shapes·places).

**Reference:** Rao's score test; Schwarz (1978) for the criterion; Holm (1979) for many families at once.
"""

from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects.base import limits
from .. import settings
from ..model.candidate import Data
from ..model.own_laws import ParameterError
from ..noise.whitening import SETTLING, NoiseModel, estimate_noise_model, white_noise_model
from .features import Features, Shape
from .projections import Products

CONTENDERS = 100
"""Shapes that may be removed before the noise model is estimated."""


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
    """Scores of all shapes, best first, under one noise model, and what did not give a finite response.

    `rows`: whitened samples that count (m); `noise_model`; `clean`: residual without model and what was picked;
    `threshold`: ΔBIC from which the gate opens; `overflowed`: shapes whose response was not finite; `white`: scores
    under white noise.
    """

    scores: tuple[Score, ...]
    noise_model: NoiseModel
    rows: int
    clean: Float[np.ndarray, "samples outputs"]
    threshold: float
    overflowed: int
    white: tuple[Score, ...] = ()

    def best_by_effect(self) -> dict[str, Score]:
        """The best score of every effect."""
        best = {}
        for score in self.scores:
            best.setdefault(score.shape.effect.id, score)
        return best

    def best_by_place(self) -> dict[tuple[str, str], Score]:
        """The best score of every effect at every place."""
        return best_by_place(self.scores)

    @property
    def shows(self) -> bool:
        """Whether any candidate is worth a refit."""
        return bool(self.scores) and self.scores[0].delta_bic >= settings.MIN_DELTA_BIC

    @property
    def fires(self) -> bool:
        """Whether any candidate passes the gate: ΔBIC above the threshold, and significant among all by Holm."""
        best = list(self.best_by_place().values())
        if not best or best[0].delta_bic < self.threshold:
            return False
        return min(score.p_value for score in best) * len(best) < settings.SIGNIFICANCE


def best_by_place(scores: tuple[Score, ...]) -> dict[tuple[str, str], Score]:
    """The best score of every effect at every place, of scores with the best first."""
    best = {}
    for score in scores:
        best.setdefault((score.shape.effect.id, score.shape.place.name), score)
    return best


def score_all(products: Products, features: Features) -> tuple[tuple[Score, ...], int]:
    """Scores of all shapes, best first, and how many had no finite response."""
    m, scores, overflowed, at = products.rows, [], 0, 0
    alone = products.one_by_one()
    for shape in features.shapes:
        columns = np.arange(at, at + len(shape.basis))
        at += len(shape.basis)
        if not np.all(products.finite[columns]):
            overflowed += 1
            continue
        if len(columns) == 1:
            k = at - 1
            if not alone.visible[k]:
                continue
            seen, share, weights, size = 1, alone.share[k], alone.weights[k : k + 1], alone.size[k]
        else:
            own = products.among(columns)
            shown = np.flatnonzero(own.visible(np.arange(len(columns))))
            if not len(shown):
                continue
            share, found = own.taken(shown)
            weights = np.zeros(len(columns))
            weights[shown] = found
            seen, size = len(shown), np.sqrt(np.max(np.diag(own.matrix)[shown]))
        ratio = -m * np.log1p(-share)
        penalty = _penalty(shape, m)
        worth = ratio - penalty > 0
        if worth and not allowed(shape, weights):
            continue
        p = float(scipy.special.chdtrc(seen, ratio)) * shape.tried if worth else 1.0
        variance = products.power * (1 - share) / m
        smallest = float(np.sqrt((penalty + settings.MIN_DELTA_BIC) * variance) / size)
        scores.append(Score(shape, weights, float(ratio), float(ratio - penalty), p, smallest, int(columns[0])))
    scores.sort(key=lambda s: -s.delta_bic)
    return tuple(scores), overflowed


def _penalty(shape: Shape, rows: int) -> float:
    return shape.free * np.log(rows) + 2 * np.log(shape.tried)


def allowed(shape: Shape, weights: np.ndarray) -> bool:
    """Whether the effect can be of this sign: some amplitude is left inside its physical bounds."""
    lower, upper, amplitudes = limits(type(shape.effect))
    values = shape.effect.combine(shape.values, weights)
    if isinstance(shape.effect, ParameterError):
        # A law may be needless: then its size is wrong by all of it.
        return bool(np.any(values != 0.0))
    return not len(amplitudes) or bool(np.any((lower < values)[amplitudes] & (values < upper)[amplitudes]))


def screen(
    e: Float[np.ndarray, "samples outputs"],
    J: Float[np.ndarray, "samples outputs parameters"],
    data: Data,
    features: Features,
    system,
    force: Float[np.ndarray, " inputs"],
    noise_model: NoiseModel | None = None,
    *,
    rounds: int = 3,
    picked: int = 3,
    surrogates: int = 0,
    rng: np.random.Generator | None = None,
) -> Screening:
    """Score every candidate, the noise model estimated on what is left once the best are removed.

    An effect must not be part of what the noise model is fitted to: it would be whitened away. So the noise model is
    estimated in turn with the scores, each time on the residual without sensitivities and without the best few
    responses.

    **Arguments:** `e`, `J`: free-run residual and its sensitivities; `data`; `features`; `system`, `force`: for
    `estimate_noise_model`; `noise_model` to begin with, default white noise; `rounds` of it; `picked`: how many are
    removed at most; `surrogates`: noise residuals that calibrate the gate; `rng` for them.

    **Returns:** a `Screening`.
    """
    noise = white_noise_model(e, data.kept, system)
    products = Products(noise, e, J, features.responses, data.kept)
    white, overflowed = score_all(products, features)
    first = white
    if noise_model is not None:
        products = Products(noise_model, e, J, features.responses, data.kept)
        first, _ = score_all(products, features)
    noise_model = noise if noise_model is None else noise_model
    few, scores, clean = features, first, e
    for turn in range(rounds):
        clean = without(e, J, few, products, scores, data.kept, noise_model.level, picked)
        renewed = estimate_noise_model(clean, data.kept, system, force)
        if (
            turn
            and renewed.ratio == noise_model.ratio
            and np.allclose(renewed.coefficients, noise_model.coefficients, atol=0.01)
        ):
            break
        noise_model = renewed
        if turn < rounds - 1:
            # On the way only those that may be removed are scored.
            few = features.only(first[:CONTENDERS]) if few is features else few
            products = Products(noise_model, e, J, few.responses, data.kept)
            scores, _ = score_all(products, few)
    products = Products(noise_model, e, J, features.responses, data.kept)
    scores, overflowed = score_all(products, features)
    threshold = settings.MIN_DELTA_BIC
    if surrogates and scores and settings.MIN_DELTA_BIC < scores[0].delta_bic < settings.CLEAR_DELTA_BIC:
        threshold = max(settings.MIN_DELTA_BIC, _calibrated(products, scores, surrogates, rng))
    return Screening(scores, noise_model, products.rows, clean, threshold, overflowed, white)


def without(
    e,
    J,
    features: Features,
    products: Products,
    scores,
    kept: Bool[np.ndarray, "samples outputs"],
    level: Float[np.ndarray, " outputs"],
    picked: int,
) -> Float[np.ndarray, "samples outputs"]:
    """The residual without sensitivities and without the best responses, chosen one after the other."""
    pool = [s for s in scores if s.delta_bic > settings.MIN_DELTA_BIC][:60]
    # Columns of the pool, and where each of its shapes has its own among them.
    columns = np.concatenate([np.arange(s.column, s.column + len(s.shape.basis)) for s in pool]) if pool else []
    ends = np.cumsum([len(s.shape.basis) for s in pool])
    here = products.among(np.asarray(columns, int))
    chosen, names = [], set()
    while len(chosen) < picked:
        best = None
        for s, end in zip(pool, ends):
            if (s.shape.effect.id, s.shape.place.name) in names:
                continue
            own = np.arange(end - len(s.shape.basis), end)
            own = own[here.visible(own)]
            if not len(own):
                continue
            share, _ = here.taken(own)
            gain = -here.rows * np.log1p(-share) - _penalty(s.shape, here.rows)
            if gain > settings.MIN_DELTA_BIC and (best is None or gain > best[0]):
                best = gain, s, own
        if best is None:
            break
        names.add((best[1].shape.effect.id, best[1].shape.place.name))
        chosen.append(columns[best[2]])
        here = here.without(best[2])
    taken = np.concatenate(chosen) if chosen else np.zeros(0, int)
    head = min(SETTLING, len(kept) // 4)
    first = [np.moveaxis(J[:head], 2, 0), features.responses[taken][:, :head], e[None, :head]]
    first = np.concatenate(first) * kept[:head] / level
    weights, states = products.weights(taken, first.reshape(len(first), -1)), J.shape[2]
    explained = J @ weights[:states] + np.tensordot(weights[states:], features.responses[taken], 1)
    return np.where(kept, e - explained, 0.0)


def _calibrated(products: Products, scores, surrogates: int, rng) -> float:
    """99 % quantile of the best ΔBIC over residuals of nothing but noise."""
    rng = np.random.default_rng(0) if rng is None else rng
    noise = rng.standard_normal((surrogates, products.X.shape[1]))
    target = products.with_noise(noise)
    best = np.full(surrogates, -np.inf)
    for s in scores:
        columns = np.arange(s.column, s.column + len(s.shape.basis))
        inverse = pseudo_inverse(products.among(columns).matrix, 1e-10)
        taken = np.einsum("is,ij,js->s", target[columns], inverse, target[columns])
        share = np.minimum(taken / products.rows, 1 - 1e-12)
        best = np.maximum(best, -products.rows * np.log1p(-share) - _penalty(s.shape, products.rows))
    return float(np.quantile(best, 0.99))
