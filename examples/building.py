"""A building of two floors on a shaken base, with a friction damper in its first storey that the model does not know.

    python examples/building.py [--samples 2000] [--seed 1] [--gallery FILE]

Measured are the acceleration of the base and the displacements of both floors relative to it. The record comes from
small steps written out here: in each, dry friction takes what speed is left, and no more. One known mass sets the
scale, which base motion leaves open. To be quick, the diagnosis weighs the laws that storeys have; without `only` it
weighs all.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
import scipy.signal

import jaxgray
from jaxgray.manual.gallery import keep

jax.config.update("jax_enable_x64", True)

MASS = np.diag([120.0, 100.0])
"""Of the floors [t]."""

STOREYS = np.array([30.0e3, 24.0e3])
"""Stiffness of the storeys [kN/m]."""

LOSS = 0.0008
"""Damping over stiffness [s]."""

STIFFNESS = np.array([[STOREYS.sum(), -STOREYS[1]], [-STOREYS[1], STOREYS[1]]])
FRICTION = 20.0
"""Of the damper in the first storey [kN]."""

SAMPLING_TIME, FINE = 0.01, 40
NOISE = 2e-5
"""Of the displacements [m]."""

LAWS = (
    "coulomb_friction",
    "quadratic_drag",
    "cubic_stiffness",
    "bilinear_stiffness",
    "bouc_wen_hysteresis",
    "end_stop",
)


def simulated(rng, samples):
    """A record of both floors under band-limited noise at the base, linear between samples."""
    band = scipy.signal.butter(2, [0.5, 8.0], "bandpass", fs=1 / SAMPLING_TIME, output="sos")
    a = scipy.signal.sosfilt(band, rng.standard_normal(samples + 500))[500:]
    a *= 1.0 / a.std()
    h = SAMPLING_TIME / FINE
    mass = np.diag(MASS)
    fine = np.interp(np.arange(samples * FINE) / FINE, np.arange(samples), a)
    q, v, y = np.zeros(2), np.zeros(2), np.empty((samples, 2))
    for k in range(samples * FINE):
        if k % FINE == 0:
            y[k // FINE] = q
        # Semi-implicit, the base as it is in the middle of the step.
        pull = -STIFFNESS @ (q + 0.5 * h * v) - LOSS * STIFFNESS @ v
        v = v + h * (pull / mass - 0.5 * (fine[k] + fine[min(k + 1, len(fine) - 1)]))
        v[0] = np.sign(v[0]) * max(abs(v[0]) - FRICTION * h / mass[0], 0.0)
        q = q + h * v
    y = y + NOISE * rng.standard_normal(y.shape)
    names = {"input_names": ("base",), "output_names": ("floor1", "floor2")}
    units = {"input_units": ("m/s^2",), "output_units": ("m", "m")}
    return jaxgray.Record(a, y, SAMPLING_TIME, hold="linear", **names, **units)


def shown(found):
    """Title, text, table and curves for the manual's gallery."""
    rows = [["fit of the free run, held out", "floor1", "floor2"]]
    for name, summary in (("linear model", found.baseline), ("with what was found", found.extended)):
        if summary is not None:
            rows.append([name, *(f"{value:.1f} %" for value in summary.fit_percent["validation"].values())])
    for finding in found.findings:
        if "Fc" in finding.parameters:
            one = finding.parameters["Fc"]
            value = f"{one.value:.2f} ± {one.standard_error:.2f} kN"
            rows.append([f"friction at {finding.location} (hidden: {FRICTION:g} kN)", value, ""])
    names = ("floor1", "floor2")
    modes = found.extended.model if found.extended is not None else found.baseline.model
    frequencies = modes.modes().natural_frequency_hz
    true = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)).real)) / (2 * np.pi)
    rows += [[f"mode {k + 1} (true: {true[k]:.4f} Hz)", f"{frequencies[k]:.4f} Hz", ""] for k in range(2)]
    curve = next(one for one in found.curves if one.held_out)
    part = slice(100, 500)
    panels = []
    for k in (0, 1):
        runs = (("measured", "plain", curve.measured), ("linear", "second", curve.baseline))
        runs += (("with friction", "law", curve.extended),)
        time = curve.time[part].tolist()
        lines = [{"label": n, "role": r, "x": time, "y": (1e3 * run[part, k]).tolist()} for n, r, run in runs]
        axes = {"title": f"{names[k]} over the base, held out", "x_label": "time [s]", "y_label": "displacement [mm]"}
        panels.append(axes | {"curves": lines})
    return {
        "title": "A building on a shaken base",
        "text": "Two floors on a base that shakes, and a friction damper in the first storey that is in no drawing. "
        + found.sentence,
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
    found = jaxgray.diagnose(
        record,
        validation=validation,
        excitation="base-acceleration",
        relative=True,
        fix="mass[0,0]=120, mass[0,1]=0",
        only=LAWS,
    )
    print(found)
    if arguments.gallery is not None:
        keep(shown(found), arguments.gallery)
    return found


if __name__ == "__main__":
    main()
