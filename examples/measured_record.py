"""A model from a measured file, its resonances held against what the record itself shows without a model.

    python examples/measured_record.py [FILE] [--validation FILE] [--inputs current]
        [--outputs motor_angle,load_angle] [--input-map current:motor_angle] [--hold zero]

The defaults are those of a motor bench with two inertias and a shaft between: a current drives the motor, and
both angles are measured. Without FILE such a bench is simulated by SciPy. Where one input repeats with a
period, the frequency response is also computed without any model: the mean over the periods, and the ratio of
output to input on the lines that are excited; its peaks and dips stand beside those of the model.
"""

import argparse

import jax
import numpy as np
import scipy.signal

import jaxgray
from jaxgray.mechanics.modal_uncertainty import modal_uncertainty

jax.config.update("jax_enable_x64", True)

SAMPLING_TIME = 4e-4
PERIOD = 2500
INERTIA = np.diag([0.0055, 0.0053])
SHAFT = np.array([[1.0, -1.0], [-1.0, 1.0]])
STIFFNESS = 620.0 * SHAFT
DAMPING = np.diag([0.02, 0.02]) + 0.08 * SHAFT
NOISE = 2e-4
"""Of the angles of the simulated bench [rad]; torque is counted in ampere."""

PROMINENCE = np.log(2.0)
"""By how much (natural logarithm) a peak or dip must stand out to be listed."""

WEAK = 0.2
"""Lines whose amplitude is below this share of the largest count as not excited."""


def simulated_bench(rng, samples):
    """A noisy record of the simulated bench: a multisine of 11 to 250 Hz, random phases, period 1 s."""
    phase = rng.uniform(0, 2 * np.pi, 240)
    t = SAMPLING_TIME * np.arange(PERIOD)
    period = np.sum(np.cos(2 * np.pi * np.arange(11, 251) * t[:, None] + phase), axis=1)
    u = np.resize(10 * period / period.std(), (samples, 1))
    zero, one = np.zeros((2, 2)), np.eye(2)
    A = np.block([[zero, one], [-np.linalg.solve(INERTIA, STIFFNESS), -np.linalg.solve(INERTIA, DAMPING)]])
    B = np.vstack([zero[:, :1], np.linalg.inv(INERTIA)[:, :1]])
    system = scipy.signal.cont2discrete((A, B, np.eye(2, 4), zero[:, :1]), SAMPLING_TIME)
    clean = scipy.signal.dlsim(system, u)[1]
    y = clean + NOISE * rng.standard_normal(clean.shape)
    names = {"input_names": ["current"], "output_names": ["motor_angle", "load_angle"]}
    return jaxgray.Record(u, y, SAMPLING_TIME, input_units=["A"], output_units=["rad", "rad"], **names)


def without_model(record):
    """Frequency response from the record alone.

    **Arguments:** `record`, with one input.

    **Returns:** excited lines [Hz] and the complex response (lines × outputs), or None where the input does
    not repeat.
    """
    period = record.detect_period()
    if record.inputs != 1 or period is None:
        return None
    # A drift is no part of any line but leaks into all of them; the first period holds the transient.
    steady = record.detrend("linear", inputs=False)
    skip = 1 if steady.samples // period > 2 else 0
    mean = steady.average_periods(period, skip=skip).record
    U, Y = np.fft.rfft(mean.u[:, 0]), np.fft.rfft(mean.y, axis=0)
    excited = np.abs(U) > WEAK * np.max(np.abs(U[1:]))
    excited[0] = False
    f = np.arange(len(U)) / (period * record.sampling_time)
    return f[excited], Y[excited] / U[excited, None]


def extrema(f, response, measured, sign):
    """Peaks (sign +1) or dips (−1) [Hz] that stand out of a frequency response.

    Looked for in the acceleration, where a free body is flat. Between the lines by the parabola in f² through
    three of |H|⁻² (peaks) or |H|² (dips), which is exact for one mode.
    """
    order = {"displacement": 2, "velocity": 1, "acceleration": 0}[measured]
    level = np.log(np.abs(response)) + order * np.log(f)
    found = []
    for k in scipy.signal.find_peaks(sign * level, prominence=PROMINENCE)[0]:
        near = slice(k - 1, k + 2)
        a, b, _ = np.polyfit(f[near] ** 2 - f[k] ** 2, np.abs(response[near]) ** (-2 * sign), 2)
        vertex = np.sqrt(f[k] ** 2 - b / (2 * a))
        found.append(vertex if f[k - 1] < vertex < f[k + 1] else f[k])
    return np.array(found)


def compared(result, record):
    """Rows (what, where, model, standard error, without model) [Hz] for all that lies in the excited band."""
    model = result.model
    spread = modal_uncertainty(model, result.covariance)
    seen = without_model(record)
    band = (0.0, np.inf) if seen is None else (seen[0][0], seen[0][-1])

    def nearest(value, output, sign):
        if seen is None:
            return np.nan
        listed = extrema(seen[0], seen[1][:, output], model.measured[output], sign)
        return listed[np.argmin(np.abs(listed - value))] if len(listed) else np.nan

    rows = []
    for value, error in zip(model.modes().natural_frequency_hz, spread.natural_frequency_hz):
        if band[0] < value < band[1]:
            rows.append(("resonance", model.output_names[0], value, error, nearest(value, 0, +1)))
    for (source, place), standard_errors in spread.antiresonance_hz.items():
        zeros = model.zeros(input=source, output=place)
        for value, error in zip(zeros.antiresonance_hz, standard_errors):
            if band[0] < value < band[1]:
                other = nearest(value, model.output_names.index(place), -1)
                rows.append(("antiresonance", f"{source} to {place}", value, error, other))
    return rows


def main(argv=None):
    """Run the example.

    **Arguments:** `argv`: as on the command line; default that of the process.

    **Returns:** `result`, the identification, and `rows`, as by `compared`.
    """
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("file", nargs="?", help="measured record; default: a simulated bench")
    parser.add_argument("--validation", help="a second record, not used by the fit")
    parser.add_argument("--inputs", default="current", help="columns, with commas")
    parser.add_argument("--outputs", default="motor_angle,load_angle", help="columns, with commas")
    parser.add_argument("--input-map", default="current:motor_angle", help="where inputs act")
    parser.add_argument("--hold", default="zero", help="the input between samples: zero or linear")
    parser.add_argument("--samples", type=int, default=25_000, help="at most so many are used")
    arguments = parser.parse_args(argv)

    if arguments.file is None:
        rng = np.random.default_rng(1)
        record, validation = (simulated_bench(rng, arguments.samples) for _ in range(2))
        print("No file given: a simulated bench.")
    else:
        options = {
            "inputs": arguments.inputs.split(","),
            "outputs": arguments.outputs.split(","),
            "hold": arguments.hold,
        }
        record = jaxgray.read_record(arguments.file, **options)[: arguments.samples]
        validation = None
        if arguments.validation is not None:
            validation = jaxgray.read_record(arguments.validation, **options)
    print(record)
    result = jaxgray.identify(record, validation=validation, input_map=arguments.input_map)
    print(result)
    print()
    print(result.model.modes())

    rows = compared(result, record)
    print(f"\n{'in the excited band':50s}{'model [Hz], 95 % interval':>34s}{'without model [Hz]':>22s}")
    for what, where, value, error, other in rows:
        interval = f"{value:.3f} ({value - 1.96 * error:.3f} to {value + 1.96 * error:.3f})"
        print(f"{what + ', ' + where:50s}{interval:>34s}" + ("" if np.isnan(other) else f"{other:22.2f}"))
    return {"result": result, "rows": rows}


if __name__ == "__main__":
    main()
