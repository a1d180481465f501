"""A parameter that changes over time, read off linear models of the windows of a record; laws that take the free run
out of step, found by the force equation."""

import types

import frames
import hidden_laws
import numpy as np
import pytest

import jaxgray
from jaxgray.diagnosis.model.candidate import Candidate, Data
from jaxgray.diagnosis.search.parts import missed_share
from jaxgray.diagnosis.starts import windows
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.effects.base import Place

H = 0.01


def shaken(effect, seed, samples=3000):
    """Two storeys on a shaken base, lightly damped: tens of periods in which a wrong frequency falls out of step."""
    frame = frames.Frame((120.0, 90.0), (1.9e5, 1.5e5), (60.0, 50.0))
    rng = np.random.default_rng(seed)
    u = 1.2 * frames.band_noise(rng, samples, 1, (0.5, 12.0), H)
    clean = frames.shaken_with(frame, u, H, [] if effect is None else [effect])[0]
    y = clean + 3e-3 * clean.std() * rng.standard_normal(clean.shape)
    units = {"input_units": ["m/s^2"], "output_units": ["m/s^2"] * 2}
    return frame, jaxgray.Record(u, y, H, hold="linear", measured="acceleration", **units)


@pytest.mark.slow
def test_a_step_of_stiffness_is_placed_and_dated_whatever_else_could_begin_then():
    lost, place = -0.1 * 1.5e5, "y1-y2"
    frame, record = shaken(hidden_laws.Effect("stiffness_step", place, {"dk": lost, "t0": 11.237}), 12)
    found = jaxgray.diagnose(record, excitation="base-acceleration")
    (finding,) = (f for f in found.findings if f.stage == "model")
    assert (finding.effect, finding.location) == ("stiffness_step", place)
    dk, t0 = finding.parameters["dk"], finding.parameters["t0"]
    assert abs(dk.value - lost / frame.masses[0]) < 4 * dk.standard_error < 0.02 * abs(dk.value)
    assert abs(t0.value - 11.237) < 4 * t0.standard_error < 0.02
    assert found.excess < 1.05


@pytest.mark.slow
def test_a_stop_that_only_the_largest_motion_meets_is_found_by_the_force_equation():
    frame, still = shaken(None, 13)
    drift = float(np.std(frames.shaken_with(frame, still.u, H, [])[1][:, 0]))
    law = hidden_laws.Effect("end_stop", "y1", {"gap": 1.5 * drift, "ks": 1.9e5})
    found = jaxgray.diagnose(shaken(law, 13)[1], excitation="base-acceleration")
    (finding,) = (f for f in found.findings if f.stage == "model")
    assert ("end_stop", "y1") in {(m.effect, m.location) for m in finding.members}
    gap = finding.parameters["gap"]
    assert abs(gap.value - 1.5 * drift) < 4 * gap.standard_error < 0.02 * gap.value
    assert found.excess < 1.05


def test_the_moment_of_a_change_is_where_the_frequencies_differ():
    hz = np.array([[2.0, 5.0]] * 4 + [[1.9, 5.0]] + [[1.8, 5.0]] * 5)
    assert windows.moment_of(hz) in (4, 5)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        # A mode that the windows hardly determine, and a rigid body that rounds to anything, tell nothing.
        noisy = np.concatenate(
            [1e-6 * rng.random((10, 1)), hz * (1 + [1e-3, 0.1] * rng.standard_normal((10, 2)))], axis=1
        )
        assert windows.moment_of(noisy) in (4, 5), seed


def window(begin, left):
    data = types.SimpleNamespace(samples=100, kept=np.ones((100, 1), bool))
    return windows._Window(data, begin, np.zeros(1), np.zeros(2), (), np.ones(1), 1e3, left)


def test_a_window_that_is_left_far_off_is_fitted_again_from_those_beside_it(monkeypatch):
    asked = []

    def fitted(context, stage, noise_model, begin, size, like):
        asked.append((begin, like.begin))
        return None if like.begin == 0 else window(begin, 1.2 if begin == 100 else 700.0)

    monkeypatch.setattr(windows, "_fitted", fitted)
    given = [window(0, 1.0), window(100, 80.0), window(200, 1.1), window(300, 600.0), window(400, 3.9)]
    found = windows._from_neighbours(None, None, None, given)
    assert [one.left for one in found] == [1.0, 1.2, 1.1, 600.0, 3.9]
    assert sorted(asked) == [(100, 0), (100, 200), (300, 200), (300, 400)]


def test_what_a_window_gained_from_its_neighbour_passes_on(monkeypatch):
    monkeypatch.setattr(
        windows, "_fitted", lambda *given: window(given[3], 1.5 if given[5].left < 4.0 else given[5].left + 5.0)
    )
    lefts = [1.0, 80.0, 75.0, 70.0, 65.0, 90.0]
    found = windows._from_neighbours(None, None, None, [window(100 * k, left) for k, left in enumerate(lefts)])
    assert [one.left for one in found] == [1.0, 1.5, 1.5, 1.5, 1.5, 1.5]
    assert [one.begin for one in found] == [0, 100, 200, 300, 400, 500]


def test_a_law_begins_with_what_all_windows_determine_of_it(monkeypatch):
    # Three entries; no window determines the third, which has wandered, and each leaves its first state open.
    rng = np.random.default_rng(5)
    truth, law, size, course = np.array([2.0, -1.0, 0.5]), np.array([0.0, 0.3, 0.0]), -4.0, [0.0, 0.0, 1.0, 1.0]
    shape = types.SimpleNamespace(held=np.zeros(3, bool))
    context = types.SimpleNamespace(simulator=types.SimpleNamespace(setup=shape))
    monkeypatch.setattr(windows, "_direction", lambda context, effect, place, entries: law)
    given, equations = [], []
    for share in course:
        entries = truth + share * size * law
        entries[2] += 10 * rng.standard_normal()
        given.append(windows._Window(None, 0, entries, np.zeros(2), (), np.ones(1), 1.0, 0.0))
        J = rng.standard_normal((50, 5))
        J[:, 2] = 0.0
        equations.append(lambda candidate, H=J.T @ J: (H,))
    theta, found = windows._fused(context, ("law", "place"), given, equations, course)
    np.testing.assert_allclose(found, size, rtol=1e-6)
    np.testing.assert_allclose(theta[:2], truth[:2], rtol=1e-6)
    # Without a law to change them, the entries of windows that differ meet in between.
    between, none = windows._fused(context, None, given, equations, course)
    assert none == 0.0 and min(truth[1], truth[1] + size * law[1]) < between[1] < truth[1]
    assert windows._fused(context, None, given, [*equations[:3], lambda candidate: None], course) is None


@pytest.mark.parametrize(("left", "carried_on"), [(0.02, True), (0.7, False), (np.nan, False)])
def test_a_change_that_the_whole_record_does_not_show_is_not_carried_on(left, carried_on, monkeypatch):
    """Windows bend to dry friction, whose model of the whole record then leaves most of the residual."""
    law = by_id("stiffness_drift")
    names = [parameter.name for parameter in law.parameters]
    shape = types.SimpleNamespace(effect=law, place=Place("y1", 0), values=np.zeros(len(names)))
    change = windows._Change(types.SimpleNamespace(shape=shape), np.zeros(3), np.zeros(2), -4.0, None, 0.02, 500)
    setup = types.SimpleNamespace(matrices=lambda entries: (entries,), entries_of=lambda X: X)
    progress = types.SimpleNamespace(stage=lambda text: None)
    simulator, data = types.SimpleNamespace(setup=setup), [data_of(np.ones((400, 1)))]
    context = types.SimpleNamespace(simulator=simulator, progress=progress, data=data, held=None)
    stage = types.SimpleNamespace(candidate=Candidate(np.zeros(3), (np.zeros(2),)), e=np.ones((400, 1)))

    def refit(simulator, begin, data, noise_model, **options):
        return types.SimpleNamespace(candidate=begin, residual=(left * stage.e,))

    monkeypatch.setattr(windows, "refit", refit)
    monkeypatch.setattr(windows, "squares_left", lambda context, one, noise: 1.0)
    monkeypatch.setattr(windows, "refit_to_convergence", lambda context, fit: fit)
    monkeypatch.setattr(windows, "begun_at", lambda score, values: score)
    monkeypatch.setattr(windows, "unresolved", lambda fit, score: None)
    found = windows._refitted(context, stage, None, change, 100)
    assert (found is not None) == carried_on
    if carried_on:
        assert found[1].candidate.terms[0].values[names.index(law.alters[1])] == -4.0


def data_of(y, kept=None):
    kept = np.ones(y.shape, bool) if kept is None else kept
    return Data(y[:, :1], np.where(kept, y, 0.0), kept, np.zeros(len(y)), len(y), 0.05, "zero")


def test_a_part_must_hold_periods_and_samples():
    data = data_of(np.zeros((800, 1)))
    assert windows.long_enough(np.array([0.0, 4.0]), data, 100, 8)
    assert windows.long_enough(np.array([1e-7, 4.0]), data, 100, 8), "a rigid body, rounded"
    assert not windows.long_enough(np.array([0.0, 0.5]), data, 100, 8), "two and a half periods"
    assert not windows.long_enough(np.array([4.0]), data, 100, 40), "few samples for so many numbers"
    assert not windows.long_enough(np.array([0.0]), data, 100, 8), "a rigid body has no period"


def test_what_a_run_misses_is_a_share_of_the_outputs_that_move():
    t = 0.05 * np.arange(2000)
    rng = np.random.default_rng(3)
    y = np.stack([np.sin(t), np.cos(t), np.zeros_like(t), np.full_like(t, 7.0)], axis=1)
    kept = np.ones(y.shape, bool)
    kept[::7, 0] = False
    kept[:, 2] = False

    def missed(shift, noise):
        ran = np.stack([np.sin(t), np.cos(t + shift), t, np.full_like(t, 6.9)], axis=1)
        run = types.SimpleNamespace(run=lambda candidate, data: ran)
        return missed_share(run, None, data_of(y + noise * rng.standard_normal(y.shape) * (y != 7.0), kept))

    assert missed(0.0, 0.0) < 1e-12
    assert missed(1.0, 0.0) == pytest.approx(2 - 2 * np.cos(1.0), rel=0.02)
    # Noise as large as the motion is not missed.
    assert missed(0.0, 0.7) < 0.1
    assert missed(np.nan, 0.0) == np.inf
