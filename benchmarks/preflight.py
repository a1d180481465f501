"""How many bad records `preflight` finds, kind by kind, and how often it speaks up on good ones.

    python benchmarks/preflight.py [--records 60] [--clean 200] [--seed 0] [--kinds clipping hum ...] [--json OUT]

Records come from SciPy's matrix exponential: chains of one to three masses in physical units, input j a force on mass
j, a zero-order hold, noise 40 to 60 dB below each output, dry friction as hard as it comes in two records of five
(a set-valued force, solved in every step). A record with a defect is a clean one that was spoilt in one way. "Found":
a finding of that kind. "False": the share of clean records with a finding of that kind; "others": findings of another
kind on the spoilt records that are wrong there too.
"""

import argparse
import json
import pathlib
import time
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.signal

from jaxgray.records import Record, chirp, multisine, prbs, preflight, random_steps, white

UNITS = (1000.0, 100.0, 10.0, 25.4, 9.80665, 57.29578, 4.448222, 3.6)
"""Factors by which a channel changes when its unit does."""


@dataclass(frozen=True)
class Draw:
    """A clean record and what it came from.

    `M`, `D`, `K`; `friction`: largest dry friction force at every mass; `kind` of the excitation; `measured`; `u`;
    `y` without noise; `noise`: standard deviation per output; `h` [s].
    """

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    friction: np.ndarray
    kind: str
    measured: str
    u: np.ndarray
    y: np.ndarray
    noise: np.ndarray
    h: float

    def noisy(self, rng, y=None):
        y = self.y if y is None else y
        return y + self.noise * rng.standard_normal(y.shape)

    def record(self, rng, u=None, y=None):
        """With noise where `y` is not given."""
        return Record(self.u if u is None else u, self.noisy(rng) if y is None else y, self.h, measured=self.measured)


def chain(rng, dofs, h, fastest):
    """Masses in a row, springs and dampers between them and to the ground; `fastest`: samples in a period of the
    highest mode."""
    M = np.diag(rng.uniform(0.5, 2.0, dofs))
    K, D = np.zeros((dofs, dofs)), np.zeros((dofs, dofs))
    ends = [np.eye(dofs)[0]] + [np.eye(dofs)[-1]] * int(rng.random() < 0.5)
    for b in ends + [np.eye(dofs)[k] - np.eye(dofs)[k - 1] for k in range(1, dofs)]:
        K += rng.uniform(0.5, 2.0) * np.outer(b, b)
        D += rng.uniform(0.2, 2.0) * np.outer(b, b)
    omega, shapes = scipy.linalg.eigh(K, M)
    omega = np.sqrt(omega)
    scale = 2.0 * np.pi / (fastest * h) / omega[-1]
    # The mean damping ratio is drawn; the ratios of the modes follow from where the dampers are.
    ratios = np.einsum("ij,ik,kj->j", shapes, D, shapes) / (2.0 * omega)
    zeta = 10.0 ** rng.uniform(-2.3, -0.7)
    return M, D * zeta / ratios.mean() * scale, K * scale**2


def simulated(M, D, K, friction, u, h, measured, steps=4):
    """From rest, with dry friction, exact between the steps of h / `steps`."""
    n = len(M)
    Mi = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-Mi @ K, -Mi @ D]])
    B = np.vstack([np.zeros((n, n)), Mi])
    rough = np.any(friction > 0.0)
    h_step = h / steps if rough else h
    flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((n, 3 * n))]]) * h_step)
    Ad, Bd = flow[: 2 * n, : 2 * n], flow[: 2 * n, 2 * n :]
    force = np.zeros((len(u), n))
    force[:, : u.shape[1]] = u
    x, states, held = np.zeros(2 * n), np.empty((len(u), 2 * n)), np.empty((len(u), n))
    f = np.zeros(n)
    at = int(np.argmax(friction))
    for k in range(len(u)):
        states[k], held[k] = x, f
        if not rough:
            x = Ad @ x + Bd @ force[k]
            continue
        drive = Bd @ force[k]
        for _ in range(steps):
            free = Ad @ x + drive
            # Friction stops the mass within the step where it can.
            f[at] = min(max(-free[n + at] / Bd[n + at, at], -friction[at]), friction[at])
            x = free + Bd[:, at] * f[at]
    if measured == "displacement":
        return states[:, :n]
    if measured == "velocity":
        return states[:, n:]
    return states @ A[n:].T + (force + held) @ Mi.T


def excitation(rng, kind, n, channels, h, slowest, fastest):
    """An input of the kind; `slowest`, `fastest`: samples in a period of the lowest and the highest mode."""
    top = min(0.45, rng.uniform(1.2, 3.0) / fastest) / h
    if kind == "noise":
        return white(n, channels, h, band_hz=None if rng.random() < 0.5 else (1.0 / (n * h), top), rng=rng)
    if kind == "multisine":
        period = n // int(rng.integers(1, 4))
        return multisine(n, channels, h, band_hz=(2.0 / (period * h), top), period_samples=period, rng=rng).signal
    if kind == "steps":
        return random_steps(n, channels, h, hold_times=(0.5 * fastest * h, 2.0 * slowest * h), rng=rng)
    if kind == "prbs":
        return prbs(n, channels, h, clock_period=h * max(1, int(fastest * rng.uniform(0.1, 0.4))))
    return chirp(n, channels, h, band_hz=(0.2 / (slowest * h), top))


KINDS = ("noise", "multisine", "steps", "prbs", "chirp")


def draw(rng, *, kinds=KINDS, measured=("displacement", "displacement", "velocity", "acceleration"), dofs=(1, 2, 3)):
    """A clean record."""
    n, count = int(rng.integers(2000, 8000)), int(rng.choice(dofs))
    h = 1.0 / 10.0 ** rng.uniform(2.0, 3.3)
    fastest = rng.uniform(4.0, 20.0)
    M, D, K = chain(rng, count, h, fastest)
    omega = np.sqrt(scipy.linalg.eigvalsh(K, M))
    kind, what = str(rng.choice(kinds)), str(rng.choice(measured))
    # Sweeps that lag each other are not told apart.
    inputs = count if kind != "chirp" and rng.random() < 0.6 else 1
    size = 10.0 ** rng.uniform(-1, 3)
    u = size * excitation(rng, kind, n, inputs, h, 2 * np.pi / (omega[0] * h), fastest)
    friction = np.zeros(count)
    if rng.random() < 0.4:
        friction[rng.integers(count)] = rng.uniform(0.1, 0.5) * u.std(axis=0).mean()
    y = simulated(M, D, K, friction, u, h, what)
    noise = y.std(axis=0) * 10.0 ** (-rng.uniform(40.0, 60.0) / 20.0)
    return Draw(M, D, K, friction, kind, what, u, y, noise, h)


# Defects: each gives a record, or None where the record drawn cannot have it


def clipping(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k = rng.integers(y.shape[1])
    share = rng.uniform(0.01, 0.1)
    low, high = np.quantile(y[:, k], [share, 1.0 - share])
    y[:, k] = np.clip(y[:, k], low if rng.random() < 0.6 else -np.inf, high)
    return d.record(rng, y=y)


def quantisation(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k = rng.integers(y.shape[1])
    step = y[:, k].std() * rng.uniform(0.05, 0.5)
    y[:, k] = step * np.rint(y[:, k] / step)
    return d.record(rng, y=y)


def outliers(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k, count = rng.integers(y.shape[1]), int(rng.integers(1, 12))
    places = rng.choice(np.arange(20, len(y) - 20), count, replace=False)
    y[places, k] += np.abs(y[:, k]).max() * rng.uniform(2.0, 10.0, count) * rng.choice([-1.0, 1.0], count)
    return d.record(rng, y=y)


def dropouts(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k, count = rng.integers(y.shape[1]), int(rng.integers(1, 6))
    places = np.arange(40, len(y) - 120, 120)
    # A value that is repeated while nothing moves is none.
    moves = [np.ptp(y[place - 4 : place + 12, k]) > 0.3 * y[:, k].std() for place in places]
    if sum(moves) < count:
        return None
    for place in rng.choice(places[moves], count, replace=False):
        length = int(rng.integers(10, 60))
        y[place : place + length, k] = np.nan if rng.random() < 0.3 else y[place, k]
    return d.record(rng, y=y)


def repeats(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k = rng.integers(y.shape[1])
    moves = np.abs(np.diff(y[:, k]))
    fast = np.flatnonzero(moves > 0.3 * np.sqrt(np.mean(moves**2)))
    fast = fast[(fast > 10) & (fast < len(y) - 10)]
    for place in np.sort(rng.choice(fast, max(40, len(y) // 100), replace=False)):
        y[place + 1, k] = y[place, k]
    return d.record(rng, y=y)


def dead(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k = rng.integers(y.shape[1])
    # A cable that is off: noise and mains alone, or nothing at all.
    form = rng.integers(2)
    noise = rng.standard_normal(len(y)) * 10.0 ** rng.uniform(-4, 0) * y[:, k].std()
    y[:, k] = rng.standard_normal() * y[:, k].std() + (noise if form else 0.0)
    return d.record(rng, y=y)


def swapped(rng):
    """Two outputs exchanged, or an input and the output of its mass."""
    two = rng.random() < 0.5
    while True:
        d = draw(rng, dofs=(2, 3) if two else (1, 2, 3))
        if not two or d.u.shape[1] == d.y.shape[1]:
            break
    u, y = d.u.copy(), d.noisy(rng)
    if two:
        a, b = rng.choice(y.shape[1], 2, replace=False)
        y[:, [a, b]] = y[:, [b, a]]
    else:
        k = rng.integers(u.shape[1])
        u[:, k], y[:, k] = y[:, k].copy(), u[:, k] + 1e-3 * u[:, k].std() * rng.standard_normal(len(u))
    return d.record(rng, u=u, y=y)


STEADY = ("noise", "multisine", "steps", "prbs")
"""Excitations that are the same all over the record: in a sweep, gain over time is gain over frequency."""


def unit(rng):
    d = draw(rng, kinds=STEADY)
    u, y = d.u.copy(), d.noisy(rng)
    at, factor = int(len(y) * rng.uniform(0.15, 0.85)), float(rng.choice(UNITS))
    x = u if rng.random() < 0.25 else y
    k = rng.integers(x.shape[1])
    x[at:, k] *= factor if rng.random() < 0.5 else 1.0 / factor
    return d.record(rng, u=u, y=y)


def sign(rng):
    """The sign of a force, or of its driving point, reversed."""
    d = draw(rng)
    u, y = d.u.copy(), d.noisy(rng)
    k = rng.integers(u.shape[1])
    if rng.random() < 0.5:
        u[:, k] *= -1.0
    else:
        y[:, k] *= -1.0
    return d.record(rng, u=u, y=y)


def shift(rng):
    """Outputs late or early by a twentieth to half a period of the strongest motion, and three samples at least."""
    d = draw(rng)
    y = d.noisy(rng)
    count = max(3, int(rng.uniform(0.05, 0.5) / _strongest(d)))
    if rng.random() < 0.5:
        return d.record(rng, u=d.u[count:], y=y[:-count])
    return d.record(rng, u=d.u[:-count], y=y[count:])


def _strongest(d):
    """Frequency of the strongest motion, in cycles per sample."""
    spectrum = np.sum(np.abs(np.fft.rfft(d.y / d.y.std(axis=0), axis=0)[1:]) ** 2, axis=1)
    return (1 + int(np.argmax(spectrum))) / len(d.y)


def clock(rng):
    """The clock of the outputs runs fast or slow: a tenth of a period of the strongest motion over the record, and two
    samples at least."""
    d = draw(rng, kinds=STEADY)
    n = len(d.y)
    total = max(2.0, rng.uniform(0.1, 0.6) / _strongest(d)) * rng.choice([-1.0, 1.0])
    if total < 0:
        total = max(total, -0.05 * n)
    position = np.arange(n) * (1.0 + total / n)
    inside = position < n - 3
    # Interpolated on a record whose spectrum ends well below half the sampling rate.
    fine = scipy.signal.resample_poly(d.y, 8, 1, axis=0)
    t = np.arange(len(fine)) / 8.0
    y = np.stack([np.interp(position[inside], t, column) for column in fine.T], axis=1)
    return d.record(rng, u=d.u[inside], y=d.noisy(rng, y))


def aliasing(rng):
    """A mode between half the sampling rate and the rate, excited by a force as fast, recorded without a filter."""
    count, factor = int(rng.integers(1, 4)), 12
    n, h = int(rng.integers(2000, 6000)), 1.0 / 10.0 ** rng.uniform(2.0, 3.3)
    fastest = 1.0 / rng.uniform(0.55, 0.95)
    M, D, K = chain(rng, count, h, fastest)
    kind = str(rng.choice(("noise", "multisine")))
    slow = 1.0 / h
    fine = {"noise": white, "multisine": multisine}[kind]
    u = fine(n * factor, 1, h / factor, band_hz=(0.01 * slow, 1.5 * slow), rng=rng)
    u = getattr(u, "signal", u)
    y = simulated(M, D, K, np.zeros(count), u, h / factor, "acceleration")[::factor]
    noise = y.std(axis=0) * 10.0 ** (-rng.uniform(40.0, 60.0) / 20.0)
    return Record(u[::factor], y + noise * rng.standard_normal(y.shape), h, measured="acceleration")


def hum(rng):
    d = draw(rng)
    y = d.noisy(rng)
    k, frequency = rng.integers(y.shape[1]), float(rng.choice([50.0, 60.0])) * (1.0 + 1e-4 * rng.standard_normal())
    t = d.h * np.arange(len(y))
    folded = np.abs(frequency - np.rint(frequency * d.h) / d.h)
    if folded * len(y) * d.h < 10.0:
        return None
    size = max(5.0 * d.noise[k], y[:, k].std() * rng.uniform(0.01, 0.2))
    y[:, k] += size * np.sin(2.0 * np.pi * frequency * t + rng.uniform(0.0, 6.28))
    return d.record(rng, y=y)


def little(rng):
    """A single sine, two inputs that move together, or an input that hardly moves the outputs."""
    d = draw(rng)
    form = rng.integers(3)
    n, count = len(d.u), len(d.M)
    if form == 0:
        period = int(rng.uniform(5.0, 100.0))
        u = np.sin(2.0 * np.pi * np.arange(n) / period)[:, None] * np.ones((1, d.u.shape[1]))
        u[:, 1:] = np.cos(2.0 * np.pi * np.arange(n) / period)[:, None]
        y = simulated(d.M, d.D, d.K, d.friction * 0.0, u, d.h, d.measured)
        # What was before the record is not in it.
        start = n // 2
        noise = y[start:].std(axis=0) * 10.0 ** (-rng.uniform(40.0, 60.0) / 20.0)
        return Record(u[start:], y[start:] + noise * rng.standard_normal(y[start:].shape), d.h, measured=d.measured)
    if form == 1:
        if count < 2:
            return None
        u = np.repeat(d.u[:, :1], count, axis=1) * rng.uniform(0.5, 2.0, count)
        u += 3e-4 * u.std(axis=0) * rng.standard_normal(u.shape)
        y = simulated(d.M, d.D, d.K, 0.0 * d.friction, u, d.h, d.measured)
        return replace(d, u=u, y=y, noise=y.std(axis=0) * 0.003).record(rng)
    loud = replace(d, noise=d.y.std(axis=0) * rng.uniform(2.0, 5.0))
    return loud.record(rng)


def closed_loop(rng):
    """u = P (r − y) − D ẏ from the noisy outputs, r steps or a multisine; a force nobody recorded moves the plant."""
    while True:
        d = draw(rng, measured=("displacement",))
        n, count, h = len(d.u), len(d.M), d.h
        A = np.block(
            [[np.zeros((count, count)), np.eye(count)], [-np.linalg.solve(d.M, d.K), -np.linalg.solve(d.M, d.D)]]
        )
        B = np.vstack([np.zeros((count, count)), np.linalg.inv(d.M)])
        flow = scipy.linalg.expm(np.block([[A, B], [np.zeros((count, 3 * count))]]) * h)
        Ad, Bd = flow[: 2 * count, : 2 * count], flow[: 2 * count, 2 * count :]
        stiffness = np.diag(d.K)
        omega = np.sqrt(stiffness / np.diag(d.M))
        P, V = rng.uniform(0.2, 1.5) * stiffness, rng.uniform(0.05, 0.3) * stiffness / omega
        C, gain = np.eye(count, 2 * count), np.diag(V / h)
        loop = np.block([[Ad - Bd @ (np.diag(P) + gain) @ C, Bd @ gain], [C, np.zeros((count, count))]])
        if np.max(np.abs(np.linalg.eigvals(loop))) > np.max(np.abs(np.linalg.eigvals(Ad))):
            continue
        size = d.y.std(axis=0).mean()
        kind = str(rng.choice(("steps", "multisine")))
        slowest, fastest = 2 * np.pi / (omega.min() * h), 2 * np.pi / (omega.max() * h)
        r = size * excitation(rng, kind, n, count, h, slowest, fastest)
        w = rng.uniform(0.03, 0.2) * size * stiffness * rng.standard_normal((n, count))
        e = size * 10.0 ** (-rng.uniform(40.0, 60.0) / 20.0) * rng.standard_normal((n, count))
        u, y, x, before = np.empty((n, count)), np.empty((n, count)), np.zeros(2 * count), e[0]
        for k in range(n):
            y[k] = x[:count] + e[k]
            u[k] = P * (r[k] - y[k]) - V * (y[k] - before) / h
            before, x = y[k], Ad @ x + Bd @ (u[k] + w[k])
        return Record(u, y, h)


@dataclass(frozen=True)
class Kind:
    """A way to spoil a record, the ids of the findings that say so, and those that are true as well."""

    spoil: object
    found: tuple[str, ...]
    also: tuple[str, ...] = ()


TABLE = {
    "clipping": Kind(clipping, ("sensor_clipping",)),
    "quantisation": Kind(quantisation, ("sensor_quantization",)),
    "outliers": Kind(outliers, ("outliers",)),
    "dropouts": Kind(dropouts, ("dropped_samples",)),
    "repeats": Kind(repeats, ("dropped_samples",)),
    "clock drift": Kind(clock, ("clock_drift",)),
    "dead channel": Kind(dead, ("dead_channel",)),
    "swapped channels": Kind(swapped, ("swapped_channels",)),
    "change of unit": Kind(unit, ("unit_change",)),
    "sign error": Kind(sign, ("sign_error",)),
    "time shift": Kind(shift, ("time_shift",)),
    "aliasing": Kind(aliasing, ("aliasing",)),
    "mains hum": Kind(hum, ("mains_hum",)),
    "little excitation": Kind(little, ("little_excitation",)),
    "closed loop": Kind(closed_loop, ("closed_loop",)),
}


def clean(rng):
    return draw(rng).record(rng)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=60, help="of every kind")
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=list(TABLE), choices=list(TABLE))
    parser.add_argument("--verbose", action="store_true", help="name every record that is missed or false")
    parser.add_argument("--json")
    arguments = parser.parse_args()

    false, spent = Counter(), []
    for k in range(arguments.clean):
        record = clean(np.random.default_rng([arguments.seed, 0, k]))
        start = time.perf_counter()
        findings = preflight(record)
        spent.append(time.perf_counter() - start)
        false.update({finding.effect for finding in findings})
        if arguments.verbose and findings:
            print(f"clean {k}: " + " | ".join(f"{f.effect} at {f.location}: {f.message}" for f in findings))
    print(
        f"{arguments.clean} clean records, seed {arguments.seed}, {1e3 * np.median(spent):.0f} ms each: {dict(false)}"
    )
    print(f"{'kind':20s}{'found':>12s}{'false on clean':>16s}   other findings on these records")
    rows = {}
    for place, (name, kind) in enumerate(TABLE.items(), 1):
        if name not in arguments.kinds:
            continue
        found, count, others, k = 0, 0, Counter(), 0
        while count < arguments.records:
            rng = np.random.default_rng([arguments.seed, place, k])
            record, k = kind.spoil(rng), k + 1
            if record is None:
                continue
            count += 1
            findings = preflight(record)
            effects = {finding.effect for finding in findings}
            found += bool(effects & set(kind.found))
            others.update(effects - set(kind.found) - set(kind.also))
            if arguments.verbose and not effects & set(kind.found):
                print(f"{name} {k - 1}: missed; {sorted(effects)}")
        wrong = sum(false[effect] for effect in kind.found)
        rows[name] = {"found": found, "of": count, "false": wrong, "clean": arguments.clean, "others": dict(others)}
        said = ", ".join(f"{effect} {n}" for effect, n in others.most_common())
        print(f"{name:20s}{found:5d} of {count:3d}{wrong:9d} of {arguments.clean:3d}   {said}", flush=True)
    if arguments.json:
        result = {"seed": arguments.seed, "clean": dict(false), "kinds": rows, "milliseconds": 1e3 * np.median(spent)}
        pathlib.Path(arguments.json).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
