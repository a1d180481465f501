"""Effects so strong that the free run of the linear model fails: stiffening springs, backlash, cogging, pendulums that
turn over, and the hold of two inputs told wrongly. What is said of each, and how far its values are from the truth.

Every record is integrated by SciPy (LSODA, relative tolerance 1e-8), sample by sample with the input as it is held.

    python benchmarks/strong_effects.py --seed 1 --repeats 2
"""

import argparse
import time
import warnings

import jax
import numpy as np
import scipy.integrate
import scipy.signal

import jaxgray

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore")


def _rate(t, x, rates, start, change):
    return rates(x, start + change * t)


def integrated(rates, states, u, h, hold):
    """States at the samples, from rest; `rates(x, u)`; `hold`: "zero" or "linear"."""
    x, found = np.zeros(states), np.empty((len(u), states))
    ends = np.concatenate([u[1:], u[-1:]]) if hold == "linear" else u
    for k, (start, end) in enumerate(zip(u, ends)):
        found[k] = x
        change = (end - start) / h
        run = scipy.integrate.solve_ivp(
            _rate, (0.0, h), x, method="LSODA", rtol=1e-8, atol=1e-12, args=(rates, start, change)
        )
        x = run.y[:, -1]
    return found


def steps(rng, samples, size, each, inputs=1):
    """Random steps, uniform within ± `size`, each held for so many samples."""
    return np.repeat(rng.uniform(-size, size, (samples // each + 1, inputs)), each, axis=0)[:samples]


def duffing(rng):
    h, t = 1 / 4096, np.arange(4000) / 4096
    lines = np.sin(2 * np.pi * np.linspace(10, 250, 40) * t[:, None] + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1)
    u = (8.0 * lines / lines.std())[:, None]
    x = integrated(lambda x, u: [x[1], (u[0] - 4 * x[1] - 6e4 * x[0] - 2e10 * x[0] ** 3) / 0.3], 2, u, h, "linear")
    return u, x[:, :1] + 0.01 * x[:, 0].std() * rng.standard_normal((len(u), 1)), h, "linear"


def light(rng):
    u = steps(rng, 3000, 20.0, 25)
    x = integrated(lambda x, u: [x[1], u[0] - 0.2 * x[1] - 100 * x[0] - 200 * x[0] ** 3], 2, u, 0.02, "zero")
    return u, x[:, :1] + 0.002 * x[:, 0].std() * rng.standard_normal((len(u), 1)), 0.02, "zero"


def cogging(rng):
    u = steps(rng, 4000, 25.0, 100)
    x = integrated(
        lambda x, u: [x[1], (u[0] - 40 * x[1] - 6 * np.sin(2 * np.pi * x[0] / 0.024)) / 5], 2, u, 0.002, "zero"
    )
    return u, x[:, :1] + 5e-6 * rng.standard_normal((len(u), 1)), 0.002, "zero"


def pendulum(rng):
    u = steps(rng, 3000, 0.9, 60)
    x = integrated(lambda x, u: [x[1], (u[0] - 0.03 * x[1] - np.sin(x[0])) / 0.1], 2, u, 0.01, "zero")
    return u, x[:, :1] + 2e-3 * rng.standard_normal((len(u), 1)), 0.01, "zero"


def backlash(rng):
    u = steps(rng, 3000, 2.0, 25)

    def rates(x, u):
        way = x[0] - x[1]
        force = 60 * (way - np.clip(way, -0.02, 0.02)) + 0.05 * (x[2] - x[3])
        return [x[2], x[3], (u[0] - 0.05 * x[2] - force) / 0.02, (force - 0.08 * x[3]) / 0.05]

    x = integrated(rates, 4, u, 0.005, "zero")
    return u, x[:, :2] + 2e-4 * rng.standard_normal((len(u), 2)), 0.005, "zero"


def wrong_hold(rng):
    sections = scipy.signal.butter(4, 8.0, fs=100.0, output="sos")
    u = scipy.signal.sosfilt(sections, rng.standard_normal((5000, 2)), axis=0)[2000:]
    u = u / u.std(axis=0)
    K = np.array([[300.0, -100.0], [-100.0, 200.0]])

    def rates(x, u):
        return [x[2], x[3], *((u - np.array([3.0, 1.0]) * x[2:] - K @ x[:2]) / np.array([2.0, 1.0]))]

    x = integrated(rates, 4, u, 0.01, "linear")
    # Told as held at zero order, which it is not.
    return u, x[:, :2] + 2e-5 * rng.standard_normal((len(u), 2)), 0.01, "zero"


RECORDS = {
    "Duffing beam": (duffing, {("cubic_stiffness", "y1"): {"k3": 2e10}}),
    "light cubic spring": (light, {("cubic_stiffness", "y1"): {"k3": 200.0}}),
    "cogging": (cogging, {("sine_stiffness", "y1"): {"k": 6 * 2 * np.pi / 0.024, "length": 0.024 / (2 * np.pi)}}),
    "pendulum": (pendulum, {("sine_stiffness", "y1"): {"k": 1.0, "length": 1.0}}),
    "backlash": (backlash, {("dead_zone_stiffness", "y1-y2"): {"k": 60.0, "gap": 0.02}}),
    "hold of two inputs": (wrong_hold, {("intersample_hold", u): {"linear_share": 1.0} for u in ("u1", "u2")}),
}
"""How each record is made, and what is hidden in it."""


def record(make, seed):
    u, y, h, hold = make(np.random.default_rng(seed))
    return jaxgray.Record(u, y, h, hold=hold)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--only", help="names of records, joined by commas")
    arguments = parser.parse_args()
    wanted = arguments.only.split(",") if arguments.only else list(RECORDS)
    right = total = 0
    for name in wanted:
        make, hidden = RECORDS[name]
        for k in range(arguments.repeats):
            records = [record(make, [arguments.seed, k, part]) for part in (0, 1)]
            begun = time.perf_counter()
            diagnosis = jaxgray.diagnose(records[0], validation=records[1])
            seconds = time.perf_counter() - begun
            found = {(f.effect, f.location): f for f in diagnosis.findings if f.stage == "model"}
            total, right = total + 1, right + (set(found) == set(hidden))
            fit = 0.0 if diagnosis.identification is None else diagnosis.identification.estimation[0].fit_percent.min()
            said = []
            for key, finding in found.items():
                text = f"{key[0]}@{key[1]}" + ("|" if finding.status == "equivalent" else "")
                for symbol, true in hidden.get(key, {}).items():
                    one = finding.parameters[symbol]
                    error = one.standard_error or np.nan
                    text += f" {symbol} {one.value:.5g} ± {error:.2g} ({(one.value - true) / error:+.1f} se)"
                said.append(text)
            gain = "" if diagnosis.gain is None else f"gain {diagnosis.gain.percent:.0f} %"
            print(
                f"{name:20} fit {fit:6.1f} %  {diagnosis.verdict:11} {'; '.join(said)} {gain}  {seconds:.0f} s",
                flush=True,
            )
    print(f"{right} of {total} records: what is hidden is said, and nothing else")


if __name__ == "__main__":
    main()
