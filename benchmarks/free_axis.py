"""An axis that nothing holds, in a control loop: its encoder counts from anywhere, and nothing dies away.

    python benchmarks/free_axis.py [--first 1] [--records 45]

One law in all but every sixth record, which have none (tests/servo_axis.py); every other encoder has its zero where the
axis stands at 0. Seeds 1 to 35 served development.
"""

import argparse
import pathlib
import sys
import warnings

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import servo_axis  # noqa: E402

import jaxgray  # noqa: E402

LAWS = {
    "none": (),
    "coulomb_friction": (0.01, 0.04),
    "quadratic_drag": (0.05, 0.2),
    "input_delay": (1, 120),
    "input_saturation": (0.4, 0.9),
    "constant_force": (0.004, 0.02),
}
"""Least and largest size: torques in N m, the delay in short steps, the saturation in shares of the largest torque."""


def drawn(seed, name):
    """A record with a law, its size, and how the axis is."""
    rng = np.random.default_rng([seed, 77])
    zero, damping = float(rng.choice([0.0, rng.uniform(-6, 6)])), float(rng.choice([0.0, 0.1, 0.4]))
    size = float(np.exp(rng.uniform(*np.log(LAWS[name])))) if LAWS[name] else 0.0
    how = {"zero": zero, "damping": damping}
    if name == "input_delay":
        return servo_axis.axis(seed, late=int(size), **how), size, how
    if name == "input_saturation":
        most = float(np.max(np.abs(servo_axis.axis(seed, **how).u)))
        return servo_axis.axis(seed, limit=size * most, **how), size, how
    laws = {
        "coulomb_friction": servo_axis.friction(size),
        "quadratic_drag": lambda q, v: size * v * abs(v),
        "constant_force": lambda q, v: size,
    }
    return servo_axis.axis(seed, law=laws.get(name), **how), size, how


def judged(seed, name):
    """Whether the law is in the only class of a diagnosis, alone there, and the noise floor over the noise."""
    record, size, how = drawn(seed, name)
    found = jaxgray.diagnose(record)
    laws = [{m.effect for m in one.members} | {one.effect} for one in found.findings if one.stage == "model"]
    alone = found.verdict == "noise" if name == "none" else laws == [{name}]
    right = alone or (len(laws) == 1 and name in laws[0] and "unexplained" not in laws[0])
    floor = float(np.max(list(found.noise_floor.values()))) / servo_axis.NOISE
    print(seed, name, f"{size:.3g}", how, found.verdict, *map(sorted, laws), f"floor {floor:.2f}", flush=True)
    return right, alone, floor


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--records", type=int, default=45)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    names = list(LAWS)
    seeds = range(asked.first, asked.first + asked.records)
    rows = np.array([judged(seed, names[seed % len(names)]) for seed in seeds], dtype=float)
    quiet = np.array([names[seed % len(names)] == "none" for seed in seeds])
    for kind, some in (("with a law", rows[~quiet]), ("without", rows[quiet])):
        if len(some):
            print(f"{kind}: {some[:, 0].sum():.0f} of {len(some)} in class, {some[:, 1].sum():.0f} alone", end="; ")
            near = np.sum(np.abs(some[:, 2] - 1) < 0.2)
            print(f"noise floor within 20 % in {near}, at most {some[:, 2].max():.1f} times the noise")


if __name__ == "__main__":
    main()
