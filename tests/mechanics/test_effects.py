"""Every effect of the catalogue: its table, its law, and what it must reproduce of physics."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from jaxgray.mechanics.effects import (
    CATALOGUE,
    MODEL_ERRORS,
    RECORD_FINDINGS,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Local,
    Place,
    Scales,
    Term,
    by_id,
    places_of,
)

IDS = """cubic_stiffness quadratic_stiffness dead_zone_stiffness end_stop bilinear_stiffness sine_stiffness
constant_force coulomb_friction stribeck_friction asymmetric_friction quadratic_drag dahl_friction
position_dependent_friction fractional_damping bouc_wen_hysteresis maxwell_slip_hysteresis gyroscopic_coupling
circulatory_coupling input_delay actuator_lag intersample_hold input_saturation input_dead_zone input_quadratic
input_position_gain band_limited_input play_hysteresis actuator_creep sensor_offset sensor_drift sensor_delay
sensor_lag sensor_crosstalk sensor_nonlinearity clock_scale dropped_samples unmodelled_mode stiffness_drift
stiffness_step mass_step position_dependent_stiffness periodic_disturbance force_step load_friction
speed_force_limit""".split()

EFFECTS = CATALOGUE + MODEL_ERRORS
NAMES = [effect.id for effect in EFFECTS]

NEARLY_LINEAR = {
    "input_delay",
    "actuator_lag",
    "input_dead_zone",
    "sensor_delay",
    "sensor_lag",
    "clock_scale",
    "dropped_samples",
    "mass_step",
}
"""Effects whose response is linear in the amplitude only while it is small."""

SAMPLES, TIME = 300, 0.01
T = np.arange(SAMPLES) * TIME
COMPLIANCE = 0.5

Q = 0.7 * np.sin(9.0 * T + 0.3) + 0.4 * np.sin(23.0 * T + 1.0)
V = 6.3 * np.cos(9.0 * T + 0.3) + 9.2 * np.cos(23.0 * T + 1.0)
A = -56.7 * np.sin(9.0 * T + 0.3) - 211.6 * np.sin(23.0 * T + 1.0)
U = 2.0 * np.sin(5.0 * T + 0.9) + np.cos(17.0 * T)
P = np.cos(2.0 * T)

SCALES = Scales(
    q=0.57,
    v=7.9,
    q_peak=1.1,
    v_peak=15.5,
    q_quantiles=tuple(np.quantile(np.abs(Q), (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)).tolist()),
    u=1.6,
    u_peak=3.0,
    u_quantiles=tuple(np.quantile(np.abs(U), (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)).tolist()),
    force=5.0,
    compliance=COMPLIANCE,
    sampling_time=TIME,
    duration=SAMPLES * TIME,
    frequencies_hz=(1.3, 3.7),
    lines_hz=(2.2, 7.1, 9.0),
    times=(0.803, 1.904),
)

MASS = np.array([[5.0, -1.0], [-1.0, 1.0]])
DAMPING = np.array([[5.0, -0.01], [-0.01, 1.0]])
STIFFNESS = np.array([[100.0, -5.0], [-5.0, 100.0]])
FIRST, SECOND = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def motion(sign=1.0, scale=1.0):
    """What a force law sees in a motion of two tones, of this sign and size."""
    c = sign * scale
    parts = (c * Q, c * V, c * A, np.full(SAMPLES, COMPLIANCE), c * U, T, P)
    return Local(*(jnp.asarray(x) for x in parts))


def states_along(effect, p, here):
    """The states of a force law over a motion, one column a sample."""
    instants = jax.tree.map(lambda x: x[:-1], here), jax.tree.map(lambda x: x[1:], here)

    def step(z, ends):
        z = effect.advance(p, z, *ends, TIME)
        return z, z

    first = jnp.zeros(effect.states)
    return jnp.concatenate([first[None], jax.lax.scan(step, first, instants)[1]]).T


def response(effect, p, sign=1.0, scale=1.0):
    """What an effect adds: to the force, to the signal, or to the matrices."""
    p = jnp.asarray(p)
    if isinstance(effect, AbstractForceEffect):
        here = motion(sign, scale)
        return effect.force(p, here, states_along(effect, p, here))
    signal = sign * scale * jnp.asarray(U)
    if isinstance(effect, AbstractInputEffect):
        return jnp.concatenate(effect.apply(p, signal, signal, TIME)) - jnp.tile(signal, 2)
    if isinstance(effect, AbstractOutputEffect):
        return effect.apply(p, signal, sign * scale * jnp.asarray(Q), TIME) - signal
    second = SECOND if effect.places == "pair" else 0.0 * SECOND
    plain = [jnp.pad(jnp.asarray(X), ((0, int(effect.extra)),) * 2) for X in (MASS, DAMPING, STIFFNESS)]
    changed = effect.matrices(p, *(jnp.asarray(X) for X in (MASS, DAMPING, STIFFNESS, FIRST, second)))
    return jnp.concatenate([(X - Y).ravel() for X, Y in zip(changed, plain)])


# Each law is compiled for a few samples only: quick compilation pays, quick code does not.
jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
respond = jit(response, static_argnums=(0, 2, 3))


def test_the_catalogue_holds_what_is_promised():
    assert len(set(NAMES)) == len(NAMES)
    assert sorted(effect.id for effect in CATALOGUE) == sorted(IDS)
    assert [effect.id for effect in MODEL_ERRORS] == ["mass_error", "damping_error", "stiffness_error"]
    assert not set(RECORD_FINDINGS) & set(NAMES)
    for effect in EFFECTS:
        assert by_id(effect.id) is effect
        assert type(effect)() == effect and hash(type(effect)()) == hash(effect)


def test_an_unknown_id_is_told_kindly():
    with pytest.raises(ValueError, match="did you mean cubic_stiffness"):
        by_id("cubic_stifness")
    with pytest.raises(ValueError, match="give one of cubic_stiffness"):
        by_id("xyz")
    with pytest.raises(ValueError, match="finding on the record"):
        by_id("outliers")


@pytest.mark.parametrize("effect", EFFECTS, ids=NAMES)
def test_description_and_shapes(effect):
    kinds = (AbstractForceEffect, AbstractInputEffect, AbstractOutputEffect, AbstractMatrixEffect)
    assert sum(isinstance(effect, kind) for kind in kinds) == 1
    assert effect.law and effect.signature and effect.reference and effect.family
    assert effect.parity in ("odd", "even", "none")
    assert places_of(effect, ["u1"], ["y1", "y2"])
    lower, upper = (np.array([getattr(p, side) for p in effect.parameters]) for side in ("lower", "upper"))
    assert np.all(lower < upper)
    assert all(len(p.unit) == 3 for p in effect.parameters)
    amplitudes = [k for k, p in enumerate(effect.parameters) if p.amplitude]
    shapes = effect.shapes(SCALES)
    limit = 24 if effect.id == "unmodelled_mode" or effect.repeats else 8 if effect.family == "hysteresis" else 4
    assert 1 <= len(shapes) <= limit
    for p in shapes:
        assert p.shape == lower.shape and p.dtype == float and np.all(np.isfinite(p))
        assert np.all(p >= lower) and np.all(p <= upper) and np.all(p[amplitudes] > 0.0)
        basis = effect.basis(p)
        assert len(basis) == max(len(amplitudes), 1) or effect.id == "periodic_disturbance"
        assert all(b.shape == p.shape for b in basis)
        back = effect.combine(p, np.ones(len(basis)))
        assert back.shape == p.shape and np.all(back >= lower) and np.all(back <= upper)


@pytest.mark.parametrize("effect", EFFECTS, ids=NAMES)
def test_response_is_the_sum_of_its_basis(effect):
    weights = np.array([0.7, 0.2, 0.4])
    for p in effect.shapes(SCALES)[:2]:
        if effect.id in ("input_saturation", "speed_force_limit"):
            (only,) = effect.basis(p)
            assert np.array_equal(effect.combine(p, np.array([0.9])), only)
            continue
        small = 0.02 if effect.id in NEARLY_LINEAR else 1.0
        basis = effect.basis(p)
        w = small * weights[: len(basis)]
        expected = sum(c * respond(effect, b) for c, b in zip(w, basis))
        if small < 1.0:
            # The tangent at zero, since the entry of the shape is a typical size, not a small one.
            zero = 0.0 * w + 1e-9
            expected = respond(effect, effect.combine(p, zero)) / 1e-9 * w[0]
        got = respond(effect, effect.combine(p, w))
        tolerance = 1e-9 if small == 1.0 else 0.1
        assert np.linalg.norm(got - expected) <= tolerance * np.linalg.norm(expected)
        assert np.linalg.norm(expected) > 0.0


@pytest.mark.parametrize("effect", [e for e in EFFECTS if e.parity != "none"], ids=lambda e: e.id)
def test_parity(effect):
    p = effect.shapes(SCALES)[-1]
    there, back = respond(effect, p), respond(effect, p, -1.0)
    if not isinstance(effect, AbstractMatrixEffect):
        expected = -there if effect.parity == "odd" else there
        np.testing.assert_allclose(back, expected, rtol=1e-9, atol=1e-12 * float(jnp.max(jnp.abs(there))))
    assert jnp.any(there != 0.0)


@pytest.mark.parametrize("effect", EFFECTS, ids=NAMES)
def test_gradient_is_that_of_finite_differences(effect):
    estimated = [k for k, parameter in enumerate(effect.parameters) if parameter.counts]
    p = np.array(effect.shapes(SCALES)[0])
    p[estimated] *= 1.07
    if effect.id in ("stiffness_step", "mass_step", "force_step"):
        p[1:] = 0.803, 0.06
    window = jnp.asarray(np.sin(np.arange(np.asarray(respond(effect, p)).size) * 0.37 + 0.2))

    def value(p):
        return window @ response(effect, p)

    # Both in one program, which is compiled once.
    both = jit(lambda p: (value(p), jax.jacfwd(value)(p)))
    slope = np.asarray(both(p)[1])
    for k in estimated:
        step = np.zeros_like(p)
        step[k] = 1e-6 * max(abs(p[k]), 1e-3)
        numerical = float(both(p + step)[0] - both(p - step)[0]) / (2.0 * step[k])
        assert slope[k] == pytest.approx(numerical, rel=2e-4, abs=1e-6 * np.max(np.abs(slope)))


@pytest.mark.parametrize("effect", EFFECTS, ids=NAMES)
def test_neither_rest_nor_absurd_values_make_a_nan(effect):
    p = effect.shapes(SCALES)[0]
    cases = [p, 1e-30 * p, 1e12 * p, 0.0 * p, -p]
    for k in range(len(p)):
        one = np.zeros_like(p)
        one[k] = 1.0
        cases += [p * (1.0 - one), p * (1.0 + 1e12 * one)]
    cases = jnp.asarray(np.unique([effect.bounded(c) for c in cases], axis=0))

    def total(p, scale):
        return jnp.sum(response(effect, p, scale=scale))

    slopes = jax.vmap(jax.value_and_grad(total, argnums=(0, 1)), in_axes=(0, None))
    value, (by_parameter, by_motion) = jit(jax.vmap(slopes, in_axes=(None, 0)))(cases, jnp.array([0.0, 1.0]))
    fine = np.isfinite(value) & np.all(np.isfinite(by_parameter), axis=2) & np.isfinite(by_motion)
    assert np.all(fine), f"not finite at {cases[~np.all(fine, axis=0)]}"


def zigzag(seed):
    """A path of straight pieces in small equal times: its samples hit every reversal."""
    rng = np.random.default_rng(seed)
    ends = np.cumsum(rng.choice([-1.0, 1.0], 40) * rng.uniform(0.05, 1.5, 40))
    return np.concatenate([[0.0], *(np.linspace(a, b, 8)[1:] for a, b in zip([0.0, *ends[:-1]], ends))])


def driven(effect, p, q):
    """The states of a force law along a path, and its force."""
    v = np.gradient(q)
    zero = np.zeros_like(q)
    here = Local(*(jnp.asarray(x) for x in (q, v, zero, zero, zero, zero, zero)))
    p = jnp.asarray(p)
    z = jit(states_along, static_argnums=0)(effect, p, here)
    return np.asarray(effect.force(p, here, z))


def integrated(rate, q):
    """z along a path by SciPy, piece by piece; `rate`(z, sign) is dz/d|q|."""
    z = [0.0]
    for step in np.diff(q):
        towards = np.sign(step)
        way = solve_ivp(lambda s, z: rate(z, towards), (0.0, abs(step)), [z[-1]], rtol=1e-10, atol=1e-13)  # noqa: B023
        z.append(way.y[0, -1])
    return np.array(z)


def test_dahl_friction_is_exact():
    q = zigzag(0)
    expected = 3.0 * integrated(lambda z, s: (s - z) / 0.2, q)
    np.testing.assert_allclose(driven(by_id("dahl_friction"), [3.0, 0.2], q), expected, atol=1e-8)


@pytest.mark.parametrize("beta, gamma", [(2.0, 1.5), (2.0, -1.2), (1.5, 1.5), (1.0, 3.0), (2.0, 0.0)])
def test_bouc_wen_hysteresis_is_exact(beta, gamma):
    q = zigzag(1)
    stiffness = 4.0
    expected = integrated(lambda z, s: stiffness * s - beta * z - gamma * s * np.abs(z), q)
    np.testing.assert_allclose(driven(by_id("bouc_wen_hysteresis"), [stiffness, beta, gamma], q), expected, atol=1e-7)


def test_bouc_wen_bounds_keep_it_stable():
    result = by_id("bouc_wen_hysteresis").bounded([1.0, 2.0, -5.0])
    assert result[1] + result[2] > 0.0


def test_maxwell_slip_is_the_sum_of_stops():
    q = zigzag(2)
    force = np.zeros(q.size)
    for stiffness, slip in ((2.0, 0.3), (1.0, 0.9)):
        z = 0.0
        for k, step in enumerate(np.diff(q)):
            # In small pieces, as an element with a slider would move.
            for _ in range(10):
                z = min(max(z + step / 10, -slip), slip)
            force[k + 1] += stiffness * z
    np.testing.assert_allclose(driven(by_id("maxwell_slip_hysteresis"), [2.0, 1.0, 0.3, 0.9], q), force, atol=1e-12)


@pytest.mark.parametrize("effect_id", ["force_step", "stiffness_step", "mass_step"])
def test_a_sudden_change_at_an_end_of_the_record_is_unresolved(effect_id):
    scales = dataclasses.replace(SCALES, times=(1.0, 5.0, 9.0))
    for moment, inside in ((0.2, False), (1.0, True), (6.3, True), (9.6, False)):
        assert (by_id(effect_id).unresolved(np.array([1.0, moment, TIME]), scales) is None) == inside


def test_a_hysteresis_shorter_than_a_sample_is_said_to_be_unresolved():
    way = SCALES.v * SCALES.sampling_time
    laws = {
        "dahl_friction": lambda d: [1.0, d],
        "bouc_wen_hysteresis": lambda d: [1.0, 0.75 / d, 0.25 / d],
        "maxwell_slip_hysteresis": lambda d: [1.0, 1.0, 10 * way, d],
    }
    for name, values in laws.items():
        effect = by_id(name)
        assert effect.unresolved(np.array(values(0.001 * way)), SCALES), name
        assert effect.unresolved(np.array(values(0.5 * way)), SCALES) is None, name
    assert by_id("coulomb_friction").unresolved(np.array([1.0, 0.0]), SCALES) is None


def test_a_loop_of_no_width_is_a_spring_and_said_to_be_one():
    effect = by_id("bouc_wen_hysteresis")
    way = [Local(q, *np.zeros(6)) for q in SCALES.q_peak * np.sin(np.linspace(0, np.pi, 101))]
    for width, loop in ((0.0, False), (0.01, False), (0.05, True), (0.5, True)):
        values = np.array([1.0, width / SCALES.q_peak, 0.8 / SCALES.q_peak])
        assert (effect.unresolved(values, SCALES) is None) == loop, width
        z, highest = np.zeros(1), 0.0
        for before, after in zip(way, way[1:]):
            z = effect.advance(values, z, before, after, None)
            highest = max(highest, float(z[0]))
        # What is left of the force after the way out and back.
        assert (abs(float(z[0])) > 0.02 * highest) == loop, width


@pytest.mark.parametrize("alpha", [0.07, 0.3, 0.5, 0.7, 0.93])
def test_fractional_damping_follows_the_power_of_frequency(alpha):
    effect = by_id("fractional_damping")
    h, duration = 1e-3, 20.0
    p = jnp.array([2.5, alpha, 0.5 / duration, 0.5 * np.pi / h])
    rest = Local(*(jnp.zeros(()) for _ in range(7)))
    moved = Local(jnp.ones(()), *(jnp.zeros(()) for _ in range(6)))
    advance = jit(lambda z, before, after: effect.advance(p, z, before, after, h))
    poles = np.diag(jax.vmap(lambda z: advance(z, rest, rest))(jnp.eye(effect.states)))
    gain = np.asarray(advance(jnp.zeros(effect.states), rest, moved))
    z = np.exp(1j * np.geomspace(0.2, 200.0, 40) * h)
    omega = np.log(z).imag / h
    states = gain[:, None] * (z - 1.0) / (z - poles[:, None])
    one, rate, none = (jnp.asarray(x) for x in (np.ones(40), 1j * omega, np.zeros(40)))
    got = effect.force(p, Local(one, rate, none, none, none, none, none), jnp.asarray(states))
    expected = 2.5 * (1j * omega) ** alpha
    assert np.max(np.abs(got / expected - 1.0)) < 0.015


def held(effect_id, hold, samples):
    """Input at the start and at the end of every sample, an effect's law for it, and points within a sample."""
    u = U[:samples]
    after = u if hold == "zero" else np.append(u[1:], u[-1])
    apply = jit(lambda p: by_id(effect_id).apply(p, jnp.asarray(u), jnp.asarray(after), TIME))
    return u, after, apply, (np.arange(2000) + 0.5) / 2000


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_input_delay_keeps_mean_and_slope_of_every_sample(hold):
    u, after, apply, s = held("input_delay", hold, 30)
    for steps in (0.0, 0.3, 1.0, 2.7, 500.0):
        start, end = np.asarray(apply(jnp.array([steps * TIME])))
        for k in range(30):
            t = k + s - steps
            at = np.maximum(np.floor(t).astype(int), 0)
            line = np.where(t < 0, u[0], u[at] + (after[at] - u[at]) * (t - at))
            assert 0.5 * (start[k] + end[k]) == pytest.approx(line.mean(), abs=2e-3)
            assert end[k] - start[k] == pytest.approx(12.0 * np.mean((s - 0.5) * line), abs=1e-2)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_actuator_lag_keeps_mean_and_slope_of_every_sample(hold):
    u, after, apply, s = held("actuator_lag", hold, 20)
    for lag in (0.0, 0.004, 0.2, 1.5, 9.9, 10.1, 300.0):
        start, end = np.asarray(apply(jnp.array([lag * TIME])))
        x = u[0]
        for k in range(20):
            a, b = u[k], after[k] - u[k]
            inside, last = ((np.exp(-t / lag) if lag else 0.0 * t) for t in (s, 1.0))
            line = a + b * (s - lag) + (x - a + b * lag) * inside
            assert 0.5 * (start[k] + end[k]) == pytest.approx(line.mean(), abs=3e-5)
            assert end[k] - start[k] == pytest.approx(12.0 * np.mean((s - 0.5) * line), abs=3e-5)
            x = a + b * (1.0 - lag) + (x - a + b * lag) * last


@pytest.mark.parametrize(
    ("effect_id", "values"),
    [
        ("input_saturation", (0.4,)),
        ("input_dead_zone", (0.4,)),
        ("input_quadratic", (0.7,)),
        ("play_hysteresis", (0.3, 0.5, -0.2, 0.05, 0.3, 1.1)),
    ],
)
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_bent_inputs_keep_mean_and_slope_of_every_sample(effect_id, values, hold):
    u, after, apply, s = held(effect_id, hold, 60)
    start, end = np.asarray(apply(jnp.array(values)))
    z = np.zeros(3)
    for k in range(60):
        x = u[k] + (after[k] - u[k]) * s
        line = {
            "input_saturation": lambda x=x: np.clip(x, -values[0], values[0]),
            "input_dead_zone": lambda x=x: x - np.clip(x, -values[0], values[0]),
            "input_quadratic": lambda x=x: x + values[0] * x**2,
            "play_hysteresis": lambda x=x: x,
        }[effect_id]()
        if effect_id == "play_hysteresis":
            for j in range(3):
                w, r = values[j], values[3 + j]
                z[j] = np.clip(z[j], x[0] - r, x[0] + r)
                moved = z[j] + (x - z[j]) - np.clip(x - z[j], -r, r)
                line, z[j] = line + w * moved, np.clip(moved[-1], after[k] - r, after[k] + r)
        assert 0.5 * (start[k] + end[k]) == pytest.approx(line.mean(), abs=1e-3)
        assert end[k] - start[k] == pytest.approx(12.0 * np.mean((s - 0.5) * line), abs=2e-3)


def test_creep_adds_the_slow_part():
    u = jnp.asarray(U)
    both = jit(lambda effect, p: effect.apply(p, u, u, TIME), static_argnums=0)
    slow = both(by_id("actuator_lag"), jnp.array([0.4]))
    for got, part in zip(both(by_id("actuator_creep"), jnp.array([0.3, 0.4])), slow):
        np.testing.assert_allclose(got, u + 0.3 * part, atol=1e-13)


def test_intersample_hold_goes_to_the_other_hold():
    effect = by_id("intersample_hold")
    u, after = jnp.asarray(U), jnp.append(jnp.asarray(U)[1:], U[-1])
    for end, expected in ((u, after), (after, u)):
        start, moved = effect.apply(jnp.ones(1), u, end, TIME)
        np.testing.assert_allclose(start, u)
        np.testing.assert_allclose(moved, expected, atol=1e-13)


def test_play_hysteresis_is_that_of_a_loop():
    w, r = np.array([0.2, -0.1, 0.4]), np.array([0.1, 0.6, 1.5])
    u = jnp.asarray(U)
    expected = U.copy()
    for weight, width in zip(w, r):
        z = 0.0
        for k in range(SAMPLES):
            z = max(U[k] - width, min(U[k] + width, z))
            expected[k] += weight * z
    start, end = by_id("play_hysteresis").apply(jnp.concatenate([w, r]), u, u, TIME)
    np.testing.assert_allclose(start, expected, atol=1e-12)
    np.testing.assert_allclose(end, expected, atol=1e-12)


@pytest.mark.parametrize("steps", [0.0, 0.4, 1.0, 3.7, 1000.0])
def test_sensor_delay_of_a_slow_signal(steps):
    y = np.sin(8.0 * T + 0.4)
    got = by_id("sensor_delay").apply(jnp.array([steps * TIME]), jnp.asarray(y), jnp.zeros(SAMPLES), TIME)
    inside = np.arange(SAMPLES) >= steps + 1.0
    np.testing.assert_allclose(got[inside][:-1], np.sin(8.0 * (T - steps * TIME) + 0.4)[inside][:-1], atol=1e-4)
    np.testing.assert_allclose(got[np.arange(SAMPLES) < steps - 1.0], y[0])


@pytest.mark.parametrize("lag", [0.003, 0.5, 4.0, 200.0])
def test_sensor_lag_is_exact_for_cubic_pieces(lag):
    got = by_id("sensor_lag").apply(jnp.array([lag * TIME]), jnp.asarray(U), jnp.zeros(SAMPLES), TIME)
    slopes = np.gradient(U)
    # Before the record the output has its first value.
    slopes[0] /= 2.0
    pieces = CubicHermiteSpline(np.arange(SAMPLES), U, slopes)
    expected = U[:1].tolist()
    for k in range(60):
        # The weight is exp(−t) over t = 0 to 1/lag back from the next sample.
        nodes, weights = np.polynomial.laguerre.laggauss(40) if lag < 0.02 else np.polynomial.legendre.leggauss(40)
        if lag < 0.02:
            new = weights @ pieces(k + 1 - lag * nodes)
        else:
            s = 0.5 * (1.0 + nodes)
            new = 0.5 * weights @ (np.exp(-(1.0 - s) / lag) / lag * pieces(k + s))
        expected.append(np.exp(-1.0 / lag) * expected[-1] + new)
    np.testing.assert_allclose(got[:61], expected, atol=1e-9)


def test_sensor_lag_of_a_smooth_signal():
    tau, w = 2.0 * TIME, 8.0
    y = np.sin(w * T)
    settled = (np.sin(w * T) - w * tau * np.cos(w * T) + w * tau * np.exp(-T / tau)) / (1 + (w * tau) ** 2)
    got = by_id("sensor_lag").apply(jnp.array([tau]), jnp.asarray(y), jnp.zeros(SAMPLES), TIME)
    assert np.max(np.abs(got - settled)[20:]) < 0.02 * (w * TIME) ** 2 / 12


def test_clock_scale_stretches_time():
    y = np.sin(8.0 * T + 0.4)
    got = by_id("clock_scale").apply(jnp.array([-0.003]), jnp.asarray(y), jnp.zeros(SAMPLES), TIME)
    np.testing.assert_allclose(got[2:-2], np.sin(8.0 * T * 0.997 + 0.4)[2:-2], atol=1e-4)


def test_dropped_samples_bring_what_follows_early():
    y = np.sin(8.0 * T + 0.4)
    got = by_id("dropped_samples").apply(jnp.array([3.0, 1.505, TIME]), jnp.asarray(y), jnp.zeros(SAMPLES), TIME)
    np.testing.assert_allclose(got[:150], y[:150], atol=1e-12)
    np.testing.assert_allclose(got[151:-3], y[154:], atol=1e-12)


def test_unmodelled_mode_is_an_attached_oscillator():
    effect = by_id("unmodelled_mode")
    frequency, damping, share = 2.0, 0.03, 0.2
    given = (jnp.asarray(X) for X in (MASS, DAMPING, STIFFNESS, FIRST, 0.0 * SECOND))
    M, D, K = effect.matrices(jnp.array([frequency, damping, share]), *given)
    assert M.shape == (3, 3)
    for X in (M, D, K):
        np.testing.assert_allclose(X, X.T)
    omega, own = 9.0, 2.0 * np.pi * frequency
    Z = np.asarray(K - omega**2 * M + 1j * omega * D)
    condensed = Z[:2, :2] - np.outer(Z[:2, 2], Z[2, :2]) / Z[2, 2]
    link = own**2 + 2j * damping * own * omega
    added = -share * MASS[0, 0] * omega**2 * link / (link - omega**2)
    plain = STIFFNESS - omega**2 * MASS + 1j * omega * DAMPING
    np.testing.assert_allclose(condensed - plain, added * np.outer(FIRST, FIRST), atol=1e-10)


def test_frequencies_of_the_unmodelled_mode_cover_plant_and_lines():
    shapes = by_id("unmodelled_mode").shapes(SCALES)
    frequencies = sorted({p[0] for p in shapes})
    assert frequencies[0] == pytest.approx(0.3 * 1.3) and frequencies[-1] == pytest.approx(4.0 * 3.7)
    assert 2.2 in frequencies


@pytest.mark.parametrize("name, which", [("mass_error", 0), ("damping_error", 1), ("stiffness_error", 2)])
def test_model_errors_change_one_entry(name, which):
    given = [jnp.asarray(X) for X in (MASS, DAMPING, STIFFNESS)]
    for second, expected in ((0.0 * SECOND, [[2.0, 0.0], [0.0, 0.0]]), (SECOND, [[0.0, 2.0], [2.0, 0.0]])):
        changed = by_id(name).matrices(jnp.array([2.0]), *given, jnp.asarray(FIRST), jnp.asarray(second))
        for k in range(3):
            np.testing.assert_allclose(changed[k] - given[k], np.array(expected) if k == which else 0.0, atol=1e-12)


@pytest.mark.parametrize("name, which", [("gyroscopic_coupling", 1), ("circulatory_coupling", 2)])
def test_skew_couplings(name, which):
    given = [jnp.asarray(X) for X in (MASS, DAMPING, STIFFNESS)]
    changed = by_id(name).matrices(jnp.array([2.0]), *given, jnp.asarray(FIRST), jnp.asarray(SECOND))
    for k in range(3):
        expected = np.array([[0.0, 2.0], [-2.0, 0.0]]) if k == which else 0.0
        np.testing.assert_allclose(changed[k] - given[k], expected, atol=1e-12)


def test_mass_step_acts_as_added_mass():
    mass, dm, applied = 2.0, 0.7, 3.0
    plain = applied / mass
    zero = jnp.zeros(())
    here = Local(zero, zero, jnp.asarray(plain), jnp.asarray(1.0 / mass), zero, jnp.asarray(5.0), zero)
    f = by_id("mass_step").force(jnp.array([dm, 1.0, TIME]), here, jnp.zeros(0))
    assert (applied - f) / mass == pytest.approx(applied / (mass + dm))


@pytest.mark.parametrize("Fs, said", [(0.5, True), (1.5, False)])
def test_friction_that_falls_towards_rest_is_no_stribeck_friction(Fs, said):
    why = by_id("stribeck_friction").unresolved(np.array([1.0, Fs, 0.1, 0.01]), None)
    assert (why is not None and "rounded off" in why) == said


def test_signs_are_those_of_the_left_side():
    def force(name, p):
        one = jnp.ones(())
        here = Local(one, one, one, jnp.asarray(0.5), one, one, one)
        return float(by_id(name).force(jnp.asarray(p, dtype=float), here, jnp.zeros(0)))

    assert force("cubic_stiffness", [2.0]) == 2.0
    assert force("coulomb_friction", [2.0, 0.01]) == pytest.approx(2.0)
    assert force("stribeck_friction", [1.0, 2.0, 100.0, 0.01]) == pytest.approx(2.0, rel=1e-3)
    assert force("position_dependent_friction", [1.0, 0.5, 0.01]) == pytest.approx(1.5)
    assert force("force_step", [2.0, 0.5, TIME]) == -2.0
    assert force("periodic_disturbance", [2.0, 1.0, 0.5 * np.pi]) == pytest.approx(-2.0)
    assert force("input_position_gain", [2.0, 0.0]) == -2.0
    assert force("load_friction", [0.3, 0.01]) == pytest.approx(0.3)
    assert force("speed_force_limit", [0.9, 0.5, 0.0]) == pytest.approx(0.6)


def test_a_limit_by_voltage_gives_back_while_braking():
    def taken(u, v, form):
        zero = jnp.zeros(())
        here = Local(zero, jnp.asarray(v), zero, zero, jnp.asarray(u), zero, zero)
        return float(by_id("speed_force_limit").force(jnp.array([1.0, 0.5, form]), here, jnp.zeros(0)))

    assert taken(1.2, 1.0, 0.0) == taken(1.2, 1.0, 1.0) == pytest.approx(0.7)
    assert taken(1.2, -1.0, 0.0) == pytest.approx(0.7) and taken(1.2, -1.0, 1.0) == 0.0
    assert taken(-1.2, -1.0, 1.0) == pytest.approx(-0.7)
    # Beyond the speed at which nothing is left it does not push back.
    assert taken(1.2, 3.0, 0.0) == pytest.approx(1.2)


def test_periodic_disturbance_combines_as_amplitude_and_phase():
    effect = by_id("periodic_disturbance")
    p = effect.combine(np.array([1.0, 2.2, 0.0]), np.array([-3.0, 4.0]))
    assert p[0] == pytest.approx(5.0) and p[2] == pytest.approx(np.arctan2(4.0, -3.0))


def test_a_scheduling_channel_modulates_the_stiffness():
    got = respond(by_id("position_dependent_stiffness"), np.array([3.0]))
    np.testing.assert_allclose(got, 3.0 * P * Q, atol=1e-12)


def test_a_term_tells_its_parameters():
    term = Term(by_id("end_stop"), Place("y1", 0), jnp.array([3.0, 0.2]))
    assert term.parameter("gap") == pytest.approx(0.2)
