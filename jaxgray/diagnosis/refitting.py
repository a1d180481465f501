"""Refits of the candidates of one round: which are worth it, how each is found, and how they compare."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..mechanics.effects.base import AbstractEffect, AbstractForceEffect, Scales, Term
from ..mechanics.effects.stiffness import DeadZoneStiffness, EndStop
from ..mechanics.extended import arm_of
from ..numerics.progress import AbstractProgress
from .competitor import FlexibleForce
from .extension import Refit, refit, weighted, with_states
from .judgement import ACCEPTED, evidence, free_run, overall
from .problem import Data
from .residual import Chain, estimate_chain
from .response import Simulator
from .result import Rejected
from .screening import Score, Screening
from .stage import Stage, rows_of, sampled_plant

TRIED = 4
"""Candidates that are refitted in a round."""

HOPELESS = 100.0
"""Distance in criterion from the best first refit beyond which a candidate is not pursued; its refit is given up at
twice this."""

ROUGH = 0.3
"""Decrement, in units of the noise variance, at which a first refit is good enough to compare."""

RENEWALS = 6
"""How often the chain of a refit is renewed."""

LITTLE = 0.05
"""Share of the size that linear responses call for, to start from where the whole is worse than nothing."""

MOST_STEPS = 16
"""Steps per sample up to which a force is followed."""

TOLERABLE = 0.1
"""Error of the steps, relative to the noise, that is never left."""


@dataclass(frozen=True)
class Attempt:
    """A candidate refitted: its `score`, `fit` and own `chain`; `criterion` with its `penalty`, and `delta_bic`, under
    the best one's chain."""

    score: Score
    fit: Refit
    chain: Chain
    criterion: float = np.inf
    penalty: float = 0.0
    delta_bic: float = -np.inf

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        return self.score.shape.effect.id, self.score.shape.place.name


@dataclass(frozen=True)
class Bench:
    """What the loop works with.

    `simulator`; `data` of estimation and of validation; `catalogue`; `names` of inputs and outputs; `held`: entries
    that do not move; `floor`: independent noise floor per output, or None; `separate`: whether validation has a clock
    of its own; `rng`; `progress`.
    """

    simulator: Simulator
    data: list[Data]
    validation: list[Data]
    catalogue: tuple[AbstractEffect, ...]
    names: tuple[tuple[str, ...], tuple[str, ...]]
    held: np.ndarray
    floor: np.ndarray | None
    separate: bool
    rng: np.random.Generator
    progress: AbstractProgress


def shortlist(screening: Screening, closer: Screening) -> list[list[Score]]:
    """Candidates worth a refit, each with the shapes to start from: best by measured motion, then by simulated."""
    near, far = closer.best_by_place(), screening.best_by_place()
    white = {}
    for score in screening.first:
        white.setdefault((score.shape.effect.id, score.shape.place.name), score)
    chosen: dict[tuple[str, str], list[Score]] = {}

    def add(ranking, count):
        ids = {key[0] for key in chosen}
        for key, score in ranking.items():
            if count == 0 or score.delta_bic < ACCEPTED:
                return
            if key in chosen or key[0] in ids or key[0] == FlexibleForce.id:
                continue
            ids.add(key[0])
            chosen[key] = []
            count -= 1

    add(near, 3)
    add(far, 1 if chosen else 3)
    add(white, 1 if chosen else 3)
    # A law that turns into a simpler one is only worth what it explains beyond that.
    for effect, place in [
        (score.shape.effect, key[1]) for key, score in [*near.items(), *far.items(), *white.items()] if key in chosen
    ]:
        for simpler in effect.contains:
            known = any((simpler, place) in table for table in (near, far, white))
            if known and (simpler, place) not in chosen:
                chosen[simpler, place] = []
    # Another place for the best effect: neighbours are easily taken for each other.
    if near:
        first = next(iter(near))
        for key, score in near.items():
            if key[0] == first[0] and key not in chosen and score.delta_bic > ACCEPTED and len(chosen) < TRIED + 1:
                chosen[key] = []
                break
    for key, scores in chosen.items():
        for table in (near, far, white):
            if key in table and not any(np.array_equal(table[key].shape.values, s.shape.values) for s in scores):
                scores.append(table[key])
        del scores[2:]
    return list(chosen.values())


def attempts_of(
    bench: Bench, stage: Stage, listed: list[list[Score]], chain: Chain, rejected: list[Rejected]
) -> dict[tuple[str, str], Attempt]:
    """Refits of the listed candidates; the chain is renewed only for those that still can be the best."""
    rough, best = {}, np.inf
    for k, scores in enumerate(listed):
        name = scores[0].shape.effect.id, scores[0].shape.place.name
        bench.progress.stage(f"refitting {name[0]} at {name[1]}", fraction=k / max(len(listed), 1))
        for score in scores:
            fit = first_fit(bench, stage, score, chain, best)
            if fit is None:
                continue
            criterion = fit.count * np.log(max(fit.cost, 1e-300)) + _penalty(bench, score)
            best = min(best, criterion)
            if name not in rough or criterion < rough[name][0]:
                rough[name] = criterion, score, fit
        if name not in rough:
            rejected.append(Rejected(*name, scores[0].delta_bic, "its refit could not be simulated"))
    attempts = {}
    for name, (criterion, score, fit) in sorted(rough.items(), key=lambda item: item[1][0]):
        if criterion > best + HOPELESS:
            why = f"explains less than the best candidate of its round (by {criterion - best:.0f})"
            rejected.append(Rejected(*name, score.delta_bic, why))
            continue
        fit = along_the_valley(bench, with_new_chains(bench, fit))
        fit = sharpened(bench, fit)
        fit = with_states(bench.simulator, fit, bench.data)
        attempt = by_contact(bench, Attempt(score, fit, chain_of(bench, fit)), stage)
        if attempt.name not in attempts or attempt.chain.cost < attempts[attempt.name].chain.cost:
            attempts[attempt.name] = attempt
    return attempts


def by_contact(bench: Bench, attempt: Attempt, stage: Stage) -> Attempt:
    """The attempt under the name that its contact gives it: backlash where the gap is left in more than half of the
    samples, an end stop where in fewer; the law is the same."""
    term = attempt.fit.candidate.terms[-1]
    if term.effect.id not in (DeadZoneStiffness.id, EndStop.id):
        return attempt
    arm = np.asarray(arm_of(term, stage.plant))
    data = bench.data[0]
    q = bench.simulator.motion(attempt.fit.candidate, data)[0][: data.samples, : len(arm)]
    contact = np.mean(np.abs(q @ arm) > float(term.values[1]))
    effect = DeadZoneStiffness() if contact > 0.5 else EndStop()
    if effect.id == term.effect.id:
        return attempt
    renamed = Term(effect, term.place, term.values)
    candidate = attempt.fit.candidate
    fit = dataclasses.replace(attempt.fit, candidate=candidate.with_terms((*candidate.terms[:-1], renamed)))
    shape = dataclasses.replace(attempt.score.shape, effect=effect)
    return dataclasses.replace(attempt, fit=fit, score=dataclasses.replace(attempt.score, shape=shape))


def with_new_chains(bench: Bench, fit: Refit) -> Refit:
    """Refits under the chain of what is left, as long as less and less of it passes for noise at the forces."""
    chain = chain_of(bench, fit)
    for _ in range(RENEWALS):
        again = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=10)
        if again is None:
            return fit
        fit, ratio, chain = again, chain.ratio, chain_of(bench, again)
        if not chain.ratio < ratio / 2:
            return fit
    return fit


def along_the_valley(bench: Bench, fit: Refit) -> Refit:
    """A refit that did not come to an end, carried on: the scale of its last term's shape is set to others, all else
    refitted, as long as that pays. A curved valley is too narrow to follow in straight steps."""
    places = [
        j
        for j, p in enumerate(fit.candidate.terms[-1].effect.parameters)
        if p.counts and p.lower == 0 and not p.amplitude
    ]
    if fit.converged or len(places) != 1:
        return fit
    chain, j = chain_of(bench, fit), places[0]
    options = {"held": bench.held, "max_steps": 8, "shapes_after": 4, "tolerance": ROUGH}
    here = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=1)
    if here is None:
        return fit
    for factor in (1.5, 1 / 1.5):
        for _ in range(4):
            values = np.array(here.candidate.terms[-1].values, dtype=float)
            values[j] *= factor
            term = here.candidate.terms[-1]
            moved = here.candidate.with_terms((*here.candidate.terms[:-1], Term(term.effect, term.place, values)))
            trial = refit(bench.simulator, moved, bench.data, chain, **options)
            if trial is None or not trial.cost < here.cost:
                break
            here = trial
    return here


def sharpened(bench: Bench, fit: Refit) -> Refit:
    """A refit in shorter steps of its added forces, where the error of the steps could be told from noise.

    The simulator keeps the shorter steps.
    """
    simulator, steps = bench.simulator, bench.simulator.substeps
    error = integration_error(bench, fit)
    rows = rows_of(bench.data[0])
    if error**2 * rows < 1.0 or steps >= MOST_STEPS:
        return fit
    chain = chain_of(bench, fit)
    simulator.substeps = min(MOST_STEPS, steps * 2 ** int(np.ceil(np.log2(2 * error * np.sqrt(rows)))))
    trial = refit(simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=10)
    if trial is not None and (error > TOLERABLE or chain_of(bench, trial).cost < chain.cost - 2.0):
        return trial
    simulator.substeps = steps
    return fit


def integration_error(bench: Bench, fit: Refit) -> float:
    """How far the free run on the first record moves with steps half as long, relative to what the fit leaves: root
    mean square over the outputs."""
    if not any(isinstance(term.effect, AbstractForceEffect) for term in fit.candidate.terms):
        return 0.0
    data, simulator, steps = bench.data[0], bench.simulator, bench.simulator.substeps
    simulator.substeps = 2 * steps
    finer = simulator.run(fit.candidate, data)
    simulator.substeps = steps
    change = np.where(data.kept, data.y - fit.residual[0] - finer, 0.0)
    level = np.maximum(np.sum(fit.residual[0] ** 2, axis=0), 1e-300)
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0) / level)))


def _penalty(bench: Bench, score: Score) -> float:
    return score.shape.free * np.log(rows_of(bench.data[0])) + 2 * np.log(score.shape.tried)


def first_fit(bench: Bench, stage: Stage, score: Score, chain: Chain, best: float) -> Refit | None:
    """Refit the model with one more term under a given chain; given up early where it is far behind the best."""
    fit = None
    here = np.where(bench.data[0].kept[:, :, None], stage.e[:, :, None], 0.0)
    nothing = float(np.sum(weighted(chain, here, bench.data[0].kept) ** 2))
    with np.errstate(over="ignore"):
        abandon = np.exp((best + 2 * HOPELESS - _penalty(bench, score)) / rows_of(bench.data[0]))
    for term in softened(score.shape.term(score.weights), score.shape.scales):
        if fit is not None:
            if fit.count * np.log(max(fit.cost, 1e-300)) > best + 10 * HOPELESS:
                return fit
            # What was found so far, with the edge of the step made sharper.
            fixed = [j for j, p in enumerate(term.effect.parameters) if not p.counts]
            values = np.array(fit.candidate.terms[-1].values, float)
            values[fixed] = np.asarray(term.values)[fixed]
            term = Term(term.effect, term.place, values)
        begin = stage.candidate if fit is None else fit.candidate
        terms = (*stage.candidate.terms, term) if fit is None else (*fit.candidate.terms[:-1], term)
        options = {"held": bench.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
        begun = refit(bench.simulator, begin.with_terms(terms), bench.data, chain, **options)
        if fit is None and (begun is None or begun.started > nothing):
            # The linear model took so much of the effect upon itself that all must move together, from little.
            little = score.shape.term(LITTLE * score.weights)
            little = Term(term.effect, term.place, np.where(_amplitudes(term), little.values, term.values))
            terms = (*stage.candidate.terms, little)
            again = refit(bench.simulator, begin.with_terms(terms), bench.data, chain, shapes_after=2, **options)
            if begun is None or (again is not None and again.cost < begun.cost):
                begun = again
        fit = begun
        if fit is None:
            return None
    return fit


def _amplitudes(term: Term) -> np.ndarray:
    return np.array([parameter.amplitude for parameter in term.effect.parameters])


def softened(term: Term, scales: Scales) -> list[Term]:
    """The terms to refit one after the other: a sudden change first smeared over the distance between the times that
    were tried, since only the samples inside its edge can tell where it belongs."""
    names = [p.name for p in term.effect.parameters]
    if "width" not in names or len(scales.times) < 2:
        return [term]
    spacing = scales.times[1] - scales.times[0]
    result = []
    for width in (2 * spacing, spacing / 2, spacing / 8, scales.sampling_time):
        values = np.array(term.values, float)
        values[names.index("width")] = width
        result.append(Term(term.effect, term.place, values))
    return result


def chain_of(bench: Bench, fit: Refit) -> Chain:
    data = bench.data[0]
    plant = bench.simulator.plant(fit.candidate)
    system = sampled_plant(plant, data, bench.simulator.setup.dofs)
    force = np.maximum(np.mean(data.u[: data.samples] ** 2, axis=0), 1e-300)
    return estimate_chain(fit.residual[0], data.kept, system, force)


def compared(bench: Bench, stage: Stage, attempts: list[Attempt]) -> list[Attempt]:
    """Attempts by their criterion under the chain of the best, best first."""
    if not attempts:
        return []

    own = [a.chain.cost + _penalty(bench, a.score) for a in attempts]
    chain = attempts[int(np.argmin(own))].chain
    still = Refit(stage.candidate, (stage.e,), (stage.J,), np.zeros((0, 0)), 0.0, 0, 0, True)
    data = bench.data
    base, rows = evidence(still, data[:1], chain)
    result = []
    for a in attempts:
        cost, _ = evidence(moving(bench, a.fit), data[:1], chain)
        penalty = _penalty(bench, a.score)
        criterion = rows * np.log(max(cost, 1e-300)) + penalty
        delta = rows * np.log(base) - criterion
        result.append(dataclasses.replace(a, criterion=float(criterion), penalty=penalty, delta_bic=float(delta)))
    return sorted(result, key=lambda a: a.criterion)


def moving(bench: Bench, fit: Refit) -> Refit:
    """A refit on the first record with the columns of what may move."""
    J = fit.jacobian[0]
    kept = np.concatenate([~bench.held, np.ones(J.shape[2] - len(bench.held), bool)])
    return dataclasses.replace(fit, residual=fit.residual[:1], jacobian=(J[:, :, kept],))


def explainable_share(bench: Bench, growth, floor: np.ndarray) -> float | None:
    """Share of the baseline's excess on held-out data that the model with a flexible force explains, η.

    **Arguments:** `bench`; `growth`: how far the loop got, its last look included; `floor`: noise per output.

    **Returns:** η, or None where there is no held-out data or no excess on it.
    """
    score = growth.screening.best_by_effect().get(FlexibleForce.id)
    if score is None or not bench.validation:
        return None
    fit = first_fit(bench, growth.stage, score, growth.screening.chain, np.inf)
    if fit is None:
        return None

    def excess(runs):
        return float(np.mean([overall(run.rmse, floor) ** 2 for run in runs])) - 1.0

    before = excess(growth.baseline_runs)
    after = excess([free_run(bench.simulator, fit.candidate, d) for d in bench.validation])
    if not (np.isfinite(after) and before > 0):
        return None
    return float(np.clip((before - after) / before, 0.0, 1.0))
