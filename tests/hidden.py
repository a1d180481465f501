"""Records with a known hidden effect, or with none, from a simulator that shares nothing with the package."""

from dataclasses import dataclass, field, replace
from typing import Any

import hidden_draws as draws
import hidden_laws as laws
import independent
import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.signal
from hidden_draws import DYNAMIC, SAMPLING_TIME, rms
from hidden_fit import linear_residual
from hidden_laws import Effect
from hidden_simulation import System, simulate

__all__ = [
    "DYNAMIC",
    "NULLS",
    "PAIRS",
    "TooHard",
    "RAW",
    "Case",
    "Effect",
    "System",
    "closed_loop_case",
    "fresh",
    "null_case",
    "random_case",
    "random_pair",
    "raw_case",
    "simulate",
]

NULLS = ("white", "coloured", "process", "initial")
RAW = (*laws.RAW, "clock_scale")
CLIPPED = 0.005
"""Least share of samples at the limit of a clipped record."""

PAIRS = (
    ("cubic_stiffness", "coulomb_friction"),
    ("cubic_stiffness", "input_delay"),
    ("quadratic_stiffness", "quadratic_drag"),
    ("end_stop", "sensor_offset"),
    ("dead_zone_stiffness", "actuator_lag"),
    ("bilinear_stiffness", "coulomb_friction"),
    ("sine_stiffness", "coulomb_friction"),
    ("coulomb_friction", "constant_force"),
    ("coulomb_friction", "input_saturation"),
    ("quadratic_drag", "sensor_drift"),
    ("stribeck_friction", "cubic_stiffness"),
    ("dahl_friction", "quadratic_stiffness"),
    ("bouc_wen_hysteresis", "input_delay"),
    ("maxwell_slip_hysteresis", "sensor_offset"),
    ("play_hysteresis", "coulomb_friction"),
    ("input_dead_zone", "cubic_stiffness"),
    ("unmodelled_mode", "coulomb_friction"),
    ("stiffness_step", "coulomb_friction"),
    ("periodic_disturbance", "cubic_stiffness"),
    ("input_quadratic", "cubic_stiffness"),
    ("sensor_lag", "quadratic_drag"),
    ("force_step", "coulomb_friction"),
    ("fractional_damping", "end_stop"),
    ("stiffness_drift", "input_delay"),
)
"""Pairs of effects that may come together."""


@dataclass(frozen=True)
class Case:
    """An estimation record, a validation record of the same system, and the truth.

    `clean`: outputs without noise and without what spoils the raw record; `noise`: its root mean square at each
    output; `excess`: residual of the best linear model on the noisy record relative to the noise, root mean square
    over the outputs (1 where nothing is hidden); `linear_residual`: what that model leaves of the clean outputs;
    `kind`, `excitation`, `levels`, `colour`, `extra`: how the records were made, for more of the same.
    """

    u: np.ndarray
    y: np.ndarray
    clean: np.ndarray
    sampling_time: float
    hold: str
    effects: tuple[Effect, ...]
    noise: np.ndarray
    system: System
    scheduling: np.ndarray | None
    u_v: np.ndarray
    y_v: np.ndarray
    clean_v: np.ndarray
    scheduling_v: np.ndarray | None
    excess: float
    linear_residual: np.ndarray
    kind: str
    excitation: str
    levels: np.ndarray
    colour: np.ndarray = field(default_factory=lambda: np.ones(1))
    extra: dict[str, Any] = field(default_factory=dict)


class TooHard(RuntimeError):
    """No record of the wanted kind was found in many tries."""


def coloured(rng, samples, sigma, colour):
    """Noise of this root mean square through the autoregression `colour` (1, a1, …); white where it is (1,)."""
    e = rng.standard_normal((samples + 500, len(sigma)))
    e = scipy.signal.lfilter([1.0], colour, e, axis=0)[500:]
    impulse = scipy.signal.lfilter([1.0], colour, np.eye(1, 2000)[0])
    return sigma * e / np.sqrt(np.sum(impulse**2))


def fresh(rng, case):
    """(u, y, clean, scheduling) of one more record of the same system, effects, excitation and noise."""
    samples = len(case.u)
    u = draws.excitation(rng, case.excitation, samples, case.levels)
    p = None if case.scheduling is None else draws.scheduling(rng, samples)
    if case.kind == "closed_loop":
        u, clean, noisy = _closed_loop(rng, case.system, samples, case.noise, **case.extra)
        return u, noisy, clean, p
    force = None
    if "force" in case.extra:
        force = case.extra["force"] * rng.standard_normal((samples, len(case.system.M)))
    x0 = case.extra["x0"] * rng.standard_normal(2 * len(case.system.M)) if "x0" in case.extra else None
    clean = simulate(case.system, u, case.sampling_time, case.effects, hold=case.hold, scheduling=p, x0=x0)
    noisy = clean + coloured(rng, samples, case.noise, case.colour)
    if force is not None:
        noisy = noisy + simulate(case.system, np.zeros_like(u), case.sampling_time, (), force=force)
    y = spoilt(rng, noisy, case.effects)
    return u[: len(y)], y, clean[: len(y)], None if p is None else p[: len(y)]


def spoilt(rng, y, effects):
    """The record after the effects that act on the stored numbers."""
    y = y.copy()
    for e in effects:
        if e.id not in laws.RAW:
            continue
        p = e.parameters
        i = None if e.place == "record" else laws.index(e.place)
        if e.id == "sensor_clipping":
            y[:, i] = np.clip(y[:, i], p["low"], p["high"])
        elif e.id == "sensor_quantization":
            y[:, i] = np.round(y[:, i] / p["step"]) * p["step"]
        elif e.id == "outliers":
            hit = rng.choice(len(y), size=p["count"], replace=False)
            y[hit, i] += p["size"] * rng.choice([-1, 1], p["count"]) * rng.uniform(0.5, 1.5, p["count"])
        elif e.id == "dropped_samples" and p["form"] == "missing":
            y[rng.choice(np.arange(1, len(y) - 1), size=p["count"], replace=False)] = np.nan
        elif e.id == "dropped_samples":
            # Shorter than the inputs, whose end is then of no use.
            y = np.delete(y, np.arange(p["at"], p["at"] + p["count"]), axis=0)
    return y


def _filled(rng, case):
    """The case with both records made."""
    u, y, clean, p = fresh(rng, case)
    u_v, y_v, clean_v, p_v = fresh(rng, case)
    return replace(case, u=u, y=y, clean=clean, scheduling=p, u_v=u_v, y_v=y_v, clean_v=clean_v, scheduling_v=p_v)


def _bare(rng, dofs, samples, kind, **more):
    """A random system with its excitation, all modes moving; no records yet. Also the linear motion."""
    n = int(dofs if np.isscalar(dofs) else rng.choice(dofs))
    while True:
        system = draws.random_system(rng, n)
        excitation = str(rng.choice(list(draws.EXCITATIONS)))
        hold = "zero" if excitation == "steps" or rng.random() < 0.5 else "linear"
        levels = draws.log_uniform(rng, 0.3, 30.0) * rng.uniform(0.5, 1.5, n)
        u = draws.excitation(rng, excitation, samples, levels)
        y = independent.simulate(system.M, system.D, system.K, u, SAMPLING_TIME, hold=hold)
        if draws.moves_all_modes(system, y):
            break
    none = np.zeros((0, n))
    case = Case(
        u, none, none, SAMPLING_TIME, hold, (), np.zeros(n), system, None, none, none, none, None, 1.0, none,
        kind, excitation, levels, **more,
    )  # fmt: skip
    return case, y


def noise_level(residual, y, excess):
    """Noise of each output for which root mean square over outputs of (residual of a fit to the noisy record /
    noise) is `excess`; None where the residual is too small for it.

    In proportion to the residual of the output, but not below a tenth of the relative noise of the noisiest output
    and not below 1e−4 of the signal.
    """
    r, signal = rms(residual), rms(y)

    def level(c):
        relative = c * r / signal
        return signal * np.maximum(np.maximum(relative, 0.1 * relative.max()), 1e-4)

    def gap(c):
        return np.sqrt(np.mean(1 + (r / level(np.exp(c))) ** 2)) - excess

    if gap(-25.0) <= 0:
        return None
    return level(np.exp(scipy.optimize.brentq(gap, -25.0, 5.0)))


def _touches(effect, clean):
    """Whether a gap is left as often as its name says: backlash in more than half of the samples, a stop in less."""
    if effect.id not in ("dead_zone_stiffness", "end_stop"):
        return True
    contact = np.mean(np.abs(clean @ laws.arm(effect.place, clean.shape[1])) > effect.parameters["gap"])
    return (contact > 0.5) == (effect.id == "dead_zone_stiffness")


def _hides(case, y, effects, p):
    """(clean outputs, linear residual) with these effects; None where they make the system another one."""
    with np.errstate(all="ignore"):
        clean = simulate(case.system, case.u, SAMPLING_TIME, effects, hold=case.hold, scheduling=p)
    if not np.all(np.isfinite(clean)) or not np.all((rms(clean) > 0.15 * rms(y)) & (rms(clean) < 4 * rms(y))):
        return None
    if not all(_touches(effect, clean) for effect in effects):
        return None
    residual = linear_residual(case.u, clean, SAMPLING_TIME, hold=case.hold, start=case.system)
    return None if residual is None else (clean, residual)


def random_case(
    rng, effect_id, *, dofs=(1, 2, 3), samples=4000, excess=(1.5, 4.0), place=None, largest_noise=0.1, tries=80
):
    """One hidden effect in a random system, the noise such that `excess` (see `Case`) falls in the range."""
    return _hidden(rng, (effect_id,), dofs, samples, excess, place, largest_noise, tries)


def random_pair(rng, *, pair=None, dofs=(1, 2, 3), samples=4000, excess=(1.5, 4.0), largest_noise=0.1, tries=80):
    """Two effects at once, each at its own place; `excess` is that of the smaller one alone, the other at most five
    times as large."""
    pair = PAIRS[rng.integers(len(PAIRS))] if pair is None else tuple(pair)
    return _hidden(rng, pair, dofs, samples, excess, None, largest_noise, tries)


def _hidden(rng, ids, dofs, samples, excess, place, largest_noise, tries):
    dofs = np.atleast_1d(dofs)
    if {*draws.PAIR}.intersection(ids):
        dofs = dofs[dofs > 1]
    strength = np.ones(len(ids))
    for _ in range(tries):
        case, y = _bare(rng, dofs, samples, "effect" if len(ids) == 1 else "pair")
        p = draws.scheduling(rng, samples) if "position_dependent_stiffness" in ids else None
        effects, alone = [], []
        for k, name in enumerate(ids):
            where = draws.random_place(rng, name, len(case.system.M)) if place is None else place
            x = draws.surroundings(case.system, case.u, y, where)
            effects.append(draws.random_effect(rng, name, where, x, strength[k]))
            alone.append(_hides(case, y, effects[-1:], p))
            if alone[-1] is None:
                strength[k] = max(0.5 * strength[k], 0.1)
                break
        else:
            sizes = np.array([np.sqrt(np.mean((rms(r) / rms(y)) ** 2)) for _, r in alone])
            least, most = np.argmin(sizes), np.argmax(sizes)
            if sizes[most] > 5 * sizes[least]:
                strength[most] = max(0.6 * strength[most], 0.1)
                strength[least] = min(1.5 * strength[least], 8.0)
                continue
            clean, residual = alone[least]
            noise = noise_level(residual, clean, draws.log_uniform(rng, *excess))
            if noise is None:
                strength = np.minimum(2 * strength, 8.0)
                continue
            if max(noise / rms(clean)) > largest_noise:
                strength = np.maximum(0.5 * strength, 0.1)
                continue
            both = (clean, residual) if len(ids) == 1 else _hides(case, y, effects, p)
            if both is None:
                strength = np.maximum(0.5 * strength, 0.1)
                continue
            left = np.sqrt(np.mean(1 + (rms(both[1]) / noise) ** 2))
            case = replace(
                case,
                effects=tuple(effects),
                noise=noise,
                scheduling=p,
                linear_residual=both[1],
                excess=float(left),
            )
            case = _recorded(rng, case)
            if np.all(np.isfinite(case.y_v)):
                return case
    raise TooHard(f"no record with {', '.join(ids)} at dofs {dofs} in {tries} tries")


def _recorded(rng, case):
    """The case with noise on the record whose inputs it has, and a validation record."""
    clean = simulate(case.system, case.u, SAMPLING_TIME, case.effects, hold=case.hold, scheduling=case.scheduling)
    y = spoilt(rng, clean + coloured(rng, len(clean), case.noise, case.colour), case.effects)
    u_v, y_v, clean_v, p_v = fresh(rng, case)
    return replace(case, y=y, clean=clean, u_v=u_v, y_v=y_v, clean_v=clean_v, scheduling_v=p_v)


def null_case(rng, kind, *, dofs=(1, 2, 3), samples=4000):
    """Nothing hidden: `white` or `coloured` output noise, `process` noise at the forces, wrong `initial` state."""
    if kind not in NULLS:
        raise ValueError(f"kind is {kind!r}; give one of {', '.join(NULLS)}")
    case, y = _bare(rng, dofs, samples, kind)
    n = len(case.system.M)
    noise = draws.log_uniform(rng, 0.003, 0.03 if kind == "process" else 0.1) * rms(y) * rng.uniform(0.5, 1.5, n)
    extra, colour = {}, np.ones(1)
    if kind == "coloured":
        radius, angle = rng.uniform(0.3, 0.97), rng.uniform(0.0, np.pi)
        colour = np.array([1.0, -2 * radius * np.cos(angle), radius**2])
        if rng.random() < 0.5:
            colour = np.array([1.0, -rng.uniform(0.3, 0.98)])
    if kind == "process":
        probe = rng.standard_normal((samples, n))
        zero = np.zeros((samples, n))
        reached = rms(simulate(case.system, zero, SAMPLING_TIME, (), force=probe))
        extra = {"force": draws.log_uniform(rng, 0.3, 3.0) * float(np.mean(noise / reached))}
    if kind == "initial":
        speeds = rms(np.gradient(y, SAMPLING_TIME, axis=0))
        extra = {"x0": np.concatenate([rms(y), speeds]) * rng.uniform(0.3, 2.0)}
    return _filled(rng, replace(case, noise=noise, colour=colour, extra=extra))


def raw_case(rng, effect_id, *, dofs=(1, 2, 3), samples=4000):
    """A linear system whose record is spoilt: clipped, quantised, with outliers, dropped samples or another clock."""
    case, y = _bare(rng, dofs, samples, "raw")
    n = len(case.system.M)
    noise = draws.log_uniform(rng, 0.002, 0.03) * rms(y) * rng.uniform(0.7, 1.3, n)
    i = int(rng.integers(n))
    place, size = f"y{i + 1}", float(rms(y)[i])
    if effect_id == "sensor_clipping":
        limit = float(np.quantile(np.abs(y[:, i]), rng.uniform(0.9, 0.985)))
        parameters = {"low": -limit, "high": limit}
    elif effect_id == "sensor_quantization":
        parameters = {"step": draws.log_uniform(rng, 2.0, 10.0) * float(noise[i])}
    elif effect_id == "outliers":
        parameters = {"count": int(rng.integers(4, samples // 100)), "size": max(15 * float(noise[i]), 2 * size)}
    elif effect_id == "dropped_samples":
        place, form = "record", str(rng.choice(["missing", "jump"]))
        if form == "missing":
            parameters = {"count": int(rng.integers(3, samples // 50)), "form": form}
        else:
            at = int(rng.uniform(0.2, 0.8) * samples)
            parameters = {"count": int(rng.integers(2, 9)), "at": at, "form": form}
    elif effect_id == "clock_scale":
        place = "record"
        parameters = {"eps": float(rng.choice([-1.0, 1.0])) * draws.log_uniform(rng, 3e-4, 3e-3)}
    else:
        raise ValueError(f"effect_id is {effect_id!r}; give one of {', '.join(RAW)}")
    for _ in range(20):
        filled = _filled(rng, replace(case, effects=(Effect(effect_id, place, parameters),), noise=noise))
        # The limit is drawn from another run of the system: a record that stays inside it is not clipped.
        if effect_id != "sensor_clipping" or np.sum(np.abs(filled.y[:, i]) >= limit) >= CLIPPED * samples:
            return filled
    raise TooHard(f"no record of {effect_id} reaches its limit")


def _closed_loop(rng, system, samples, noise, *, proportional, derivative, reference, dither):
    """u = P (r − y) − D ẏ + dither, held between samples, from the noisy outputs; linear system from rest."""
    n = len(system.M)
    A, B = independent.state_space(system.M, system.D, system.K, np.eye(n))
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((n, 3 * n))]]) * SAMPLING_TIME)
    Ad, Bd = flow[: 2 * n, : 2 * n], flow[: 2 * n, 2 * n :]
    r = reference * draws.excitation(rng, "steps", samples, np.ones(n))
    push = dither * rng.standard_normal((samples, n))
    push[: draws.QUIET] = 0.0
    e = noise * rng.standard_normal((samples, n))
    u, clean = np.empty((samples, n)), np.empty((samples, n))
    x, before = np.zeros(2 * n), e[0]
    for k in range(samples):
        clean[k] = x[:n]
        y = clean[k] + e[k]
        u[k] = proportional * (r[k] - y) - derivative * (y - before) / SAMPLING_TIME + push[k]
        x, before = Ad @ x + Bd @ u[k], y
    return u, clean, clean + e


def closed_loop_case(rng, *, dofs=(1, 2, 3), samples=4000):
    """A linear system under proportional-derivative feedback of its noisy outputs to steps of a reference."""
    while True:
        case, y = _bare(rng, dofs, samples, "closed_loop")
        n = len(case.system.M)
        noise = draws.log_uniform(rng, 0.005, 0.05) * rms(y) * rng.uniform(0.7, 1.3, n)
        stiffness = np.diag(case.system.K)
        omega = np.sqrt(stiffness / np.diag(case.system.M))
        proportional = rng.uniform(0.2, 1.5) * stiffness
        extra = {
            "proportional": proportional,
            "derivative": rng.uniform(0.05, 0.3) * stiffness / omega,
            "reference": rms(y) * rng.uniform(0.7, 1.5),
            "dither": rng.uniform(0.02, 0.2) * proportional * rms(y),
        }
        filled = _filled(rng, replace(case, hold="zero", excitation="steps", noise=noise, extra=extra))
        if np.all(np.abs(filled.clean) < 20 * rms(y)) and np.all(np.abs(filled.clean_v) < 20 * rms(y)):
            return filled
