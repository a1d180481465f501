"""Inner products of sensitivities, residual and responses through one noise model, sensitivities taken out."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse
from ..noise.whitening import NoiseModel, counted

DEPENDENT = 1e-9
"""Share of a response's power off the model's sensitivities below which the record cannot show it."""

_NEGLIGIBLE = 1e-13
"""Share of all below which a direction of the sensitivities is none."""


@dataclass(frozen=True)
class Dense:
    """Products among a few responses: `matrix` of the responses and `target` with the residual, both off the span of
    the sensitivities; `power` of the residual there (r0); `before`: power of the responses as they were; `rows` (m).
    """

    matrix: Float[np.ndarray, "columns columns"]
    target: Float[np.ndarray, " columns"]
    power: float
    before: Float[np.ndarray, " columns"]
    rows: int

    def visible(self, columns) -> np.ndarray:
        """Which of some responses the record can show."""
        return np.diag(self.matrix)[columns] > DEPENDENT * np.maximum(self.before[columns], 1e-300)

    def taken(self, columns) -> tuple[float, Float[np.ndarray, " columns"]]:
        """Share of the residual's power that some responses explain, and their weights."""
        if len(columns) == 1:
            power = self.matrix[columns[0], columns[0]]
            weights = self.target[columns] / power if power > 0 else np.zeros(1)
        else:
            weights = pseudo_inverse(self.matrix[np.ix_(columns, columns)], 1e-10) @ self.target[columns]
        return min(max(float(self.target[columns] @ weights) / self.power, 0.0), 1 - 1e-12), weights

    def without(self, columns) -> "Dense":
        """The same with some responses taken out as well."""
        inverse = pseudo_inverse(self.matrix[np.ix_(columns, columns)])
        across = self.matrix[:, columns] @ inverse
        return Dense(
            self.matrix - across @ self.matrix[columns],
            self.target - across @ self.target[columns],
            self.power - float(self.target[columns] @ inverse @ self.target[columns]),
            self.before,
            self.rows,
        )


class Alone(NamedTuple):
    """What every response does by itself: whether the record can show it; share of the residual's power that it
    explains, and its weight; its `size` off the sensitivities."""

    visible: Bool[np.ndarray, " columns"]
    share: Float[np.ndarray, " columns"]
    weights: Float[np.ndarray, " columns"]
    size: Float[np.ndarray, " columns"]


class Products:
    """All responses through one noise model, kept as rows so that products are taken only where they are asked for.

    **Arguments:** `noise_model`; `e`: residual, `J`: its sensitivities; `responses`; `kept`: what was measured.

    `rows`: whitened samples that count (m); `power` of the residual off the sensitivities (r0); `finite`: which
    responses are.
    """

    def __init__(
        self,
        noise_model: NoiseModel,
        e: Float[np.ndarray, "samples outputs"],
        J: Float[np.ndarray, "samples outputs parameters"],
        responses: Float[np.ndarray, "columns samples outputs"],
        kept: Bool[np.ndarray, "samples outputs"],
    ):
        used = counted(kept)
        self.rows = int(used.sum())

        def white(X):
            return noise_model.whiten_rows(X, kept, used).reshape(len(X), kept.size)

        self.model = white(np.moveaxis(np.concatenate([J, e[:, :, None]], axis=2), 2, 0))
        self.finite = np.isfinite(responses.sum(axis=(1, 2)))
        self.X = white(responses if self.finite.all() else np.where(self.finite[:, None, None], responses, 0.0))
        self.before = np.einsum("km,km->k", self.X, self.X)
        self.finite &= np.isfinite(self.before)
        self.X[~self.finite], self.before[~self.finite] = 0.0, 0.0
        S, e = self.model[:-1], self.model[-1]
        scale = np.sqrt(np.maximum(np.einsum("km,km->k", S, S), 1e-300))
        values, vectors = np.linalg.eigh((S @ S.T) / scale[:, None] / scale[None, :])
        strong = values > _NEGLIGIBLE * len(values) * np.max(values, initial=1e-300)
        self.basis = (vectors[:, strong] / np.sqrt(values[strong])).T / scale @ S
        off = e - (self.basis @ e) @ self.basis
        self.power = float(off @ off)
        both = self.X @ np.concatenate([self.basis, off[None]]).T
        self.inside, self.target = both[:, :-1], both[:, -1]

    def among(self, columns) -> Dense:
        """Products among some responses."""
        inside, before = self.inside[columns], self.before[columns]
        if len(before) == 1:
            products = before[:, None]
        else:
            X = self.X[columns]
            products = X @ X.T
        return Dense(products - inside @ inside.T, self.target[columns], self.power, before, self.rows)

    def one_by_one(self) -> Alone:
        """Every response by itself."""
        power = self.before - np.einsum("ki,ki->k", self.inside, self.inside)
        visible = power > DEPENDENT * np.maximum(self.before, 1e-300)
        weights = np.divide(self.target, power, out=np.zeros_like(power), where=visible)
        share = np.clip(self.target * weights / self.power, 0.0, 1 - 1e-12)
        return Alone(visible, share, weights, np.sqrt(np.maximum(power, 0.0)))

    def with_noise(self, noise: Float[np.ndarray, "surrogates whitened"]) -> Float[np.ndarray, "columns surrogates"]:
        """Products of the responses with residuals of white noise, off the sensitivities."""
        return self.X @ noise.T - self.inside @ (self.basis @ noise.T)

    def weights(self, columns, first: Float[np.ndarray, "all head"]) -> Float[np.ndarray, " all"]:
        """Least-squares weights of the sensitivities and some responses, in this order, for the residual.

        **Arguments:** `columns`: of the responses; `first`: the same as they are over the first samples, in units of
        the noise, the residual last; a noise model with noise at the forces leaves a first state open.
        """
        white = np.concatenate([self.model[:-1], self.X[columns], self.model[-1:]])
        table = np.concatenate([white, first], axis=1)
        table, e = table[:-1], table[-1]
        scale = np.sqrt(np.einsum("km,km->k", table, table))
        scale = np.where(scale > 0, scale, 1.0)
        gram = (table @ table.T) / scale[:, None] / scale[None, :]
        return pseudo_inverse(gram) @ (table @ e / scale) / scale
