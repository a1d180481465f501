"""Parameters of a physical structure from a transfer function, and every other set that gives the same one.

Least squares from many starts, along a path of contours: on the positive real axis of s a mechanical transfer function
has neither resonances nor antiresonances and the parameters are found from afar; then the contour is turned towards the
imaginary axis, where they are found exactly. Ends that fit equally well and differ are the discrete ambiguities.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float

from .transfer import Family, contour

STARTS = 32
"""Random starts, side by side."""

ANGLES = (0.0, 0.9, 1.35, np.pi / 2)
"""The path of contours [rad]."""

STEPS = (60, 40, 40, 80)
"""Most steps on each."""

ALIKE = 1e-2
"""Largest relative difference of parameters that counts as the same end."""

NO_DAMPING = 1e-3
"""Damping, relative to the critical one of the largest mass and spring, below which changes are changes of nothing."""

EQUAL = 1e-3
"""Rise of the mean squared relative error over the best that counts as equally good."""

EXACT = 1e-12
"""The same where the target has hardly any noise."""

ROUNDS = 3
"""Times that random starts are drawn where none comes near."""

GOOD = 1e-5
"""Mean squared relative error that is near."""

MOST_ENDS = 12
"""Different ends that are carried from one contour to the next."""

LARGEST = 46.0
"""Most that the logarithm of a parameter may be away from its start: what is not there at all goes to zero."""


@dataclass(frozen=True)
class Matched:
    """Ends that fit equally well, the best first: `parameters`, one row an end; `errors`: their mean squares, infinite
    where no start led anywhere."""

    parameters: Float[np.ndarray, "ends parameters"]
    errors: Float[np.ndarray, " ends"]


def matched(
    family: Family,
    target,
    rates: Float[np.ndarray, " modes"],
    known: Float[np.ndarray, " parameters"],
    *,
    starts: int = STARTS,
    seed: int = 0,
    first: Float[np.ndarray, " parameters"] | None = None,
) -> Matched:
    """Parameters of a family whose transfer function is nearest to a given one.

    **Arguments:** `family`; `target`: function of points s (points), the transfer function there (points × outputs ×
    inputs); `rates`: sizes of its poles; `known`: parameters that are given, NaN for the others; `starts`: how many;
    `seed` of the random starts; `first`: a start of one's own, besides.

    **Returns:** a `Matched`.
    """
    free = ~np.isfinite(known)
    x, cost, before = np.zeros((0, int(free.sum()))), np.zeros(0), np.inf
    for k in range(ROUNDS):
        begun, fixed = _starts(family, target, rates, known, starts, seed + k, first)
        for angle, steps in zip(ANGLES, STEPS):
            s = contour(rates, angle)
            begun, error = _descend(family, s, target(s), begun, fixed, free, steps)
            keep = _distinct(_parameters(begun, fixed, free), error, family)
            begun, error = begun[keep], error[keep]
        x, cost = np.concatenate([x, begun]), np.concatenate([cost, error])
        keep = _distinct(_parameters(x, fixed, free), cost, family)
        x, cost = x[keep], cost[keep]
        # Noise of the target leaves an error, too: then the same end comes again.
        if cost[0] < GOOD or (k and cost[0] > 0.99 * before):
            break
        before = cost[0]
    good = np.isfinite(cost) & (cost <= cost[0] * (1 + EQUAL) + EXACT)
    good[0] = True
    return Matched(_parameters(x[good], fixed, free), cost[good])


def _distinct(theta: Float[np.ndarray, "starts parameters"], cost, family: Family) -> list[int]:
    """Positions of the best ends, no two of them the same, best first."""
    kept: list[int] = []
    for k in np.argsort(cost):
        if len(kept) == MOST_ENDS:
            break
        if not kept or (np.isfinite(cost[k]) and not any(alike(theta[k], theta[other], family) for other in kept)):
            kept.append(int(k))
    return kept


def alike(a: np.ndarray, b: np.ndarray, family: Family) -> bool:
    """Whether two sets of parameters are the same; one that hardly matters beside others does not count."""
    size = np.maximum(a, b)
    largest = np.array([np.max(size[family.powers == power], initial=0.0) for power in (0, 1, 2)])
    # A damper matters beside what masses and springs make of it, too: alone of its kind it may go to zero.
    floor = 1e-2 * largest
    floor[1] = max(floor[1], NO_DAMPING * np.sqrt(largest[0] * largest[2]))
    return bool(np.all(np.abs(a - b) <= ALIKE * np.maximum(size, floor[family.powers])))


def _parameters(x, fixed, free):
    theta = np.broadcast_to(fixed, (len(x), len(fixed))).copy()
    theta[:, free] = np.exp(x)
    return theta


def _starts(family: Family, target, rates, known, starts, seed, first):
    rng = np.random.default_rng(seed)
    free = ~np.isfinite(known)
    fixed = np.where(free, 0.0, known)
    low, high = np.log(np.min(rates[rates > 1e-3 * np.max(rates)])), np.log(np.max(rates))
    rate = np.exp(rng.uniform(low, high, (starts, len(known))))
    ratio = np.exp(rng.uniform(np.log(0.003), np.log(0.2), (starts, len(known))))
    spread = np.exp(rng.normal(0.0, 0.7, (starts, len(known))))
    given = known[(family.powers == 2) & ~free]
    unit = np.exp(np.mean(np.log(given))) if len(given) else 1.0
    theta = unit * spread * np.select([family.powers == 2, family.powers == 1], [1.0, ratio * rate], rate**2)
    theta = np.where(free, theta, fixed)
    if first is not None:
        floor = 1e-6 * np.array([max(np.max(first[family.powers == k], initial=0.0), 1e-300) for k in (0, 1, 2)])
        theta = np.concatenate([np.where(free, np.maximum(first, floor[family.powers]), fixed)[None], theta])
    if free.all() and np.any(family.powers == 2):
        # One common factor of all parameters is the size of the response.
        s = contour(rates, 0.0)
        with np.errstate(all="ignore"):
            H, wanted = family.response(theta, s)[0], target(s)
            off = np.nanmean(np.log(np.abs(H) / np.abs(wanted)), axis=(1, 2, 3))
        theta = theta * np.exp(np.where(np.isfinite(off), off, 0.0))[:, None]
    return np.log(theta[:, free]), fixed


def _descend(
    family: Family, s, wanted: Complex[np.ndarray, "..."], x, fixed, free: Bool[np.ndarray, " parameters"], steps: int
):
    """Levenberg-Marquardt in the logarithms of the free parameters, all starts side by side."""
    size = np.abs(wanted)
    level = np.sqrt(np.mean(size**2, axis=0, keepdims=True))
    weight = 1 / np.sqrt(size**2 + (1e-4 * level) ** 2 + np.finfo(float).tiny)
    begun = x.copy()

    def errors(x, slopes):
        theta = _parameters(x, fixed, free)
        with np.errstate(all="ignore"):
            try:
                H, dH = family.response(theta, s, slopes=slopes)
            except np.linalg.LinAlgError:
                H, dH = np.full((len(x), *wanted.shape), np.nan + 0j), None
        e = ((H - wanted) * weight).reshape(len(x), -1)
        e = np.concatenate([e.real, e.imag], axis=1)
        if dH is None:
            return e, None
        J = dH[..., free] * theta[:, None, None, None, free] * weight[..., None]
        J = J.reshape(len(x), -1, x.shape[1])
        return e, np.concatenate([J.real, J.imag], axis=1)

    def squares(e):
        return np.where(np.all(np.isfinite(e), axis=1), np.mean(np.nan_to_num(e) ** 2, axis=1), np.inf)

    e, J = errors(x, True)
    cost = squares(e)
    if J is None:
        return x, cost
    damping = np.full(len(x), 1e-2)
    eye = np.eye(x.shape[1])
    for _ in range(steps):
        J, clean = np.nan_to_num(J), np.nan_to_num(e)
        H = np.einsum("nki,nkj->nij", J, J)
        g = np.einsum("nki,nk->ni", J, clean)
        scale = np.maximum(np.einsum("nii->ni", H), 1e-12 * np.max(H, axis=(1, 2))[:, None] + 1e-300)
        step = -np.linalg.solve(H + (damping[:, None] * scale)[:, :, None] * eye + 1e-300 * eye, g[:, :, None])[..., 0]
        trial = np.clip(x + np.clip(np.nan_to_num(step), -2.0, 2.0), begun - LARGEST, begun + LARGEST)
        e_there, J_there = errors(trial, True)
        cost_there = squares(e_there)
        better = cost_there < cost
        settled = np.all(~better | (cost - cost_there <= 1e-9 * cost)) and np.all(damping[~better] > 1e3)
        x = np.where(better[:, None], trial, x)
        e = np.where(better[:, None], e_there, e)
        if J_there is not None:
            J = np.where(better[:, None, None], J_there, J)
        cost = np.where(better, cost_there, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 4), 1e-12, 1e6)
        if settled:
            break
    return x, cost
