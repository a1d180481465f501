"""The force equation where accelerations are measured: motion by integration, masses of a shaken frame, first laws."""

import dataclasses
from types import SimpleNamespace

import frames
import hidden_laws
import hidden_simulation
import numpy as np
import pytest
import scipy.signal

import jaxgray
from jaxgray.diagnosis.equation_error import integrated_band as bands
from jaxgray.diagnosis.equation_error.band import band_of
from jaxgray.diagnosis.equation_error.base_motion import as_forces
from jaxgray.diagnosis.equation_error.integrated_band import integrated_band
from jaxgray.diagnosis.equation_error.rows import series_of
from jaxgray.diagnosis.equation_error.search import first_trials, table_of
from jaxgray.diagnosis.equation_error.unmeasured_forces import samples_of
from jaxgray.diagnosis.model.baseline import baseline_of
from jaxgray.diagnosis.routing import ForceEquation, force_equation_trials
from jaxgray.diagnosis.starts import equation_error as starts
from jaxgray.mechanics.effects import by_id
from jaxgray.mechanics.systems.drives import BaseAcceleration, Force
from jaxgray.numerics.programs.runtime import ready
from jaxgray.numerics.progress import Budgeted, Silent

H = 0.005
FRAME = frames.Frame((120.0, 70.0, 100.0), (1.9e5, 1.7e5, 1.5e5), (120.0, 100.0, 110.0))
LAWS = "cubic_stiffness", "end_stop", "dead_zone_stiffness", "bilinear_stiffness", "coulomb_friction"
BASE = BaseAcceleration(np.ones((3, 1)))


def shaken(law, storey, seed, samples=6000):
    """A frame with a strong law in one storey, its accelerometers, and the true drifts [m]."""
    rng = np.random.default_rng(seed)
    u = 1.2 * frames.band_noise(rng, samples, 1, (0.5, 20.0), H)
    effects = []
    if law is not None:
        drift = np.std(frames.shaken_with(FRAME, u, H, [])[1][:, storey])
        effects = [frames.storey_law(law, FRAME, storey, drift, samples * H, rng)]
    clean, drifts = frames.shaken_with(FRAME, u, H, effects)
    y = clean + 3e-3 * clean.std() * rng.standard_normal(clean.shape)
    units = {"input_units": ["m/s^2"], "output_units": ["m/s^2"] * 3}
    return jaxgray.Record(u, y, H, hold="linear", measured="acceleration", **units), drifts, effects


def test_accelerations_are_integrated_to_the_motion_in_the_band():
    record, drifts, _ = shaken("end_stop", 1, 3)
    relative = as_forces([record], BASE)[0]
    series = series_of(relative[0], integrated_band(relative))
    true = np.cumsum(scipy.signal.sosfiltfilt(series.sections, drifts, axis=0), axis=1)
    inside = slice(int(2 / (series.band.low * H)), -int(2 / (series.band.low * H)))
    for found, truth in ((series.q, true), (series.v, np.gradient(true, H, axis=0))):
        wrong = np.linalg.norm((found - truth)[inside], axis=0) / np.linalg.norm(truth[inside], axis=0)
        assert np.all(wrong < 0.02), wrong


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_impacts_that_pass_for_noise_of_a_sensor_do_not_take_the_motion_out_of_the_band(seed, monkeypatch):
    ready()
    frame, h = frames.Frame((120.0, 90.0, 140.0), (1.9e5, 1.7e5, 2.1e5), (15.0, 12.0, 14.0)), 0.01
    rng = np.random.default_rng([77, seed])
    u = 1.2 * frames.band_noise(rng, 6000, 1, (0.5, 20.0), h)
    gap = 0.9 * np.std(frames.shaken_with(frame, u, h, [])[1][:, 0])
    stop = hidden_laws.Effect("end_stop", "y1", {"gap": gap, "ks": 2.85e5})
    clean = frames.shaken_with(frame, u, h, [stop])[0]
    y = clean + 1e-3 * clean.std() * rng.standard_normal(clean.shape)
    record = jaxgray.Record(u, y, h, hold="linear", measured="acceleration")
    relative, drive, mass = as_forces([record], BASE)
    # Hit at its first floor, the frame moves at 2.8 Hz above all.
    assert band_of(relative).low > 5.0 and integrated_band(relative).low < 2.8
    np.testing.assert_allclose(np.diag(mass), np.array(frame.masses) / frame.masses[0], rtol=0.15)
    best = proposed(relative, drive, mass)[0]
    assert best.name == ("end_stop", "y1")
    np.testing.assert_allclose(best.term.values, [2.85e5 / frame.masses[0], gap], rtol=0.1)
    # Where rows are too few to tell, or shorter ones lose the strong motion, it stays as spectra set it.
    monkeypatch.setattr(bands, "ROWS_PER_COEFFICIENT", 1000)
    assert integrated_band(relative) == band_of(relative)
    monkeypatch.undo()
    monkeypatch.setattr(bands, "KEPT", 2.0)
    assert integrated_band(relative) == band_of(relative)


def test_a_band_stays_as_spectra_set_it_where_nothing_is_integrated():
    record = shaken("end_stop", 1, 3)[0]
    still = dataclasses.replace(record, measured="displacement", output_units=["m"] * 3)
    assert integrated_band([still]) == band_of([still])


@pytest.mark.parametrize("law", [None, "end_stop", "bilinear_stiffness", "coulomb_friction"])
def test_masses_are_those_that_make_the_stiffness_symmetric(law):
    ready()
    for storey in range(3):
        mass = as_forces([shaken(law, storey, 20 + storey)[0]], BASE)[2]
        np.testing.assert_allclose(np.diag(mass), np.array(FRAME.masses) / FRAME.masses[0], rtol=0.15)


@pytest.mark.parametrize(
    "law, storey", [("end_stop", 1), ("bilinear_stiffness", 2), pytest.param("end_stop", 0, marks=pytest.mark.slow)]
)
def test_a_strong_law_is_the_first_that_the_force_equation_proposes(law, storey):
    ready()
    record, _, (truth,) = shaken(law, storey, 30 + storey)
    relative, drive, mass = as_forces([record], BASE)
    best = proposed(relative, drive, mass)[0]
    assert best.name == (law, truth.place)
    stiffness = truth.parameters["ks"] / FRAME.masses[0]
    assert abs(best.term.values[0] - stiffness) < 0.15 * stiffness


def proposed(records, drive, mass=None):
    """Trials of the first law."""
    table = table_of(records, drive, tuple(map(by_id, LAWS)), mass, samples_of((), records), Silent())
    return first_trials(table)


def pushed(effects, seed, samples=6000):
    """Accelerations of the frame under a force on every floor."""
    rng = np.random.default_rng(seed)
    u = 150.0 * frames.band_noise(rng, samples, 3, (0.5, 20.0), H)
    system = hidden_simulation.System(FRAME.mass, FRAME.damping, FRAME.stiffness, np.eye(3))
    q, v, t, substeps = hidden_simulation.motion(system, u, H, effects, hold="linear")
    q, v, t = (x[::substeps][:samples] for x in (q, v, t))
    pull = u - q @ FRAME.stiffness - v @ FRAME.damping
    for effect in effects:
        arm = hidden_laws.arm(effect.place, 3)
        here = SimpleNamespace(q=q @ arm, v=v @ arm, middle=t)
        pull = pull - np.asarray(hidden_laws.FORCES[effect.id](effect.parameters, here))[:, None] * arm
    y = pull / FRAME.masses
    y = y + 3e-3 * y.std() * rng.standard_normal(y.shape)
    return jaxgray.Record(u, y, H, hold="linear", measured="acceleration"), np.std(q[:, 1] - q[:, 0])


def test_nothing_is_proposed_for_a_linear_frame():
    ready()
    relative, drive, mass = as_forces([shaken(None, 0, 40)[0]], BASE)
    assert proposed(relative, drive, mass) == []
    assert proposed([pushed([], 41)[0]], Force(np.eye(3))) == []


def test_under_forces_a_law_is_proposed_with_its_size():
    ready()
    drift = pushed([], 42)[1]
    truth = hidden_laws.Effect("end_stop", "y1-y2", {"gap": 1.2 * drift, "ks": 1.7e5})
    record = pushed([truth], 42)[0]
    best = proposed([record], Force(np.eye(3)))[0]
    assert best.name == ("end_stop", "y1-y2")
    assert abs(best.term.values[0] - truth.parameters["ks"]) < 0.35 * truth.parameters["ks"]


def test_masses_are_found_with_a_held_input_missing_samples_and_other_sensors():
    ready()
    true = np.array(FRAME.masses) / FRAME.masses[0]
    rng = np.random.default_rng(60)
    u = 1.2 * frames.band_noise(rng, 6000, 1, (0.5, 20.0), H)
    held = hidden_simulation.System(FRAME.mass, FRAME.damping, FRAME.stiffness, -FRAME.mass @ np.ones((3, 1)))
    q, v, _, substeps = hidden_simulation.motion(held, u, H, [])
    q, v = (x[::substeps][:6000] for x in (q, v))
    y = -(q @ FRAME.stiffness + v @ FRAME.damping) / FRAME.masses
    y = y + 3e-3 * y.std() * rng.standard_normal(y.shape)
    kinds = {"acceleration": (y, BASE), "relative": (y - u, BaseAcceleration(np.ones((3, 1)), relative=True))}
    for name, (seen, drive) in kinds.items():
        found = as_forces([jaxgray.Record(u, seen, H, measured="acceleration")], drive)[2]
        np.testing.assert_allclose(np.diag(found), true, rtol=0.15, err_msg=name)
    lost = shaken("end_stop", 1, 61)[0]
    y = lost.y.copy()
    y[rng.choice(len(y), 25, replace=False), rng.integers(3, size=25)] = np.nan
    np.testing.assert_allclose(np.diag(as_forces([dataclasses.replace(lost, y=y)], BASE)[2]), true, rtol=0.15)


def test_records_that_do_not_tell_the_masses_are_refused():
    ready()
    record = shaken(None, 0, 62)[0]
    with pytest.raises(jaxgray.ComputationError, match="rows of motion|no band"):
        as_forces([record[:400]], BASE)
    heavy = frames.Frame((120.0, 3000.0, 100.0), (1.9e5, 1.7e5, 1.5e5), (120.0, 100.0, 110.0))
    u = record.u
    y = frames.shaken(heavy.rates, u, H)
    y = y + 1e-4 * y.std(axis=0) * np.random.default_rng(63).standard_normal(y.shape)
    with pytest.raises(jaxgray.ComputationError, match="symmetric"):
        as_forces([dataclasses.replace(record, y=y)], BASE)
    # One floor that moves slowly, and one fast: no band holds both.
    rng = np.random.default_rng(64)
    parts = [frames.band_noise(rng, 6000, 1, band, H) for band in ((0.5, 3.0), (15.0, 30.0))]
    y = np.hstack(parts) + 0.01 * rng.standard_normal((6000, 2))
    with pytest.raises(jaxgray.ComputationError, match="no band"):
        band_of([jaxgray.Record(u, y, H, hold="linear", measured="acceleration")])


def test_what_the_force_equation_would_add_is_asked_for_only_while_there_is_time():
    ready()
    record = shaken("end_stop", 1, 65)[0]
    laws, options = tuple(map(by_id, LAWS)), {"excitation": "base-acceleration"}
    late, forces = (ForceEquation(laws, 1, 0, progress) for progress in (Budgeted(Silent(), 1e-9), Silent()))
    assert force_equation_trials([record], late, options)() == []
    short = force_equation_trials([record[:300]], forces, options)
    assert short() == []
    jumping = jaxgray.Record(record.u, record.y, H, measured="acceleration")
    assert force_equation_trials([jumping], forces, {}) is None


def test_of_laws_that_differ_in_their_name_alone_one_is_refitted_at_every_place(monkeypatch):
    names = [("end_stop", "y1"), ("dead_zone_stiffness", "y1"), ("sine_stiffness", "y1"), ("dead_zone_stiffness", "y2")]
    asked = []

    def refitted(context, stage, screening, trial, windows):
        asked.append(trial.name)
        return trial if trial.name == ("dead_zone_stiffness", "y2") else None

    def score(effect, place):
        return SimpleNamespace(
            shape=SimpleNamespace(effect=SimpleNamespace(id=effect), place=SimpleNamespace(name=place))
        )

    def law(effect):
        return SimpleNamespace(effect=by_id(effect))

    monkeypatch.setattr(starts, "_refitted", refitted)
    # What the screening ruled out is not tried, nor counted.
    screening = SimpleNamespace(white=[], scores=[score(*name) for name in names if name[0] != "sine_stiffness"])
    context = SimpleNamespace(first_trials=lambda: [SimpleNamespace(name=name, term=law(name[0])) for name in names])
    stage = SimpleNamespace(candidate=SimpleNamespace(terms=()))
    (found,) = starts.from_first_trials(context, stage, screening)
    assert found.name == names[3] and asked == [names[0], names[3]]


@pytest.mark.parametrize(
    "fix",
    ["mass[1,1]=1.5", *(pytest.param(fix, marks=pytest.mark.slow) for fix in ("mass[0,1]=0", "stiffness[0,0]=6000"))],
)
def test_what_is_begun_has_the_masses_of_the_frame_and_what_does_not_move(fix):
    ready()
    record, _, (truth,) = shaken("end_stop", 1, 66, samples=4000)
    options = {"excitation": "base-acceleration", "fix": fix}
    relative, drive, mass = as_forces([record], BASE)
    trial = proposed(relative, drive, mass)[0]
    setup_of = baseline_of([record], jaxgray.identify(record, refine=False, **options), None)
    setup, candidate = setup_of.setup, setup_of.start
    context = SimpleNamespace(simulator=SimpleNamespace(setup=setup))
    begun = starts._begun(context, candidate, trial)
    M = np.asarray(setup.matrices(begun.entries)[0])
    scale = {"mass[1,1]=1.5": 1.5 * 120 / 70}.get(fix, M[0, 0])
    np.testing.assert_allclose(np.diag(M), scale * np.array(FRAME.masses) / FRAME.masses[0], rtol=0.15)
    assert begun.terms[0].values[0] == pytest.approx(M[0, 0] * trial.term.values[0], rel=0.15)
    assert np.all(begun.entries[setup.held] == candidate.entries[setup.held])
