"""Refits of the candidates of one round: which are worth it, how each is found, and how they compare."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...mechanics.effects.base import Term
from ...mechanics.effects.stiffness import DeadZoneStiffness, EndStop
from ...mechanics.extended import arm_of
from ...numerics.side_by_side import side_by_side
from ..acceptance import at_its_bound
from ..findings import NOT_SIMULATED, Reason, Refusal, Rejected
from ..noise.whitening import Chain
from ..screening.linearization import Stage, rows_of
from ..screening.score_test import Score
from ..settings import CONTACT, HOPELESS, STANDING_ALIKE
from .change_points import dated, softened, width_of
from .context import Bench, chain_of
from .continuation import ROUGH, at_the_same_steps, pursued, sharpened
from .gauss_newton import Refit, refit
from .normal_equations import weighted
from .significance import at_bound, evidence

TOGETHER = 2
"""First refits beside one another, which know the best of those before them; as many on any machine."""

HELD_BACK = 4
"""Steps for which a term keeps its first size while the linear model gives back what it had taken."""

LITTLE = 0.05
"""Share of the size that linear responses call for, to start from where the whole is worse than nothing."""


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


def attempts_of(
    bench: Bench, stage: Stage, listed: list[list[Score]], chain: Chain, rejected: list[Rejected]
) -> dict[tuple[str, str], Attempt]:
    """Refits of the listed candidates; only those that still can be the best are carried to their end. Laws that
    contain a simpler one begin where that ended."""
    names = {_name(scores[0]) for scores in listed}
    left = {_name(scores[0]): scores for scores in listed if names & set(_simpler(scores))}
    fits = _outright(bench, stage, [scores for scores in listed if _name(scores[0]) not in left], chain, rejected)
    bases: dict[tuple[str, str], _Base] = {}
    while left:
        # Beside one another, but for laws that go on from one of the others.
        now = {name: scores for name, scores in left.items() if not left.keys() & set(_simpler(scores))} or left
        left = {name: scores for name, scores in left.items() if name not in now}
        base_of = {name: next((one for one in _simpler(scores) if one in fits), None) for name, scores in now.items()}
        for base in set(base_of.values()) - {None, *bases}:
            bases[base] = _Base.of(bench, *fits[base])
        for name in (name for name, base in base_of.items() if base is None):
            fits |= _outright(bench, stage, [now[name]], chain, rejected)
        beyond = {name: (bases[base], now[name]) for name, base in base_of.items() if base is not None}
        for name, end in zip(beyond, side_by_side(lambda one: _beyond(bench, *one), beyond.values())):
            if isinstance(end, Rejected):
                rejected.append(end)
            else:
                fits[name] = end
    attempts: dict[tuple[str, str], Attempt] = {}
    for score, fit in _followed(bench, fits, rejected).values():
        attempt = by_contact(bench, Attempt(score, fit, chain_of(bench, fit)), stage)
        if attempt.name not in attempts or attempt.chain.cost < attempts[attempt.name].chain.cost:
            attempts[attempt.name] = attempt
    return attempts


def _name(score: Score) -> tuple[str, str]:
    return score.shape.effect.id, score.shape.place.name


def _simpler(scores: list[Score]) -> list[tuple[str, str]]:
    """Laws at the same place that this one contains."""
    shape = scores[0].shape
    return [(simpler, shape.place.name) for simpler in shape.effect.contains]


def dominated(behind: float) -> Refusal:
    """The refusal of a law that is not carried to its end, being so far behind another."""
    return Refusal(Reason.DOMINATED, f"explains less than the best candidate of its round (by {behind:.0f})")


def criterion_of(bench: Bench, score: Score, fit: Refit) -> float:
    """BIC of a refit under the chain that it was found under: N ln cost, and what its shape costs."""
    return fit.count * np.log(max(fit.cost, 1e-300)) + _penalty(bench, score)


def unresolved(fit: Refit, score: Score) -> str | None:
    """Why a law at the end of a refit is another one there, as far as the record shows; None where it is not."""
    shape = score.shape
    term = next(t for t in fit.candidate.terms if (t.effect.id, t.place.name) == _name(score))
    return shape.effect.unresolved(np.array(term.values, dtype=float), shape.scales)


def _outright(
    bench: Bench, stage: Stage, listed: list[list[Score]], chain: Chain, rejected: list[Rejected]
) -> dict[tuple[str, str], tuple[Score, Refit]]:
    """Refits from the model without the candidate, under one chain first, then those that are left to their end."""
    rough: dict[tuple[str, str], tuple[float, Score, Refit]] = {}
    starts, best, unlike = [score for scores in listed for score in scores], np.inf, {}

    def first(k):
        effect, place = _name(starts[k])
        bench.progress.stage(f"refitting {effect} at {place}", fraction=k / len(starts))
        return first_fit(bench, stage, starts[k], chain, best)

    for begin in range(0, len(starts), TOGETHER):
        together = range(len(starts))[begin : begin + TOGETHER]
        for score, fit in zip(starts[begin:], side_by_side(first, together)):
            if fit is None:
                continue
            name, criterion = _name(score), criterion_of(bench, score, fit)
            if (why := unresolved(fit, score)) is not None:
                # Another law under this one's name, which others must not be measured by.
                unlike[name] = why
                continue
            best = min(best, criterion)
            if name not in rough or criterion < rough[name][0]:
                rough[name] = criterion, score, fit
    for scores in listed:
        if (name := _name(scores[0])) not in rough:
            why = Refusal(Reason.OTHER_LAW, unlike[name]) if name in unlike else NOT_SIMULATED
            rejected.append(Rejected.of(name, scores[0].delta_bic, why))
    going: dict[tuple[str, str], tuple[Score, Refit]] = {}
    for name, (criterion, score, fit) in sorted(rough.items(), key=lambda item: item[1][0]):
        if criterion > best + HOPELESS:
            rejected.append(Rejected.of(name, score.delta_bic, dominated(criterion - best)))
            continue
        bound = at_bound(fit, len(fit.candidate.terms) - 1)
        if bound is not None and criterion > best:
            rejected.append(Rejected.of(name, score.delta_bic, at_its_bound(bound)))
            continue
        going[name] = score, fit

    def at_end(name):
        bench.progress.stage(f"pursuing {name[0]} at {name[1]}")
        return going[name][0], pursued(bench, going[name][1])

    return dict(zip(going, side_by_side(at_end, going)))


@dataclass(frozen=True)
class _Base:
    """The refit of a law that others contain, under the chain that they are refitted with; `most`: the criterion from
    which one of them pays too little."""

    score: Score
    fit: Refit
    chain: Chain
    most: float

    @classmethod
    def of(cls, bench: Bench, score: Score, fit: Refit) -> "_Base":
        chain = chain_of(bench, fit)
        # With the same samples counted as what is compared with it.
        again = refit(bench.simulator, fit.candidate, bench.data, chain, held=bench.held, max_steps=3, tolerance=ROUGH)
        fit = fit if again is None else again
        # Noise at the forces may hide what a law is worth.
        most = criterion_of(bench, score, fit) + (STANDING_ALIKE if chain.ratio == 0.0 else HOPELESS)
        return cls(score, fit, chain, most)


def _beyond(bench: Bench, base: _Base, scores: list[Score]) -> tuple[Score, Refit] | Rejected:
    """The best refit of a law from that of a simpler one which it contains, or why there is none: its further
    parameters pay too little."""
    simple, chain, most = base.fit, base.chain, base.most
    name = _name(scores[0])
    bench.progress.stage(f"refitting {name[0]} at {name[1]}")
    last = simple.candidate.terms[-1]
    known = dict(zip((p.name for p in last.effect.parameters), last.values))
    found = []
    for score in scores:
        shape = score.shape.term(score.weights)
        term = Term(shape.effect, shape.place, shape.effect.widened(np.array(shape.values, dtype=float), known))
        begin = simple.candidate.with_terms((*simple.candidate.terms[:-1], term))
        with np.errstate(over="ignore"):
            abandon = np.exp((most - _penalty(bench, score)) / simple.count)
        options = {"held": bench.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
        fit = refit(bench.simulator, begin, bench.data, chain, **options)
        if fit is not None:
            found.append((criterion_of(bench, score, fit), score, fit))
    if not found:
        return Rejected.of(name, scores[0].delta_bic, NOT_SIMULATED)
    if min(criterion for criterion, *_ in found) > most:
        words = f"explains no more than {base.score.shape.effect.id}, which it contains"
        return Rejected.of(name, scores[0].delta_bic, Refusal(Reason.NEEDLESS, words))
    bench.progress.stage(f"pursuing {name[0]} at {name[1]}")
    # A start that is ahead after a few steps need not lead to the best end.
    ends = [(score, pursued(bench, fit)) for criterion, score, fit in found if criterion <= most]
    return min(ends, key=lambda end: chain_of(bench, end[1]).cost + _penalty(bench, end[0]))


def _followed(
    bench: Bench, fits: dict[tuple[str, str], tuple[Score, Refit]], rejected: list[Rejected]
) -> dict[tuple[str, str], tuple[Score, Refit]]:
    """The refits with their forces followed in steps as short as the best of them needs; all in the same, since what
    shorter steps mend is not a law's merit."""
    if not fits:
        return fits
    costs = {name: chain_of(bench, fit).cost + _penalty(bench, score) for name, (score, fit) in fits.items()}
    best, steps = min(costs, key=costs.get), bench.simulator.substeps
    sharp = sharpened(bench, fits[best][1])
    if bench.simulator.substeps == steps:
        return fits
    near = {name: fit for name, (_, fit) in fits.items() if costs[name] - costs[best] < HOPELESS}
    for name, (score, _) in fits.items():
        if name not in near:
            rejected.append(Rejected.of(name, score.delta_bic, dominated(costs[name] - costs[best])))

    def again(name):
        return sharp if name == best else at_the_same_steps(bench, near[name])

    return {name: (fits[name][0], fit) for name, fit in zip(near, side_by_side(again, near))}


def by_contact(bench: Bench, attempt: Attempt, stage: Stage) -> Attempt:
    """The attempt under the name that its contact gives it: backlash where the gap is left in more than half of the
    samples, an end stop where in fewer; the law is the same. Under its own where the other is not looked for."""
    term = attempt.fit.candidate.terms[-1]
    if term.effect.id not in CONTACT:
        return attempt
    arm = np.asarray(arm_of(term, stage.plant))
    data = bench.data[0]
    q = bench.simulator.motion(attempt.fit.candidate, data)[0][: data.samples, : len(arm)]
    contact = np.mean(np.abs(q @ arm) > float(term.values[1]))
    effect = DeadZoneStiffness() if contact > 0.5 else EndStop()
    if effect.id == term.effect.id or effect.id not in {one.id for one in bench.catalogue}:
        return attempt
    renamed = Term(effect, term.place, term.values)
    candidate = attempt.fit.candidate
    fit = dataclasses.replace(attempt.fit, candidate=candidate.with_terms((*candidate.terms[:-1], renamed)))
    shape = dataclasses.replace(attempt.score.shape, effect=effect)
    return dataclasses.replace(attempt, fit=fit, score=dataclasses.replace(attempt.score, shape=shape))


def _penalty(bench: Bench, score: Score) -> float:
    return score.shape.free * np.log(rows_of(bench.data[0])) + 2 * np.log(score.shape.tried)


def first_fit(bench: Bench, stage: Stage, score: Score, chain: Chain, best: float) -> Refit | None:
    """Refit the model with one more term under a given chain; given up early where it is far behind the best."""
    fit = None
    nothing = float(np.sum(weighted(chain, stage.e[:, :, None], bench.data[0].kept) ** 2))
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
        begin = begin.with_terms(terms)
        if fit is not None:
            begin = dated(bench, begin, chain, width_of(fit.candidate.terms[-1]))
        options = {"held": bench.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
        begun = refit(bench.simulator, begin, bench.data, chain, **options)
        if begun is not None:
            # Another start is worth its time only while it promises more than this one gave.
            options["abandon"] = min(abandon, begun.cost)
        if fit is None and (begun is None or begun.started > nothing):
            # The linear model took so much of the effect upon itself that all must move together, from little.
            little = score.shape.term(LITTLE * score.weights)
            little = Term(term.effect, term.place, np.where(_amplitudes(term), little.values, term.values))
            terms = (*stage.candidate.terms, little)
            again = refit(
                bench.simulator, stage.candidate.with_terms(terms), bench.data, chain, shapes_after=2, **options
            )
            if begun is None or (again is not None and again.cost < begun.cost):
                begun = again
            if begun is not None and not begun.converged:
                options["abandon"] = min(abandon, begun.cost)
                # Or from all of it, the linear model giving back what it took before the term itself moves.
                again = refit(bench.simulator, begin, bench.data, chain, last_after=HELD_BACK, **options)
                begun = again if again is not None and again.cost < begun.cost else begun
        fit = begun
        if fit is None:
            return None
    return fit


def _amplitudes(term: Term) -> np.ndarray:
    return np.array([parameter.amplitude for parameter in term.effect.parameters])


def compared(bench: Bench, stage: Stage, attempts: list[Attempt]) -> list[Attempt]:
    """Attempts by their criterion under the chain of the best, best first."""
    if not attempts:
        return []

    own = [a.chain.cost + _penalty(bench, a.score) for a in attempts]
    chain = attempts[int(np.argmin(own))].chain
    data = bench.data[0]
    base, rows = evidence(stage.e, stage.J, data, chain)
    result = []
    for a in attempts:
        cost, _ = evidence(*moving(bench, a.fit), data, chain)
        penalty = _penalty(bench, a.score)
        criterion = rows * np.log(max(cost, 1e-300)) + penalty
        delta = rows * np.log(base) - criterion
        result.append(dataclasses.replace(a, criterion=float(criterion), penalty=penalty, delta_bic=float(delta)))
    return sorted(result, key=lambda a: a.criterion)


def moving(bench: Bench, fit: Refit) -> tuple[np.ndarray, np.ndarray]:
    """Residual of a refit on the first record, and the columns of its Jacobian for what may move."""
    J = fit.jacobian[0]
    kept = np.concatenate([~bench.held, np.ones(J.shape[2] - len(bench.held), bool)])
    return fit.residual[0], J[:, :, kept]
