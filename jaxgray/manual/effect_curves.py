"""What the picture of an effect shows: curves that the law itself computes, along a sine motion or a sine signal."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.signal

from ..mechanics.effects import (
    AbstractEffect,
    AbstractForceEffect,
    AbstractInputEffect,
    AbstractMatrixEffect,
    AbstractOutputEffect,
    Local,
    Scales,
)
from ..mechanics.runs.force_over_time import force_over_time

PERIOD = 2 * np.pi
"""Of the motion [s]: its displacement, velocity and acceleration are then equally large."""

PERIODS = 3
FINE, COARSE = 400, 60
"""Samples in a period: of a motion, and of a signal that is sampled visibly."""

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
COMPLIANCE = 0.5

PICKED = {
    "dead_zone_stiffness": 2,
    "sine_stiffness": 3,
    "stribeck_friction": 1,
    "fractional_damping": 1,
    "dahl_friction": 2,
    "bouc_wen_hysteresis": 1,
    "maxwell_slip_hysteresis": 2,
    "input_delay": 2,
    "actuator_lag": 2,
    "input_dead_zone": 1,
    "play_hysteresis": 1,
    "actuator_creep": 1,
    "sensor_delay": 2,
    "sensor_lag": 2,
    "unmodelled_mode": 11,
}
"""Which of the shapes of a law is drawn, where not the first."""

CHANGED = {
    "stribeck_friction": {1: 1.6},
    "asymmetric_friction": {1: 0.4},
    "position_dependent_friction": {1: 0.7},
    "gyroscopic_coupling": {0: 0.4},
    "circulatory_coupling": {0: 0.2},
    "input_quadratic": {0: 0.4},
    "input_position_gain": {0: 0.6},
    "play_hysteresis": {0: 0.3, 1: 0.3, 2: 0.3},
    "actuator_creep": {0: 0.4},
    "sensor_offset": {0: 0.3},
    "sensor_drift": {0: 0.02, 1: 0.002},
    "sensor_crosstalk": {0: 0.3},
    "sensor_nonlinearity": {0: 0.3},
    "clock_scale": {0: 0.03},
    "dropped_samples": {0: 8.0},
    "unmodelled_mode": {2: 0.1},
    "mass_error": {0: 0.3},
    "damping_error": {0: 0.1},
    "stiffness_error": {0: 0.4},
}
"""Values, by position among the parameters, that show a law better than those of its shape."""

MASS, DAMPING = np.eye(2), np.array([[0.12, -0.02], [-0.02, 0.12]])
STIFFNESS = np.array([[1.5, -0.3], [-0.3, 2.5]])


@dataclass(frozen=True)
class Curve:
    """One line: `label`; `x`, `y`; `role`: "law", "second", "third", or "plain" for what is there without it."""

    label: str
    x: np.ndarray
    y: np.ndarray
    role: str = "law"


@dataclass(frozen=True)
class Panel:
    """Curves over common axes: `title`, `x_label`, `y_label`, `curves`; `logarithmic`: both axes."""

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False


def panels(effect: AbstractEffect) -> tuple[Panel, Panel]:
    """What is drawn of a law.

    **Arguments:** `effect`: of the catalogue, or an error of a given model.

    **Returns:** on the left what its force or signal depends on, on the right how it shows.
    """
    if effect.id in SINGLE:
        return SINGLE[effect.id](effect)
    return next(draw for kind, draw in KINDS if isinstance(effect, kind))(effect)


def _times(samples: int) -> np.ndarray:
    return np.arange(PERIODS * samples + 1) * (PERIOD / samples)


def _scales(samples: int) -> Scales:
    """Sizes of a sine of amplitude 1, of a motion and of an input alike."""
    t = _times(samples)
    levels = tuple(np.quantile(np.abs(np.sin(t)), LEVELS).tolist())
    middle = np.sqrt(0.5)
    return Scales(
        q=middle,
        v=middle,
        q_peak=1.0,
        v_peak=1.0,
        q_quantiles=levels,
        u=middle,
        u_peak=1.0,
        u_quantiles=levels,
        force=1.0,
        compliance=COMPLIANCE,
        sampling_time=PERIOD / samples,
        duration=t[-1],
        frequencies_hz=(1.2 / PERIOD, 1.6 / PERIOD),
        lines_hz=(2.0 / PERIOD,),
        times=(0.45 * t[-1],),
    )


def _values(effect: AbstractEffect, samples: int = FINE) -> np.ndarray:
    p = np.array(effect.shapes(_scales(samples))[PICKED.get(effect.id, 0)])
    for position, value in CHANGED.get(effect.id, {}).items():
        p[position] = value
    return effect.bounded(p)


def _here(**series) -> Local:
    """What a law sees, zero where nothing is given."""
    names = ("q", "v", "a", "compliance", "u", "t", "p")
    given = np.broadcast_arrays(*(np.asarray(series.get(name, 0.0), dtype=float) for name in names))
    return Local(*(jnp.asarray(x) for x in given))


def _motion(t: np.ndarray, rate: float = 1.0, **more) -> Local:
    x = rate * t
    return _here(q=np.sin(x), v=rate * np.cos(x), a=-(rate**2) * np.sin(x), compliance=COMPLIANCE, t=t, **more)


def _along(effect: AbstractForceEffect, here: Local, step: float) -> np.ndarray:
    return np.asarray(force_over_time(effect, jnp.asarray(_values(effect)), here, step))


def _static(effect: AbstractForceEffect, **series) -> np.ndarray:
    """Force of a law without memory where the place is held."""
    here = _here(**series)
    return np.asarray(jnp.broadcast_to(effect.force(jnp.asarray(_values(effect)), here, jnp.zeros(0)), here.q.shape))


def _scaled(x: np.ndarray, like: np.ndarray) -> np.ndarray:
    return x * np.max(np.abs(like)) / np.max(np.abs(x))


def _force_trace(effect: AbstractForceEffect, against: str = "displacement", **more) -> Panel:
    """Force of a law over a sine motion, with what it follows behind it."""
    t = _times(FINE)
    here = _motion(t, **more)
    force = _along(effect, here, t[1])
    seen = {"displacement": here.q, "velocity": here.v, "acceleration": here.a}[against]
    behind = Curve(f"{against}, scaled", t, _scaled(np.asarray(seen), force), "plain")
    return Panel("Over a sine motion", "time [s]", "force", (behind, Curve("force of the law", t, force)))


WAY = np.linspace(-1.2, 1.2, 1201)


def _stiffness(effect: AbstractForceEffect) -> tuple[Panel, Panel]:
    line = Curve("force of the law", WAY, _static(effect, q=WAY))
    return Panel("Force against displacement", "displacement [length]", "force", (line,)), _force_trace(effect)


def _friction(effect: AbstractForceEffect) -> tuple[Panel, Panel]:
    line = Curve("force of the law", WAY, _static(effect, v=WAY))
    left = Panel("Force against velocity", "velocity [length/s]", "force", (line,))
    return left, _force_trace(effect, "velocity")


def _hysteresis(effect: AbstractForceEffect) -> tuple[Panel, Panel]:
    t = _times(FINE)
    # A motion that grows by the period shows small loops within large ones.
    size = np.interp(t, [0.0, PERIOD, 2 * PERIOD, t[-1]], [0.5, 0.5, 1.0, 1.0])
    q = size * np.sin(t)
    force = _along(effect, _here(q=q, v=np.gradient(q, t), t=t), t[1])
    left = Panel("Loop over displacement", "displacement [length]", "force", (Curve("force of the law", q, force),))
    behind = Curve("displacement, scaled", t, _scaled(q, force), "plain")
    return left, Panel("Over time", "time [s]", "force", (behind, Curve("force of the law", t, force)))


def _family(effect: AbstractForceEffect) -> tuple[Panel, Panel]:
    return {"friction": _friction, "hysteresis": _hysteresis}.get(effect.family, _stiffness)(effect)


ROLES = ("law", "second", "third")


def _several(effect, title, x_label, labels, x, settings) -> Panel:
    """A law that has another line at every setting."""
    curves = [
        Curve(label, x, _static(effect, **one), role) for label, one, role in zip(labels, settings, ROLES, strict=True)
    ]
    return Panel(title, x_label, "force", tuple(curves))


def _position_dependent_friction(effect) -> tuple[Panel, Panel]:
    places = (-0.8, 0.0, 0.8)
    labels = [f"{place:g}" for place in places]
    settings = [{"v": WAY, "q": place} for place in places]
    left = _several(
        effect, "Force against velocity, at three displacements", "velocity [length/s]", labels, WAY, settings
    )
    return left, _force_trace(effect, "velocity")


def _scheduled(effect) -> tuple[Panel, Panel]:
    channel = (-1.0, 0.0, 1.0)
    labels = [f"{p:g}" for p in channel]
    settings = [{"q": WAY, "p": p} for p in channel]
    left = _several(
        effect,
        "Force against displacement, by the channel",
        "displacement [length]",
        labels,
        WAY,
        settings,
    )
    return left, _force_trace(effect, p=np.cos(_times(FINE) / PERIODS))


def _over_the_record(effect) -> tuple[Panel, Panel]:
    end = _times(FINE)[-1]
    moments = {"at the start": 0.0, "in the middle": 0.5 * end, "at the end": end}
    settings = [{"q": WAY, "t": t} for t in moments.values()]
    left = _several(effect, "Force against displacement", "displacement [length]", moments, WAY, settings)
    return left, _force_trace(effect)


def _step(effect) -> tuple[Panel, Panel]:
    """A stiffness or a mass before and after a moment."""
    end = _times(FINE)[-1]
    name, unit, letter = (
        ("acceleration", "length/s^2", "a") if effect.id == "mass_step" else ("displacement", "length", "q")
    )
    curves = [
        Curve(label, WAY, _static(effect, **{letter: WAY, "t": t, "compliance": COMPLIANCE}), role)
        for label, t, role in (("before", 0.0, "plain"), ("after", end, "law"))
    ]
    left = Panel(f"Force against {name}", f"{name} [{unit}]", "force", tuple(curves))
    return left, _force_trace(effect, name)


def _fractional(effect) -> tuple[Panel, Panel]:
    curves = []
    for label, rate, role in (("slow motion", 1.0, "law"), ("ten times faster", 10.0, "second")):
        t = _times(FINE) / rate
        here = _motion(t, rate)
        force = _along(effect, here, t[1])
        last = slice(-FINE - 1, None)
        curves.append(Curve(label, np.asarray(here.q)[last], force[last], role))
    left = Panel("Loop over displacement", "displacement [length]", "force", tuple(curves))
    return left, _force_trace(effect, "velocity")


def _moved(force: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Displacement of a mass on a spring under an applied force."""
    return scipy.signal.lsim(([1.0], [1.0, 0.2, 1.44]), force, t)[1]


def _applied(effect) -> tuple[Panel, Panel]:
    """A force that depends on time alone, and the motion with it."""
    t = np.linspace(0.0, 8 * PERIOD, 3201)
    p = np.array(_values(effect))
    names = [one.name for one in effect.parameters]
    if "t0" in names:
        p[names.index("t0")] = 0.45 * t[-1]
    force = np.asarray(effect.force(jnp.asarray(p), _here(q=0.0 * t, t=t), jnp.zeros(0)))
    applied = -np.broadcast_to(force, t.shape)
    driven = np.sin(0.5 * t)
    curves = (
        Curve("without", t, _moved(driven, t), "plain"),
        Curve("with the effect", t, _moved(driven + applied, t)),
    )
    left = Panel("Applied force over time", "time [s]", "force", (Curve("force of the law", t, applied),))
    return left, Panel("Motion that it makes", "time [s]", "displacement [length]", curves)


def _position_gain(effect) -> tuple[Panel, Panel]:
    places = (-0.8, 0.0, 0.8)
    curves = [Curve(f"{q:g}", WAY, WAY - _static(effect, u=WAY, q=q), role) for q, role in zip(places, ROLES)]
    left = Panel("Applied force against input, at three displacements", "input [force]", "applied force", tuple(curves))
    t = _times(FINE)
    u = np.sin(3.0 * t)
    force = u - _along(effect, _motion(t, u=u), t[1])
    lines = (Curve("without", t, u, "plain"), Curve("with the effect", t, force))
    return left, Panel("Fast input, slow motion", "time [s]", "applied force", lines)


def _load_friction(effect) -> tuple[Panel, Panel]:
    loads = (0.3, 1.0, 2.0)
    settings = [{"v": WAY, "u": u} for u in loads]
    labels = [f"{u:g}" for u in loads]
    left = _several(effect, "Force against velocity, at three inputs", "velocity [length/s]", labels, WAY, settings)
    return left, _force_trace(effect, "velocity", u=np.sin(0.4 * _times(FINE)))


def _speed_force_limit(effect) -> tuple[Panel, Panel]:
    speeds = (0.0, 0.4, 0.8)
    curves = [Curve(f"{v:g}", WAY, WAY - _static(effect, u=WAY, v=v), role) for v, role in zip(speeds, ROLES)]
    left = Panel("Applied force against input, at three speeds", "input [force]", "applied force", tuple(curves))
    t = _times(FINE)
    u = 1.2 * np.cos(t)
    force = u - _along(effect, _motion(t, u=u), t[1])
    lines = (Curve("command", t, u, "plain"), Curve("applied force", t, force))
    return left, Panel("Command in phase with the velocity", "time [s]", "applied force", lines)


def _segments(t: np.ndarray, start: np.ndarray, end: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines over the samples as one line."""
    return np.column_stack([t, t + step]).ravel(), np.column_stack([start, end]).ravel()


def _input(effect: AbstractInputEffect) -> tuple[Panel, Panel]:
    t = _times(COARSE)
    u = np.where(np.sin(t) >= 0, 1.0, -1.0) if effect.id == "actuator_creep" else np.sin(t)
    start, end = effect.apply(jnp.asarray(_values(effect, COARSE)), jnp.asarray(u), jnp.asarray(u), t[1])
    out = np.asarray(start + end) / 2
    last = slice(COARSE, None)
    left = Panel("Output against input", "input [force]", "applied force", (Curve("", u[last], out[last]),))
    lines = (Curve("command", t, u, "plain"), Curve("applied force", t, out))
    return left, Panel("Over time", "time [s]", "force", lines)


def _between_samples(effect: AbstractInputEffect) -> tuple[Panel, Panel]:
    step = PERIOD / 10
    t = np.arange(-40, 80) * step
    u = np.sin(t) + 0.3 * np.sin(2.0 * t)
    start, end = effect.apply(jnp.asarray(_values(effect)), jnp.asarray(u), jnp.asarray(u), step)
    shown = slice(40, 60)
    said = _segments(t, u, u, step)[1].reshape(-1, 2)[shown].ravel()
    x, y = (one.reshape(-1, 2)[shown].ravel() for one in _segments(t, np.asarray(start), np.asarray(end), step))
    both = Curve("as said", x, said, "plain"), Curve("with the effect", x, y)
    left = Panel("Input between samples", "time [s]", "input [force]", both)
    return left, Panel("Difference of the two", "time [s]", "force", (Curve("", x, y - said),))


def _output(effect: AbstractOutputEffect) -> tuple[Panel, Panel]:
    t = _times(COARSE)
    y, source = np.sin(t), np.sin(5.0 * t)
    read = np.asarray(
        effect.apply(jnp.asarray(_values(effect, COARSE)), jnp.asarray(y), jnp.asarray(source), jnp.asarray(t[1]))
    )
    # The ends are those of the record, where a reading has nothing to come from.
    inner = slice(COARSE // 4, -COARSE // 4)
    left = Panel("Reading against output", "output [length]", "reading [length]", (Curve("", y[inner], read[inner]),))
    lines = (Curve("output", t[inner], y[inner], "plain"), Curve("reading", t[inner], read[inner]))
    return left, Panel("Over time", "time [s]", "length", lines)


def _matrices(effect: AbstractMatrixEffect) -> list[tuple[np.ndarray, ...]]:
    """M, D, K without and with the effect."""
    first, second = np.eye(2)
    arms = [first, second if effect.places == "pair" else 0.0 * second]
    given = [jnp.asarray(X) for X in (MASS, DAMPING, STIFFNESS, *arms)]
    changed = effect.matrices(jnp.asarray(_values(effect)), *given)
    return [(MASS, DAMPING, STIFFNESS), tuple(np.asarray(X) for X in changed)]


def _gain(matrices, output: int, input: int, omega: np.ndarray) -> np.ndarray:
    M, D, K = matrices
    w = omega[:, None, None]
    return np.abs(np.linalg.inv(K + 1j * w * D - w**2 * M)[:, output, input])


def _rung(matrices, output: int, input: int, t: np.ndarray) -> np.ndarray:
    """Displacement after a blow of unit impulse."""
    M, D, K = matrices
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    state = np.concatenate([np.zeros(n), np.linalg.inv(M)[:, input]])
    step, seen = scipy.linalg.expm(A * (t[1] - t[0])), []
    for _ in t:
        seen.append(state[output])
        state = step @ state
    return np.array(seen)


def _matrix(effect: AbstractMatrixEffect) -> tuple[Panel, Panel]:
    without, changed = _matrices(effect)
    ways = [("without", without, (1, 0), "plain"), ("with the effect", changed, (1, 0), "law")]
    where = "y2 from u1"
    if effect.places != "pair":
        ways = [(label, matrices, (0, 0), role) for label, matrices, _, role in ways]
        where = "y1 from u1"
    elif effect.id == "circulatory_coupling":
        ways = [("without", without, (1, 0), "plain"), ("y2 from u1", changed, (1, 0), "law")]
        ways.append(("y1 from u2", changed, (0, 1), "second"))
        where = "y2 from u1, y1 from u2"
    omega, t = np.geomspace(0.3, 5.0, 500), np.linspace(0.0, 8 * PERIOD, 801)
    gains = tuple(Curve(label, omega / PERIOD, _gain(X, *way, omega), role) for label, X, way, role in ways)
    rung = tuple(Curve(label, t, _rung(X, *way, t), role) for label, X, way, role in ways)
    left = Panel(f"Frequency response, {where}", "frequency [Hz]", "magnitude [length/force]", gains, logarithmic=True)
    return left, Panel("After a blow", "time [s]", "displacement [length]", rung)


def _constant(effect) -> tuple[Panel, Panel]:
    return _stiffness(effect)[0], _applied(effect)[1]


SINGLE: dict[str, Callable[..., tuple[Panel, Panel]]] = {
    "constant_force": _constant,
    "position_dependent_stiffness": _scheduled,
    "position_dependent_friction": _position_dependent_friction,
    "fractional_damping": _fractional,
    "intersample_hold": _between_samples,
    "band_limited_input": _between_samples,
    "input_position_gain": _position_gain,
    "load_friction": _load_friction,
    "speed_force_limit": _speed_force_limit,
    "stiffness_drift": _over_the_record,
    "stiffness_step": _step,
    "mass_step": _step,
    "periodic_disturbance": _applied,
    "force_step": _applied,
}
"""Laws that are not drawn as others of their kind."""

KINDS = (
    (AbstractForceEffect, _family),
    (AbstractInputEffect, _input),
    (AbstractOutputEffect, _output),
    (AbstractMatrixEffect, _matrix),
)
