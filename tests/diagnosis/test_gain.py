"""The gain of a finding: its size, and how far it may be from that on other records."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxgray.diagnosis.model.free_run import FreeRun
from jaxgray.diagnosis.model.held_out_gain import gain_of
from jaxgray.diagnosis.search.forward import recount
from jaxgray.diagnosis.search.state import Accepted, SearchState

FLOOR, NAMES, SAMPLES = np.array([0.1]), ("y1",), 4000


def runs(rng, *sizes):
    """A free run of every size of error, alone on its record."""
    kept = np.ones((SAMPLES, 1), bool)
    errors = [size * rng.standard_normal((SAMPLES, 1)) for size in sizes]
    return tuple([FreeRun(e, e, kept)] for e in errors)


def test_gain_is_that_of_the_errors_and_sure_of_it_where_they_are_alike_all_along():
    rng = np.random.default_rng(0)
    before, after = runs(rng, 0.4, 0.1)
    gain = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=rng)
    assert gain.percent == pytest.approx(75.0, abs=1.5)
    assert gain.ci95[0] < gain.percent < gain.ci95[1]
    assert gain.ci95[1] - gain.ci95[0] < 10
    assert gain.ci99_lower > 70


def test_runs_are_compared_where_all_of_them_count():
    rng = np.random.default_rng(3)
    before, after = runs(rng, 0.4, 0.1)
    # On its first half one of them is far off, and the other fits its first state there.
    before[0].e[: SAMPLES // 2] *= 100
    after = [FreeRun(after[0].e, after[0].e, np.arange(SAMPLES)[:, None] >= SAMPLES // 2)]
    gain = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=rng)
    assert gain.percent == pytest.approx(75.0, abs=2.0)
    assert gain.per_output["y1"] == pytest.approx((0.4, 0.1), rel=0.1)


def test_the_interval_holds_a_gain_that_leaves_next_to_nothing():
    rng = np.random.default_rng(2)
    before, after = runs(rng, 4000.0, 0.1)
    gain = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=rng)
    assert 99.99 < gain.ci95[0] < gain.percent < gain.ci95[1] < 100.0


def test_interval_reaches_as_far_as_the_gain_differs_between_records():
    rng = np.random.default_rng(1)
    before, after = runs(rng, 0.4, 0.1)
    seen_before, seen_after = runs(rng, 0.2, 0.1)
    alone = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=rng)
    seen = (seen_before, seen_after, seen_before)
    gain = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=rng, seen=seen)
    assert alone.ci95[0] > 60
    # Half of the error was left on the data of the fit, a quarter on these.
    assert gain.ci95[0] == pytest.approx(50.0, abs=3.0)
    assert gain.ci95[1] > 85
    assert gain.percent == alone.percent


@pytest.mark.parametrize(("left", "large"), [(0.1, False), (0.5, True)])
def test_a_model_that_leaves_noise_alone_loses_nothing_on_other_records(left, large):
    """Noise of 0.1, and a slow error beside it; the model before leaves 30 times more on the data of the fit than on
    these, the one after the same (`left`) on both."""
    rng = np.random.default_rng(6)
    kept, slow = np.ones((SAMPLES, 1), bool), np.sin(np.arange(SAMPLES) / 40.0)[:, None]

    def run(size):
        return [FreeRun(slow, 0.1 * rng.standard_normal((SAMPLES, 1)) + size * slow, kept)]

    before, after, seen_before, seen_after = run(0.6), run(left - 0.1), run(18.0), run(left - 0.1)
    options = {"held_out": True, "rng": rng, "seen": (seen_before, seen_after, seen_before)}
    gain = gain_of(before, after, before, FLOOR, NAMES, **options)
    assert gain.percent > 20 and (gain.ci95[0] < -100) == large
    if not large:
        # Up to what the noise allows.
        assert -60 < gain.ci95[0] < 0


def test_findings_that_gain_only_together_share_one_gain():
    rng = np.random.default_rng(5)
    base, worse, both, third = runs(rng, 0.4, 0.5, 0.1, 0.1)
    sizes = {"a": worse, "b": both, "c": third}

    def accepted(name):
        fit = SimpleNamespace(residual=[sizes[name][0].e])
        return Accepted(SimpleNamespace(fit=fit), (), SimpleNamespace(held_out=True), sizes[name])

    start = SimpleNamespace(e=base[0].e)
    state = SearchState(start, start, accepted=[accepted("a"), accepted("b")], baseline_runs=base, runs=both)
    data = SimpleNamespace(kept=np.ones((SAMPLES, 1), bool))
    context = SimpleNamespace(data=[data], names=((), NAMES), rng=rng)
    recount(context, state, FLOOR)
    gains = [one.gain for one in state.accepted]
    assert [gain.together for gain in gains] == [2, 2]
    assert all(gain.percent == pytest.approx(37.5, abs=1.0) and gain.ci95[0] > 30 for gain in gains)
    assert gains[0].per_output["y1"][1] == gains[1].per_output["y1"][0]
    assert (gains[0].per_output["y1"][0], gains[1].per_output["y1"][1]) == pytest.approx((0.4, 0.1), abs=0.01)

    state.accepted = [accepted("b"), accepted("c")]
    recount(context, state, FLOOR)
    assert [one.gain.together for one in state.accepted] == [1, 1]
    assert state.accepted[0].gain.percent == pytest.approx(75.0, abs=1.5)


def test_later_candidates_on_the_same_data_must_be_surer():
    rng = np.random.default_rng(2)
    bounds = {trials: [] for trials in (1, 5, 20)}
    for k in range(60):
        # No gain at all.
        before, after = runs(rng, 0.1, 0.1)
        for trials in bounds:
            draws = np.random.default_rng(k)
            gain = gain_of(before, after, before, FLOOR, NAMES, held_out=True, rng=draws, trials=trials)
            bounds[trials].append(gain.ci99_lower)
    assert np.all(np.diff([np.mean(bounds[trials]) for trials in (1, 5, 20)]) < 0)
    # One in a hundred of the first, a twentieth of that of the twentieth: of sixty, next to none.
    assert sum(bound > 0 for bound in bounds[1]) <= 4 and not any(bound > 0 for bound in bounds[20])


def test_what_happened_once_is_judged_by_the_pieces_of_its_record():
    rng = np.random.default_rng(3)
    kept = np.ones((SAMPLES, 1), bool)
    # Nearly all of the error is made in the last tenth: other records may gain all, or the little of the other tenths.
    size = np.where(np.arange(SAMPLES) > 0.9 * SAMPLES, 20.0, 0.11)[:, None]
    noise = rng.standard_normal((SAMPLES, 1))
    before, after = ([FreeRun(e, e, kept)] for e in (size * noise, 0.1 * noise))
    others = gain_of(before, after, before, FLOOR, NAMES, held_out=False, rng=rng)
    here = gain_of(before, after, before, FLOOR, NAMES, held_out=False, rng=rng, once=True)
    assert here.percent == others.percent > 98
    assert 5 < others.ci95[0] < 15 < here.ci95[0] < here.percent < here.ci95[1] and here.ci99_lower > 5


def test_a_piece_that_loses_may_be_another_record():
    rng = np.random.default_rng(4)
    kept = np.ones((SAMPLES, 1), bool)
    first, last = np.arange(SAMPLES) < 0.25 * SAMPLES, np.arange(SAMPLES) > 0.9 * SAMPLES
    noise = rng.standard_normal((SAMPLES, 1))
    before = np.where(last, 20.0, 0.1)[:, None] * noise
    after = np.where(first, 0.3, 0.1)[:, None] * noise
    gain = gain_of(
        [FreeRun(before, before, kept)],
        [FreeRun(after, after, kept)],
        [FreeRun(before, before, kept)],
        FLOOR,
        NAMES,
        held_out=False,
        rng=rng,
    )
    assert gain.percent > 90 and gain.ci95[0] < -100
