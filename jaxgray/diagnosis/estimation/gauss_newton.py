"""Refit of everything: M, D, K over physical matrices, first states, and the parameters of all effects.

Damped Gauss-Newton on the whitened free-run error, along curved valleys to second order. Every step is a small
semidefinite least squares: M ≻ 0, D ⪰ 0, K ⪰ 0, and each bounded parameter of an effect as a block of one.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ...identification.refinement.conic import pseudo_inverse, step_inside, undetermined
from ...numerics.matrices.bounded import bounded
from ...numerics.matrices.positive import ClarabelSolver
from ..model.candidate import Candidate, Data, Setup
from ..model.parameter_vector import Layout, state_step
from ..model.reversals import decided_residual
from ..model.simulator import Simulator
from ..noise.whitening import NoiseModel
from .normal_equations import Equations

DECREMENT = 1e-2
"""Stop when a step would lower the sum of squares by less than this, in units of the noise variance."""

SLOW = 0.85
"""Ratio of a step's sums of squares above which a fit falls slowly."""

PARTS = (1.0, 0.3)
"""Shares of a step that are tried along a curved valley."""

BENT = 0.75
"""Correction for the bend, relative to the step, up to which a step is tried; twice that of the reference, since one
that fails costs a simulation and a shorter one follows."""


NOTHING = 1e-15
"""Curvature, relative to the largest, that is rounding: short of it a direction is badly determined, and says so by its
error bars."""


@dataclass(frozen=True, eq=False)
class Refit:
    """A candidate after its refit, and the evidence.

    `candidate`; `residual` e of every record (zero where missing) and `jacobian` J of the simulated outputs by the
    entries, that record's first state, and the values term by term; `covariance` of all parameters; `cost`: sum of
    squared whitened errors; `count`: output samples that count; `steps`; `converged`; `started`: `cost` at the start;
    `undetermined`: parameters that some direction moves which nothing determines, and which `covariance` leaves out;
    `undetermined_alone`: those of the laws for which that holds with M, D, K as they are.
    """

    candidate: Candidate
    residual: tuple[Float[np.ndarray, "samples outputs"], ...]
    jacobian: tuple[Float[np.ndarray, "samples outputs parameters"], ...]
    covariance: Float[np.ndarray, "parameters parameters"]
    cost: float
    count: int
    steps: int
    converged: bool
    started: float
    undetermined: Bool[np.ndarray, " parameters"]
    undetermined_alone: Bool[np.ndarray, " parameters"]


class _Step:
    """One Gauss-Newton step inside the cone and the bounds."""

    def __init__(self, setup: Setup, layout: Layout, held: np.ndarray):
        self.setup, self.layout, self.held = setup, layout, held
        bounded = np.isfinite(layout.lower)
        self.blocked = np.concatenate([np.arange(layout.entries), layout.first + np.flatnonzero(bounded)])
        self.free = np.setdiff1d(np.arange(layout.size), self.blocked)
        self.sizes = (*setup.sizes, *(1,) * int(bounded.sum()))
        self.floors = np.concatenate([setup.structure.floors(setup.dofs), layout.lower[bounded]])
        self.solver = ClarabelSolver()

    def __call__(self, theta, H, g, damping):
        """The change of the parameters; None where no step could be found."""
        own = np.diag(H)
        diagonal = np.maximum(own, 1e-14 * np.max(own))
        # In every parameter's own units: beside a mass, a spring constant of 1e10 N/m³ has next to no curvature.
        H = H + np.diag((damping + 1e-13) * np.where(own > 0, own, diagonal))
        inside, free = self.blocked, self.free
        inner = pseudo_inverse(H[np.ix_(free, free)])
        across = H[np.ix_(inside, free)] @ inner
        z = theta[inside]
        # In units of each block's size, so that the cone problem is well scaled.
        unit = np.ones(len(z))
        at = 0
        for n in self.sizes:
            count = n * (n + 1) // 2
            size = np.linalg.norm(z[at : at + count])
            spread = 1 / np.sqrt(np.max(diagonal[inside][at : at + count]))
            unit[at : at + count] = max(size, spread)
            at += count
        ends = np.cumsum([n * (n + 1) // 2 for n in self.sizes]) - 1
        reduced = (H[np.ix_(inside, inside)] - across @ H[np.ix_(free, inside)]) * unit[:, None] * unit[None, :]
        slope = (g[inside] - across @ g[free]) * unit
        here = z / unit
        reduced = (reduced + reduced.T) / 2
        held = self.held[inside]
        dz = step_inside(self.solver, reduced, slope, here, self.floors / unit[ends], self.sizes, held)
        if dz is None:
            return None
        dz = dz * unit
        dn = -inner @ (g[free] + H[np.ix_(free, inside)] @ dz)
        step = np.zeros(len(theta))
        step[inside], step[free] = dz, dn
        values = np.clip(theta + step, self._lower, self._upper)
        return values - theta if np.all(np.isfinite(values)) else None

    @property
    def _lower(self):
        return np.concatenate([np.full(self.layout.first, -np.inf), self.layout.lower])

    @property
    def _upper(self):
        return np.concatenate([np.full(self.layout.first, np.inf), self.layout.upper])


def refit(
    simulator: Simulator,
    candidate: Candidate,
    data: list[Data],
    noise_model: NoiseModel,
    *,
    held=None,
    max_steps: int = 15,
    tolerance: float = DECREMENT,
    abandon: float = np.inf,
    shapes_after: int = 0,
    last_after: int = 0,
) -> Refit | None:
    """Refit a candidate with a given noise model.

    **Arguments:** `simulator`; `candidate` to start from; `data`: the records; `noise_model`; `held`: parameters that
    do not move (all entries of the user's own model), default those of the setup; `max_steps`; `tolerance`: stop when a
    step would lower the sum of squares by less, in units of the noise variance; `abandon`: sum of squares above which,
    from the second step on, a fit that falls slowly is given up unless its next step promises to pass below;
    `shapes_after`: steps before the shape of the last term moves, not only its amplitudes; `last_after`: steps before
    anything of it moves.

    **Returns:** a `Refit`, or None where the start cannot be simulated.
    """
    setup = simulator.setup
    layout = Layout(setup, candidate)
    fixed = np.zeros(layout.size, bool)
    fixed[: layout.entries] = setup.held if held is None else held
    masks = fixed | layout.last(candidate), fixed | layout.shape_of_last(candidate), fixed
    step = _Step(setup, layout, fixed)
    equations = Equations(simulator, data, noise_model, layout)
    candidate = equations.moved_or_at_rest(candidate)
    theta, now = layout.vector(candidate), equations(candidate)
    if now is None:
        return None
    damping, steps, converged, before, started = 0.0, 0, False, np.inf, now[2]
    while steps < max_steps and damping < 1e6 and not converged:
        steps += 1
        step.held = fixed = masks[0 if steps <= last_after else 1 if steps <= shapes_after else 2]
        H, g, cost = now[0], now[1], now[2]
        free = np.where(fixed, 0.0, 1.0)
        pinned = H * free[:, None] * free[None, :] + np.diag(fixed * 1.0), g * free
        change = step(theta, *pinned, damping)
        if change is None:
            damping = max(10 * damping, 1e-3)
            continue
        full = np.where(fixed, 0.0, change)
        change = layout.limited(full, theta)
        variance = max(cost / max(now[3], 1), 1e-300)
        decrement = _decrement(change, H, g) / variance
        if not decrement > -tolerance:
            # Not a way down: where the data leave a direction open, an undamped step is all rounding.
            damping = max(10 * damping, 1e-3)
            continue
        if decrement < tolerance and fixed is not masks[2]:
            last_after, shapes_after = 0, shapes_after if fixed is masks[0] else 0
            continue
        if decrement < tolerance:
            # Damping shortens a step in a flat valley to nothing: the end is where the undamped step is short, too.
            converged = damping == 0.0 or _decrement(step(theta, *pinned, 0.0), *pinned) / variance < 10 * tolerance
            break
        # A fit that still falls fast is further from its end than its next step says.
        slow = steps > 2 and cost > SLOW * before and cost - decrement * variance > abandon
        if slow and fixed is masks[2]:
            break
        moved = layout.moved(theta, change, candidate)
        trial_candidate = layout.candidate(moved, candidate)
        trial = equations(trial_candidate)
        if (trial is None or not trial[2] <= cost) and decrement >= 10 * tolerance:
            bend = equations.bend(theta, candidate, change, now)
            bowed = None if bend is None else step(theta, pinned[0], np.where(fixed, 0.0, g - bend), damping)
            for bent in [] if bowed is None else _along(change, np.where(fixed, 0.0, bowed) - full, H):
                moved = layout.moved(theta, layout.limited(bent, theta), candidate)
                trial_candidate = layout.candidate(moved, candidate)
                trial = equations(trial_candidate)
                if trial is not None and trial[2] <= cost:
                    break
        if trial is None or not trial[2] <= cost:
            converged = damping == 0.0 and decrement < 10 * tolerance
            damping = max(10 * damping, 1e-3)
            continue
        theta, candidate, now, before = moved, trial_candidate, trial, cost
        damping = damping / 10 if damping > 1e-5 else 0.0
    H, _, cost, count, residuals, jacobians = now
    variance = cost / max(count - layout.size, 1)
    moving = ~masks[2]
    covariance = np.zeros_like(H)
    covariance[np.ix_(moving, moving)] = pseudo_inverse(H[np.ix_(moving, moving)], NOTHING) * variance
    loose = moving.copy()
    loose[moving] = undetermined(H[np.ix_(moving, moving)], NOTHING)
    laws = moving & (np.arange(layout.size) >= layout.first)
    alone = laws.copy()
    alone[laws] = undetermined(H[np.ix_(laws, laws)], NOTHING)
    return Refit(candidate, residuals, jacobians, covariance, cost, count, steps, converged, started, loose, alone)


def _decrement(change, H, g) -> float:
    """By how much a step lowers the sum of squares, to second order; infinite where none was found."""
    return np.inf if change is None else float(-(2 * g @ change + change @ H @ change))


def _along(change: np.ndarray, correction: np.ndarray, H: np.ndarray) -> list[np.ndarray]:
    """Steps along a curved valley, the whole way and a part of it, as far as the correction is small.

    **Reference:** Transtrum & Sethna, *Improvements to the Levenberg-Marquardt algorithm* (arXiv:1201.5885, 2012), §3.
    """
    scale = np.sqrt(np.maximum(np.diag(H), 0.0))
    ratio = np.linalg.norm(scale * correction) / max(np.linalg.norm(scale * change), 1e-300)
    return [share * change + share**2 * correction for share in PARTS if share * ratio <= BENT]


def with_states(simulator: Simulator, fit: Refit, data: list[Data], *, steps: int = 2) -> Refit:
    """A refit with the first states that bring the free run itself nearest to the records.

    Under a noise model with noise at the forces the innovations filter forgets the first state, which then is not
    determined by the refit; the free run needs one all the same.
    """
    candidate = fit.candidate
    first, states = len(candidate.entries), len(candidate.x0[0])
    residuals, jacobians = list(fit.residual), list(fit.jacobian)
    for k, d in enumerate(data):
        for _ in range(steps):
            e, J = residuals[k], jacobians[k]
            scale = np.sqrt(np.maximum(np.mean(e[: d.samples] ** 2, axis=0), 1e-300))
            change = state_step(e, J[:, :, first : first + states], d.kept, scale)
            x0 = tuple(x + change if j == k else x for j, x in enumerate(candidate.x0))
            trial = Candidate(candidate.entries, x0, candidate.terms)
            y, J = simulator.run_and_jacobian(trial, d, k)
            if not bounded(y, J):
                break
            new, J = decided_residual(simulator, trial, d, y, J, k)
            if not np.sum((new / scale) ** 2) < np.sum((e / scale) ** 2):
                break
            candidate, residuals[k], jacobians[k] = trial, new, J
    return dataclasses.replace(fit, candidate=candidate, residual=tuple(residuals), jacobian=tuple(jacobians))
