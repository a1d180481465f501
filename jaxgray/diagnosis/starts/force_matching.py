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
from ..estimation.gauss_newton import refit
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
    last, found = (len(best.fit.candidate.terms) - 1,), []
    for name in sorted(scores):
        here = list(scores[name].values())
        starts = imitating(context, best.fit.candidate, last, [score.shape for score in here])
        found += [[(here[start.number], start) for start in starts]] if starts else []
    near = sorted(found, key=lambda starts: starts[0][1].left)[:NEARBY]
    ends = side_by_side(lambda starts: _refit_from(context, best, starts), near)
    rejected += [end for end in ends if isinstance(end, Rejected)]
    return [end for end in ends if isinstance(end, Attempt)]


@dataclass(frozen=True)
class Start:
    """What a shape of a law leaves of the force of others, relative to what a spring and a damper do; its number among
    those that were tried; the model with it in the place of the others."""

    left: float
    number: int
    candidate: Candidate


def imitating(
    context: SearchContext, candidate: Candidate, others: tuple[int, ...], shapes: list[Shape]
) -> list[Start]:
    """Of a law's shapes that can imitate some force laws together, all along one arm, the nearest, and the one that
    differs most: the nearest may be another law, with nothing that tells them apart to go on from.

    **Arguments:** `context`; `candidate`; `others`: positions of the laws among its terms, the last of which the law
    stands for; `shapes`: of one law at one place.
    """
    data, terms = context.data[0], [candidate.terms[k] for k in others]
    plant, setup = context.simulator.plant(candidate), context.simulator.setup
    q, v = context.simulator.motion(candidate, data)
    arm, motion = np.asarray(arm_of(terms[-1], plant)), Motion(q, v, q)
    # At the coordinate, or at the input that acts there: each sees what is at its own place.
    own = [Shape(t.effect, t.place, np.array(t.values), (np.array(t.values),), shapes[0].scales, 1) for t in terms]
    target = sum(forces_of([shape], plant, motion, data)[0, : data.samples] for shape in own)
    made = forces_of(shapes, plant, motion, data)[:, : data.samples]
    plain = np.stack([q @ arm, v @ arm])[:, : data.samples]
    size = np.maximum(np.linalg.norm(plain, axis=1), 1e-300)
    bare = max(_left(plain / size[:, None], target)[0], 1e-300)
    M, D, K = (np.asarray(X) for X in setup.matrices(candidate.entries))
    line = np.outer(arm, arm)[: setup.dofs, : setup.dofs]
    starts, at = [], 0
    for number, shape in enumerate(shapes):
        columns = made[at : at + len(shape.basis)]
        at += len(columns)
        scale = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
        if not np.all(np.isfinite(columns)):
            continue
        left, weights = _left(np.concatenate([plain / size[:, None], columns / scale[:, None]]), target)
        if left < settings.MATCHED_FORCE * bare:
            stiffness, damping = weights[:2] / size
            entries = setup.entries_of(M, D + damping * line, K + stiffness * line)
            kept = [term for k, term in enumerate(candidate.terms) if k not in others[:-1]]
            kept[others[-1] - len(others) + 1] = shape.term(weights[2:] / scale)
            starts.append(
                Start(left / bare, number, dataclasses.replace(candidate, entries=entries, terms=tuple(kept)))
            )
    starts.sort(key=lambda start: start.left)
    return [starts[0], starts[-1]] if len(starts) > 1 else starts


def _left(rows: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Norm of what a least squares on some rows leaves of a target, and its weights."""
    weights = np.linalg.lstsq(rows.T, target, rcond=1e-10)[0]
    return float(np.linalg.norm(target - weights @ rows)), weights


def _refit_from(context: SearchContext, best: Attempt, starts: list[tuple[Score, Start]]) -> Attempt | Rejected | None:
    """The refit of a law from where it imitates the best one, or that it ends as another; None where far behind."""
    shape = starts[0][0].shape
    context.progress.stage(f"refitting {shape.effect.id} at {shape.place.name}")
    options = {"held": context.held, "tolerance": ROUGH}
    again = refit(context.simulator, best.fit.candidate, context.data, best.noise_model, max_steps=3, **options)
    most = criterion_of(context, best.score, best.fit if again is None else again) + settings.MAX_CRITERION_GAP
    other_law, ends = None, []
    for score, start in starts:
        fit = refit(context.simulator, start.candidate, context.data, best.noise_model, max_steps=10, **options)
        if fit is None or criterion_of(context, score, fit) > most:
            continue
        end = refit_to_convergence(context, fit)
        other_law = unresolved(end, score)
        ends += [Attempt(score, end, noise_model_of(context, end))] if other_law is None else []
    if ends:
        return by_contact(context, min(ends, key=lambda end: end.noise_model.cost))
    if other_law is None:
        return None
    why = Refusal(Reason.OTHER_LAW, other_law)
    return Rejected.of((shape.effect.id, shape.place.name), starts[0][0].delta_bic, why)
