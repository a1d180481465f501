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


def test_a_simpler_law_goes_on_from_a_wider_one_that_became_it(monkeypatch):
    simple, wide = (by_id(name) for name in LAWS[:2])
    place, other = (SimpleNamespace(name=name) for name in ("y1", "y2"))

    class Start(SimpleNamespace):
        terms = ()

        def with_terms(self, terms):
            made = Start()
            made.terms = tuple(terms)
            return made

    def ended(at, cost, count=100):
        term = Term(wide, at, np.array([0.7, 0.1, 1e-4, 2e-3]))
        return SimpleNamespace(candidate=Start().with_terms([term]), cost=np.exp(cost / count), count=count)

    shape = SimpleNamespace(
        effect=simple, place=place, free=1, tried=1, term=lambda w: Term(simple, place, np.array([0.2, 1e-3]))
    )
    score = SimpleNamespace(shape=shape, weights=np.ones(1))
    begun = []

    def refitted(simulator, candidate, *given, **options):
        begun.append(candidate.terms)
        return SimpleNamespace(candidate=candidate, cost=np.exp(-5.0), count=100)

    monkeypatch.setattr(multistart, "refit", refitted)
    monkeypatch.setattr(multistart, "refit_to_convergence", lambda context, fit: fit)
    monkeypatch.setattr(multistart, "_penalty", lambda context, score: 0.0)
    context = SimpleNamespace(simulator=None, data=None, held=None, progress=Silent())

    def found(unlike, fits=None):
        begun.clear()
        return multistart._from_wider(context, {("coulomb_friction", "y1"): score}, fits or {}, unlike, None)

    ahead = {("stribeck_friction", "y1"): (-300.0, ended(place, -300.0))}
    ((name, (_, fit)),) = found(ahead).items()
    assert name == ("coulomb_friction", "y1")
    ((term,),) = begun
    assert term.effect is simple and term.place is place
    np.testing.assert_array_equal(term.values, [0.7, 2e-3])
    # Not at another place, and not where the law is ahead by itself: its own refit has −500 here.
    assert not found({("stribeck_friction", "y2"): (-300.0, ended(other, -300.0))}) and not begun
    assert not found({("stribeck_friction", "y1"): (-200.0, ended(place, -200.0))}, {name: (score, fit)})
    assert not found({})
