"""Laws that alter a matrix over time, begun where linear models fit every window of the record.

Where a spring changes, the linear model that is nearest to the whole record is out of phase with it before the change
and after, and no score about it tells the place or the moment. Over a few periods no run loses phase: windows
have linear models of their own, whose natural frequencies show the moment. What a law at a place explains of them is
then refitted to some of the windows together,

    min Σ_w ‖y_w − ŷ(θ + g_w α d, x0_w)‖²,

where d is what a unit of the law does to the entries θ, and g_w how much of it acts in a window.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...identification.refinement.conic import pseudo_inverse
from ...mechanics.effects.base import AbstractEffect, Place, Term, onset_of
from ...mechanics.runs.extended import arm_along
from ...numerics.matrices.bounded import bounded
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import unresolved
from ..estimation.normal_equations import Equations
from ..model.candidate import Candidate, Data
from ..model.free_run import overall
from ..model.parameter_vector import Layout
from ..model.simulator import natural_frequencies_hz
from ..noise.floor import residual_rms
from ..noise.whitening import NoiseModel, white_noise_model
from ..screening.linearization import Stage
from ..screening.score_test import Score, Screening
from ..screening.shortlist import begun_at
from .multiple_shooting import RIGID, WINDOWS, long_enough, squares_left

STEPS = 25
"""Of the refit of a window, and of the first refit of a law."""

TOGETHER = 4
"""Windows that a law without a moment is refitted to together."""

BEGUN = 3
"""Laws that are refitted to the whole record, at most."""

FAR = 4.0
"""Squares left in a window, relative to the least of all, from which it is fitted again."""

BETTER = 0.9
"""Squares left in a window, relative to those before, from which its neighbours are fitted again from it."""

CLEAR = 2
"""Windows left out on either side of a change."""

FUSIONS = 2
"""Steps in which the entries of windows become those of one model with a law."""

MOMENTS = 64
"""Moments that a change is tried at, over as many windows on both sides of it."""


@dataclass(frozen=True)
class _Window:
    """A linear model of one window: `data`; `entries` and first state `x0`, with the values of `terms` found before;
    natural frequencies `hz`; the sample where it begins; the squares that the whole record's model leaves there
    (`before`) and that are `left`."""

    data: Data
    begin: int
    entries: Float[np.ndarray, " entries"]
    x0: Float[np.ndarray, " states"]
    terms: tuple[Term, ...]
    hz: Float[np.ndarray, " modes"]
    before: float
    left: float

    @property
    def middle(self) -> float:
        """Sample at its middle."""
        return self.begin + self.data.samples / 2


@dataclass(frozen=True)
class _Change:
    """A law at a place as the windows show it: `entries` and first state `x0` without it, its `size`, the middle
    [samples] of the windows around its moment (None where it has none), and the share of the squared residual that it
    leaves in so many `rows` of the windows."""

    score: Score
    entries: Float[np.ndarray, " entries"]
    x0: Float[np.ndarray, " states"]
    size: float
    around: tuple[float, float] | None
    left: float
    rows: int


def changes_over_time(
    context: SearchContext, stage: Stage, screening: Screening
) -> dict[tuple[str, str], tuple[Score, Refit]]:
    """Laws that alter a matrix over time, refitted from what the windows of the first record show; none where linear
    models of the windows leave more than a little of the residual, or no such law does.

    **Arguments:** `context`; `stage`; `screening`: of that stage.
    """
    laws = [] if np.all(context.held) else _laws(screening)
    lasting = not any(term.effect.tied_to_clock for term in stage.candidate.terms)
    data = context.data[0]
    size = data.samples // WINDOWS
    hz, numbers = natural_frequencies_hz(stage.plant), len(stage.candidate.entries) + len(stage.candidate.x0[0])
    if not laws or not lasting or not long_enough(hz, data, size, numbers):
        return {}
    # The ends alone first: where another law than a change is missing, no linear model fits them much better.
    noise_model = _level(stage, data)
    ends = side_by_side(lambda begin: _fitted(context, stage, noise_model, begin, size), (0, data.samples - size))
    if any(window is None for window in ends):
        return {}
    ends = _from_neighbours(context, stage, noise_model, ends)
    if not _share(ends) < settings.WINDOW_SHARE:
        return {}
    context.progress.stage("fitting windows of the record")
    begins = np.arange(max(size // 2, 1), data.samples - size, max(size // 2, 1))
    inner = side_by_side(lambda begin: _fitted(context, stage, noise_model, int(begin), size), begins)
    windows = [ends[0], *(window for window in inner if window is not None), ends[1]]
    windows = _from_neighbours(context, stage, noise_model, windows)
    k = moment_of(np.array([window.hz for window in windows]))
    # Clear of the change, also where it was taken for the next window's.
    sides = windows[: max(k - CLEAR, 1)], windows[min(k + CLEAR, len(windows) - 1) :]
    if not all(_alike(context, noise_model, side) for side in sides):
        # No change at once of the linear model: these laws would be refitted in vain.
        laws = [law for law in laws if not law.shape.effect.onset]
    around = windows[k - 1].middle, windows[k].middle
    changes = side_by_side(lambda law: _read(context, noise_model, law, windows, sides, around), laws)
    near = [change for change in changes if change is not None and change.left < settings.WINDOW_SHARE]
    near = sorted(near, key=lambda change: change.left)
    near = [c for c in near if c.rows * np.log(c.left / max(near[0].left, 1e-300)) < settings.MAX_CRITERION_GAP][:BEGUN]
    refits = side_by_side(lambda change: _refitted(context, stage, noise_model, change, size), near)
    named = {(c.score.shape.effect.id, c.score.shape.place.name): end for c, end in zip(near, refits)}
    return {name: end for name, end in named.items() if end is not None}


def _laws(screening: Screening) -> list[Score]:
    """Every law that alters a matrix, once at every place."""
    found: dict[tuple[str, str], Score] = {}
    for score in (*screening.scores, *screening.white):
        if score.shape.effect.alters:
            found.setdefault((score.shape.effect.id, score.shape.place.name), score)
    return list(found.values())


def _level(stage: Stage, data: Data) -> NoiseModel:
    """White noise of every output as large as what the model of the whole record leaves there."""
    level = np.sqrt(np.sum(stage.e**2, axis=0) / np.maximum(data.kept.sum(axis=0), 1))
    level = np.maximum(level, max(1e-6 * float(level.max()), 1e-300))
    return dataclasses.replace(white_noise_model(stage.e, data.kept, stage.system), level=level, lower=np.diag(level))


def _share(windows: list[_Window]) -> float:
    """What the windows' own models leave of the squares that the whole record's model leaves in them."""
    return sum(window.left for window in windows) / max(sum(window.before for window in windows), 1e-300)


def _from_neighbours(
    context: SearchContext, stage: Stage, noise_model: NoiseModel, windows: list[_Window]
) -> list[_Window]:
    """The windows, those left with more than `FAR` times the least refitted from each neighbour that fits better as
    well; the best end counts: from a start of large phase error a refit may end in another minimum. What got better
    passes on."""
    least = FAR * min(_per_sample(window) for window in windows)
    news = set(range(len(windows)))

    def better(k: int) -> _Window:
        window = windows[k]
        near = [windows[j] for j in (k - 1, k + 1) if j in news and windows[j].left < window.left]
        again = (_fitted(context, stage, noise_model, window.begin, window.data.samples, one) for one in near)
        return min([window, *filter(None, again)], key=lambda one: one.left)

    for _ in range(len(windows)):
        late = [k for k in range(len(windows)) if _per_sample(windows[k]) > least and news & {k - 1, k + 1}]
        found = dict(zip(late, side_by_side(better, late)))
        news = {k for k, window in found.items() if window.left < BETTER * windows[k].left}
        windows = [found.get(k, window) for k, window in enumerate(windows)]
    return windows


def _per_sample(window: _Window) -> float:
    return window.left / max(int(window.data.kept.sum()), 1)


def _fitted(
    context: SearchContext,
    stage: Stage,
    noise_model: NoiseModel,
    begin: int,
    size: int,
    like: _Window | None = None,
) -> _Window | None:
    """The linear model refitted to one window, from that of the stage, or of another window; None where it cannot be
    simulated."""
    data = context.data[0]
    window, kept = data.part(begin, size, padded=True), data.kept[begin : begin + size]
    if not np.all(np.any(kept, axis=0)):
        return None
    before = float(np.sum((np.where(kept, stage.e[begin : begin + size], 0.0) / noise_model.level) ** 2))
    entries, terms = (stage.candidate.entries, stage.candidate.terms) if like is None else (like.entries, like.terms)
    begun = Candidate(entries, (np.zeros_like(stage.candidate.x0[0]),), terms)
    fit = refit(context.simulator, begun, [window], noise_model, max_steps=STEPS, tolerance=ROUGH)
    if fit is None:
        return None
    found = fit.candidate
    hz = natural_frequencies_hz(context.simulator.plant(found))
    left = float(np.sum((fit.residual[0] / noise_model.level) ** 2))
    return _Window(window, begin, found.entries, found.x0[0], found.terms, hz, before, left)


def _alike(context: SearchContext, noise_model: NoiseModel, windows: list[_Window]) -> bool:
    """Whether one linear model explains the first and the last of some windows."""
    chosen = _far_apart(windows)
    found = _together(context, noise_model, None, chosen, [0.0] * len(chosen))
    before = sum(window.before for window in chosen)
    return found is not None and found[3] < settings.WINDOW_SHARE * before


def _far_apart(windows: list[_Window]) -> list[_Window]:
    return windows if len(windows) == 1 else [windows[0], windows[-1]]


def _read(
    context: SearchContext,
    noise_model: NoiseModel,
    score: Score,
    windows: list[_Window],
    sides: tuple[list[_Window], list[_Window]],
    around: tuple[float, float],
) -> _Change | None:
    """What the windows say of one law, those on both sides of a change for one that begins at once; None where they
    say nothing."""
    effect, samples = score.shape.effect, context.data[0].samples
    if effect.onset:
        chosen = [window for side in sides for window in _far_apart(side)]
        course = [float(window.middle > sides[0][-1].middle) for window in chosen]
    else:
        chosen = [windows[k] for k in np.linspace(0, len(windows) - 1, TOGETHER).astype(int)]
        course, around = [window.middle / samples for window in chosen], None
    found = _together(context, noise_model, (effect, score.shape.place), chosen, course)
    if found is None:
        return None
    *values, left, rows = found
    return _Change(score, *values, around, left / max(sum(window.before for window in chosen), 1e-300), rows)


def moment_of(hz: Float[np.ndarray, "windows modes"]) -> int:
    """The first window after a change at once, from the natural frequencies [Hz] of all windows: each mode in units of
    its scatter from one window to the next, modes of a rigid body left out."""
    size = np.median(hz, axis=0)
    hz = hz[:, size > RIGID * size.max()]
    noise = np.median(np.abs(np.diff(hz, axis=0)), axis=0)
    z = hz / np.maximum(noise, 1e-9 * np.median(hz, axis=0))

    def scatter(k: int) -> float:
        return sum(float(np.sum(np.abs(side - np.median(side, axis=0)))) for side in (z[:k], z[k:]))

    return min(range(1, len(hz)), key=scatter)


def _together(
    context: SearchContext,
    noise_model: NoiseModel,
    law: tuple[AbstractEffect, Place] | None,
    windows: list[_Window],
    course: list[float],
) -> tuple[np.ndarray, np.ndarray, float, float, int] | None:
    """The entries, the first state of the first window, the size of a law, what is left, and of how many rows: refitted
    to some windows together by damped Gauss-Newton; None where that cannot be simulated.

    **Arguments:** `context`; `noise_model`; `law`: effect and place, None for none; `windows`; `course`: how much of
    the law acts in each.
    """
    setup, equations = context.simulator.setup, []
    for window in windows:
        layout = Layout(setup, Candidate(window.entries, (window.x0,), window.terms))
        equations.append(Equations(context.simulator, [window.data], noise_model, layout))
    entries = len(windows[0].entries)
    first = entries + len(windows[0].x0)
    moving = np.concatenate([~setup.held, [law is not None]])

    def evaluated(theta, size, states):
        d = np.zeros(entries) if law is None or not bounded(theta) else _direction(context, *law, theta)
        if d is None or not bounded(theta, size * d, *states):
            return None
        parts = zip(equations, course, states, windows)
        made = [eq(Candidate(theta + g * size * d, (x0,), window.terms)) for eq, g, x0, window in parts]
        return None if any(one is None for one in made) else (d, made, sum(one[2] for one in made))

    def refined(theta, size, states):
        now, damping = evaluated(theta, size, states), 1e-6
        for _ in range(STEPS if now is not None else 0):
            d, made, cost = now
            parts, H, gradient = [], 0.0, 0.0
            for (full, g_full, *_), g in zip(made, course):
                # By the entries and the size; the first state taken out.
                T = np.concatenate([np.eye(entries), (g * d)[:, None]], axis=1)
                inner = pseudo_inverse(full[entries:first, entries:first])
                across = T.T @ full[:entries, entries:first]
                H = H + T.T @ full[:entries, :entries] @ T - across @ inner @ across.T
                gradient = gradient + T.T @ g_full[:entries] - across @ inner @ g_full[entries:first]
                parts.append((inner, across, g_full[entries:first]))
            H, gradient = H[np.ix_(moving, moving)], gradient[moving]
            step = np.zeros(entries + 1)
            step[moving] = -pseudo_inverse(H + damping * np.diag(np.diag(H))) @ gradient
            moved = [x0 - inner @ (g0 + across.T @ step) for x0, (inner, across, g0) in zip(states, parts)]
            trial = evaluated(theta + step[:-1], size + step[-1], moved)
            if trial is None or not trial[2] <= cost:
                damping = max(10 * damping, 1e-3)
                if damping > 1e6:
                    break
                continue
            theta, size, states, damping = theta + step[:-1], size + step[-1], moved, damping / 10
            now = trial
            if cost - trial[2] < ROUGH * trial[2] / sum(one[3] for one in trial[1]):
                break
        return None if now is None else (theta, states[0], size, now[2], sum(one[3] for one in now[1]))

    # A change that takes a window out of phase is out of reach of the slope at none.
    starts = [(windows[0].entries, 0.0), _fused(context, law, windows, equations, course)]
    ends = [refined(*start, [window.x0 for window in windows]) for start in starts if start is not None]
    return min(filter(None, ends), key=lambda end: end[3], default=None)


def _fused(
    context: SearchContext,
    law: tuple[AbstractEffect, Place] | None,
    windows: list[_Window],
    equations: list[Equations],
    course: list[float],
) -> tuple[np.ndarray, float] | None:
    """The entries and the size of a law that are nearest to the windows' own entries, as far as each window determines
    them; None where one sees none."""
    setup = context.simulator.setup
    n, theta, size = len(windows[0].entries), windows[0].entries, 0.0
    seen = []
    for window, eq in zip(windows, equations):
        made = eq(Candidate(window.entries, (window.x0,), window.terms))
        if made is None:
            return None
        full, to = made[0], n + len(window.x0)
        seen.append(full[:n, :n] - full[:n, n:to] @ pseudo_inverse(full[n:to, n:to]) @ full[n:to, :n])
    moving = np.concatenate([~setup.held, [law is not None]])
    for _ in range(FUSIONS):
        d = np.zeros(n) if law is None else _direction(context, *law, theta)
        if d is None:
            return None
        H, gradient = 0.0, 0.0
        for window, share, own in zip(windows, course, seen):
            T = np.concatenate([np.eye(n), (share * d)[:, None]], axis=1)
            H = H + T.T @ own @ T
            gradient = gradient + T.T @ own @ (window.entries - theta - share * size * d)
        step = np.zeros(n + 1)
        step[moving] = pseudo_inverse(H[np.ix_(moving, moving)]) @ gradient[moving]
        theta, size = theta + step[:-1], size + step[-1]
        if not bounded(theta):
            return None
    return theta, float(size)


def _direction(context: SearchContext, effect: AbstractEffect, place: Place, entries: np.ndarray) -> np.ndarray | None:
    """What a unit of a law does to the entries, M, D, K being as they are; None where they are none."""
    setup, names = context.simulator.setup, ("mass", "damping", "stiffness")
    matrices = [np.asarray(X) for X in setup.matrices(entries)]
    if not bounded(*matrices):
        return None
    arm = np.asarray(arm_along(effect, place, np.zeros((setup.dofs, 1))))
    at = names.index(effect.alters[0])
    unit = 1e-3 * float(np.max(np.abs(matrices[at])))
    moved = [X + unit * np.outer(arm, arm) if k == at else X for k, X in enumerate(matrices)]
    return (setup.entries_of(*moved) - setup.entries_of(*matrices)) / unit


def _refitted(
    context: SearchContext, stage: Stage, noise_model: NoiseModel, change: _Change, size: int
) -> tuple[Score, Refit] | None:
    """The refit of a law from what the windows say of it; None where it is not `settings.MUCH_NEARER` to the
    whole record than the model without it, or is another law there."""
    shape = change.score.shape
    names = [parameter.name for parameter in shape.effect.parameters]
    context.progress.stage(f"refitting {shape.effect.id} at {shape.place.name} from the windows")
    values = np.array(shape.values, float)
    values[names.index(shape.effect.alters[1])] = change.size
    setup = context.simulator.setup
    # By matrices that are possible: the steps over windows know no cone.
    entries = setup.entries_of(*setup.matrices(change.entries))
    begun = Candidate(entries, (change.x0, *stage.candidate.x0[1:]))
    terms = [_term(change, values)] if change.around is None else _moments(context, change, values, size)
    tried = [begun.with_terms((*stage.candidate.terms, term)) for term in terms]
    best = min(tried, key=lambda candidate: squares_left(context, candidate, noise_model))
    options = {"held": context.held, "max_steps": STEPS, "tolerance": ROUGH}
    fit = refit(context.simulator, best, context.data, noise_model, **options)
    if fit is None:
        return None
    left, before = (residual_rms(e, context.data[0]) for e in (fit.residual[0], stage.e))
    if not overall(left, before) < settings.MUCH_NEARER:
        # Windows bend to another law, as damping does to dry friction, where the whole record does not.
        return None
    end = refit_to_convergence(context, fit)
    score = begun_at(change.score, np.array(best.terms[-1].values, float))
    return None if unresolved(end, score) else (score, end)


def _term(change: _Change, values: np.ndarray) -> Term:
    shape = change.score.shape
    return Term(shape.effect, shape.place, shape.effect.bounded(values))


def _moments(context: SearchContext, change: _Change, values: np.ndarray, size: int) -> list[Term]:
    """The law at moments around the one that the windows show."""
    data, (time, width) = context.data[0], onset_of(change.score.shape.effect)
    first, last = change.around[0] - size, change.around[1] + size
    terms = []
    for at in np.linspace(max(first, 1.0), min(last, data.samples - 1.0), MOMENTS):
        moved = values.copy()
        moved[time], moved[width] = at * data.sampling_time, data.sampling_time
        terms.append(_term(change, moved))
    return terms
