"""Free run, first state and prediction against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from jaxgray.mechanics.model import MechanicalModel
from jaxgray.mechanics.runs.simulate import initial_state, predict, simulate
from jaxgray.mechanics.systems.drives import BaseAcceleration, BaseDisplacement
from jaxgray.numerics.outcomes import ComputationError
from jaxgray.records import Record

H = 0.02
SAMPLES = 400
X0 = np.array([0.01, -0.02, 0.1, 0.05])
MIXED = ("velocity", "acceleration")
KINDS = ["displacement", MIXED]


def first_order(matrices, measured="displacement"):
    """A, B, C, D with plain NumPy."""
    M, D, K = matrices
    lower = -np.linalg.solve(M, np.hstack([K, D]))
    A = np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), lower])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    kinds = (measured,) * 2 if isinstance(measured, str) else measured
    rows = {"displacement": np.eye(4)[:2], "velocity": np.eye(4)[2:], "acceleration": lower}
    C = np.stack([rows[kind][k] for k, kind in enumerate(kinds)])
    through = np.stack([B[2 + k] * (kind == "acceleration") for k, kind in enumerate(kinds)])
    return A, B, C, through


@pytest.fixture(scope="module")
def u():
    rng = np.random.default_rng(0)
    return np.repeat(rng.choice([-1.0, 1.0], (SAMPLES // 20, 2)), 20, axis=0)


def with_measured(model, measured):
    return MechanicalModel(model.mass, model.damping, model.stiffness, measured=measured)


@pytest.mark.parametrize("measured", KINDS)
@pytest.mark.parametrize(("hold", "method"), [("zero", "zoh"), ("linear", "foh")])
def test_samples_are_those_of_scipy(model, matrices, u, hold, method, measured):
    system = first_order(matrices, measured)
    Ad, Bd, Cd, Dd, _ = scipy.signal.cont2discrete(system, H, method=method)
    # SciPy's state under its linear hold is x − B1 u, and D_d = D + C B1.
    held = np.zeros((4, 2))
    if hold == "linear":
        held = scipy.signal.cont2discrete((*system[:2], np.eye(4), np.zeros((4, 2))), H, method="foh")[3]
    _, expected, _ = scipy.signal.dlsim((Ad, Bd, Cd, Dd, H), u, x0=X0 - held @ u[0])
    y = simulate(with_measured(model, measured), u, H, hold=hold, x0=X0)
    np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-12 * np.max(np.abs(expected)))
    assert isinstance(y, np.ndarray)


@pytest.fixture(scope="module")
def driven(matrices, u):
    """A force that is linear between samples, and the state under it by SciPy's integrator."""
    A, B, _, _ = first_order(matrices)
    u = np.cumsum(u, axis=0) / 20
    time = H * np.arange(SAMPLES)

    def slope(t, x):
        return A @ x + B @ [np.interp(t, time, column) for column in u.T]

    run = scipy.integrate.solve_ivp(
        slope, (0, time[-1]), X0, method="DOP853", t_eval=time, rtol=1e-9, atol=1e-10, max_step=5 * H
    )
    return u, run.y.T


@pytest.mark.parametrize("measured", KINDS)
def test_linear_hold_follows_the_differential_equation(model, matrices, driven, measured):
    u, x = driven
    _, _, C, through = first_order(matrices, measured)
    y = simulate(with_measured(model, measured), u, H, hold="linear", x0=X0)
    np.testing.assert_allclose(y, x @ C.T + u @ through.T, atol=1e-5 * np.max(np.abs(y)))


def base(t, order):
    """A smooth base motion that starts with displacement, velocity and acceleration, and its derivatives."""
    motion = 0.0
    for size, rate, phase in ((0.02, 3.0, 0.4), (0.01, 9.0, 1.1)):
        motion = motion + size * rate**order * np.sin(rate * t + phase + order * np.pi / 2)
    return motion


@pytest.fixture(scope="module")
def excited(matrices):
    """(time, q, q̇, q̈) of M q̈ + D(q̇ − r ẋ) + K(q − r x) = 0, absolute, on a fine grid."""
    M, D, K = matrices
    r = np.array([1.0, 0.5])
    time = 0.001 * np.arange(1501)

    def acceleration(t, q, v):
        t = np.atleast_1d(t)[:, None]
        pull = (v - r * base(t, 1)) @ D.T + (q - r * base(t, 0)) @ K.T
        return -np.linalg.solve(M, pull.T).T

    def slope(t, x):
        return np.concatenate([x[2:], acceleration(t, x[None, :2], x[None, 2:])[0]])

    run = scipy.integrate.solve_ivp(slope, (0, time[-1]), X0, t_eval=time, rtol=1e-9, atol=1e-12)
    q, v = run.y[:2].T, run.y[2:].T
    return time, r, q, v, acceleration(time, q, v)


# The input is smooth but taken as linear between samples: (9 rad/s · h)²/12 = 7e-6 of it is lost.
BASE_CASES = [
    (BaseAcceleration, True, ("displacement", "acceleration")),
    (BaseAcceleration, False, ("acceleration", "acceleration")),
    (BaseDisplacement, False, ("displacement", "velocity")),
    (BaseDisplacement, True, ("displacement", "displacement")),
]


@pytest.mark.parametrize(("drive", "relative", "measured"), BASE_CASES)
def test_excited_base(matrices, excited, drive, relative, measured):
    time, r, *motion = excited
    model = MechanicalModel(*matrices, drive=drive(jnp.asarray(r)[:, None], relative), measured=measured)
    x0 = X0.copy()
    if drive is BaseAcceleration:
        x0 = X0 - np.concatenate([r * base(0.0, 0), r * base(0.0, 1)])
    u = base(time, 2 if drive is BaseAcceleration else 0)
    y = simulate(model, u, time[1], hold="linear", x0=x0)
    for k, kind in enumerate(measured):
        order = ("displacement", "velocity", "acceleration").index(kind)
        expected = motion[order][:, k] - relative * base(time, order) * r[k]
        np.testing.assert_allclose(y[:, k], expected, atol=3e-5 * np.max(np.abs(expected)))


def test_initial_state_with_an_excited_base(matrices, excited):
    time, r, q, v, _ = excited
    model = MechanicalModel(*matrices, drive=BaseDisplacement(jnp.asarray(r)[:, None]))
    x0, offset = initial_state(model, base(time, 0), q, time[1], hold="linear")
    np.testing.assert_allclose(x0, X0, atol=1e-4)
    np.testing.assert_allclose(offset, 0.0, atol=1e-5)


def test_rest_means_a_base_at_zero_until_the_first_sample(matrices):
    # A base that steps to 1 just before the first sample gives the coordinates the velocity M⁻¹ D r at once.
    M, D, _ = matrices
    drive = BaseDisplacement(jnp.ones((2, 1)))
    model = MechanicalModel(*matrices, drive=drive, measured="velocity")
    u = np.ones(SAMPLES)
    started = np.concatenate([np.zeros(2), np.linalg.solve(M, D @ np.ones(2))])
    at_rest = simulate(model, u, H)
    np.testing.assert_allclose(at_rest[0], started[2:], rtol=1e-12)
    np.testing.assert_allclose(at_rest, simulate(model, u, H, x0=started), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("hold", "measured"), [("zero", "displacement"), ("linear", MIXED)])
def test_initial_state_is_found_through_gaps(model, u, hold, measured):
    model = with_measured(model, measured)
    offset = np.array([0.3, -0.2])
    y = simulate(model, u, H, hold=hold, x0=X0, offset=offset)
    y[50:90, 0] = np.nan
    y[3, 1] = np.nan
    x0, found = initial_state(model, u, y, H, hold=hold)
    np.testing.assert_allclose(x0, X0, atol=1e-9)
    np.testing.assert_allclose(found, offset, atol=1e-9)
    wrong = np.where(np.arange(SAMPLES)[:, None] < 150, y, 7.0)
    x0, found = initial_state(model, u, wrong, H, hold=hold, kept=np.arange(SAMPLES) < 150)
    np.testing.assert_allclose(np.concatenate([x0, found]), np.concatenate([X0, offset]), atol=1e-8)


def test_initial_state_of_a_free_body_is_the_smallest(u):
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    free = MechanicalModel(np.diag([1.0, 2.0]), 0.1 * spring, 50 * spring)
    y = simulate(free, 0.1 * u, H, x0=X0, offset=[1.0, 1.0])
    x0, offset = initial_state(free, 0.1 * u, y, H)
    np.testing.assert_allclose(simulate(free, 0.1 * u, H, x0=x0, offset=offset), y, atol=1e-8)
    # Standing 1 further off and an offset of 1 are one and the same: the sum is what the record tells.
    np.testing.assert_allclose(x0[:2] + offset, X0[:2] + 1.0, atol=1e-7)
    assert np.linalg.norm(np.concatenate([x0[:2], offset])) < np.linalg.norm([*X0[:2], 1.0, 1.0])


def test_prediction_without_force_noise_is_the_free_run(model, u):
    y = np.random.default_rng(1).standard_normal((SAMPLES, 2))
    expected = simulate(model, u, H, x0=X0, offset=[1.0, 2.0])
    np.testing.assert_array_equal(predict(model, u, y, H, x0=X0, offset=[1.0, 2.0]), expected)


@pytest.mark.parametrize("measured", ["displacement", MIXED])
def test_prediction_is_the_stationary_kalman_filter(model, matrices, measured):
    rng = np.random.default_rng(2)
    system = first_order(matrices, measured)
    Ad, Bd, Cd, Dd, _ = scipy.signal.cont2discrete(system, H)
    u = rng.standard_normal((SAMPLES, 2))
    ratio, noise = 0.3, np.array([1e-4, 2e-4])
    W = ratio * np.diag(np.mean(u**2, axis=0))
    w = rng.standard_normal((SAMPLES, 2)) @ np.sqrt(W)
    y = scipy.signal.dlsim((Ad, Bd, Cd, Dd, H), u + w)[1] + noise * rng.standard_normal((SAMPLES, 2))
    R = np.diag(noise**2) + Dd @ W @ Dd.T
    P = scipy.linalg.solve_discrete_are(Ad.T, Cd.T, Bd @ W @ Bd.T, R, s=Bd @ W @ Dd.T)
    G = (Ad @ P @ Cd.T + Bd @ W @ Dd.T) @ np.linalg.inv(Cd @ P @ Cd.T + R)
    y[[7, 100, 101], 0] = np.nan
    x, expected = np.zeros(4), []
    for u_k, y_k in zip(u, y):
        expected.append(Cd @ x + Dd @ u_k)
        x = Ad @ x + Bd @ u_k + G @ np.nan_to_num(y_k - expected[-1])
    model = with_measured(model, measured)
    found = predict(model, u, y, H, force_noise_ratio=ratio, output_noise=noise)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.nanmax(np.abs(y)))
    # Left to itself it takes the noise from the residual's second differences.
    guessed = predict(model, u, y, H, force_noise_ratio=ratio)
    free = simulate(model, u, H)
    assert np.all(np.nanstd(y - guessed, axis=0) < 0.9 * np.nanstd(y - free, axis=0))


def test_methods_take_records(model, u):
    y = simulate(model, u, H, hold="linear")
    record = Record(u, y, H, hold="linear")
    np.testing.assert_array_equal(model.simulate(record), y)
    np.testing.assert_array_equal(model.simulate(u, H, hold="linear"), y)
    np.testing.assert_array_equal(model.predict(record), y)
    assert np.max(np.abs(model.simulate(record, hold="zero") - y)) > 1e-6


def test_bad_arguments(model, u):
    with pytest.raises(ValueError, match="u has 1 channels, the model has 2 inputs"):
        simulate(model, u[:, :1], H)
    with pytest.raises(ValueError, match="u is NaN at sample 3"):
        simulate(model, np.where(np.arange(SAMPLES)[:, None] == 3, np.nan, u), H)
    with pytest.raises(ValueError, match="x0 is .* give 4 finite numbers"):
        simulate(model, u, H, x0=[1.0, 2.0])
    with pytest.raises(ValueError, match="sampling_time is missing"):
        model.simulate(u)
    with pytest.raises(ValueError, match="come with the record"):
        model.simulate(Record(u, u, H), H)
    with pytest.raises(ValueError, match="hold='cubic'"):
        simulate(model, u, H, hold="cubic")
    with pytest.raises(ValueError, match="leave no sample"):
        initial_state(model, u, np.full_like(u, np.nan), H)
    with pytest.raises(ValueError, match="kept has shape"):
        initial_state(model, u, u, H, kept=[True])
    with pytest.raises(ValueError, match="force_noise_ratio"):
        predict(model, u, u, H, force_noise_ratio=-1.0)


def test_unbounded_motion_is_a_named_failure(matrices, u):
    M, D, K = matrices
    with pytest.raises(ComputationError, match="grow without bound"):
        simulate(MechanicalModel(M, -2000 * D, K), u, H)
