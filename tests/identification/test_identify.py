"""The whole identification on records of one length, so that one compilation serves most tests."""

import dataclasses
import zlib

import hidden
import independent as data
import numpy as np
import pytest
import scipy.signal

from jaxgray import ComputationError, MechanicalModel, Record, identify
from jaxgray.identification.initialization.modal_start import modal_start
from jaxgray.identification.setup.preparation import prepare, scaling_of
from jaxgray.identification.validation.reach import check_reach

H = data.REFERENCE_TIME * 4
SAMPLES = 4000
TRUTH = tuple(data.REFERENCE.values())
NOISE = data.REFERENCE_NOISE


def record_of(seed, *, noise=NOISE, offset=0.0, x0=None, truth=TRUTH, E=None, samples=SAMPLES, w=None):
    rng = np.random.default_rng(seed)
    inputs = 2 if E is None else E.shape[1]
    u = data.random_steps(rng, samples, inputs, H, (0.2, 1.5))
    y = data.simulate(*truth, u, H, E=E, x0=x0, w=w) + offset
    return Record(u, y + noise * rng.standard_normal(y.shape), H)


def errors_of(found, truth=TRUTH):
    return data.relative_errors((found.mass, found.damping, found.stiffness), truth)


def bound_of(J, noise=NOISE, kept=None):
    J = (J if kept is None else J * kept[..., None]).reshape(-1, J.shape[-1]) / noise
    information = J.T @ J
    inner = np.linalg.solve(information[9:, 9:], information[9:, :9])
    return np.linalg.inv(information[:9, :9] - information[:9, 9:] @ inner)


def entries(found):
    return np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in (found.mass, found.damping, found.stiffness)])


@pytest.fixture(scope="module")
def bound():
    return bound_of(data.sensitivities(TRUTH, record_of(0).u, H))


@pytest.mark.slow
def test_sixty_realisations_reach_the_cramer_rao_bound(bound):
    """One input, sixty noises: errors as small as they can be, intervals as wide as they should be."""
    clean = record_of(0, noise=0.0)
    truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
    deviations, standard = [], []
    for seed in range(60):
        noise = NOISE * np.random.default_rng(100 + seed).standard_normal(clean.y.shape)
        found = identify(Record(clean.u, clean.y + noise, H), time_constants=0.1, block_rows=6)
        deviations.append(entries(found) - truth)
        standard.append(np.sqrt(np.diag(found.covariance)))
    deviations, standard = np.array(deviations), np.array(standard)
    twice = np.tile([1.0, 2.0, 1.0], 3)
    ratio = np.sqrt(
        (twice * np.mean(deviations**2, axis=0)).reshape(3, 3).sum(1) / (twice * np.diag(bound)).reshape(3, 3).sum(1)
    )
    assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio
    np.testing.assert_allclose(np.mean(standard, axis=0), np.sqrt(np.diag(bound)), rtol=0.05)
    covered = np.mean(np.abs(deviations) < 1.96 * standard)
    assert 0.92 < covered < 0.98, covered


def test_offset_and_start_in_motion_cost_nothing():
    plain, moved = [], []
    for seed in range(5):
        plain.append(errors_of(identify(record_of(seed), refine=False)))
        record = record_of(seed, offset=0.01, x0=[0.01, -0.02, 0.05, 0.1])
        moved.append(errors_of(identify(record, refine=False)))
    assert np.all(np.median(moved, axis=0) < 1.3 * np.median(plain, axis=0))


def test_missing_samples_cost_only_what_is_missing():
    found, norms = [], []
    for seed in range(6):
        record = record_of(seed)
        kept = np.random.default_rng(seed).random(record.y.shape) > 0.1
        J = data.sensitivities(TRUTH, record.u, H)
        norms.append(np.sqrt(np.diag(bound_of(J, kept=kept))))
        holes = identify(Record(record.u, np.where(kept, record.y, np.nan), H))
        truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
        found.append((entries(holes) - truth) / norms[-1])
        np.testing.assert_allclose(np.sqrt(np.diag(holes.covariance)), norms[-1], rtol=0.1)
    assert np.sqrt(np.mean(np.square(found))) < 1.3


def test_two_records_serve_as_one():
    pair = [record_of(1), record_of(2)]
    both = identify(pair, validation=record_of(3))
    alone = identify(pair[0])
    assert np.all(np.diag(both.covariance) < 0.75 * np.diag(alone.covariance))
    truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
    assert np.max(np.abs(entries(both) - truth) / np.sqrt(np.diag(both.covariance))) < 4
    assert min(both.fit_percent["validation"].values()) > 95


@pytest.mark.parametrize(("su", "sy", "st"), [(1e6, 1, 1), (1, 1e-6, 1), (1, 1, 1e3), (1, 1, 1e-3)])
def test_units_do_not_matter(su, sy, st):
    record = record_of(4)
    plain = identify(record)
    found = identify(Record(record.u * su, record.y * sy, H * st))
    back = (found.mass / su * sy / st**2, found.damping / su * sy / st, found.stiffness / su * sy)
    assert data.relative_errors(back, (plain.mass, plain.damping, plain.stiffness)).max() < 1e-6


@pytest.mark.slow
def test_innovations_form_pays_under_process_noise():
    plain, better = [], []
    for seed in range(4):
        w = 0.05 * np.random.default_rng(50 + seed).standard_normal((SAMPLES, 2))
        record = record_of(seed, w=w)
        simple = identify(record)
        plain.append(errors_of(simple))
        found = identify(record, noise="innovations")
        better.append(errors_of(found))
        assert found.noise["form"] == "innovations"
        assert any("not white" in text for text in simple.warnings)
    assert np.all(np.mean(better, axis=0) < np.mean(plain, axis=0))


K_FREE = np.array([[40.0, -40.0], [-40.0, 40.0]])
D_SINGULAR = np.array([[2.0, -2.0], [-2.0, 2.0]])


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ((TRUTH[0], TRUTH[1], K_FREE), "stiffness is singular"),
        ((TRUTH[0], D_SINGULAR, TRUTH[2]), "damping is singular"),
    ],
    ids=["rigid body", "undamped mode"],
)
def test_truth_on_the_edge(truth, said):
    found = identify(record_of(5, noise=0.0, truth=truth))
    assert errors_of(found, truth).max() < 1e-6
    assert any(said in text for text in found.warnings), found.warnings
    assert np.all(np.isfinite(found.covariance))


def refined_on_the_edge(truth, start):
    """Where the refinement ends from a start in physical units, and the relative errors there."""
    from jaxgray.identification.refinement.refine import refine
    from jaxgray.identification.setup.prediction import Batch, Setting

    record = record_of(6, noise=0.0, truth=truth)
    scaling = scaling_of([record])
    model = MechanicalModel(*truth)
    setting = Setting(model.drive.scaled(scaling.coordinates, scaling.inputs, H), record.measured, record.hold)
    end = refine(scaling.matrices_in(*start), Batch.of([prepare(record, scaling)]), setting)
    return end, data.relative_errors(scaling.matrices_out(end.mass, end.damping, end.stiffness), truth).max()


def test_start_on_the_edge_with_a_regular_truth():
    rank_one = [np.outer(X[:, 0], X[:, 0]) / X[0, 0] for X in TRUTH[1:]]
    assert refined_on_the_edge(TRUTH, (1.1 * TRUTH[0], *rank_one))[1] < 1e-6


@pytest.mark.parametrize("settles", [True, False], ids=["over the cone", "by Cholesky factors"])
def test_start_on_the_edge_where_the_truth_is(settles, monkeypatch):
    """A drive that turns freely: Cholesky factors crawl along the edge, steps over the cone do not."""
    from jaxgray.identification.refinement import refine as refinement

    if not settles:
        monkeypatch.setattr(refinement, "_straight", lambda start, criterion: None)
    end, error = refined_on_the_edge((TRUTH[0], TRUTH[1], K_FREE), (1.1 * TRUTH[0], 0.8 * TRUTH[1], 0.9 * K_FREE))
    assert error < 1e-6
    assert (sum(end.steps) < 30) == settles, end.steps


@pytest.mark.slow
def test_short_noisy_records_stay_physical():
    rng = np.random.default_rng(0)
    for seed in range(6):
        record = record_of(seed, samples=400, noise=0.02 * rng.uniform(0.5, 1.5))
        found = identify(record)
        assert np.linalg.eigvalsh(found.mass)[0] > 0
        for X in (found.damping, found.stiffness):
            values = np.linalg.eigvalsh(X)
            assert values[0] >= -1e-9 * values[-1]


def test_one_input_moves_two_coupled_coordinates():
    E = np.array([[1.0], [0.0]])
    found = identify(record_of(7, E=E))
    truth = np.concatenate([X[(0, 0, 1), (0, 1, 1)] for X in TRUTH])
    assert np.max(np.abs(entries(found) - truth) / np.sqrt(np.diag(found.covariance))) < 4.5


@pytest.mark.parametrize(
    "fix",
    [pytest.param("mass[0,0]=2,mass[0,1]=0,mass[1,1]=1", marks=pytest.mark.slow), None],
    ids=["masses given", "not given"],
)
def test_base_acceleration(fix):
    M, D, K = np.diag([2.0, 1.0]), np.array([[1.2, -0.4], [-0.4, 0.9]]), np.array([[300.0, -120.0], [-120.0, 200.0]])
    rng = np.random.default_rng(0)
    u = data.smooth_noise(rng, SAMPLES, 1, 0.2)
    y = data.simulate(M, D, K, u, 0.01, E=-M @ np.ones((2, 1)), hold="linear")
    y = y + 1e-3 * y.std() * rng.standard_normal(y.shape)
    record = Record(u, y, 0.01, hold="linear")
    found = identify(record, excitation="base-acceleration", relative=True, fix=fix)
    for X, truth, bar in ((found.damping, D, 0.03), (found.stiffness, K, 0.002)):
        truth = np.linalg.solve(M, truth)
        assert np.linalg.norm(np.linalg.solve(found.mass, X) - truth) < bar * np.linalg.norm(truth)
    assert any("normalised" in text for text in found.warnings) == (fix is None)
    if fix is None:
        assert found.mass[0, 0] == 1.0
    else:
        np.testing.assert_array_equal(found.mass, M)
    with pytest.raises(ValueError, match="absolute displacement"):
        identify(record, excitation="base-acceleration", relative=False)


@pytest.mark.parametrize("fix", ["mass[0,0]=200", "mass[1,1]=100", "mass[0,1]=0"])
def test_one_known_mass_sets_the_scale_that_a_moving_base_leaves_open(fix):
    M, D, K = np.diag([2.0, 1.0]), np.array([[1.2, -0.4], [-0.4, 0.9]]), np.array([[300.0, -120.0], [-120.0, 200.0]])
    rng = np.random.default_rng(0)
    u = data.smooth_noise(rng, SAMPLES, 1, 0.2)
    y = data.simulate(M, D, K, u, 0.01, E=-M @ np.ones((2, 1)), hold="linear")
    record = Record(u, y + 1e-3 * y.std() * rng.standard_normal(y.shape), 0.01, hold="linear")
    found = identify(record, excitation="base-acceleration", relative=True, fix=fix)
    # Where only a zero is known the scale is still open, and the first mass is one. Ratios are hardly determined.
    assert found.mass[0, 0] == pytest.approx(1.0 if fix == "mass[0,1]=0" else 200.0, rel=0.2)
    truth = np.linalg.solve(M, K)
    assert np.linalg.norm(np.linalg.solve(found.mass, found.stiffness) - truth) < 0.002 * np.linalg.norm(truth)
    assert any("normalised" in text for text in found.warnings) == (fix == "mass[0,1]=0")


@pytest.mark.parametrize("seed", [1, 147])
def test_base_displacement(seed):
    """The second record's likeliest cell gives a physical model with the damping cut off, from which the refinement
    did not come to its end."""
    M, D, K = np.diag([2.0, 1.0]), np.array([[1.2, -0.4], [-0.4, 0.9]]), np.array([[300.0, -120.0], [-120.0, 200.0]])
    rng = np.random.default_rng(seed)
    u = data.smooth_noise(rng, SAMPLES, 1, 0.2)
    A21, A22, r = np.linalg.solve(M, K), np.linalg.solve(M, D), np.ones((2, 1))
    # The state (q, q̇ − A22 r u) does without the derivative of the base's motion.
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-A21, -A22]])
    B = np.vstack([A22 @ r, (A21 - A22 @ A22) @ r])
    y = scipy.signal.lsim((A, B, np.eye(2, 4), np.zeros((2, 1))), u, 0.01 * np.arange(SAMPLES))[1]
    record = Record(u, y + 1e-3 * y.std() * rng.standard_normal(y.shape), 0.01, hold="linear")
    fix = "mass[0,0]=2,mass[0,1]=0,mass[1,1]=1"
    found = identify(record, excitation="base-displacement", fix=fix)
    for X, truth, bar in ((found.damping, D, 0.005), (found.stiffness, K, 0.0005)):
        assert np.linalg.norm(X - truth) < bar * np.linalg.norm(truth)


def test_rigid_body_under_friction_is_said_to_be_one():
    """A mass with Coulomb friction, pushed to and fro: no stiffness may be invented from its drift."""
    rng = np.random.default_rng(0)
    u = 5 * data.random_steps(rng, SAMPLES, 1, H, (0.1, 0.5))
    x = np.zeros(2)
    y = np.empty((SAMPLES, 1))
    for k in range(SAMPLES):
        y[k] = x[0]
        for _ in range(20):
            x = x + H / 20 * np.array([x[1], (u[k, 0] - 4 * x[1] - 1.0 * np.tanh(x[1] / 1e-3)) / 2.0])
    found = identify(Record(u, y + 1e-5 * rng.standard_normal(y.shape), H))
    # The travel is about 0.5 m under 5 N: a stiffness that mattered would be of the order of 10 N/m.
    assert found.stiffness[0, 0] < 0.01
    assert any("stiffness" in text for text in found.warnings), found.warnings
    assert 1.0 < found.mass[0, 0] < 4.0


def test_fixed_entries_and_structure():
    truth = (
        np.diag([4.0, 1.0]),
        0.02 * TRUTH[0] * 0 + np.diag([3.0, 0.8]),
        np.array([[120.0, -40.0], [-40.0, 90.0]]),
    )
    record = record_of(8, truth=truth)
    free = identify(record)
    fixed = identify(record, fix="mass[0,0]=4,mass[0,1]=0")
    assert fixed.mass[0, 0] == 4.0 and fixed.mass[0, 1] == 0.0
    assert fixed.standard_errors["mass"][0, 0] == 0.0
    assert np.all(fixed.standard_errors["stiffness"] < free.standard_errors["stiffness"])
    formed = identify(record, structure=("diagonal-mass", "chain"))
    assert formed.mass[0, 1] == 0.0
    assert errors_of(formed, truth).max() < 0.02
    proportional = (TRUTH[0], 0.3 * TRUTH[0] + 0.01 * TRUTH[2], TRUTH[2])
    found = identify(record_of(9, truth=proportional), structure="modal-damping")
    assert errors_of(found, proportional)[1] < 0.02


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weight": "moseb"}, "weight='moseb'.*choose from"),
        ({"map": "bilinear"}, "map='bilinear'"),
        ({"structure": "sparse"}, "structure='sparse'"),
        ({"fix": "stiffness[0;1]=0"}, "not understood"),
        ({"fix": "stiffness[0,5]=0"}, "outside a model of 2"),
        ({"input_map": "u1:y1"}, "no coordinate for u2"),
        ({"input_map": "u1:y1,u2:y7"}, "no coordinate 'y7'"),
        ({"excitation": "hammer"}, "excitation='hammer'"),
        ({"noise": "pink"}, "noise='pink'"),
        ({"time_constants": -1.0}, "time_constants"),
        ({"block_rows": 2}, "block_rows"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        identify(record_of(0), **options)


def test_records_that_cannot_serve_are_named_failures():
    record = record_of(0)
    rng = np.random.default_rng(0)
    cases = {
        "is constant": Record(np.ones_like(record.u), record.y, H),
        "do not determine displacements": Record(record.u, record.y[:, [0, 0]], H),
        "too short": Record(rng.standard_normal((20, 2)), record.y[:20], H),
        "does not reach coordinate y2": Record(
            record.u[:, :1],
            np.stack([record.y[:, 0], NOISE * rng.standard_normal(SAMPLES)], axis=1),
            H,
        ),
    }
    for message, bad in cases.items():
        with pytest.raises((ComputationError, ValueError), match=message):
            identify(bad)


def test_64_bit_floats_are_asked_for():
    import jax

    record = record_of(0)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="jax_enable_x64"):
            identify(record)
    finally:
        jax.config.update("jax_enable_x64", True)


def test_result_can_be_read():
    found = identify(record_of(10), validation=record_of(11))
    text = repr(found)
    assert "±" in text and "fit on validation" in text
    assert set(found.fit_percent) == {"estimation", "validation"}
    assert found.structure_test.fits and found.residual_test.white
    assert found.covariance.shape == (9, 9)
    assert not found.warnings, found.warnings


def test_a_third_mode_asks_for_another_form():
    rng = np.random.default_rng(3)
    u = data.random_steps(rng, SAMPLES, 2, H, (0.2, 1.5))
    y = data.simulate(*data.random_system(rng, 3), u, H, E=np.eye(3, 2))[:, :2]
    found = identify(Record(u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape), H))
    assert not found.structure_test.fits and found.structure_test.modes == 3
    assert any("do not fit" in text for text in found.misfits) and set(found.misfits) <= set(found.warnings)


def test_modes_alone_lead_near_the_truth():
    """Shapes are taken for real: damping that couples the modes is missed."""
    record = record_of(12, noise=5 * NOISE)
    found = identify(record)
    assert found.structure_test.fits
    start = modal_start([prepare(record, found.scaling)], found.setting)
    mass, damping, stiffness = data.relative_errors(found.scaling.matrices_out(*start.matrices), TRUTH)
    assert mass < 0.02 and stiffness < 0.02 and damping < 0.4


@pytest.mark.parametrize(
    "shaken", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow), 2]
)
def test_a_drift_is_not_taken_for_a_slow_mode(shaken):
    """The refinement from the subspace start ends at masses of 1e6, unsettled: another start is tried, whatever the
    last digits are, on which processors do not agree."""
    rng = np.random.default_rng([77, 3])
    u = data.random_steps(rng, SAMPLES, 2, H, (0.2, 1.5))
    y = data.simulate(*TRUTH, u, H)
    share = np.arange(SAMPLES) / SAMPLES
    drift = 3.2 * y[:, 1].std() * (share + 0.8 * share**2)
    y = y + NOISE * rng.standard_normal(y.shape) + np.stack([np.zeros(SAMPLES), drift], axis=1)
    y = y * (1 + 1e-13 * shaken * np.random.default_rng(shaken).standard_normal(y.shape))
    assert max(errors_of(identify(Record(u, y, H)))) < 0.05


def test_lost_samples_do_not_lead_to_a_singular_mass():
    """The refinement from the subspace start settles at masses of 1e6; that is no end."""
    rng = np.random.default_rng([97003, 3, zlib.crc32(b"dropped_samples"), 2])
    case = hidden.raw_case(rng, "dropped_samples", samples=SAMPLES, dofs=(1, 2, 3))
    found = identify(Record(case.u, case.y, case.sampling_time, hold=case.hold))
    errors = data.relative_errors((found.mass, found.damping, found.stiffness), dataclasses.astuple(case.system)[:3])
    assert max(errors) < 0.2


def test_quasi_static_record_says_how_little_it_shows_of_inertia():
    """Forces so slow that M q̈ is nowhere above the noise: a named failure, a warning with a remedy, or masses with wide
    errors that hold the true ones (the likelihood is highest at 4.6 and 4.4 kg where 5 and 1 are true)."""
    rng = np.random.default_rng(0)
    u = np.cumsum(data.smooth_noise(rng, SAMPLES, 2, 0.002), axis=0)
    u = u / u.std(axis=0)
    y = data.simulate(*TRUTH, u, H)
    record = Record(u, y + 1e-2 * y.std(axis=0) * rng.standard_normal(y.shape), H)
    try:
        found = identify(record)
    except ComputationError as error:
        assert "try" in str(error).lower() or "excite" in str(error).lower()
    else:
        errors = found.standard_errors["mass"]
        wide = np.diag(errors) > 0.1 * np.diag(found.mass)
        held = wide.all() and np.all(np.abs(found.mass - TRUTH[0]) < 5 * errors)
        assert held or any("Excite nearer" in text for text in found.warnings), repr(found)


def test_a_slow_motion_sampled_fast_is_reached_by_its_inputs():
    # Whitened sample by sample, little but noise is left of it.
    rng = np.random.default_rng([3005, 3])
    M, D, K = data.random_system(rng, 3)
    h = 10.0 ** rng.uniform([-4, -2.6], [4, -1.9])[1]
    u = data.random_steps(rng, 4000, 3, h, (0.1, 1.0))
    x0 = rng.standard_normal(6) * np.repeat([0.003, 0.03], 3)
    y = data.simulate(M, D, K, u, h, x0=x0)
    y = y + rng.uniform(-1, 1, 3) * y.std(axis=0)
    y = y + 10 ** rng.uniform(-3, -1.5) * y.std(axis=0) * rng.standard_normal(y.shape)
    names = ("u1", "u2", "u3"), ("y1", "y2", "y3")

    def check(y):
        record = Record(u, y, h)
        check_reach([prepare(record, scaling_of([record]))], *names)

    check(y)
    y[:, 1] = rng.standard_normal(4000)
    with pytest.raises(ComputationError, match="does not reach coordinate y2"):
        check(y)


@pytest.mark.parametrize("seed", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_a_mode_next_to_half_the_sampling_rate_keeps_its_mass(seed):
    """Neither a mass of nothing nor the alias of the mode is a better end of the refinement."""
    rng, h = np.random.default_rng([79, seed]), 0.2687
    u = data.smooth_noise(rng, 400, 1, 0.5)
    y = data.simulate([[0.8]], [[1.5]], [[90.0]], u, h, hold="linear")
    record = Record(u, y + 0.5 * y.std() * rng.standard_normal(y.shape), h, hold="linear")
    found = identify(record)
    assert abs(found.mass[0, 0] - 0.8) < 4 * found.standard_errors["mass"][0, 0] < 0.6
    assert abs(found.stiffness[0, 0] - 90.0) < 4 * found.standard_errors["stiffness"][0, 0]
