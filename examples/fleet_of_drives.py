"""A fleet: six drives recorded sixteen times each; in one the friction grows, in another the spring has been replaced.

    python examples/fleet_of_drives.py [--out DIR] [--seed 1] [--gallery FILE]

Every record is a file, identified by itself; then each machine is compared with itself over time. What has changed,
since which record and by how much, is said for the two machines that changed, and nothing of the others. The records
come from small steps written out here.
"""

import argparse
import concurrent.futures
import tempfile
from pathlib import Path

import jax
import numpy as np

import jaxgray
from jaxgray.manual.gallery import keep

jax.config.update("jax_enable_x64", True)

MACHINES, RECORDS, SAMPLES = 6, 16, 1000
MASS, DAMPING, STIFFNESS = 2.0, 6.0, 200.0
SAMPLING_TIME, FINE, NOISE = 0.01, 40, 2e-4
RUBS, REPLACED = 2, 4
"""The machine with growing friction, and the one with another spring; counted from 0."""

BEGINS, FRICTION = 6, 0.2
"""Record from which the friction grows, and what it comes to [N]."""

SINCE, SOFTER = 9, 0.98
"""Record from which the spring is another, and its stiffness over that of the first."""

SECOND_ORDER = (
    "Nothing but friction and that spring was changed: other entries that seem to move are what their change does to "
    "second order, which the comparison, linear about each machine's reference, leaves out."
)


def written(folder, rng):
    """All records as files, simulated side by side."""
    shape = (MACHINES, RECORDS)
    u = np.repeat(rng.uniform(-10, 10, (*shape, SAMPLES // 20)), 20, axis=2)
    friction, stiffness = np.zeros(shape), np.full(shape, STIFFNESS)
    friction[RUBS, BEGINS:] = FRICTION * np.arange(1, RECORDS - BEGINS + 1) / (RECORDS - BEGINS)
    stiffness[REPLACED, SINCE:] *= SOFTER
    h = SAMPLING_TIME / FINE
    q, v, y = np.zeros(shape), np.zeros(shape), np.empty((*shape, SAMPLES))
    for k in range(SAMPLES):
        y[..., k] = q
        for _ in range(FINE):
            free = v + h * (u[..., k] - DAMPING * v - stiffness * (q + 0.5 * h * v)) / MASS
            # Dry friction takes what speed is left, and no more.
            v = np.sign(free) * np.maximum(np.abs(free) - friction * h / MASS, 0.0)
            q = q + h * v
    y += NOISE * rng.standard_normal(y.shape)
    for machine in range(MACHINES):
        for k in range(RECORDS):
            path = folder / f"drive{machine + 1}_2026-01-{k + 1:02d}.npz"
            np.savez(path, force=u[machine, k], position=y[machine, k])


def shown(found):
    """Title, text, table and curves for the manual's gallery."""
    rows = [["machine", "what has changed", "since record", "size ± standard error"]]
    panels = []
    for drift in sorted(found.drifts, key=lambda one: one.machine):
        change = drift.change
        size = f"{change.size:.3g} ± {change.standard_error:.1g}"
        rows.append([drift.machine, drift.title, str(change.begins + 1), size])
        x = list(range(1, RECORDS + 1))
        curves = [{"label": drift.machine, "role": "law", "x": x, "y": drift.estimates.tolist()}]
        for sign in (-1, 1):
            band = drift.estimates + sign * 1.96 * drift.errors
            curves.append({"label": "95 %" if sign > 0 else "", "role": "plain", "x": x, "y": band.tolist()})
        panels.append({"title": drift.title, "x_label": "record", "y_label": "off the reference", "curves": curves})
    return {
        "title": "A fleet of drives",
        "text": f"{MACHINES} drives, {RECORDS} records each. In drive{RUBS + 1} dry friction grows from record "
        f"{BEGINS + 1} to {FRICTION:g} N; drive{REPLACED + 1} has a spring {100 * (1 - SOFTER):.0f} % softer from "
        f"record {SINCE + 1}. " + " ".join(drift.sentence for drift in found.drifts),
        "table": rows,
        "panels": panels[:2],
    }


def main(argv=None):
    """Run the example, and return the fleet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for records and results (default: one that is removed)")
    parser.add_argument("--seed", type=int, default=1, help="of inputs and noise (default 1)")
    parser.add_argument("--gallery", type=Path, help="file for the manual's gallery (default: none)")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as temporary, concurrent.futures.ThreadPoolExecutor(1) as client:
        folder = Path(temporary if arguments.out is None else arguments.out)
        folder.mkdir(parents=True, exist_ok=True)
        written(folder, np.random.default_rng(arguments.seed))
        # Without `client`, processes of this machine start by themselves.
        found = jaxgray.fleet(
            str(folder / "*.npz"),
            inputs="force",
            outputs="position",
            out=folder / "fleet",
            reading={"sampling_time": SAMPLING_TIME},
            machine="{machine}_{when}.npz",
            client=client,
        )
    print(found)
    if arguments.gallery is not None:
        keep(shown(found), arguments.gallery)
    return found


if __name__ == "__main__":
    main()
