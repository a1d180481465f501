"""The loop: look, name, refit, accept or reject, look again."""

import dataclasses

import numpy as np
import scipy.special

from ..identification.validation import residual_test
from ..mechanics.effects.base import AbstractEffect
from ..mechanics.effects.sensor import SensorCrosstalk
from ..numerics.runtime import relieve
from .bench import Bench
from .competitor import FlexibleForce
from .extension import Layout
from .gain import gain_of
from .grown import TIME_LOCAL, Accepted, Growth, held_out_run, stage_of_candidate
from .judgement import (
    ACCEPTED,
    ALIKE,
    SIGNIFICANT,
    FreeRun,
    at_bound,
    overall,
    significance,
)
from .problem import Candidate, Data
from .pruning import prune
from .refitting import STANDING_ALIKE, Attempt, attempts_of, compared
from .residual import white_chain
from .result import Rejected
from .screening import Screening
from .shortlist import shortlist
from .stage import Stage, look, look_closer

EXPLAINED = 0.1
"""Least share of the excess that a finding must explain."""

SLIGHT = 0.02
"""Share of what is left that the best effect must explain for "unexplained" to be said when no refit holds."""

STANDING = (
    frozenset(("input_delay", "actuator_lag", "intersample_hold", "sensor_delay", "sensor_lag")),
    frozenset(("constant_force", "sensor_offset")),
    frozenset(("stiffness_step", "mass_step")),
    frozenset(("cubic_stiffness", "end_stop", "dead_zone_stiffness", "sine_stiffness")),
    frozenset(("bouc_wen_hysteresis", "maxwell_slip_hysteresis", "dahl_friction")),
    frozenset(("bilinear_stiffness", "quadratic_stiffness")),
)
"""Laws that are easily alike: one of them is ruled out only by more."""

BEHIND = 50.0
"""ΔBIC by measured motion from which an effect may hide behind noise at the forces."""


def grow(
    bench: Bench, start: Candidate, max_effects: int, *, errors: tuple[AbstractEffect, ...] = (), max_errors: int = 0
) -> Growth:
    """Extend a model until nothing more is found.

    **Arguments:** `bench`; `start`: the model to begin with; `max_effects`; `errors`: effects to look for alone first,
    at most `max_errors` of them (wrong numbers of a model that was given).

    **Returns:** a `Growth`.
    """
    first = stage_of_candidate(bench, start)
    growth = Growth(first, first)
    growth.baseline_runs = [held_out_run(bench, start, d) for d in bench.validation]
    growth.runs = growth.baseline_runs
    if errors:
        _extend(dataclasses.replace(bench, catalogue=errors), growth, max_errors, errors)
    _extend(bench, growth, max_effects, (*bench.catalogue, FlexibleForce()))
    return growth


def _extend(bench: Bench, growth: Growth, most: int, searched: tuple[AbstractEffect, ...]) -> None:
    """Rounds of looking and accepting, until nothing more is found or `most` effects were."""
    for turn in range(most + 1):
        relieve()
        found, told_from = len(growth.accepted), growth.ruled_out
        growth.stage = dataclasses.replace(growth.stage, ruled_out=growth.ruled_out)
        bench.progress.stage("looking for effects" if found == 0 else f"looking further ({found} found)")
        screening = look(growth.stage, bench.data[0], searched, bench.names, rng=bench.rng)
        growth.screening = screening
        growth.first = screening if growth.first is None else growth.first
        strong = _strong(screening)
        growth.unexplained = screening.fires
        closer = None
        if not screening.fires and not strong:
            closer = _behind_the_noise(bench, growth.stage, screening)
            if closer is None:
                return
        if turn == most:
            return
        if closer is None:
            closer = look_closer(growth.stage, bench.data[0], bench.catalogue, bench.names, screening.chain)
            if not closer.shows:
                closer = look_closer(growth.stage, bench.data[0], bench.catalogue, bench.names)
        ranked = _refitted(bench, growth, screening, closer)
        if not _accepted(bench, growth, ranked):
            if growth.ruled_out != told_from:
                continue
            growth.unexplained = screening.fires and not _refuted(bench, growth, ranked, searched)
            return
        prune(bench, growth)
        growth.unexplained = False


def _strong(screening: Screening) -> bool:
    """Whether some candidate takes most of what is left, though the chain could pass it off as noise at the forces."""
    best = screening.first[0] if screening.first else None
    if best is None or best.delta_bic < 100:
        return False
    return 1 - np.exp(-best.ratio / screening.rows) > 0.3


def _behind_the_noise(bench: Bench, stage: Stage, screening: Screening) -> Screening | None:
    """The ranking by measured motion where the gate is silent only because noise at the forces takes all; None where
    that shows nothing either.

    At large amplitudes the simulated motion is too far off for its features to count, and the chain then swallows the
    effect. What is found so must still hold on data that the fit has not seen.
    """
    if screening.chain.ratio == 0.0:
        return None
    closer = look_closer(stage, bench.data[0], bench.catalogue, bench.names)
    return closer if closer.scores and closer.scores[0].delta_bic > BEHIND else None


def _refuted(bench: Bench, growth: Growth, ranked: list[Attempt], searched: tuple[AbstractEffect, ...]) -> bool:
    """Whether the gate was wrong: it sees effects to first order, and none of those refitted holds.

    It must have opened to next to nothing, or barely, or stay shut under the noise that the best refit leaves: where it
    took noise at the forces for white, every effect seemed to explain some of it.
    """
    best = growth.screening.scores[0]
    if 1 - np.exp(-best.ratio / growth.screening.rows) < SLIGHT:
        return True
    if not ranked or any(attempt.delta_bic >= ACCEPTED for attempt in ranked):
        return False
    if best.delta_bic < 2 * growth.screening.threshold:
        return True
    chain = ranked[0].chain
    again = look(growth.stage, bench.data[0], searched, bench.names, chain=chain, rng=bench.rng)
    if again.fires or again.chain.ratio == 0.0:
        return False
    growth.screening = again
    return True


def _refitted(bench: Bench, growth: Growth, screening: Screening, closer: Screening) -> list[Attempt]:
    """The most promising candidates, refitted, best first."""
    stage = growth.stage
    chain = closer.chain if closer.shows else white_chain(stage.e, bench.data[0].kept, stage.system)
    attempts = attempts_of(bench, growth.stage, shortlist(screening, closer), chain, growth.rejected)
    ranked = _simplified(compared(bench, stage, list(attempts.values())))
    growth.tried |= {attempt.name: attempt.fit for attempt in ranked}
    return ranked


def _accepted(bench: Bench, growth: Growth, ranked: list[Attempt]) -> bool:
    """Accept the best candidate that holds; whether one did."""
    floor = _floor(bench, ranked)
    for k, attempt in enumerate(ranked):
        bench.progress.stage(f"judging {attempt.name[0]} at {attempt.name[1]}")
        why, gain, runs = judged(bench, growth, attempt, floor)
        if why is not None:
            growth.rejected.append(Rejected(*attempt.name, attempt.delta_bic, why, gain))
            continue
        rivals = []
        for other in ranked[k + 1 :]:
            if other.criterion - attempt.criterion >= _alike(attempt, other):
                best = " at ".join(attempt.name)
                why = f"explained better by {best} (by {other.criterion - attempt.criterion:.0f})"
                growth.rejected.append(Rejected(*other.name, other.delta_bic, why))
            elif _needless(other, attempt):
                why = f"the same as {attempt.name[0]} with a parameter that explains nothing"
                growth.rejected.append(Rejected(*other.name, other.delta_bic, why))
            elif (bound := at_bound(other.fit, len(other.fit.candidate.terms) - 1)) is not None:
                growth.rejected.append(Rejected(*other.name, other.delta_bic, f"{bound} ran to its physical bound"))
            else:
                rivals.append(other)
        growth.accepted.append(Accepted(attempt, tuple(rivals[:3]), gain, runs))
        growth.fit, growth.runs = attempt.fit, runs
        growth.stage = stage_of_candidate(bench, attempt.fit.candidate)
        return True
    return False


def _simplified(ranked: list[Attempt]) -> list[Attempt]:
    """The ranking, with the simpler law first where the best is the same with a parameter that explains nothing."""
    for other in ranked[1:]:
        if _needless(ranked[0], other):
            return [other, *(one for one in ranked if one is not other)]
    return ranked


def _alike(best: Attempt, other: Attempt) -> float:
    both = {best.name[0], other.name[0]}
    return STANDING_ALIKE if any(both <= group for group in STANDING) else ALIKE


def _needless(rival: Attempt, best: Attempt) -> bool:
    """Whether a rival is the best law at its place with more parameters, which do not pay (likelihood ratio) or are
    within two standard errors of nothing."""
    small, large = best.score.shape, rival.score.shape
    if rival.name[1] != best.name[1] or small.effect.id not in large.effect.contains:
        return False
    term, known = rival.fit.candidate.terms[-1], {p.name for p in small.effect.parameters}
    own = [j for j, p in enumerate(term.effect.parameters) if p.counts]
    errors = np.sqrt(np.maximum(np.diag(rival.fit.covariance)[-len(own) :], 0.0))
    further = [(float(term.values[j]), e) for j, e in zip(own, errors) if term.effect.parameters[j].name not in known]
    if further and all(abs(value) < 2 * error for value, error in further):
        return True
    ratio = best.criterion - best.penalty - (rival.criterion - rival.penalty)
    return ratio < scipy.special.chdtri(max(large.free - small.free, 1), 0.05)


def _floor(bench: Bench, attempts: list[Attempt]) -> np.ndarray:
    """Noise floor per output: the independent one, or what the best refit leaves."""
    if bench.floor is not None:
        return bench.floor
    if not attempts:
        return np.ones(bench.simulator.setup.dofs)
    return residual_rms(attempts[0].fit.residual[0], bench.data[0])


def residual_rms(e: np.ndarray, data: Data) -> np.ndarray:
    """Root mean square of a residual per output over the samples that were measured."""
    power = np.sum(np.where(data.kept, e, 0.0) ** 2, axis=0) / np.maximum(data.kept.sum(axis=0), 1)
    return np.maximum(np.sqrt(power), 1e-300)


def judged(bench: Bench, growth: Growth, attempt: Attempt, floor: np.ndarray):
    """Why an attempt cannot be believed (None if it can), its gain, and its free runs on held-out data."""
    last = len(attempt.fit.candidate.terms) - 1
    if attempt.delta_bic < ACCEPTED:
        return f"the refit explains too little (ΔBIC {attempt.delta_bic:.0f})", None, None
    if _fed_back(bench, growth, attempt):
        return "the inputs follow what it leaves: a closed loop looks the same", None, None
    bound = at_bound(attempt.fit, last)
    if bound is not None:
        return f"{bound} ran to its physical bound", None, None
    size = significance(attempt.fit, Layout(bench.simulator.setup, attempt.fit.candidate), last)
    if size < SIGNIFICANT:
        return f"only {size:.1f} standard errors from nothing", None, None
    if not np.all(
        residual_rms(attempt.fit.residual[0], bench.data[0]) < 2 * residual_rms(growth.stage.e, bench.data[0])
    ):
        return "its free run leaves more than it explains", None, None
    before = overall(residual_rms(growth.stage.e, bench.data[0]), floor) ** 2
    after = overall(residual_rms(attempt.fit.residual[0], bench.data[0]), floor) ** 2
    if after > before:
        return "its free run leaves more than the model without it", None, None
    if before - after < EXPLAINED * max(before - 1.0, 0.0):
        share = 100 * (before - after) / (before - 1.0)
        return f"explains only {share:.0f} % of the excess", None, None
    local = attempt.name[0] in TIME_LOCAL and not (bench.separate and attempt.name[0] != "periodic_disturbance")
    names = bench.names[1]
    if local or not bench.validation:
        runs = growth.runs
        old, new, base = (
            [FreeRun(e, e, bench.data[0].kept)] for e in (growth.stage.e, attempt.fit.residual[0], growth.start.e)
        )
        gain = gain_of(old, new, base, floor, names, held_out=False, rng=bench.rng)
        # What was fitted to these data always gains a little.
        sure = gain.ci99_lower > 0 and gain.ci95[0] > 0
        return (None if sure else "no sure gain, even on the data of the fit"), gain, runs
    runs = [held_out_run(bench, attempt.fit.candidate, d) for d in bench.validation]
    if not all(np.all(np.isfinite(run.e)) for run in runs):
        return "its free run on held-out data overflows", None, None
    gain = gain_of(growth.runs, runs, growth.baseline_runs, floor, names, held_out=True, rng=bench.rng)
    if not gain.ci99_lower > 0:
        return f"no sure gain on held-out data ({gain.percent:.1f} %, from {gain.ci99_lower:.1f} %)", gain, None
    return None, gain, runs


def _fed_back(bench: Bench, growth: Growth, attempt: Attempt) -> bool:
    """Whether crosstalk from an input stands for a closed loop that feeds the noise back to the inputs; such crosstalk
    is then no longer looked for."""
    inputs, outputs = bench.names
    from_inputs = frozenset((SensorCrosstalk.id, f"{u}->{y}") for u in inputs for y in outputs)
    if attempt.name not in from_inputs:
        return False
    data = bench.data[0]
    e = np.where(data.kept, attempt.fit.residual[0], np.nan)[: data.samples]
    if not residual_test(e, data.u[: data.samples]).followed:
        return False
    growth.ruled_out |= from_inputs
    return True


def recount(bench: Bench, growth: Growth, floor: np.ndarray) -> None:
    """Gains that add up: of every finding over what the findings before it leave, in units of one noise floor."""
    before = growth.baseline_runs
    for k, accepted in enumerate(growth.accepted):
        if accepted.gain.held_out:
            gain = gain_of(
                before, accepted.runs, growth.baseline_runs, floor, bench.names[1], held_out=True, rng=bench.rng
            )
            growth.accepted[k] = dataclasses.replace(accepted, gain=gain)
            before = accepted.runs
