"""Laws that were left behind, restarted where their force is nearest to that of the best law.

A strong effect takes a linear model far away: a law refitted from there may end in another optimum while one that can
imitate it finds the way. Then the law that is right begins where the other ended. What its force leaves of the other's
over the record's motion says whether it is worth a refit, and with which sizes, stiffness and damping it begins.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...mechanics.effects.base import AbstractForceEffect, Term
from ...mechanics.runs.extended import arm_of
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..estimation.context import SearchContext, noise_model_of
from ..estimation.continuation import ROUGH, refit_to_convergence
from ..estimation.gauss_newton import Refit, refit
from ..estimation.multistart import Attempt, by_contact, criterion_of, unresolved
from ..findings import Reason, Refusal, Rejected
from ..model.candidate import Candidate
from ..screening.features import Motion, Shape, forces_of
from ..screening.score_test import Score, Screening

SAME_ARM = 0.02
"""Difference of two arms, one of which may have been estimated, that is none."""

NEARBY = 3
"""Laws that are restarted at most."""


def force_matched(
    context: SearchContext,
    best: Attempt,
    tried: set[tuple[str, str]],
    tables: tuple[Screening, ...],
    rejected: list[Rejected],
) -> list[Attempt]:
    """Force laws along the arm of the best one that can imitate it, but ended far behind it: refitted from where it
    ended, those that come near.

    **Arguments:** `context`; `best`; `tried`: laws and places that ended far behind;
    `tables`: where their shapes are; `rejected`: takes those that are another law where they end.
    """
    term = best.fit.candidate.terms[-1]
    if not isinstance(term.effect, AbstractForceEffect):
        return []
    plant = context.simulator.plant(best.fit.candidate)
    scores: dict[tuple[str, str], dict[bytes, Score]] = {}
    for score in (score for table in tables for score in table.scores):
        name = score.shape.effect.id, score.shape.place.name
        nested = term.effect.id in score.shape.effect.contains or score.shape.effect.id in term.effect.contains
        if name not in tried or nested or not isinstance(score.shape.effect, AbstractForceEffect):
            continue
        arms = (arm_of(one, plant) for one in (term, Term(score.shape.effect, score.shape.place, np.zeros(0))))
        if np.allclose(*arms, atol=SAME_ARM):
            scores.setdefault(name, {}).setdefault(score.shape.values.tobytes(), score)
    found = [_imitating(context, best.fit, list(scores[name].values())) for name in sorted(scores)]
    near = sorted((starts for starts in found if starts), key=lambda starts: starts[0].left)[:NEARBY]
    ends = side_by_side(lambda starts: _refit_from(context, best, starts), near)
    rejected += [end for end in ends if isinstance(end, Rejected)]
    return [end for end in ends if isinstance(end, Attempt)]


@dataclass(frozen=True)
class _Start:
    """What a shape of a law leaves of the force of another law, relative to what a spring and a damper do; its score;
    the model with it in the other's place."""

    left: float
    score: Score
    candidate: Candidate


def _imitating(context: SearchContext, fit: Refit, scores: list[Score]) -> list[_Start]:
    """Of a law's shapes that can imitate the last term of a refit the nearest, and the one that differs most: the
    nearest may be the other law, with nothing that tells them apart to go on from."""
    data, term = context.data[0], fit.candidate.terms[-1]
    plant, setup = context.simulator.plant(fit.candidate), context.simulator.setup
    q, v = context.simulator.motion(fit.candidate, data)
    arm, motion = np.asarray(arm_of(term, plant)), Motion(q, v, q)
    own = Shape(term.effect, term.place, np.array(term.values), (np.array(term.values),), scores[0].shape.scales, 1)
    # At the coordinate, or at the input that acts there: each sees what is at its own place.
    made = [forces_of(shapes, plant, motion, data) for shapes in ([own], [score.shape for score in scores])]
    made = np.concatenate(made)[:, : data.samples]
    plain = np.stack([q @ arm, v @ arm])[:, : data.samples]
    size = np.maximum(np.linalg.norm(plain, axis=1), 1e-300)
    bare = max(_left(plain / size[:, None], made[0])[0], 1e-300)
    M, D, K = (np.asarray(X) for X in setup.matrices(fit.candidate.entries))
    line = np.outer(arm, arm)[: setup.dofs, : setup.dofs]
    starts, at = [], 1
    for score in scores:
        columns = made[at : at + len(score.shape.basis)]
        at += len(columns)
        scale = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
        if not np.all(np.isfinite(columns)):
            continue
        left, weights = _left(np.concatenate([plain / size[:, None], columns / scale[:, None]]), made[0])
        if left < settings.MATCHED_FORCE * bare:
            stiffness, damping = weights[:2] / size
            entries = setup.entries_of(M, D + damping * line, K + stiffness * line)
            terms = (*fit.candidate.terms[:-1], score.shape.term(weights[2:] / scale))
            candidate = dataclasses.replace(fit.candidate, entries=entries, terms=terms)
            starts.append(_Start(left / bare, score, candidate))
    starts.sort(key=lambda start: start.left)
    return [starts[0], starts[-1]] if len(starts) > 1 else starts


def _left(rows: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Norm of what a least squares on some rows leaves of a target, and its weights."""
    weights = np.linalg.lstsq(rows.T, target, rcond=1e-10)[0]
    return float(np.linalg.norm(target - weights @ rows)), weights


def _refit_from(context: SearchContext, best: Attempt, starts: list[_Start]) -> Attempt | Rejected | None:
    """The refit of a law from where it imitates the best one, or that it ends as another; None where far behind."""
    shape = starts[0].score.shape
    context.progress.stage(f"refitting {shape.effect.id} at {shape.place.name}")
    options = {"held": context.held, "tolerance": ROUGH}
    again = refit(context.simulator, best.fit.candidate, context.data, best.noise_model, max_steps=3, **options)
    most = criterion_of(context, best.score, best.fit if again is None else again) + settings.MAX_CRITERION_GAP
    other_law, ends = None, []
    for start in starts:
        fit = refit(context.simulator, start.candidate, context.data, best.noise_model, max_steps=10, **options)
        if fit is None or criterion_of(context, start.score, fit) > most:
            continue
        end = refit_to_convergence(context, fit)
        other_law = unresolved(end, start.score)
        ends += [Attempt(start.score, end, noise_model_of(context, end))] if other_law is None else []
    if ends:
        return by_contact(context, min(ends, key=lambda end: end.noise_model.cost))
    if other_law is None:
        return None
    why = Refusal(Reason.OTHER_LAW, other_law)
    return Rejected.of((shape.effect.id, shape.place.name), starts[0].score.delta_bic, why)
