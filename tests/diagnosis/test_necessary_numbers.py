"""Which numbers of a simulator have to be other: runs that are no numbers, and how a class of them is told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxgray.diagnosis.findings import Estimate, Finding, Gain, Member
from jaxgray.diagnosis.model.free_run import FreeRun
from jaxgray.diagnosis.own_simulator import necessary_numbers
from jaxgray.diagnosis.own_simulator.settling import left_of
from jaxgray.diagnosis.words.sentences import _correction


@pytest.mark.parametrize(("left", "used"), [(1.0, True), (np.nan, False), (np.inf, False)])
def test_a_run_that_is_no_number_is_refused(monkeypatch, left, used):
    layout = SimpleNamespace(moved=lambda theta, step, like: theta + step, candidate=lambda vector, like: vector)
    monkeypatch.setattr(necessary_numbers, "shown_by", lambda *arguments, **options: (np.zeros((3, 1)),))
    monkeypatch.setattr(necessary_numbers, "left_by", lambda *arguments: left)
    monkeypatch.setattr(necessary_numbers.dataclasses, "replace", lambda one, **changes: changes)
    about = SimpleNamespace(layout=layout, theta=np.ones(2), count=2)
    fewer = necessary_numbers._Fewer(None, SimpleNamespace(candidate=None, fit=None), about, None)
    assert (fewer._moved(np.zeros(2), np.eye(2), 10.0) is not None) == used


@pytest.mark.parametrize(
    ("fit", "unseen", "sure", "missed"),
    [
        (0.05, 0.05, False, True),
        (0.05, 0.001, False, False),
        (0.05, 0.001, True, True),
        (0.05, -0.05, False, False),
        (0.001, 0.05, True, False),
    ],
)
def test_a_number_is_missed_where_data_that_the_fit_has_not_seen_say_so(monkeypatch, fit, unseen, sure, missed):
    """Shares by which runs without it leave more, in the data of the fit and in those held out; whether its gain is
    sure."""
    samples, e = 1000, np.random.default_rng(1).standard_normal((1000, 1))

    def runs(settled_y):
        made = [[FreeRun(e, share * e, np.ones(e.shape, bool))] for share in settled_y]
        return made[0], made[1]

    monkeypatch.setattr(necessary_numbers, "parts_of", lambda problem, y: runs(y))
    monkeypatch.setattr(necessary_numbers, "left_by", lambda problem, y: left_of(runs(y)[0]))
    about = SimpleNamespace(samples=samples, penalty=np.log(samples))
    fewer = necessary_numbers._Fewer(None, None, about, None)
    without, shown = (SimpleNamespace(y=y) for y in (np.sqrt([1 + fit, 1 + unseen]), (1.0, 1.0)))
    lower = 1.0 if sure else -1.0
    gain = Gain({}, 1.0, (lower, 2.0), lower, True)
    assert fewer._missed(without, shown, gain) == missed


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A fit of one number, which was given as 1, and of the size of a law beside it."""

    candidate: SimpleNamespace
    covariance: np.ndarray
    undetermined: np.ndarray


@dataclasses.dataclass(frozen=True)
class Simulated:
    """What is settled with it."""

    candidate: SimpleNamespace
    fit: Fitted
    linear: SimpleNamespace
    pushed: tuple = ()
    y: float = 0.0


@pytest.mark.parametrize(("left", "used"), [(1.0, True), (3.0, False)])
def test_numbers_go_on_by_own_runs_where_fewer_leave_less(monkeypatch, left, used):
    """All numbers leave 2 of what one alone leaves 1; own runs from there leave `left`."""
    candidate = SimpleNamespace(entries=np.array([1.5]), terms=())
    fit = Fitted(candidate, np.array([[1e-4]]), np.zeros(1, bool))
    settled = Simulated(candidate, fit, SimpleNamespace(setup=None), y=2.0)
    fewer, further = dataclasses.replace(settled, y=1.0), dataclasses.replace(settled, pushed=("none",), y=left)
    monkeypatch.setattr(necessary_numbers, "Layout", lambda *given: SimpleNamespace(vector=lambda one: one.entries))
    monkeypatch.setattr(necessary_numbers, "left_by", lambda problem, y: y)
    monkeypatch.setattr(necessary_numbers, "_by_own_runs", lambda *given: further)
    monkeypatch.setattr(necessary_numbers, "_sharpened", lambda problem, shown, free: shown)
    search = necessary_numbers._Fewer
    monkeypatch.setattr(search, "first", lambda self: (np.ones(1, bool), fewer if self.settled.y == 2.0 else further))
    monkeypatch.setattr(search, "found", lambda self, free, shown: (self.settled, free, {}, {0: ()}, {}))
    made = necessary_numbers.necessary(None, settled, np.ones(1), 200, lambda one, other: None).settled
    assert made.y == (left if used else 2.0)


@pytest.mark.parametrize(
    ("evidence", "apart", "clear"),
    [(130.0, 1.0, True), (110.0, 1.0, False), (2000.0, 0.2, True), (300.0, 0.2, False), (1e6, 0.1, False)],
)
def test_evidence_of_a_number_is_clear_however_wrong_slopes_are(evidence, apart, clear):
    fewer = necessary_numbers._Fewer(None, None, SimpleNamespace(apart=lambda free, k: apart), None)
    assert fewer._clear(evidence, np.ones(2, bool), 0) == clear


def test_no_run_is_spent_where_slopes_foretell_nothing(monkeypatch):
    """A number that went back leaves 30 units whatever the other does, of which a step would mend 0.01."""
    about = SimpleNamespace(theta=np.zeros(2), conditional=lambda free: (np.array([0.0, 1.0]), 1e-2 * np.eye(2)))
    search, runs = necessary_numbers._Fewer, []
    monkeypatch.setattr(search, "_moved", lambda self, *given: runs.append(given) or SimpleNamespace(y="there"))
    monkeypatch.setattr(search, "_hopeless", lambda self, *given: False)
    monkeypatch.setattr(search, "_left", lambda *given: 30.0)
    monkeypatch.setattr(search, "_slope", lambda *given: np.array([0.0, 1.0]))
    assert search(None, None, about, None)._with(np.array([False, True]), 50.0).y == "there"
    assert len(runs) == 1


@pytest.mark.parametrize("off", [0.0, 2.0, 4.0, 6.0])
def test_a_law_is_no_surer_than_a_number_that_went_back(monkeypatch, off):
    """`off`: standard errors by which the number was off."""
    candidate = SimpleNamespace(entries=np.array([1 + 0.01 * off]), terms=())
    covariance, loose = 1e-4 * np.array([[1.0, -0.99], [-0.99, 1.0]]), np.zeros(1, bool)
    settled = Simulated(candidate, Fitted(candidate, covariance, loose), SimpleNamespace(setup=None))
    layout = SimpleNamespace(vector=lambda one: np.array([*one.entries, 2.0]))
    monkeypatch.setattr(necessary_numbers, "Layout", lambda *given: layout)
    back, restricted = necessary_numbers._Ellipsoid(settled, np.ones(1), 200).conditional(np.zeros(1, bool))
    shown = Simulated(SimpleNamespace(entries=np.ones(1)), Fitted(candidate, restricted, loose), settled.linear)
    found = shown, np.zeros(1, bool), {}, {}, {}
    monkeypatch.setattr(necessary_numbers._Fewer, "first", lambda self: (found[1], settled))
    monkeypatch.setattr(necessary_numbers._Fewer, "leaves_less", lambda *given: False)
    monkeypatch.setattr(necessary_numbers._Fewer, "found", lambda *given: found)
    made = necessary_numbers.necessary(None, settled, np.ones(1), 200, lambda one, other: None).settled
    error, gone = np.sqrt(made.fit.covariance[1, 1]), abs(back[1] - 2.0)
    # As likely as the number is other after all; below the penalty of a parameter that is hardly so.
    likely = 1 / (1 + np.exp((np.log(200) - off**2) / 2))
    assert error == pytest.approx(np.hypot(np.sqrt(restricted[1, 1]), np.sqrt(likely) * gone), rel=1e-6)
    assert gone == pytest.approx(0.0099 * off) and made.fit.covariance[0, 0] == 0.0


def test_runs_say_what_a_number_that_went_back_asks_of_the_others(monkeypatch):
    """Two numbers, of which runs that hang sharply on them miss the second one by 40 units, and no other data do."""
    whole, fewer = (SimpleNamespace(entries=np.array(entries)) for entries in ([2.0, 1.1], [2.5, 1.0]))
    layout = SimpleNamespace(vector=lambda one: one.entries)
    about = SimpleNamespace(layout=layout, theta=whole.entries, penalty=10.0, count=2, known=np.ones(2, bool))
    about.free_only = lambda: np.ones(2, bool)
    settled = SimpleNamespace(candidate=whole, y="whole", pushed=("forces",))
    other = SimpleNamespace(candidate=fewer, y="fewer")
    search = necessary_numbers._Fewer
    monkeypatch.setattr(search, "_with", lambda self, free, within: None if free[1] else other)
    monkeypatch.setattr(search, "_doubtful", lambda self, free: [1] if free[1] else [])
    monkeypatch.setattr(search, "_missed", lambda *given: False)
    monkeypatch.setattr(search, "_left", lambda self, one, two: 40.0 * ((one.y == "fewer") - (two.y == "fewer")))
    monkeypatch.setattr(search, "_worth", lambda *given: np.inf)
    monkeypatch.setattr(search, "_rivals", lambda *given: ())
    fewest = search(None, settled, about, lambda one, two: None)
    shown, free, _, _, gone = fewest.found(*fewest.first())
    assert shown is other and list(free) == [True, False]
    assert list(gone) == [1]
    np.testing.assert_allclose(gone[1], np.array([0.5, 0.1]) ** 2, rtol=1e-5)


def test_a_number_and_a_law_that_stand_for_one_another_are_both_told():
    number = {"delta": Estimate(0.1, 0.01, ""), "value": Estimate(0.6, 0.01, "")}
    law = Member("coulomb_friction", "y1", -1.0, {"Fc": Estimate(0.2, 0.01, "N")})
    members = (Member("parameter_error", "seal", 0.0, number), Member("parameter_error", "bearing", 0.0, number), law)
    finding = Finding("parameter_error", "seal", "equivalent", "model", members, number, 20.0, None)
    said = _correction(finding, ("y1",))
    assert said.startswith(
        "seal is 0.60 ± 0.01, not 0.5, or bearing is 0.60 ± 0.01, not 0.5, or Coulomb friction at y1"
    )
    assert said.endswith("(this record cannot tell which)")
