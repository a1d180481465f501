"""Whether the record's linear behaviour is that of M, D, K with so many coordinates, or asks for another form."""

from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float

from ...numerics.outcomes import RESULTS, ComputationError
from ...numerics.responses.filters import filtered
from .free_modes import CELLS, RivalFit, Whitened, at_poles, fit_rival, further_modes, poles_of

SIGNIFICANCE = 1e-3

HIGHEST_AR = 40

RINGING = 1.25
"""By how much more than white noise inputs that have nothing to do with a residual explain of it where noise enters at
the forces."""

MOST = 0.5
"""Share of the residual from which a rival explains more of it than noise at the forces could pass for."""

SHIFTS = (0.13, 0.24, 0.37, 0.5, 0.63, 0.76, 0.87)
"""Shares of the record by which its inputs are shifted until they have nothing to do with the residual."""

ROUNDING = 1e-9
"""Residual, relative to the output, below which nothing is asked: it is rounding."""


@dataclass(frozen=True)
class StructureTest:
    """Whether a linear model with more freedom than M, D, K explains more of the record.

    `statistic` and `p_value`: F-test against the rival that says most; `explained_percent`: share of the residual's
    power that it explains; `fits`: whether M, D, K is accepted; `modes`: how many modes that rival has.
    """

    statistic: float
    p_value: float
    explained_percent: float
    fits: bool
    modes: int


def structure_test(
    y: Float[np.ndarray, "samples outputs"],
    residual: Float[np.ndarray, "samples outputs"],
    jacobian: Float[np.ndarray, "samples outputs parameters"],
    u: Float[np.ndarray, "samples inputs"],
    A: Float[np.ndarray, "states states"],
    *,
    direct: bool,
    significance: float = SIGNIFICANCE,
) -> StructureTest:
    """Likelihood-ratio test of M, D, K against free residues at as many modes, and at one more.

    Both rivals start from the model's poles, the second also where one more mode explains most of what is left, and
    are refined. What they leave is the noise, so that its colour, by which everything is whitened, is not confounded
    with the misfit. Under the null no further mode exists: its chance of fitting noise at one of many frequencies
    is allowed for by Bonferroni's inequality over the grid that it starts from.

    **Arguments:** `y`: measured, missing samples NaN; `residual` of the free run; `jacobian` of the outputs by all
    estimated parameters; `u`; `A`: continuous system matrix, time in samples; `direct`: whether inputs reach outputs at
    once; `significance`.

    **Returns:** a `StructureTest`.

    **Raises:** `ComputationError` for a free run that overflows.

    **Reference:** Ljung, *System Identification*, §16.4; Davies, Biometrika 74 (1987) 33-43, on parameters that only
    the alternative has.
    """
    dofs = len(A) // 2
    if np.any(np.isinf(residual)) or not np.all(np.any(np.isfinite(residual), axis=0)):
        raise ComputationError(RESULTS.nonfinite, stage="assessing", detail="the free run overflows")
    size = np.nanstd(residual, axis=0)
    if np.all(size <= ROUNDING * np.nanstd(y, axis=0)):
        return StructureTest(0.0, 1.0, 0.0, True, dofs)
    size = np.maximum(size, ROUNDING * np.nanstd(y, axis=0))
    parameters = int(np.sum(np.any(jacobian != 0, axis=(0, 1))))
    starts = [poles_of(A)]
    coefficients = [np.ones(1)] * y.shape[1]
    ringing = None
    while True:
        data = Whitened.of(y, u, coefficients, size, direct=direct)
        left = _left(residual, jacobian, coefficients, size)
        own = fit_rival(starts[0], data)
        judged = [_judge(own, data, left, parameters, 1, ringing or 1.0)]
        if data.count > 4 * own.parameters:
            extra = starts[1:] or [np.concatenate([own.poles, new[None]]) for new in further_modes(own, data)]
            further = min((fit_rival(poles, data) for poles in extra), key=lambda fit: fit.cost)
            judged.append(_judge(further, data, left, parameters, CELLS, ringing or 1.0))
        best = min(judged, key=lambda found: (found[0], -found[1]))
        rest = judged[-1][2].residual.T
        if ringing is None:
            explained = 1.0 - judged[-1][2].cost / max(left, 1e-300)
            ringing = _ringing(poles_of(A), residual, u, direct) if explained < MOST else 1.0
            if ringing > RINGING:
                # What the residual's own colour hides is lost, but noise at the forces is not taken for a misfit.
                coefficients, size = _colour(residual)
                continue
            ringing = 1.0
        colours = [ar_by_bic(row) for row in rest.T] if len(coefficients[0]) == 1 else []
        if all(len(c) == 1 for c in colours):
            break
        coefficients = [c if len(c) > 1 else np.array([1.0, 0.0]) for c in colours]
        size = size * np.std([filtered(c, [1.0], row) for c, row in zip(coefficients, rest.T)], axis=1)
        starts = [own.poles, *(found[2].poles for found in judged[1:])]
    p_value, statistic, fit = best
    p_value = min(1.0, len(judged) * p_value)
    share = 100 * max(left - fit.cost, 0.0) / max(left, 1e-300)
    return StructureTest(statistic, p_value, share, p_value > significance, len(fit.poles))


def _left(residual, jacobian, coefficients, size) -> float:
    """What M, D, K leave of the whitened residual at best, to first order."""
    kept = np.isfinite(residual).T
    columns = np.concatenate([jacobian, np.nan_to_num(residual)[:, :, None]], axis=2)
    rows = [filtered(c, [1.0], columns[:, k].T) * kept[k] / size[k] for k, c in enumerate(coefficients)]
    table = np.concatenate(rows, axis=1)
    norm = np.linalg.norm(table[:-1], axis=1)
    table[:-1] /= np.where(norm > 0, norm, 1.0)[:, None]
    values, vectors = np.linalg.eigh(table[:-1] @ table[:-1].T)
    good = values > 1e-11 * values[-1]
    along = vectors[:, good].T @ (table[:-1] @ table[-1]) / np.sqrt(values[good])
    return float(table[-1] @ table[-1] - along @ along)


def _judge(
    fit: RivalFit, data: Whitened, left: float, parameters: int, looks: int, ringing: float
) -> tuple[float, float, RivalFit]:
    """Probability of so good a rival by chance among so many looks, the statistic, and the rival."""
    free = max(fit.parameters - parameters, 1)
    rest = max(data.count - fit.parameters, 1.0)
    statistic = max(left - fit.cost, 0.0) / free / max(fit.cost / rest, 1e-300) / ringing
    return min(1.0, looks * float(scipy.special.fdtrc(free, rest, statistic))), float(statistic), fit


def _colour(residual) -> tuple[list, np.ndarray]:
    """AR coefficients of every output's residual, and the size of its innovations."""
    e = np.nan_to_num(residual - np.nanmean(residual, axis=0))
    colour = [ar_by_bic(x) for x in e.T]
    colour = [c if len(c) > 1 else np.array([1.0, 0.0]) for c in colour]
    size = np.array([np.std(filtered(c, [1.0], x)) for c, x in zip(colour, e.T)])
    return colour, np.where(size > 0, size, 1.0)


def _ringing(poles, residual, u, direct: bool) -> float:
    """How much more of a residual, its own colour taken out, is explained by inputs that have nothing to do
    with it than would be of white noise.

    The record's own inputs, shifted in time, drive the model's modes. Noise at the forces rings at the same modes and
    passes for a response to anything; white noise and coloured noise of sensors give 1.
    """
    colour, size = _colour(residual)
    centred = residual - np.nanmean(residual, axis=0)
    shares = []
    for part in SHIFTS:
        data = Whitened.of(centred, np.roll(u, int(part * len(u)), axis=0), colour, size, direct=direct)
        placebo = at_poles(poles, data)
        taken = float(np.sum(data.y**2)) - placebo.cost
        noise = placebo.cost / max(data.count - placebo.parameters, 1.0)
        shares.append(taken / max(noise, 1e-300) / max(placebo.parameters - poles.size, 1))
    return float(np.mean(shares))


def coloured_cost(e: Float[np.ndarray, " samples"]) -> float:
    """−2 ln L of a residual under the colour that it has itself, but for a constant."""
    e = e - e.mean()
    return float(len(e) * np.log(max(float(np.mean(filtered(ar_by_bic(e), [1.0], e) ** 2)), 1e-300)))


def ar_by_bic(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " coefficients"]:
    """1, −a_1, … of the AR model that BIC chooses, by Levinson's recursion; 1 alone for white noise."""
    n = len(x)
    r = np.array([x[lag:] @ x[: n - lag] / n for lag in range(min(HIGHEST_AR, n // 8) + 1)])
    if not r[0] > 0:
        return np.ones(1)
    a, power = np.ones(1), r[0]
    best, chosen = n * np.log(power), a
    for order in range(1, len(r)):
        reflection = -(a @ r[order:0:-1]) / power
        a = np.concatenate([a, [0.0]])
        a = a + reflection * a[::-1]
        power = power * (1 - reflection**2)
        if not power > 0:
            break
        criterion = n * np.log(power) + order * np.log(n)
        if criterion < best:
            best, chosen = criterion, a
    return chosen
