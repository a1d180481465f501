"""Simulation of a mechanical system with hidden effects, independent of the package.

Runge-Kutta of order four on fine steps; true (set-valued) friction with sticking, stops and reversals located inside
the step; inputs follow their hold exactly; delays and lags are exact in continuous time.
"""

from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import hidden_laws as laws
import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class System:
    """M q̈ + D q̇ + K q = E u with q measured; `E` by default the identity (input j acts on coordinate j)."""

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    E: np.ndarray | None = None

    def map(self, inputs):
        """E for this number of inputs."""
        return np.eye(len(self.M), inputs) if self.E is None else np.asarray(self.E, dtype=float)


def product(X, x):
    """X x, written so that a whole step compiles into one loop body."""
    return (X * x[None, :]).sum(axis=1)


def parabola(three, c):
    """Value at fraction c of the parabola through start, middle and end."""
    return three[0] * (1 - c) * (1 - 2 * c) + three[1] * 4 * c * (1 - c) + three[2] * c * (2 * c - 1)


def small_solve(W, r):
    """W⁻¹ r without a library call for one and two unknowns."""
    if len(r) == 1:
        return r / W[0, 0]
    if len(r) == 2:
        determinant = W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]
        return jnp.stack([W[1, 1] * r[0] - W[0, 1] * r[1], W[0, 0] * r[1] - W[1, 0] * r[0]]) / determinant
    return jnp.linalg.solve(W, r)


@partial(jax.jit, static_argnames=("kinds", "inputs_at"))
def integrate(kinds, inputs_at, M, forces, follow, E, parameters, arms, duration, dt, t, drive, scheduling, s0):
    """(q, q̇, z) at the start of every step.

    `kinds`: id and form of every effect that acts in the equation of motion; `inputs_at`: input each of them acts
    with, or −1; `parameters`, `arms`: one each; `drive` (steps, 3, inputs) and `scheduling` (steps, 3) at the start,
    middle and end of every step.
    """
    n = len(M)
    inverse = jnp.linalg.inv(M)
    linear_states = len(follow)
    counts = [
        len(p["d"]) if kind == "maxwell_slip_hysteresis" else int(kind in laws.RATES)
        for (kind, _), p in zip(kinds, parameters)
    ]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(int) + 2 * n + linear_states
    where = [slice(int(a), int(a + c)) for a, c in zip(starts, counts)]
    rubbing = [k for k, (kind, _) in enumerate(kinds) if kind in laws.FRICTION]
    B = jnp.stack([arms[k] for k in rubbing], axis=1) if rubbing else jnp.zeros((n, 0))

    def sees(k, s, before, step, c):
        q, z = (arms[k] * s[:n]).sum(), s[where[k]]
        return SimpleNamespace(
            q=q,
            v=(arms[k] * s[n : 2 * n]).sum(),
            z=before[where[k]] if kinds[k][0] == "maxwell_slip_hysteresis" else z,
            q_before=(arms[k] * before[:n]).sum(),
            t=step.t + c * step.dt,
            middle=step.t + 0.5 * step.dt,
            p=parabola(step.scheduling, c),
            u=parabola(step.drive[:, inputs_at[k]], c) if inputs_at[k] >= 0 else 0.0,
            form=kinds[k][1],
            duration=duration,
        )

    def levels(s, step, c):
        q, v = product(B.T, s[:n]), product(B.T, s[n : 2 * n])
        at = [sees(k, s, s, step, c).u for k in rubbing]
        return jnp.stack(
            [laws.FRICTION[kinds[k][0]](parameters[k], q[j], jnp.abs(v[j]), at[j]) for j, k in enumerate(rubbing)]
        )

    def rate(s, before, step, c, mode):
        """ṡ and the friction that would hold the places in question still."""
        r = product(E, parabola(step.drive, c)) - product(forces, s[: 2 * n + linear_states])
        slopes = [product(follow, s[: 2 * n + linear_states])]
        for k, (kind, _) in enumerate(kinds):
            here = sees(k, s, before, step, c)
            if kind in laws.FORCES:
                r = r - arms[k] * laws.FORCES[kind](parameters[k], here)
            if counts[k]:
                slopes.append(laws.RATES[kind](parameters[k], here) if kind in laws.RATES else jnp.zeros(counts[k]))
        holding = jnp.zeros(0)
        if rubbing:
            r = r - product(B, mode * levels(s, step, c))
            still = mode == 0
            W = jnp.where(jnp.outer(still, still), B.T @ step.inverse @ B, jnp.diag(1.0 - still))
            holding = small_solve(W, jnp.where(still, product(B.T, product(step.inverse, r)), 0.0))
            r = r - product(B, holding)
        return jnp.concatenate([s[n : 2 * n], product(step.inverse, r), *slopes]), holding

    def piece(s, step, c0, c1, mode):
        """Runge-Kutta from fraction c0 to c1 of the step, the friction being in one mode."""
        h, middle = (c1 - c0) * step.dt, 0.5 * (c0 + c1)
        k1 = rate(s, s, step, c0, mode)[0]
        k2 = rate(s + h / 2 * k1, s, step, middle, mode)[0]
        k3 = rate(s + h / 2 * k2, s, step, middle, mode)[0]
        k4 = rate(s + h * k3, s, step, c1, mode)[0]
        after = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        for k, (kind, _) in enumerate(kinds):
            if kind == "maxwell_slip_hysteresis":
                moved = (arms[k] * (after[:n] - s[:n])).sum()
                d = parameters[k]["d"]
                after = after.at[where[k]].set(jnp.clip(s[where[k]] + moved, -d, d))
        return after, k1

    def let_go(s, step, c, mode):
        """Mode of the places at rest: still where the friction can hold them, else sliding the way they are pushed.

        Also how much of the friction is to spare there, negative where it gave way.
        """
        holding = rate(s, s, step, c, mode)[1]
        spare = levels(s, step, c) - jnp.abs(holding)
        return jnp.where((mode == 0) & (spare < 0), jnp.sign(holding), mode), spare, holding

    def at_rest(s, step, stop):
        """The state with the places in `stop` brought to rest by an impulse there."""
        W = jnp.where(jnp.outer(stop, stop), B.T @ step.inverse @ B, jnp.diag(1.0 - stop))
        impulse = small_solve(W, jnp.where(stop, product(B.T, s[n : 2 * n]), 0.0))
        return s.at[n : 2 * n].add(-product(step.inverse, product(B, impulse)))

    def crossing(w0, a0, w1, a1, h):
        """Fraction at which the cubic through values and slopes at both ends vanishes (they differ in sign)."""
        c = jnp.clip(w0 / jnp.where(w0 == w1, 1.0, w0 - w1), 0.0, 1.0)
        for _ in range(4):
            value = w0 * (1 + 2 * c) * (1 - c) ** 2 + h * a0 * c * (1 - c) ** 2
            value = value + w1 * c**2 * (3 - 2 * c) + h * a1 * c**2 * (c - 1)
            slope = (w1 - w0) * 6 * c * (1 - c) + h * a0 * (1 - c) * (1 - 3 * c) + h * a1 * c * (3 * c - 2)
            c = jnp.clip(c - value / jnp.where(slope == 0, 1.0, slope), 0.0, 1.0)
        return c

    def rub(s, step, mode):
        mode, spare0, _ = let_go(s, step, 0.0, mode)
        full, k1 = piece(s, step, 0.0, 1.0, mode)
        w0, w1 = product(B.T, s[n : 2 * n]), product(B.T, full[n : 2 * n])
        a0, a1 = (product(B.T, x[n : 2 * n]) for x in (k1, rate(full, full, step, 1.0, mode)[0]))
        c = jnp.where(w1 * mode < 0, crossing(w0, a0, w1, a1, step.dt), 1.0)
        _, spare1, _ = let_go(full, step, 1.0, mode)
        yields = (mode == 0) & (spare1 < 0)
        c = jnp.where(yields, jnp.clip(spare0 / jnp.where(yields, spare0 - spare1, 1.0), 0.0, 1.0), c)
        first = c.min()

        def again(_):
            there, _ = piece(s, step, 0.0, first, mode)
            freed = yields & (c <= first)
            ended = ((c <= first) | (mode == 0)) & ~freed
            there = at_rest(there, step, ended | freed)
            sliding, _, holding = let_go(there, step, first, jnp.where(ended | freed, 0.0, mode))
            sliding = jnp.where(freed, jnp.sign(holding), sliding)
            end, _ = piece(there, step, first, 1.0, sliding)
            back = product(B.T, end[n : 2 * n]) * sliding < 0
            sliding = jnp.where(back, 0.0, sliding)
            return at_rest(end, step, sliding == 0), sliding

        return jax.lax.cond(first < 1.0, again, lambda _: (at_rest(full, step, mode == 0), mode), None)

    def advance(carry, xs):
        s, mode = carry
        step = SimpleNamespace(dt=xs[0], t=xs[1], drive=xs[2], scheduling=xs[3], inverse=inverse)
        for k, (kind, _) in enumerate(kinds):
            if kind == "mass_step":
                dm = parameters[k]["dm"] * (step.t + 0.5 * step.dt >= parameters[k]["t0"])
                pull = product(step.inverse, arms[k])
                step.inverse = step.inverse - dm * jnp.outer(pull, pull) / (1 + dm * (arms[k] * pull).sum())
        after = rub(s, step, mode) if rubbing else (piece(s, step, 0.0, 1.0, mode)[0], mode)
        return after, s[: 2 * n]

    mode = jnp.sign(product(B.T, s0[n : 2 * n]))
    return jax.lax.scan(advance, (s0, mode), (dt, t, drive, scheduling))[1]


def steps_of(sampling_time, breaks, count):
    """Lengths of `count` steps that fill a sample, with ends at the breaks (fractions of a sample)."""
    edges = np.unique(np.concatenate([[0.0, 1.0], [b % 1.0 for b in breaks]]))
    edges = edges[np.concatenate([[True], np.diff(edges) > 1e-9])]
    edges[-1] = 1.0
    widths = np.diff(edges)
    share = np.ones(len(widths), dtype=int)
    while share.sum() < count:
        share[np.argmax(widths / share)] += 1
    return np.concatenate([np.full(k, w / k) for w, k in zip(widths, share)]) * sampling_time


def between(time, grid, value, slope):
    """Cubic through values and slopes at the grid."""
    k = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, len(grid) - 2)
    h = grid[k + 1] - grid[k]
    c = (time - grid[k]) / h
    return (
        value[k] * (1 + 2 * c) * (1 - c) ** 2
        + h * slope[k] * c * (1 - c) ** 2
        + value[k + 1] * c**2 * (3 - 2 * c)
        + h * slope[k + 1] * c**2 * (c - 1)
    )


def simulate(system, u, sampling_time, effects, *, hold="zero", scheduling=None, x0=None, force=None, substeps=None):
    """Outputs (displacements) at the samples, without noise; arguments as of `motion`."""
    q, v, t, substeps = motion(
        system, u, sampling_time, effects, hold=hold, scheduling=scheduling, x0=x0, force=force, substeps=substeps
    )
    return sampled(q, v, t, substeps, np.asarray(u, dtype=float), np.arange(len(u)) * sampling_time, effects)


def motion(system, u, sampling_time, effects, *, hold="zero", scheduling=None, x0=None, force=None, substeps=None):
    """Displacements and velocities at every step, the times of the steps, and how many of them go to a sample.

    `effects`: any number of `Effect`; `scheduling`: one value a sample, straight lines between; `x0`: (q, q̇) at the
    start; `force` (samples, coordinates): forces added to E u, held over each sample; before the record every
    input has the value of its first sample; `substeps` per sample, by default 16, or 64 with friction at two places
    (where two events may fall into one step).
    """
    u = np.asarray(u, dtype=float)
    if substeps is None:
        substeps = 16 if sum(e.id in laws.FRICTION for e in effects) < 2 else 64
    unknown = {e.id for e in effects} - laws.KNOWN
    if unknown:
        raise ValueError(f"no law for {sorted(unknown)}")
    samples, m = u.shape
    observed = len(system.M)
    names = {(e.id, e.place): e.parameters for e in effects}
    fastest = max([e.parameters["eps"] for e in effects if e.id == "clock_scale"], default=0.0)
    length = samples + 1 + max(0, int(np.ceil(fastest * samples)))

    delays = [names.get(("input_delay", f"u{j + 1}"), {"tau": 0.0})["tau"] for j in range(m)]
    breaks = [d / sampling_time for d in delays]
    breaks += [e.parameters["t0"] / sampling_time for e in effects if "t0" in e.parameters]
    widths = steps_of(sampling_time, breaks, substeps)
    dt = np.tile(widths, length)
    t = (np.arange(length)[:, None] * sampling_time + np.concatenate([[0.0], np.cumsum(widths[:-1])])).ravel()
    three = t[:, None] + dt[:, None] * np.array([0.0, 0.5, 1.0])
    middle = three[:, 1:2]

    drive = np.empty((len(t), 3, m))
    for j in range(m):
        linear = (hold == "linear") != (("intersample_hold", f"u{j + 1}") in names)
        drive[:, :, j] = laws.held(u[:, j], three, middle, sampling_time, linear, delays[j])
    for e in effects:
        if e.id in laws.INPUTS:
            j = laws.index(e.place)
            drive[:, :, j] = laws.INPUTS[e.id](e.parameters, drive[:, :, j], dt)
    E = system.map(m)
    if force is not None:
        E = np.hstack([E, np.eye(observed)])
        pushed = [laws.held(w, three, middle, sampling_time, False, 0.0) for w in np.asarray(force).T]
        drive = np.concatenate([drive, np.stack(pushed, axis=2)], axis=2)
    p = np.zeros(samples) if scheduling is None else np.asarray(scheduling, dtype=float)
    p = laws.held(p, three, middle, sampling_time, True, 0.0)

    M, forces, follow, E = laws.linear_parts(
        effects, system.M, system.D, system.K, E, sampling_time / substeps, samples * sampling_time
    )
    moving = [e for e in effects if e.id in laws.FORCES or e.id in laws.FRICTION or e.id == "mass_step"]
    inputs_at = tuple(laws.index(e.place) if e.id in laws.AT_INPUTS else -1 for e in moving)
    arms = [
        E[:, j] if j >= 0 else np.pad(laws.arm(e.place, observed), (0, len(M) - observed))
        for e, j in zip(moving, inputs_at)
    ]
    parameters = [{k: jnp.asarray(v, dtype=float) for k, v in e.parameters.items() if k != "form"} for e in moving]
    states = 2 * len(M) + len(follow) + sum(laws.states(e) for e in moving)
    s0 = np.zeros(states)
    if x0 is not None:
        s0[:observed] = x0[:observed]
        s0[len(M) : len(M) + observed] = x0[observed:]
    kinds = tuple((e.id, e.parameters.get("form", "")) for e in moving)
    path = integrate(
        kinds, inputs_at, M, forces, follow, E, parameters, arms, samples * sampling_time, dt, t, drive, p, s0
    )
    path = np.asarray(path)
    return path[:, :observed], path[:, len(M) : len(M) + observed], t, substeps


def sampled(q, v, grid, substeps, u, time, effects):
    """What the sensors make of the motion: lags, delays and the clock first, then what acts on single samples."""
    samples, dofs = len(u), q.shape[1]
    dt = np.diff(grid)
    y = np.empty((samples, dofs))
    for i in range(dofs):
        value, slope, late, clock = q[:, i], v[:, i], 0.0, 1.0
        for e in effects:
            if e.place not in (f"y{i + 1}", "record"):
                continue
            if e.id == "clock_scale":
                clock += e.parameters["eps"]
            if e.id == "sensor_delay":
                late += e.parameters["tau"]
            if e.id == "sensor_lag":
                centre = between(0.5 * (grid[1:] + grid[:-1]), grid, value, slope)
                tau = e.parameters["tau"]
                follow = laws.lag(np.stack([value[:-1], centre, value[1:]], axis=1), dt, tau, value[0])
                follow = np.append(follow[:, 0], follow[-1, 2])
                value, slope = follow, (value - follow) / tau
        if late == 0.0 and clock == 1.0:
            y[:, i] = value[::substeps][:samples]
        else:
            y[:, i] = between(np.maximum(time * clock - late, 0.0), grid, value, slope)
    clean = y.copy()
    for e in effects:
        if e.id not in laws.OUTPUTS:
            continue
        source = np.zeros(samples)
        target = e.place
        if "->" in e.place:
            name, target = e.place.split("->")
            source = (clean if name[0] == "y" else u)[:, laws.index(name)]
        i = laws.index(target)
        y[:, i] = laws.OUTPUTS[e.id](e.parameters, y[:, i], source, time)
    return y
