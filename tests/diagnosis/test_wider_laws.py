"""Laws that turn into a simpler one: where their refit begins, and what becomes of the simpler one beside them."""

import dataclasses
import zlib
from types import SimpleNamespace

import hidden
import numpy as np
import pytest
from found import check_found, diagnosed

import jaxgray
from jaxgray.diagnosis.estimation import multistart
from jaxgray.diagnosis.estimation.context import noise_model_of
from jaxgray.diagnosis.estimation.gauss_newton import refit
from jaxgray.diagnosis.estimation.multistart import Attempt
from jaxgray.diagnosis.estimation.significance import at_bound
from jaxgray.diagnosis.findings import Reason, Refusal, Rejected
from jaxgray.diagnosis.search import forward as growing
from jaxgray.diagnosis.search.backward import prune
from jaxgray.diagnosis.search.state import Accepted
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Term
from jaxgray.numerics.progress import Silent

LAWS = ["coulomb_friction", "stribeck_friction", "constant_force"]


@pytest.fixture(scope="module")
def friction():
    """A record with friction that is larger at rest, what is said about it, and the loop once the first was accepted.

    The score asks for less friction at rest than in motion, and a refit from there makes vs run to nothing.
    """
    rng = np.random.default_rng([92001, 0, zlib.crc32(b"stribeck_friction"), 4])
    case = hidden.random_case(rng, "stribeck_friction", excess=(1.5, 4.0), samples=4000, dofs=(1, 2, 3))
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growing, "prune", lambda context, state: seen.append((context, dataclasses.replace(state))))
        diagnosis = diagnosed(case, only=LAWS)
    return case, diagnosis, seen


@pytest.mark.slow
def test_friction_at_rest_is_found_from_the_refit_without_it(friction):
    case, diagnosis, _ = friction
    check_found(case, diagnosis)
    assert diagnosis.verdict == "named" and diagnosis.findings[0].effect == "stribeck_friction", str(diagnosis)


@pytest.mark.slow
def test_a_wider_law_takes_in_the_simpler_one_accepted_before(friction):
    context, state = friction[2][0]
    whole, noise_model, accepted = state.fit, noise_model_of(context, state.fit), state.accepted[0]
    wide = whole.candidate.terms[0]
    Fc, Fs, vs, eps = (float(value) for value in wide.values)
    simple = Term(by_id("coulomb_friction"), wide.place, np.array([Fc, eps]))
    first = refit(
        context.simulator, whole.candidate.with_terms((simple,)), context.data, noise_model, held=context.held
    )
    # The same force as the sum of two laws, of which the wider one has nothing left of what both name.
    beside = Term(wide.effect, wide.place, np.array([0.0, Fs - Fc, vs, eps]))
    both = whole.candidate.with_terms((simple, beside))
    both = refit(context.simulator, both, context.data, noise_model, held=context.held, max_steps=0)
    assert at_bound(both, 1) is None
    assert at_bound(dataclasses.replace(both, candidate=both.candidate.with_terms((beside,))), 0) == "Fc"

    score, shape = accepted.attempt.score, accepted.attempt.score.shape
    coulomb = dataclasses.replace(score, shape=dataclasses.replace(shape, effect=simple.effect))
    state.accepted = [
        Accepted(Attempt(coulomb, first, noise_model, delta_bic=300.0), (), accepted.gain, state.runs),
        dataclasses.replace(accepted, attempt=Attempt(score, both, noise_model, delta_bic=200.0), rivals=()),
    ]
    state.fit, state.rejected = both, []
    prune(context, state)
    (left,) = state.accepted
    assert left.attempt.name == ("stribeck_friction", wide.place.name) and left.attempt.fit is state.fit
    assert [(one.effect, one.location) for one in state.rejected] == [("coulomb_friction", wide.place.name)]
    np.testing.assert_allclose(state.fit.candidate.terms[0].values, wide.values, rtol=0.02)
    assert left.attempt.delta_bic > 480


def test_a_wider_law_begins_as_the_simpler_one():
    simple, wide = (by_id(name) for name in LAWS[:2])
    p = wide.widened(np.array([0.3, 0.1, 0.5, 1e-3]), {"Fc": 0.7, "eps": 2e-3})
    v = np.linspace(-2.0, 2.0, 41)
    here = jaxgray.mechanics.effects.base.Local(0.0, v, 0.0, 1.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(wide.force(p, here, None), simple.force(np.array([0.7, 2e-3]), here, None), rtol=1e-12)


@pytest.mark.slow
def test_a_record_is_judged_where_no_law_is_left_to_look_for(friction):
    diagnosis = diagnosed(friction[0], only=["coulomb_friction"])
    assert [finding.effect for finding in diagnosis.findings] == ["coulomb_friction"], str(diagnosis)
    assert diagnosis.verdict == "partly", str(diagnosis)


class Start(SimpleNamespace):
    """As much of a candidate as its terms."""

    terms = ()

    def with_terms(self, terms):
        made = Start()
        made.terms = tuple(terms)
        return made


def of_place(name, cost, count=100):
    """A wide law at a place that became the simple one, refitted with a criterion."""
    term = Term(by_id("stribeck_friction"), SimpleNamespace(name=name), np.array([0.7, 0.1, 1e-4, 2e-3]))
    return cost, SimpleNamespace(candidate=Start().with_terms([term]), cost=np.exp(cost / count), count=count)


def score_of(id, *values):
    effect, place = by_id(id), SimpleNamespace(name="y1")
    shape = SimpleNamespace(effect=effect, place=place, free=1, tried=1, term=lambda w: Term(effect, place, values))
    return SimpleNamespace(shape=shape, weights=np.ones(1))


@pytest.fixture
def refits(monkeypatch):
    """Refits that all come to a criterion of −500, and the terms that they began with."""
    begun = []

    def refitted(simulator, candidate, *given, **options):
        begun.append(candidate.terms)
        return SimpleNamespace(candidate=candidate, cost=np.exp(-5.0), count=100)

    monkeypatch.setattr(multistart, "refit", refitted)
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda context, fit: fit)
    monkeypatch.setattr(multistart, "shape_penalty", lambda context, score: 0.0)
    return begun


CONTEXT = SimpleNamespace(simulator=None, data=None, held=None, progress=Silent())
COULOMB, STRIBECK = ("coulomb_friction", "y1"), ("stribeck_friction", "y1")


def test_a_simpler_law_goes_on_from_a_wider_one_that_became_it(refits):
    score = score_of("coulomb_friction", 0.2, 1e-3)

    def found(unlike, fits=None, best=np.inf):
        refits.clear()
        return multistart._from_wider(CONTEXT, {COULOMB: score}, fits or {}, unlike, None, best)

    ((name, (_, fit)),) = found({STRIBECK: of_place("y1", -300.0)}).items()
    assert name == COULOMB
    ((term,),) = refits
    assert term.effect is score.shape.effect and term.place is score.shape.place
    np.testing.assert_array_equal(term.values, [0.7, 2e-3])
    # Not at another place, not behind another law (−500) or a refit that is known, and not where it comes to no more.
    assert not found({("stribeck_friction", "y2"): of_place("y2", -300.0)}) and not refits
    assert not found({STRIBECK: of_place("y1", -200.0)}, {("cubic_stiffness", "y2"): (score, fit)})
    assert not found({STRIBECK: of_place("y1", -200.0)}, best=-400.0) and not refits
    assert not found({STRIBECK: of_place("y1", -700.0)}, best=-600.0) and len(refits) == 1
    assert not found({})


def test_a_law_that_was_given_up_comes_back_by_a_wider_one(refits, monkeypatch):
    def outright(context, stage, listed, noise_model, rejected, best):
        (scores,) = listed
        name = scores[0].shape.effect.id, "y1"
        why = multistart.dominated(900.0) if name == COULOMB else Refusal(Reason.OTHER_LAW, "rounded off")
        rejected.append(Rejected.of(name, 5.0, why))
        return {}, {} if name == COULOMB else {STRIBECK: of_place("y1", -300.0)}

    monkeypatch.setattr(multistart, "_outright", outright)
    monkeypatch.setattr(
        multistart, "_followed", lambda context, found, rejected: [(a.score, a.fit) for a in found.values()]
    )
    monkeypatch.setattr(multistart, "by_contact", lambda context, attempt: attempt)
    monkeypatch.setattr(multistart, "noise_model_of", lambda context, fit: SimpleNamespace(cost=0.0))
    listed = [[score_of("stribeck_friction", 0.1, 0.1, 0.1, 1e-3)], [score_of("coulomb_friction", 0.2, 1e-3)]]
    refused = Rejected.of(COULOMB, 1.0, multistart.dominated(50.0))
    rejected = [refused]
    attempts = multistart.attempts_of(CONTEXT, None, listed, None, rejected, {})
    assert list(attempts) == [COULOMB]
    # Of this round it is refused no more; what an earlier one said of it stays.
    assert rejected[0] is refused and [(one.effect, one.location) for one in rejected[1:]] == [STRIBECK]
