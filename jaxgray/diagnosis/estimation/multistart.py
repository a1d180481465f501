"""Refits of the candidates of one round: which are worth it, how each is found, and how they compare."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...mechanics.effects.base import AbstractEffect, Term
from ...mechanics.runs.extended import arm_of
from ...numerics.programs.side_by_side import side_by_side
from .. import settings
from ..acceptance import at_its_bound
from ..findings import NOT_SIMULATED, Reason, Refusal, Rejected
from ..model.candidate import Candidate
from ..noise.whitening import NoiseModel
from ..screening.features import forces_of
from ..screening.linearization import Stage, rows_of
from ..screening.score_test import Score
from ..screening.shortlist import form_of
from .change_points import dated, softened, width_of
from .context import SearchContext, noise_model_of
from .continuation import ROUGH, at_the_same_steps, refit_to_convergence, sharpened
from .gauss_newton import Refit, refit
from .measured_motion import along_measured_motion
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
    """A candidate refitted: its `score`, `fit` and own `noise_model`; `criterion` with its `penalty`, and `delta_bic`,
    under the best one's noise model."""

    score: Score
    fit: Refit
    noise_model: NoiseModel
    criterion: float = np.inf
    penalty: float = 0.0
    delta_bic: float = -np.inf

    @property
    def name(self) -> tuple[str, str]:
        """Effect and place."""
        return self.score.shape.effect.id, self.score.shape.place.name


def attempts_of(
    context: SearchContext,
    stage: Stage,
    listed: list[list[Score]],
    noise_model: NoiseModel,
    rejected: list[Rejected],
    known: dict[tuple[str, str], tuple[Score, Refit]],
) -> dict[tuple[str, str], Attempt]:
    """Refits of the listed candidates; only those that still can be the best are carried to their end. Laws that
    contain a simpler one begin where that ended.

    **Arguments:** `context`; `stage`; `listed`; `noise_model` of the first refits; `rejected`: takes those that are
    far behind; `known`: refits carried to their end already, which the others are measured by.
    """
    best = min((_criterion_under(context, *one, noise_model) for one in known.values()), default=np.inf)
    names = {_name(scores[0]) for scores in listed}
    left = {_name(scores[0]): scores for scores in listed if names & set(_simpler(scores))}
    plain = [scores for scores in listed if _name(scores[0]) not in left]
    before, simple = len(rejected), {_name(scores[0]): scores[0] for scores in plain}
    fits, _ = _outright(context, stage, plain, noise_model, rejected, best)
    bases: dict[tuple[str, str], _Base] = {}
    while left:
        # Beside one another, but for laws that go on from one of the others.
        now = {name: scores for name, scores in left.items() if not left.keys() & set(_simpler(scores))} or left
        base_of = {name: next((one for one in _simpler(scores) if one in fits), None) for name, scores in now.items()}
        if None in base_of.values():
            name = next(name for name, base in base_of.items() if base is None)
            found, unlike = _outright(context, stage, [left.pop(name)], noise_model, rejected, best)
            fits |= found
            fits |= _from_wider(context, simple, fits, unlike, noise_model, best)
            continue
        left = {name: scores for name, scores in left.items() if name not in now}
        for base in set(base_of.values()) - {*bases}:
            bases[base] = _Base.of(context, *fits[base])
        beyond = {name: (bases[base], now[name]) for name, base in base_of.items()}
        for name, end in zip(beyond, side_by_side(lambda one: _beyond(context, *one), beyond.values())):
            if isinstance(end, Rejected):
                rejected.append(end)
            else:
                fits[name] = end
    rejected[before:] = [one for one in rejected[before:] if (one.effect, one.location) not in fits]
    named = _under_their_names(context, (fits | known).values())
    return _under_their_names(context, _followed(context, named, rejected))


def _under_their_names(context: SearchContext, ends: Iterable[tuple[Score, Refit]]) -> dict[tuple[str, str], Attempt]:
    """Refits by the names that their contact gives them; of two of one law at one place the better."""
    attempts: dict[tuple[str, str], Attempt] = {}
    for score, fit in ends:
        attempt = by_contact(context, Attempt(score, fit, noise_model_of(context, fit)))
        if attempt.name not in attempts or attempt.noise_model.cost < attempts[attempt.name].noise_model.cost:
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


def criterion_of(context: SearchContext, score: Score, fit: Refit) -> float:
    """BIC of a refit under the noise model that it was found under: N ln cost, and what its shape costs."""
    return fit.count * np.log(max(fit.cost, 1e-300)) + shape_penalty(context, score)


def _criterion_under(context: SearchContext, score: Score, fit: Refit, noise_model: NoiseModel) -> float:
    """BIC of a refit as it is under another noise model, infinite where it cannot be simulated."""
    same = refit(context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=0)
    return np.inf if same is None else criterion_of(context, score, same)


def unresolved(fit: Refit, score: Score) -> str | None:
    """Why a law at the end of a refit is another one there, as far as the record shows; None where it is not."""
    shape = score.shape
    term = next(t for t in fit.candidate.terms if (t.effect.id, t.place.name) == _name(score))
    return shape.effect.unresolved(np.array(term.values, dtype=float), shape.scales)


def _outright(
    context: SearchContext,
    stage: Stage,
    listed: list[list[Score]],
    noise_model: NoiseModel,
    rejected: list[Rejected],
    best: float,
) -> tuple[dict[tuple[str, str], tuple[Score, Refit]], dict[tuple[str, str], tuple[float, Refit]]]:
    """Refits from the model without the candidate, under one noise model first, then those that are left to their
    end, every form of a law by itself; and the best first refits of those that are another law there, with their
    criterion."""
    rough: dict[tuple, tuple[float, Score, Refit]] = {}
    unlike: dict[tuple[str, str], tuple[float, Refit]] = {}
    starts, words = [score for scores in listed for score in scores], {}

    def first(k):
        effect, place = _name(starts[k])
        context.progress.stage(f"refitting {effect} at {place}", fraction=k / len(starts))
        return first_fit(context, stage, starts[k], noise_model, best)

    for begin in range(0, len(starts), TOGETHER):
        together = range(len(starts))[begin : begin + TOGETHER]
        for score, fit in zip(starts[begin:], side_by_side(first, together)):
            if fit is None:
                continue
            name, criterion = _name(score), criterion_of(context, score, fit)
            if (why := unresolved(fit, score)) is not None:
                # Another law under this one's name, which others must not be measured by.
                words[name] = why
                if name not in unlike or criterion < unlike[name][0]:
                    unlike[name] = criterion, fit
                continue
            best = min(best, criterion)
            form = name, form_of(score)
            if form not in rough or criterion < rough[form][0]:
                rough[form] = criterion, score, fit
    begun = {name for name, _ in rough}
    for scores in listed:
        if (name := _name(scores[0])) not in begun:
            why = Refusal(Reason.OTHER_LAW, words[name]) if name in words else NOT_SIMULATED
            rejected.append(Rejected.of(name, scores[0].delta_bic, why))
    going: dict[tuple, tuple[Score, Refit]] = {}
    for form, (criterion, score, fit) in sorted(rough.items(), key=lambda item: item[1][0]):
        if criterion > best + settings.MAX_CRITERION_GAP:
            rejected.append(Rejected.of(form[0], score.delta_bic, dominated(criterion - best)))
            continue
        bound = at_bound(fit, len(fit.candidate.terms) - 1, context.simulator.setup.own)
        if bound is not None and criterion > best:
            rejected.append(Rejected.of(form[0], score.delta_bic, at_its_bound(bound)))
            continue
        going[form] = score, fit

    def at_end(form):
        name, (score, fit) = form[0], going[form]
        context.progress.stage(f"refining {name[0]} at {name[1]}")
        return score, refit_to_convergence(context, fit)

    ends: dict[tuple[str, str], list[tuple[Score, Refit]]] = {}
    for (name, _), end in zip(going, side_by_side(at_end, going)):
        ends.setdefault(name, []).append(end)
    return {name: _likeliest(context, several) for name, several in ends.items()}, unlike


def _likeliest(context: SearchContext, ends: list[tuple[Score, Refit]]) -> tuple[Score, Refit]:
    """The best of several refits, each under a noise model of its own."""
    if len(ends) == 1:
        return ends[0]
    return min(ends, key=lambda end: noise_model_of(context, end[1]).cost + shape_penalty(context, end[0]))


def _from_wider(
    context: SearchContext,
    listed: dict[tuple[str, str], Score],
    fits: dict[tuple[str, str], tuple[Score, Refit]],
    unlike: dict[tuple[str, str], tuple[float, Refit]],
    noise_model: NoiseModel,
    best: float,
) -> dict[tuple[str, str], tuple[Score, Refit]]:
    """Simpler laws, given up by themselves, refitted from where a wider one became one of them and is ahead of all
    others, and of a criterion: with more to move, the wider one found the way. Parameters of the same name begin with
    its values."""
    found = {}
    for name, score in listed.items():
        wider = [one for key, one in unlike.items() if key[1] == name[1]]
        wider = [one for one in wider if name[0] in one[1].candidate.terms[-1].effect.contains]
        if not wider:
            continue
        reached = min([best, *(_criterion_under(context, *one, noise_model) for one in fits.values())])
        criterion, fit = min(wider, key=lambda one: one[0])
        if criterion > reached:
            continue
        context.progress.stage(f"refitting {name[0]} at {name[1]}")
        last, shape = fit.candidate.terms[-1], score.shape.term(score.weights)
        known = last.effect.named_values(last.values)
        values = [known.get(p.name, value) for p, value in zip(shape.effect.parameters, shape.values)]
        term = Term(shape.effect, shape.place, shape.effect.bounded(np.array(values, float)))
        begin = fit.candidate.with_terms((*fit.candidate.terms[:-1], term))
        again = refit(
            context.simulator, begin, context.data, noise_model, held=context.held, max_steps=10, tolerance=ROUGH
        )
        if again is not None and criterion_of(context, score, again) < reached:
            found[name] = score, refit_to_convergence(context, again)
    return found


@dataclass(frozen=True)
class _Base:
    """The refit of a law that others contain, under the noise model that they are refitted with; `most`: the criterion
    from which one of them pays too little."""

    score: Score
    fit: Refit
    noise_model: NoiseModel
    most: float

    @classmethod
    def of(cls, context: SearchContext, score: Score, fit: Refit) -> "_Base":
        noise_model = noise_model_of(context, fit)
        # With the same samples counted as what is compared with it.
        again = refit(
            context.simulator, fit.candidate, context.data, noise_model, held=context.held, max_steps=3, tolerance=ROUGH
        )
        fit = fit if again is None else again
        # Noise at the forces may hide what a law is worth.
        most = criterion_of(context, score, fit) + (
            settings.MIN_DELTA_BIC if noise_model.ratio == 0.0 else settings.MAX_CRITERION_GAP
        )
        return cls(score, fit, noise_model, most)


def _beyond(context: SearchContext, base: _Base, scores: list[Score]) -> tuple[Score, Refit] | Rejected:
    """The best refit of a law from that of a simpler one which it contains, or why there is none: its further
    parameters pay too little."""
    simple, noise_model, most = base.fit, base.noise_model, base.most
    name = _name(scores[0])
    context.progress.stage(f"refitting {name[0]} at {name[1]}")
    last = simple.candidate.terms[-1]
    known = last.effect.named_values(last.values)
    found = []
    for score in scores:
        shape = score.shape.term(score.weights)
        term = Term(shape.effect, shape.place, shape.effect.widened(np.array(shape.values, dtype=float), known))
        begin = simple.candidate.with_terms((*simple.candidate.terms[:-1], term))
        with np.errstate(over="ignore"):
            abandon = np.exp((most - shape_penalty(context, score)) / simple.count)
        options = {"held": context.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
        fit = refit(context.simulator, begin, context.data, noise_model, **options)
        if fit is not None:
            found.append((criterion_of(context, score, fit), score, fit))
    if not found:
        return Rejected.of(name, scores[0].delta_bic, NOT_SIMULATED)
    if min(criterion for criterion, *_ in found) > most:
        words = f"explains no more than {base.score.shape.effect.id}, which it contains"
        return Rejected.of(name, scores[0].delta_bic, Refusal(Reason.NEEDLESS, words))
    context.progress.stage(f"refining {name[0]} at {name[1]}")
    # A start that is ahead after a few steps need not lead to the best end.
    ends = [(score, refit_to_convergence(context, fit)) for criterion, score, fit in found if criterion <= most]
    return _likeliest(context, ends)


def _followed(
    context: SearchContext, attempts: dict[tuple[str, str], Attempt], rejected: list[Rejected]
) -> list[tuple[Score, Refit]]:
    """The refits with their forces followed in steps as short as the best of them needs; all in the same, since what
    shorter steps mend is not a law's merit."""
    if not attempts:
        return []
    costs = {name: one.noise_model.cost + shape_penalty(context, one.score) for name, one in attempts.items()}
    best, steps = min(costs, key=costs.get), context.simulator.steps
    sharp = sharpened(context, attempts[best].fit)
    if sharp is attempts[best].fit and context.simulator.steps == steps:
        return [(one.score, one.fit) for one in attempts.values()]
    near = {name: one for name, one in attempts.items() if costs[name] - costs[best] < settings.MAX_CRITERION_GAP}
    for name, one in attempts.items():
        if name not in near:
            rejected.append(Rejected.of(name, one.score.delta_bic, dominated(costs[name] - costs[best])))

    def again(name):
        return sharp if name == best else at_the_same_steps(context, near[name].fit)

    return [(one.score, fit) for one, fit in zip(near.values(), side_by_side(again, near))]


def by_contact(context: SearchContext, attempt: Attempt) -> Attempt:
    """The attempt under the name that its contact gives it, its own where the other is not looked for."""
    law = called_by_contact(context, attempt.fit.candidate, -1)
    return attempt if law.id == attempt.fit.candidate.terms[-1].effect.id else called(attempt, law)


def called_by_contact(context: SearchContext, candidate: Candidate, k: int) -> AbstractEffect:
    """What the k-th law of a model is called by its contact: backlash where the gap is left in more than half of the
    samples, an end stop where in fewer; the law is the same. As it is where the other is not looked for."""
    term = candidate.terms[k]
    if not term.effect.by_contact:
        return term.effect
    data, arm = context.data[0], np.asarray(arm_of(term, context.simulator.plant(candidate)))
    q = context.simulator.motion(candidate, data)[0][: data.samples, : len(arm)]
    contact = np.mean(np.abs(q @ arm) > float(term.values[1]))
    name = term.effect.by_contact[0 if contact > 0.5 else 1]
    return next((one for one in context.catalogue if one.id == name), term.effect)


def called(attempt: Attempt, law: AbstractEffect) -> Attempt:
    """The attempt under another name of the same law."""
    shape = dataclasses.replace(attempt.score.shape, effect=law)
    fit = renamed(attempt.fit, attempt.name, law)
    return dataclasses.replace(attempt, fit=fit, score=dataclasses.replace(attempt.score, shape=shape))


def renamed(fit: Refit, name: tuple[str, str], law: AbstractEffect) -> Refit:
    """A refit with a law, given by effect and place, under another name where it is there."""
    terms = [Term(law, t.place, t.values) if (t.effect.id, t.place.name) == name else t for t in fit.candidate.terms]
    return dataclasses.replace(fit, candidate=fit.candidate.with_terms(tuple(terms)))


def shape_penalty(context: SearchContext, score: Score) -> float:
    """What the BIC of a law takes for its parameters, and for the shapes and places among which it was chosen."""
    return score.shape.free * np.log(rows_of(context.data[0])) + 2 * np.log(score.shape.tried)


def first_fit(context: SearchContext, stage: Stage, score: Score, noise_model: NoiseModel, best: float) -> Refit | None:
    """Refit the model with one more term under a given noise model; given up early where it is far behind the best."""
    fit = None
    nothing = float(np.sum(weighted(noise_model, stage.e[:, :, None], context.data[0].kept) ** 2))
    with np.errstate(over="ignore"):
        abandon = np.exp(
            (best + 2 * settings.MAX_CRITERION_GAP - shape_penalty(context, score)) / rows_of(context.data[0])
        )
    for term in softened(score.shape.term(score.weights), score.shape.scales):
        if fit is not None:
            if fit.count * np.log(max(fit.cost, 1e-300)) > best + 10 * settings.MAX_CRITERION_GAP:
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
            begin = dated(context, begin, noise_model, width_of(fit.candidate.terms[-1]))
        options = {"held": context.held, "max_steps": 10, "tolerance": ROUGH, "abandon": abandon}
        begun = refit(context.simulator, begin, context.data, noise_model, **options)
        if begun is not None:
            # Another start is worth its time only while it promises more than this one gave.
            options["abandon"] = min(abandon, begun.cost)
        if fit is None and (begun is None or begun.started > nothing):
            # The linear model took so much of the effect upon itself that all must move together, from little.
            little = score.shape.term(LITTLE * score.weights)
            little = Term(term.effect, term.place, np.where(_amplitudes(term), little.values, term.values))
            terms = (*stage.candidate.terms, little)
            again = refit(
                context.simulator,
                stage.candidate.with_terms(terms),
                context.data,
                noise_model,
                shapes_after=2,
                **options,
            )
            if begun is None or (again is not None and again.cost < begun.cost):
                begun = again
            if begun is not None and not begun.converged:
                options["abandon"] = min(abandon, begun.cost)
                # Or the linear model gives back what it took before the free run of the term counts.
                measured = along_measured_motion(context, stage, score, tolerance=ROUGH)
                start, more = (begin, {"last_after": HELD_BACK}) if measured is None else (measured, {})
                again = refit(context.simulator, start, context.data, noise_model, **more, **options)
                begun = again if again is not None and again.cost < begun.cost else begun
        for whole in _in_place_of_element(context, stage, score, noise_model) if fit is None else ():
            again = refit(context.simulator, whole, context.data, noise_model, **options | {"abandon": abandon})
            begun = again if begun is None or (again is not None and again.cost < begun.cost) else begun
        fit = begun
        if fit is None:
            return None
    return fit


def _in_place_of_element(
    context: SearchContext, stage: Stage, score: Score, noise_model: NoiseModel
) -> list[Candidate]:
    """The model with a law in the place of the spring or damper that the linear model has there, and as large, with the
    shape that comes nearest: backlash leaves nothing beside it. Empty for other laws, and where there is no such
    element."""
    setup, plant, effect, place = context.simulator.setup, stage.plant, score.shape.effect, score.shape.place
    if not effect.replaces or len(plant.mass) > setup.dofs:
        return []
    owner = effect.replaces
    matrices = {key: np.asarray(getattr(plant, key)) for key in ("mass", "damping", "stiffness")}
    X, first, second = matrices[owner], place.first, place.second
    there = float(-X[first, second] if second >= 0 else X[first].sum())
    if not there > 0.0:
        return []
    data, along = context.data[0], stage.motion.v if owner == "damping" else stage.motion.q
    arm = np.asarray(arm_of(score.shape.term(score.weights), plant))
    # As large as what it replaces, along the motion.
    shapes = [dataclasses.replace(score.shape, values=p, basis=(p,)) for p in effect.shapes(score.shape.scales)]
    made = np.asarray(forces_of(shapes, plant, stage.motion, data))[:, : data.samples]
    force = there * (along @ arm)[: data.samples]
    sizes = made @ force / np.maximum(np.sum(made**2, axis=1), 1e-300)
    terms = [shape.term(np.array([size])) for shape, size in zip(shapes, sizes)]
    matrices[owner] = X - there * np.outer(arm, arm)
    begin = stage.candidate.with_entries(setup.entries_of(**matrices))
    tried = [begin.with_terms((*stage.candidate.terms, term)) for term in terms]
    options = {"held": context.held, "max_steps": 0}
    runs = [refit(context.simulator, candidate, context.data, noise_model, **options) for candidate in tried]
    costs = [np.inf if run is None else run.cost for run in runs]
    return [tried[int(np.argmin(costs))]]


def _amplitudes(term: Term) -> np.ndarray:
    return np.array([parameter.amplitude for parameter in term.effect.parameters])


def compared(context: SearchContext, stage: Stage, attempts: list[Attempt]) -> list[Attempt]:
    """Attempts by their criterion under the noise model of the best, best first."""
    if not attempts:
        return []

    own = [a.noise_model.cost + shape_penalty(context, a.score) for a in attempts]
    noise_model = attempts[int(np.argmin(own))].noise_model
    data = context.data[0]
    base, rows = evidence(stage.e, stage.J, data, noise_model)
    result = []
    for a in attempts:
        cost, _ = evidence(*moving(context, a.fit), data, noise_model)
        penalty = shape_penalty(context, a.score)
        criterion = rows * np.log(max(cost, 1e-300)) + penalty
        delta = rows * np.log(base) - criterion
        result.append(dataclasses.replace(a, criterion=float(criterion), penalty=penalty, delta_bic=float(delta)))
    return sorted(result, key=lambda a: a.criterion)


def moving(context: SearchContext, fit: Refit) -> tuple[np.ndarray, np.ndarray]:
    """Residual of a refit on the first record, and the columns of its Jacobian for what may move."""
    J = fit.jacobian[0]
    kept = np.concatenate([~context.held, np.ones(J.shape[2] - len(context.held), bool)])
    return fit.residual[0], J[:, :, kept]
