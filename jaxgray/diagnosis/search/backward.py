"""What newer findings make of the older: laws that are part of a wider one, terms that are needless now, and laws that
a simpler one can stand for.

The newest may be the needless one: where the others had not come to their best values, any law that is refitted with
them brings them there, and has the credit.
"""

import dataclasses

import numpy as np

from ...mechanics.effects.base import Term
from ..estimation.context import Bench, chain_of
from ..estimation.gauss_newton import Refit, refit, with_states
from ..estimation.multistart import moving
from ..estimation.significance import evidence, significance
from ..findings import Reason, Refusal, Rejected
from ..model.candidate import Candidate
from ..model.parameter_vector import Layout
from ..settings import ACCEPTED, SIGNIFICANT
from .state import Growth, held_out_run, stage_of_candidate

LITTLE = 3.0
"""Standard errors from nothing up to which a parameter beyond those of a simpler law is doubted."""


def prune(bench: Bench, growth: Growth) -> None:
    """Make one law of the newest and of what it contains, and drop the terms that the newer ones have made needless;
    where there is none, put simpler laws in the place of those that hardly differ from them."""
    before = len(growth.accepted)
    _unite(bench, growth)
    while len(growth.accepted) > 1 and _dropped(bench, growth):
        pass
    if len(growth.accepted) == before:
        _simplify(bench, growth)


def _unite(bench: Bench, growth: Growth) -> None:
    """Let the newest law stand alone, in the place of a simpler one that it contains and that was accepted where it
    acts: beside it, what both name is shared between them at will."""
    terms = growth.fit.candidate.terms
    wide, accepted = terms[-1], growth.accepted[-1]
    inside = [t.effect.id in wide.effect.contains and t.place == wide.place for t in terms[:-1]]
    if not any(inside):
        return
    k = inside.index(True)
    whole = (*terms[:k], _sum_of(wide, terms[k]), *terms[k + 1 : -1])
    found = _instead(bench, growth, growth.fit.candidate.with_terms(whole))
    if found is None:
        return
    fit, ratio, rows = found
    gone = growth.accepted[k]
    change = ratio - gone.attempt.score.shape.free * np.log(rows)
    if change >= ACCEPTED:
        return
    why = f"contained in {wide.effect.id}, which explains as much alone"
    growth.rejected.append(Rejected.of(gone.attempt.name, change, Refusal(Reason.NEEDLESS, why)))
    # What stood for either of them was refitted beside other terms; it is compared with their sum at the end.
    known = {r.name: r for r in (*gone.rivals, *accepted.rivals) if r.name != accepted.attempt.name}
    rivals = tuple(dataclasses.replace(r, criterion=np.inf) for r in known.values())
    worth = accepted.attempt.delta_bic + gone.attempt.delta_bic - change
    attempt = dataclasses.replace(accepted.attempt, fit=gone.attempt.fit, delta_bic=float(worth))
    growth.accepted.pop()
    growth.accepted[k] = dataclasses.replace(accepted, attempt=attempt, rivals=rivals, runs=gone.runs)
    _take(bench, growth, fit)
    if k == len(growth.accepted) - 1:
        _credit(growth, 0.0)


def _sum_of(wide: Term, simple: Term) -> Term:
    """The wider law with the part of the simpler one as well, or nearly: where a refit of it alone begins."""
    values = np.array(wide.values, dtype=float)
    sizes = [p.amplitude for p in wide.effect.parameters]
    known = {p.name: float(value) for p, value in zip(simple.effect.parameters, simple.values)}
    part = wide.effect.widened(np.where(sizes, 0.0, values), known)
    return Term(wide.effect, wide.place, wide.effect.bounded(np.where(sizes, values + part, values)))


def _dropped(bench: Bench, growth: Growth) -> bool:
    """Drop one accepted term that explains nothing beside the others; whether there was one."""
    layout = Layout(bench.simulator.setup, growth.fit.candidate)
    for k in range(len(growth.accepted)):
        if significance(growth.fit, layout, k) >= SIGNIFICANT:
            continue
        terms = tuple(t for j, t in enumerate(growth.fit.candidate.terms) if j != k)
        found = _instead(bench, growth, growth.fit.candidate.with_terms(terms))
        if found is None:
            continue
        gone = growth.accepted[k].attempt
        fit, ratio, rows = found
        change = ratio - gone.score.shape.free * np.log(rows)
        if change < ACCEPTED:
            growth.accepted.pop(k)
            why = Refusal(Reason.NEEDLESS, "needless once the others are in the model")
            growth.rejected.append(Rejected.of(gone.name, change, why))
            _take(bench, growth, fit)
            if k == len(growth.accepted):
                _credit(growth, gone.delta_bic - change)
            return True
    return False


def _credit(growth: Growth, delta_bic: float) -> None:
    """Give the last finding its better values, and what they are worth."""
    last = growth.accepted[-1]
    attempt = dataclasses.replace(last.attempt, fit=growth.fit, delta_bic=last.attempt.delta_bic + delta_bic)
    growth.accepted[-1] = dataclasses.replace(last, attempt=attempt)


def _simplify(bench: Bench, growth: Growth) -> None:
    """A law whose further parameters explain nothing beside the others gives way to the simpler one that it contains,
    begun from where it ended."""
    known = {effect.id: effect for effect in bench.catalogue}
    for k, accepted in enumerate(growth.accepted):
        term = growth.fit.candidate.terms[k]
        inside = {t.effect.id for t in growth.fit.candidate.terms if t.place == term.place}
        for simpler in (known[name] for name in term.effect.contains if name in known and name not in inside):
            values = dict(zip((p.name for p in term.effect.parameters), np.array(term.values, dtype=float)))
            # The width over which a sign turns is nothing where the law with more in it has none.
            values = {p.name: 0.0 for p in simpler.parameters if not p.counts} | values
            named = all(p.name in values for p in simpler.parameters)
            if not named or not _doubtful(bench, growth, k, simpler):
                continue
            plain = Term(simpler, term.place, np.array([values[p.name] for p in simpler.parameters], dtype=float))
            terms = tuple(plain if j == k else t for j, t in enumerate(growth.fit.candidate.terms))
            found = _instead(bench, growth, growth.fit.candidate.with_terms(terms))
            if found is None:
                continue
            fit, ratio, rows = found
            shape = dataclasses.replace(accepted.attempt.score.shape, effect=simpler)
            if ratio >= max(accepted.attempt.score.shape.free - shape.free, 1) * np.log(rows):
                continue
            why = f"the same as {simpler.id} with a parameter that explains nothing beside the others"
            growth.rejected.append(Rejected.of(accepted.attempt.name, ratio, Refusal(Reason.NEEDLESS, why)))
            score = dataclasses.replace(accepted.attempt.score, shape=shape)
            attempt = dataclasses.replace(accepted.attempt, score=score)
            # Rivals that contain it, too, are it with something that explains nothing.
            rivals = tuple(
                r for r in accepted.rivals if r.name != attempt.name and simpler.id not in r.score.shape.effect.contains
            )
            growth.accepted[k] = dataclasses.replace(accepted, attempt=attempt, rivals=rivals)
            _take(bench, growth, fit)
            break


def _doubtful(bench: Bench, growth: Growth, k: int, simpler) -> bool:
    """Whether what a law has beyond a simpler one is near nothing by now."""
    layout = Layout(bench.simulator.setup, growth.fit.candidate)
    errors = np.sqrt(np.maximum(np.diag(growth.fit.covariance), 0.0))
    term, common = growth.fit.candidate.terms[k], {p.name for p in simpler.parameters}
    further = [
        abs(float(term.values[j])) <= LITTLE * errors[layout.first + at]
        for at, (owner, j) in enumerate(layout.terms)
        if owner == k and term.effect.parameters[j].name not in common
    ]
    return any(further)


def _instead(bench: Bench, growth: Growth, candidate: Candidate) -> tuple[Refit, float, int] | None:
    """A candidate with less in it, refitted, and by how much the likelihood ratio speaks for the present model, over
    so many samples; None where it cannot be simulated."""
    chain = chain_of(bench, growth.fit)
    fit = refit(bench.simulator, candidate, bench.data, chain, held=bench.held)
    if fit is None:
        return None
    with_it, rows = evidence(*moving(bench, growth.fit), bench.data[0], chain)
    without_it, _ = evidence(*moving(bench, fit), bench.data[0], chain)
    return fit, float(rows * np.log(without_it / with_it)), rows


def _take(bench: Bench, growth: Growth, fit: Refit) -> None:
    """Go on from another refit."""
    fit = with_states(bench.simulator, fit, bench.data)
    growth.fit, growth.stage = fit, stage_of_candidate(bench, fit.candidate)
    growth.runs = [held_out_run(bench, fit.candidate, d) for d in bench.validation]
    growth.accepted[-1] = dataclasses.replace(growth.accepted[-1], runs=growth.runs)
