"""A law that a newer one makes needless in a user's simulator: which is dropped, and what stays of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxgray.diagnosis.findings import Reason
from jaxgray.diagnosis.own_simulator import contenders, search

COUNT = 100.0


def law(name):
    return SimpleNamespace(attempt=SimpleNamespace(name=(name, "y1")))


def fakes(monkeypatch, sizes, left):
    """Three laws of so many standard errors; what runs leave without the first ones."""

    def with_terms(terms):
        return SimpleNamespace(terms=terms, with_terms=with_terms)

    monkeypatch.setattr(contenders, "Layout", lambda *given: None)
    monkeypatch.setattr(contenders, "significance", lambda fit, layout, k: sizes[k])
    monkeypatch.setattr(contenders, "at_bound", lambda fit, k: None)
    monkeypatch.setattr(contenders, "noise_model_of", lambda *given: None)
    monkeypatch.setattr(contenders, "refit", lambda linear, candidate, *given, **held: candidate)
    monkeypatch.setattr(contenders, "settle", lambda problem, context, fit, wholes: SimpleNamespace(y=fit.terms))
    monkeypatch.setattr(contenders, "left_by", lambda problem, y: left[y])
    monkeypatch.setattr(contenders, "parts_of", lambda problem, y: ([], []))
    monkeypatch.setattr(contenders, "_independent", lambda runs: COUNT)
    monkeypatch.setattr(contenders, "estimated", lambda term: (0, 1))
    monkeypatch.setattr(contenders.dataclasses, "replace", lambda one, **changes: SimpleNamespace(held=None, **changes))
    settled = SimpleNamespace(linear=SimpleNamespace(setup=None), fit=None, wholes=None, data=(), y="abc")
    settled.candidate = with_terms(("a", "b", "c"))
    return settled


def test_a_law_that_is_not_significant_is_asked_for_in_the_simulator(monkeypatch):
    whole = ("a", "b", "c")
    left = {"abc": 0.0, ("b", "c"): 0.5, ("a", "c"): 0.1}
    settled = fakes(monkeypatch, {0: 0.1, 1: 0.1, 2: 0.1}, left)
    k, worth, other = contenders.needless(None, None, [law(one) for one in whole], settled)
    # Without the first, runs leave surely more: worth 50 - 2 ln 100; without the second 10 - 2 ln 100; the last is new.
    assert k == 1 and np.isclose(worth, 10.0 - 2 * np.log(100.0)) and other.y == ("a", "c")


@pytest.mark.parametrize("sizes", [{0: 9.0, 1: 9.0, 2: 0.0}, {0: 0.1, 1: 9.0, 2: 0.0}])
def test_what_is_significant_or_explains_something_stays(monkeypatch, sizes):
    settled = fakes(monkeypatch, sizes, {"abc": 0.0, ("b", "c"): 0.5})
    assert contenders.needless(None, None, [law("a"), law("b"), law("c")], settled) is None


def test_what_is_dropped_is_said(monkeypatch):
    found = iter([(0, 2.5, "without"), None])
    monkeypatch.setattr(search, "needless", lambda *given: next(found))
    states = [SimpleNamespace(accepted=[law(name)], rejected=[]) for name in ("end_stop", "cubic_stiffness")]
    settled = ["one", "both"]
    search._drop_needless(None, None, states, settled)
    assert settled == ["without"] and [len(state.accepted) for state in states] == [0, 1]
    (gone,) = states[-1].rejected
    assert (gone.effect, gone.location, gone.reason, gone.delta_bic) == ("end_stop", "y1", Reason.NEEDLESS, 2.5)
