"""A drive with dry friction at the motor and backlash in the coupling, both found from one record.

    python examples/drive.py [--samples 2000] [--seed 1] [--gallery FILE]

A motor turns a load through a shaft whose coupling has play: within ± the gap it passes no torque. The bearings of
the motor rub. Encoders see both angles. A linear model blames the friction on the damping and the backlash on the
shaft. The record comes from small steps written out here: in each, dry friction takes what speed is left, and no
more. To be quick, the diagnosis weighs the laws that drives have; without `only` it weighs all.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import jaxgray
from jaxgray.manual.gallery import keep

jax.config.update("jax_enable_x64", True)

INERTIA = np.diag([0.02, 0.03])
"""Of motor and load [kg m²]."""

SHAFT, LOSS = 60.0, 0.04
"""Stiffness [N m/rad] and damping [N m s/rad] between the two."""

BEARINGS = np.diag([0.05, 0.06])
HOLDING = np.diag([0.0, 20.0])
"""A spring that brings the load back [N m/rad]."""

FRICTION = 0.25
"""Of the motor [N m]."""

GAP = 0.012
"""Half of the play [rad]."""

SAMPLING_TIME, FINE = 0.002, 40
NOISE = 2e-4


LAWS = (
    "coulomb_friction",
    "stribeck_friction",
    "quadratic_drag",
    "dead_zone_stiffness",
    "cubic_stiffness",
    "bilinear_stiffness",
    "end_stop",
    "input_delay",
)


def simulated(rng, samples):
    """A record of both angles under steps of torque at both ends, in small semi-implicit steps."""
    u = np.empty((samples, 2))
    for column, size in zip(u.T, (3.0, 2.0)):
        k = 0
        while k < samples:
            length = int(rng.uniform(0.03, 0.2) / SAMPLING_TIME)
            column[k : k + length] = size * rng.uniform(-1, 1)
            k += length
    h = SAMPLING_TIME / FINE
    inertia = np.diag(INERTIA)
    q, v, y = np.zeros(2), np.zeros(2), np.empty((samples, 2))
    for k in range(samples):
        y[k] = q
        for _ in range(FINE):
            twist = q[0] - q[1]
            # The spring of the shaft acts beyond the gap, on either side.
            torque = SHAFT * (twist - np.clip(twist, -GAP, GAP)) + LOSS * (v[0] - v[1])
            drive = u[k] - np.diag(BEARINGS) * v - np.diag(HOLDING) * q - [torque, -torque]
            free = v + h * drive / inertia
            # Dry friction takes what speed is left, and no more.
            held = FRICTION * h / inertia[0]
            free[0] = np.sign(free[0]) * max(abs(free[0]) - held, 0.0)
            v = free
            q = q + h * v
    y = y + NOISE * rng.standard_normal(y.shape)
    units = {"input_units": ("N m", "N m"), "output_units": ("rad", "rad")}
    names = {"input_names": ("torque", "brake"), "output_names": ("motor", "load")}
    return jaxgray.Record(u, y, SAMPLING_TIME, **names, **units)


def shown(found):
    """Title, text, table and curves for the manual's gallery."""
    rows = [["", "hidden", "found ± standard error"]]
    truth = {"Fc": ("friction of the motor", FRICTION, "N m"), "gap": ("half of the play", GAP, "rad")}
    for finding in found.findings:
        for name, one in finding.parameters.items():
            if name in truth:
                words, value, unit = truth[name]
                error = f"{one.value:.5f} ± {one.standard_error:.5f} {unit}"
                rows.append([f"{words}, at {finding.location}", f"{value:g} {unit}", error])
    for name, summary in (("linear model", found.baseline), ("with what was found", found.extended)):
        if summary is not None:
            fits = ", ".join(f"{value:.1f} %" for value in summary.fit_percent["validation"].values())
            rows.append([f"held-out fit of motor, load: {name}", "", fits])
    curve = next(one for one in found.curves if one.held_out)
    part = slice(200, 500)
    time = curve.time[part].tolist()
    panels = []
    for title, pick in (("motor, held out", [1, 0]), ("twist between motor and load, held out", [1, -1])):
        runs = (("measured", "plain", curve.measured), ("linear", "second", curve.baseline))
        runs += (("with friction and play", "law", curve.extended),)
        lines = [{"label": n, "role": r, "x": time, "y": (run[part] @ pick).tolist()} for n, r, run in runs]
        panels.append({"title": title, "x_label": "time [s]", "y_label": "angle [rad]", "curves": lines})
    return {
        "title": "A drive with friction and backlash",
        "text": "Motor and load on a shaft with play, the motor rubbing in its bearings. " + found.sentence,
        "table": rows,
        "panels": panels,
    }


def main(argv=None):
    """Run the example, and return the diagnosis."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=2000, help="of each record (default 2000)")
    parser.add_argument("--seed", type=int, default=1, help="of inputs and noise (default 1)")
    parser.add_argument("--gallery", type=Path, help="file for the manual's gallery (default: none)")
    arguments = parser.parse_args(argv)
    rng = np.random.default_rng(arguments.seed)
    record, validation = (simulated(rng, arguments.samples) for _ in range(2))
    found = jaxgray.diagnose(record, validation=validation, only=LAWS)
    print(found)
    if arguments.gallery is not None:
        keep(shown(found), arguments.gallery)
    return found


if __name__ == "__main__":
    main()
