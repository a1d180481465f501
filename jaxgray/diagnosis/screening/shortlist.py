"""Which candidates are worth a refit, and from which shapes each begins."""

import dataclasses

import numpy as np

from ...mechanics.effects.base import AbstractEffect, AbstractMatrixEffect
from .. import settings
from ..model.own_laws import told_apart
from .flexible_force import FlexibleForce
from .score_test import Score, Screening, best_by_place

TRIED = 4
"""Candidates of a round up to which another place of the best is tried, too."""

LINE_START = 0.03, 0.02
"""Damping ratio and mass ratio with which a mode at a line of the residual begins."""

SAME = 0.05
"""Relative difference of estimated shape parameters up to which two starts are one."""


def shortlist(screening: Screening, closer: Screening) -> list[list[Score]]:
    """Candidates worth a refit, each with the shapes to start from: best by measured motion, then by simulated.

    First the best under white noise: the noise model that was estimated may take an effect for coloured noise.
    """
    near, far = closer.best_by_place(), screening.best_by_place()
    near_white, far_white = best_by_place(closer.white), best_by_place(screening.white)
    chosen: dict[tuple[str, str], list[Score]] = {}

    def add(ranking, count):
        ids = {told_apart(key) for key in chosen}
        for key, score in ranking.items():
            if count == 0 or score.delta_bic < settings.MIN_DELTA_BIC:
                return
            if key in chosen or told_apart(key) in ids or key[0] == FlexibleForce.id:
                continue
            ids.add(told_apart(key))
            chosen[key] = []
            count -= 1

    add(near, 3)
    for table in (far, far_white):
        add(table, 1 if chosen else 3)
    likely = (key for key, score in near_white.items() if key[0] != FlexibleForce.id)
    chosen = {key: [] for key in [*likely][:1] if near_white[key].delta_bic >= settings.MIN_DELTA_BIC} | chosen
    tables = (near, far, near_white, far_white)
    entries = [entry for table in tables for entry in table.items()]
    # A law that turns into a simpler one is only worth what it explains beyond that.
    for effect, place in [(score.shape.effect, key[1]) for key, score in entries if key in chosen]:
        for simpler in effect.contains:
            known = any((simpler, place) in table for table in tables)
            if known and (simpler, place) not in chosen:
                chosen[simpler, place] = []
    # Another place for the best effect: neighbours are easily taken for each other.
    if near:
        first = next(iter(near))
        for key, score in near.items():
            if (
                key[0] == first[0]
                and key not in chosen
                and score.delta_bic > settings.MIN_DELTA_BIC
                and len(chosen) < TRIED + 1
            ):
                chosen[key] = []
                break
    # A law that contains one of these is its refit with little more to find.
    simple = set(chosen)
    for key, score in entries:
        inside = any((simpler, key[1]) in simple for simpler in score.shape.effect.contains)
        if inside and key not in chosen and score.delta_bic > settings.MIN_DELTA_BIC:
            chosen[key] = []
    # Laws that one of these may turn out to be are candidates as well.
    turns = {
        (law, key[1]) for table in tables for key in table if key in chosen for law in table[key].shape.effect.becomes
    }
    chosen |= {key: [] for key in sorted(turns) if key not in chosen and any(key in table for table in tables)}
    for key, scores in chosen.items():
        for table in tables:
            if key in table and not any(same_start(table[key], s) for s in scores):
                scores.append(table[key])
        del scores[2:]
        # What tells the forms of a law apart may be far from where the linear model runs.
        scores += in_other_forms(scores, (*closer.scores, *screening.scores))
        scores += at_lines(scores[0])
    return list(chosen.values())


def form_of(score: Score) -> tuple[float, ...]:
    """Values of the parameters that are a choice of words, which no refit changes."""
    shape = score.shape
    return tuple(float(value) for p, value in zip(shape.effect.parameters, shape.values) if p.choices)


def in_other_forms(scores: list[Score], ranked: tuple[Score, ...]) -> list[Score]:
    """Of the same law at the same place, the best of a ranking in every form that is not among the scores yet."""
    effect, place = scores[0].shape.effect, scores[0].shape.place
    if not any(p.choices for p in effect.parameters):
        return []
    known, found = {form_of(score) for score in scores}, []
    for score in ranked:
        same = score.shape.effect.id == effect.id and score.shape.place.name == place.name
        if same and form_of(score) not in known:
            known.add(form_of(score))
            found.append(score)
    return found


def at_lines(score: Score) -> list[Score]:
    """For an effect that adds a mode, starts at the strongest lines of the residual; none for others.

    To first order the line of a heavy mass says little: it rings with the structure, which has taken part of it upon
    itself.
    """
    if not adds_mode(score.shape.effect):
        return []
    lines = dict.fromkeys(score.shape.scales.lines_hz)
    return [begun_at(score, np.array([frequency, *LINE_START])) for frequency in lines]


def begun_at(score: Score, values: np.ndarray) -> Score:
    """A score of an effect that begins with other values."""
    shape = dataclasses.replace(score.shape, values=np.asarray(values, dtype=float))
    return dataclasses.replace(score, shape=shape, weights=np.ones(len(score.weights)))


def adds_mode(effect: AbstractEffect) -> bool:
    """Whether an effect is a structure with a coordinate of its own."""
    return isinstance(effect, AbstractMatrixEffect) and effect.extra


def listed_with(listed: list[list[Score]], more: list[Score]) -> list[list[Score]]:
    """A short list with further starts, of what is on it and of others."""
    result = [list(scores) for scores in listed]
    by_name = {(scores[0].shape.effect.id, scores[0].shape.place.name): scores for scores in result}
    for score in more:
        name = score.shape.effect.id, score.shape.place.name
        if name in by_name:
            by_name[name].append(score)
        else:
            result.append([score])
    return result


def same_start(one: Score, other: Score) -> bool:
    """Whether two scores are of one shape, as far as a refit moves it: amplitudes find their size in a step or two."""
    moving = [p.counts and not p.amplitude for p in one.shape.effect.parameters]
    a, b = one.shape.values[moving], other.shape.values[moving]
    return bool(np.all(np.abs(a - b) <= SAME * np.maximum(np.abs(a), np.abs(b))))
